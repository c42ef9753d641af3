"""A photo's reflectance packed for a page: images, arrays and tables, in one JSON document."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull

from facerf_cli import strips
from facerf_cli.colour import (
    AUTO_EXPOSURE_PERCENTILE,
    FACE_PERCENTILE,
    MOST_OVER_FRONT_EV,
    linear_to_srgb,
    luminance,
)
from facerf_cli.composite import Composition
from facerf_cli.face.crop import Crop
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait_field import PortraitField
from facerf_cli.viewer.arrays import ArrayPack
from facerf_cli.viewer.decoder_arrays import add_decoder
from facerf_cli.viewer.person_arrays import add_detail, add_person, add_shadow_rays
from facerf_cli.viewer.stage import StageTextures, atlas
from facerf_cli.whole_person import WholePerson

_MAP_QUALITY, _STRIP_QUALITY = 88, 82
_HEAD_RADIUS = 0.55  # of a head, in sides of the crop around its face
_SURE = 0.5  # share from which on a pixel is skin, or the person's
_STEPS_16 = 65535


@dataclass(frozen=True, eq=False)
class PageMap:
    """An environment map of a page: lat-long [h, 2 h, 3], and the command that draws it."""

    name: str
    pixels: np.ndarray
    command: str
    path: str  # that the command writes


def packed(
    photo: np.ndarray, crop: Crop, field: PortraitField, composition: Composition, maps: Sequence[PageMap]
) -> dict[str, Any]:
    """The document of a page: all that its script needs, without names.

    `composition` is that of the photo [H, W, 3], of which the page shows at most 8 bits of sRGB.
    """
    whole, detail = composition.surround, composition.detail
    assert isinstance(whole, WholePerson) and detail is not None
    pack = ArrayPack()
    person = add_person(pack, field, whole)
    add_shadow_rays(pack, field)
    person |= add_detail(pack, detail, field) | {"guideGain": float(2.0**composition.guide_ev)}
    decoder = add_decoder(pack, field.field)
    stage = StageTextures.of(field.field)
    tiles, scales, columns, tile = atlas(stage.maps)
    matte = composition.matte
    return {
        "size": [matte.shape[1], matte.shape[0]],
        "head": _head(matte, crop),
        "photo": _lossless(_encoded(photo)),
        "fringe": _lossless(_fringe(strips.whole(composition.own), matte)),
        "matte": _png(np.round(matte * 255).astype(np.uint8)),
        "window": _add_window(pack, composition),
        "person": person,
        "decoder": decoder,
        "exposure": _exposure(field, whole),
        "stage": {
            "directions": _floats(stage.directions),
            "coefficients": _floats(stage.coefficients),
            "triangles": _bytes(ConvexHull(stage.directions.astype(float)).simplices.astype("<u2").tobytes()),
            "tile": tile,
            "columns": columns,
            "scales": scales,
        },
        "maps": _jpeg(tiles, _MAP_QUALITY),
        "envmaps": [_envmap(one) for one in maps],
        **pack.document(),
    }


def _add_window(pack: ArrayPack, composition: Composition) -> list[int]:
    """Add where the face is in the photo: (u, v) and its soft mask; return left, top, width, height."""
    view = composition.view
    mask = composition.face_share(slice(0, len(view.mask))) * view.coverage.numpy()
    planes = [view.uv[..., 0].numpy(), view.uv[..., 1].numpy(), mask]
    steps = [np.round(plane.clip(0, 1) * _STEPS_16).astype(np.uint16) for plane in planes]
    pack.add("window", np.stack(steps), "index")
    height, width = view.mask.shape
    return [view.left, view.top, width, height]


def _fringe(own: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """The person's colours as 8-bit sRGB where they are mixed with the background, black elsewhere."""
    mixed = (matte > 0) & (matte < 1)
    return np.where(mixed[..., None], _encoded(own), 0).astype(np.uint8)


def _head(matte: np.ndarray, crop: Crop) -> list[float]:
    """The middle of the face as shares of the photo's sides, and the radius of the head in the shorter."""
    height, width = matte.shape
    middle = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    return [middle[0] / width, middle[1] / height, _HEAD_RADIUS * crop.side_px / min(height, width)]


def _exposure(field: PortraitField, whole: WholePerson) -> dict[str, Any]:
    """Brightness of the photo, with which `anchored_exposure_ev` compares a relit person."""
    plate = luminance(field.person.image.permute(1, 2, 0).numpy())
    skin = field.person.classes[class_index("skin")].numpy() > _SURE

    def brighter(mask: np.ndarray, percentile: float) -> float:
        return float(np.percentile(plate[mask], percentile)) if mask.any() else 0.0

    return {
        "mostOverFront": MOST_OVER_FRONT_EV,
        "percentiles": [FACE_PERCENTILE, AUTO_EXPOSURE_PERCENTILE],
        "wanted": brighter(skin, FACE_PERCENTILE),
        "own": brighter(whole.own.numpy() > _SURE, AUTO_EXPOSURE_PERCENTILE),
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


def _lossless(data: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "WEBP", lossless=True, quality=60, method=4, exact=True)
    return _bytes(stream.getvalue())


def _png(data: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "PNG", optimize=True)
    return _bytes(stream.getvalue())


def _floats(values: np.ndarray) -> str:
    return _bytes(values.astype("<f4").tobytes())


def _bytes(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
