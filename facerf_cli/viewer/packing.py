"""A light basis packed for a page: images as JPEG and PNG, tables as base64, in one JSON document."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from facerf_cli.colour import (
    AUTO_EXPOSURE_PERCENTILE,
    FACE_PERCENTILE,
    linear_to_srgb,
    luminance,
)
from facerf_cli.light.sphere import RIG_LIGHTS, rig_directions
from facerf_cli.viewer.basis import ExposureSamples, LightBasis, brightness_of

_EXPOSURE_RANK = 64  # factors of the samples of exposure
_PHOTO_QUALITY, _MAP_QUALITY, _STRIP_QUALITY = 93, 90, 82
_TILE = 8  # a JPEG's blocks: tiles of the atlas begin on them
_ZERO, _STEPS = 128, 127  # the byte of 0 in a map, and that of its scale above it
_HEAD_RADIUS = 0.55  # of a head, in sides of the crop around its face
_BRIGHTEST = 99.9  # percentile of the detail that is white in its image


@dataclass(frozen=True, eq=False)
class PageMap:
    """An environment map of a page: lat-long [h, 2 h, 3], and the command that draws it."""

    name: str
    pixels: np.ndarray
    command: str
    path: str  # that the command writes


def packed(basis: LightBasis, maps: Sequence[PageMap]) -> dict[str, Any]:
    """The document of a page: all that its script needs, without names."""
    gain = max(float(np.percentile(basis.detail[basis.matte > 0.5], _BRIGHTEST)), 1e-6)
    shown = np.where(basis.matte[..., None] > 0, basis.detail / gain, 0.18)
    atlas, scales, columns, tile = _atlas(basis.maps)
    box = basis.box
    return {
        "size": [basis.matte.shape[1], basis.matte.shape[0]],
        "box": [box.left, box.top, box.width, box.height],
        "mapSize": [basis.maps.shape[2], basis.maps.shape[1]],
        "tile": tile,
        "columns": columns,
        "scales": scales,
        "gain": gain,
        "head": _head(basis),
        "photo": _jpeg(_encoded(basis.photo), _PHOTO_QUALITY),
        "background": _jpeg(_encoded(basis.background), _PHOTO_QUALITY),
        "detail": _jpeg(_encoded(shown), _PHOTO_QUALITY),
        "matte": _png(np.round(basis.matte * 255).astype(np.uint8)),
        "maps": _jpeg(atlas, _MAP_QUALITY),
        "directions": _floats(basis.directions),
        "triangles": _bytes(basis.triangles.astype("<u2").tobytes()),
        "coefficients": _floats(basis.coefficients),
        "stage": _floats(rig_directions(RIG_LIGHTS).numpy()),
        "exposure": _exposure(basis.samples, basis.coefficients),
        "envmaps": [_envmap(one) for one in maps],
    }


def _atlas(maps: np.ndarray) -> tuple[np.ndarray, list[float], int, list[int]]:
    """Maps [K, h, w, 3] as bytes side by side, their scales, tiles in a row, and a tile's size."""
    count, height, width = maps.shape[:3]
    tile_h, tile_w = (-(-side // _TILE) * _TILE for side in (height, width))
    columns = max(1, round(math.sqrt(count * tile_h / tile_w)))
    atlas = np.full((-(-count // columns) * tile_h, columns * tile_w, 3), _ZERO, np.uint8)
    scales = [max(float(np.abs(one).max()), 1e-9) for one in maps]
    for index, (one, scale) in enumerate(zip(maps, scales, strict=True)):
        data = np.round(_ZERO + _STEPS * one / scale).astype(np.uint8)
        top, left = index // columns * tile_h, index % columns * tile_w
        atlas[top : top + tile_h, left : left + tile_w] = np.pad(
            data, ((0, tile_h - height), (0, tile_w - width), (0, 0)), mode="edge"
        )
    return atlas, scales, columns, [tile_w, tile_h]


def _head(basis: LightBasis) -> list[float]:
    """The middle of the face as shares of the photo's sides, and the radius of the head in the shorter."""
    height, width = basis.matte.shape
    crop = basis.crop
    middle = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    return [middle[0] / width, middle[1] / height, _HEAD_RADIUS * crop.side_px / min(height, width)]


def _exposure(samples: ExposureSamples, coefficients: np.ndarray) -> dict[str, Any]:
    """Factors [K, n, 3] of the samples as bytes, and what `anchored_exposure_ev` compares them with."""
    brightness = brightness_of(samples)[:, None]  # by which `factored` weighs the lights
    inverse = ((coefficients / brightness).T / brightness.T)[:_EXPOSURE_RANK]

    def factors(points: np.ndarray) -> dict[str, Any]:
        factor = np.einsum("kl,lnc->knc", inverse, points)
        scales = np.maximum(np.abs(factor).reshape(len(factor), -1).max(1, initial=0), 1e-9)
        data = np.round(factor / scales[:, None, None] * _STEPS).astype(np.int8)
        return {"count": points.shape[1], "scales": scales.tolist(), "factors": _bytes(data.tobytes())}

    def brighter(plate: np.ndarray, percentile: float) -> float:
        return float(np.percentile(luminance(plate), percentile)) if len(plate) else 0.0

    return {
        "skin": factors(samples.skin),
        "person": factors(samples.person),
        "percentiles": [FACE_PERCENTILE, AUTO_EXPOSURE_PERCENTILE],
        "wanted": brighter(samples.plate_skin, FACE_PERCENTILE),
        "own": brighter(samples.plate_person, AUTO_EXPOSURE_PERCENTILE),
    }


def _envmap(one: PageMap) -> Mapping[str, Any]:
    return {
        "name": one.name,
        "size": [one.pixels.shape[1], one.pixels.shape[0]],
        "pixels": _bytes(one.pixels.astype("<f2").tobytes()),
        "command": one.command,
        "path": one.path,
    }


def strip_jpeg(images: Sequence[np.ndarray]) -> str:
    """Images [h, w, 3], encoded 0..1, side by side as a JPEG in base64."""
    whole = np.concatenate(list(images), 1)
    return _jpeg(np.round(whole.clip(0, 1) * 255).astype(np.uint8), _STRIP_QUALITY)


def _encoded(linear: np.ndarray) -> np.ndarray:
    """Scene-linear [H, W, 3] as 8-bit sRGB."""
    data: np.ndarray = np.round(linear_to_srgb(np.clip(linear, 0, 1)) * 255).astype(np.uint8)
    return data


def _jpeg(data: np.ndarray, quality: int) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "JPEG", quality=quality, subsampling=0, optimize=True)
    return _bytes(stream.getvalue())


def _png(data: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "PNG", optimize=True)
    return _bytes(stream.getvalue())


def _floats(values: np.ndarray) -> str:
    return _bytes(values.astype("<f4").tobytes())


def _bytes(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
