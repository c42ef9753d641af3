"""The page of a person under moving lights: one file of HTML, style, script and data that loads nothing."""

import base64
import hashlib
import io
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from facerf_cli.files.documents import json_text
from facerf_cli.files.sheets import filled_page
from facerf_cli.image.colour import (
    AUTO_EXPOSURE_PERCENTILE,
    AUTO_EXPOSURE_TARGET_LINEAR,
    MOST_OVER_FRONT_EV,
    linear_to_srgb,
)
from facerf_cli.light.entries import (
    EVEN,
    ROOM_BEFORE_BRIGHT,
    ROOM_BEFORE_DARK,
    WORDS,
    lit_images,
    preset_names,
)
from facerf_cli.light.envmap import rig_triangles
from facerf_cli.viewer.basis import Basis, Brightest, LightSamples

_HERE = Path(__file__).parent
SCRIPTS = ("light.js", "lights.js", "readers.js", "image.js", "page.js")
_RATIO_QUALITY, _PHOTO_QUALITY, _STRIP_QUALITY = 90, 97, 82


@dataclass(frozen=True, eq=False)
class PageMap:
    """An environment map of a page: lat-long [h, 2 h, 3], and the command that draws it."""

    name: str
    pixels: np.ndarray
    command: str
    path: str  # that the command writes


@dataclass(frozen=True, eq=False)
class Plate:
    """Images that a page shows besides its basis: all [H, W, ...].

    `before` is the photo, or what stands for it; `background` the photo without its person, if it is shown;
    `even` the brightness of even light by which skin is as bright as in the photo.
    """

    before: np.ndarray
    matte: np.ndarray
    background: np.ndarray | None = None
    even: float = 1.0


@dataclass(frozen=True)
class IndexEntry:
    """A page in an index: its title, its address relative to the index, and its strip (JPEG, base64)."""

    title: str
    address: str
    strip: str


def packed(basis: Basis, plate: Plate, head: Sequence[float], maps: Sequence[PageMap]) -> dict[str, Any]:
    """The document of a page: all that its script needs, without names.

    `head` is the middle of the face as shares of the sides, and the radius of the head in the shorter one.
    """
    height, width = plate.matte.shape
    background = np.zeros_like(plate.before) if plate.background is None else plate.background
    # Shares of a room's light, before a bright background and before a dark one; an OLAT stack has no room.
    room = {"bright": ROOM_BEFORE_BRIGHT, "dark": ROOM_BEFORE_DARK}
    return {
        "size": [width, height],
        "small": [basis.ratios.shape[2], basis.ratios.shape[1]],
        "head": list(head),
        "directions": _floats(basis.directions),
        **_triangles(basis.directions),
        "ratios": [_jpeg(ratio, _RATIO_QUALITY) for ratio in basis.ratios],
        "scales": basis.scales.tolist(),
        "guide": _webp(basis.guide),
        "white": basis.white,
        "photo": _jpeg(_encoded(plate.before), _PHOTO_QUALITY),
        "plate": _webp(_encoded(background)),
        "background": plate.background is not None,
        "room": room if len(basis.ratios) > len(basis.directions) else None,
        "matte": _webp(np.round(plate.matte * 255).astype(np.uint8)),
        "exposure": _exposure(basis.samples),
        **packed_lights(plate.background is not None, plate.even),
        "envmaps": [
            {
                "name": one.name,
                "size": [one.pixels.shape[1], one.pixels.shape[0]],
                "pixels": _floats(one.pixels),
                "command": one.command,
                "path": one.path,
            }
            for one in maps
        ],
    }


def _triangles(directions: np.ndarray) -> dict[str, str]:
    """Lights of the triangles between which a page interpolates; none where they surround nothing.

    The matrix of a triangle turns a direction into shares of its lights, up to their sum.
    """
    corners = rig_triangles(directions)
    to_shares = np.linalg.pinv(directions[corners].astype(float).mT)
    return {"triangles": _bytes(corners.astype("<u2").tobytes()), "shares": _floats(to_shares)}


