"""The page of a person under movable lights: one HTML file with style, script and data."""

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
    AMBIENT_OVER_BRIGHT,
    AMBIENT_OVER_DARK,
    DELIGHT,
    ORIGINAL,
    WORDS,
    lit_images,
    preset_names,
)
from facerf_cli.light.envmap import rig_triangles
from facerf_cli.viewer.basis import Basis, LightSamples

_HERE = Path(__file__).parent
SCRIPTS = ("light.js", "lights.js", "readers.js", "image.js", "page.js")
_RATIO_QUALITY, _PHOTO_QUALITY, _STRIP_QUALITY = 90, 97, 82


@dataclass(frozen=True, eq=False)
class PageMap:
    """An environment map of a page: lat-long [h, 2 h, 3], and the command that draws it to `path`."""

    name: str
    pixels: np.ndarray
    command: str
    path: str


@dataclass(frozen=True, eq=False)
class Plate:
    """Further images [H, W, ...] of a page: the photo (`before`), the matte, the photo without its person.

    `uniform_intensity` is the intensity of uniform light that makes skin as bright as in the photo.
    """

    before: np.ndarray
    matte: np.ndarray
    background: np.ndarray | None = None
    uniform_intensity: float = 1.0


@dataclass(frozen=True)
class IndexEntry:
    """A page in an index: its title, its address relative to the index, and its strip (JPEG, base64)."""

    title: str
    address: str
    strip: str


def packed(basis: Basis, plate: Plate, head: Sequence[float], maps: Sequence[PageMap]) -> dict[str, Any]:
    """Return the data of a page's script.

    `head` is the face's centre relative to the sides, and the head's radius relative to the shorter side.
    """
    height, width = plate.matte.shape
    background = np.zeros_like(plate.before) if plate.background is None else plate.background
    # Ambient fill over bright and dark backgrounds; OLAT stacks have none.
    ambient = {"bright": AMBIENT_OVER_BRIGHT, "dark": AMBIENT_OVER_DARK}
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
        "ambient": ambient if len(basis.ratios) > len(basis.directions) else None,
        "matte": _webp(np.round(plate.matte * 255).astype(np.uint8)),
        "exposure": _exposure(basis.samples),
        **packed_lights(plate.background is not None, plate.uniform_intensity),
        "envmaps": [
            {
                "name": envmap.name,
                "size": [envmap.pixels.shape[1], envmap.pixels.shape[0]],
                "pixels": _floats(envmap.pixels),
                "command": envmap.command,
                "path": envmap.path,
            }
            for envmap in maps
        ],
    }


def _triangles(directions: np.ndarray) -> dict[str, str]:
    """Return the triangles of lights between which a page interpolates.

    A triangle's matrix converts a direction to weights of its lights, up to their sum.
    """
    corners = rig_triangles(directions)
    to_shares = np.linalg.pinv(directions[corners].astype(float).mT)
    return {"triangles": _bytes(corners.astype("<u2").tobytes()), "shares": _floats(to_shares)}


def packed_lights(of_photo: bool, uniform_intensity: float = 1.0) -> dict[str, Any]:
    """Return the light of each word, and the named lights of each shipped rig.

    `original` and `delight` are included only `of_photo`; `delight` is uniform light of `uniform_intensity`.
    """
    words = {word: light for word, light in WORDS.items() if of_photo or word not in (ORIGINAL, DELIGHT)}
    if of_photo:
        words[DELIGHT] = replace(words[DELIGHT], rgb=(uniform_intensity,) * 3)
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
    """Return sample pixels for automatic exposure, and their target.

    Luminances are encoded as an image of square roots, with one row and one scale per light.
    """
    person = samples.person
    values = np.pad(person.luminances.clip(min=0), ((0, 0), (0, not person.luminances.size)))  # not empty
    scales = np.maximum(values.max(1), 1e-9)
    return {
        "face": None if samples.face is None else _floats(samples.face),
        "person": {
            "roots": _webp(np.round(255 * np.sqrt(values / scales[:, None])).astype(np.uint8)),
            "scales": scales.tolist(),
            "shares": _floats(person.shares),
            "total": person.total,
        },
        "plate": samples.plate,
        "personPercentile": AUTO_EXPOSURE_PERCENTILE,
        "target": AUTO_EXPOSURE_TARGET_LINEAR,
        "mostOverFront": MOST_OVER_FRONT_EV,
    }


def page(title: str, photo: Sequence[str], document: Mapping[str, Any], strip: str, key: str = "") -> str:
    """Return the HTML of a page.

    `photo` is its path and options on a command line; `document` is from `packed`, `strip` from `strip_jpeg`.
    """
    data = json_text({**document, "title": title, "source": shlex.join(photo)}).replace("<", "\\u003c")
    script = '"use strict";\n' + "".join(map(_text, SCRIPTS))
    return _filled("page.html", script, title=title, data=data, strip=strip, key=key)


def index_page(entries: Sequence[IndexEntry]) -> str:
    """Return the HTML of a list of pages, with their strips."""
    return _filled("index.html", "", entries=entries)


def strip_of(text: str) -> str:
    """Return the strip of a written page; '' without one."""
    _, marker, rest = text.partition('<meta name="facerf:strip" content="')
    return rest.partition('"')[0] if marker else ""


def strip_jpeg(images: Sequence[np.ndarray]) -> str:
    """Return images [h, w, 3], encoded 0..1, side by side as a JPEG in base64."""
    return _jpeg(np.round(np.concatenate(list(images), 1).clip(0, 1) * 255).astype(np.uint8), _STRIP_QUALITY)


def _filled(name: str, script: str, **values: Any) -> str:
    style = _text("page.css")
    hashes = {"style_hash": _hash(style), "script_hash": _hash(script)}
    return filled_page(_HERE / name, style=style, script=script, **hashes, **values)


def _hash(text: str) -> str:
    """Return the hash of an inline element for a content security policy."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") + "'"


def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.asarray(np.round(linear_to_srgb(np.clip(linear, 0, 1)) * 255), np.uint8)


def _jpeg(data: np.ndarray, quality: int) -> str:
    return _image(data, "JPEG", quality=quality, subsampling=0, optimize=True)


def _webp(data: np.ndarray) -> str:
    return _image(data, "WEBP", lossless=True, quality=60, method=4, exact=True)


def _image(data: np.ndarray, form: str, **settings: Any) -> str:
    stream = io.BytesIO()
    Image.fromarray(data).save(stream, form, **settings)
    return _bytes(stream.getvalue())


def _floats(values: np.ndarray) -> str:
    return _bytes(np.ascontiguousarray(values, "<f4").tobytes())


def _bytes(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