def packed_lights(of_photo: bool, even: float = 1.0) -> dict[str, Any]:
    """The light of each word, and those of each shipped rig, with names.

    The photo's own, and even light of a brightness, only `of_photo`.
    """
    words = {word: light for word, light in WORDS.items() if of_photo or not (light.own or light.even)}
    if of_photo:
        words[EVEN] = replace(words[EVEN], rgb=(even, even, even))
    images = {preset: lit_images([preset])[0] for preset in preset_names()}
    return {
        "words": {word: asdict(light) for word, light in words.items()},
        "presets": {
            preset: [
                {"name": name, **asdict(light)}
                for name, light in zip(image.names, *image.frames, strict=True)
            ]
            for preset, image in images.items()
        },
    }


def _exposure(samples: LightSamples) -> dict[str, Any]:
    """Pixels by which a page chooses its exposure, and what it compares them with."""
    return {
        "face": None if samples.face is None else _floats(samples.face),
        "person": _brightest(samples.person),
        "plate": samples.plate,
        "personPercentile": AUTO_EXPOSURE_PERCENTILE,
        "target": AUTO_EXPOSURE_TARGET_LINEAR,
        "mostOverFront": MOST_OVER_FRONT_EV,
    }


def _brightest(some: Brightest) -> dict[str, Any]:
    """Luminances as an image of their square roots, a row a light, each by its own scale."""
    values = np.pad(some.luminances.clip(min=0), ((0, 0), (0, not some.luminances.size)))  # none is no image
    scales = np.maximum(values.max(1), 1e-9)
    return {
        "roots": _webp(np.round(255 * np.sqrt(values / scales[:, None])).astype(np.uint8)),
        "scales": scales.tolist(),
        "shares": _floats(some.shares),
        "total": some.total,
    }


def page(title: str, photo: Sequence[str], document: Mapping[str, Any], strip: str, key: str = "") -> str:
    """Return the page of a photo.

    `photo` is its path and options on a command line, `strip` a JPEG in base64, `key` that of `-o FILE`.
    """
    data = json_text({**document, "title": title, "source": shlex.join(photo)}).replace("<", "\\u003c")
    script = '"use strict";\n' + "".join(map(_text, SCRIPTS))
    return _filled("page.html", script, title=title, data=data, strip=strip, key=key)


def index_page(entries: Sequence[IndexEntry]) -> str:
    """A page of links to pages, each with its strip."""
    return _filled("index.html", "", entries=entries)


def strip_of(text: str) -> str:
    """The strip of a page that was written; empty where it holds none."""
    _, found, rest = text.partition('<meta name="facerf:strip" content="')
    return rest.partition('"')[0] if found else ""


def strip_jpeg(images: Sequence[np.ndarray]) -> str:
    """Images [h, w, 3], encoded 0..1, side by side as a JPEG in base64."""
    whole = np.concatenate(list(images), 1)
    return _jpeg(np.round(whole.clip(0, 1) * 255).astype(np.uint8), _STRIP_QUALITY)


def _filled(name: str, script: str, **values: Any) -> str:
    style = _text("page.css")
    hashes = {"style_hash": _hash(style), "script_hash": _hash(script)}
    return filled_page(_HERE / name, style=style, script=script, **hashes, **values)


def _hash(text: str) -> str:
    """The name of an inline element in a content security policy."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") + "'"


def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _encoded(linear: np.ndarray) -> np.ndarray:
    """Scene-linear [H, W, 3] as 8-bit sRGB."""
    data: np.ndarray = np.round(linear_to_srgb(np.clip(linear, 0, 1)) * 255).astype(np.uint8)
    return data


def _jpeg(data: np.ndarray, quality: int) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "JPEG", quality=quality, subsampling=0, optimize=True)
    return _bytes(stream.getvalue())


def _webp(data: np.ndarray) -> str:
    """An image without loss."""
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, "WEBP", lossless=True, quality=60, method=4, exact=True)
    return _bytes(stream.getvalue())


def _floats(values: np.ndarray) -> str:
    return _bytes(np.ascontiguousarray(values, "<f4").tobytes())


def _bytes(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
