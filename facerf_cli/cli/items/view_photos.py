"""The pages of photos, and the list of them."""

import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.photos import FittedFace, facts_of, fit_faces, load_models_once, read_photo
from facerf_cli.colour import linear_to_srgb
from facerf_cli.composite import Composition
from facerf_cli.face.head import Head
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.models import Models
from facerf_cli.pipeline import composition_of, reflectance_of, relit_by
from facerf_cli.portrait_field import PortraitField
from facerf_cli.resize import fitted, resized, shrunk_photo
from facerf_cli.synth.sky.skies import KINDS, draw_sky
from facerf_cli.viewer.packing import PageMap, packed, strip_jpeg
from facerf_cli.viewer.page import IndexEntry, index_page, page, strip_of

if TYPE_CHECKING:
    from facerf_cli.cli.view import MakePage

_MAP_WIDTH_PX, _DRAWN_WIDTH_PX = 64, 512
_STRIP_PX = 160  # longer side of an image of the strip
_STRIP_LIGHTS = ((-60.0, 15.0), (20.0, 30.0), (150.0, 15.0))  # azimuth and elevation, degrees


def write_pages(item: Item, work: "MakePage") -> tuple[list[Path], dict[str, Any]]:
    """Write a page for each chosen face of a photo; their paths, and facts for the report."""
    image = read_photo(item, work.photo)
    faces = fit_faces(item, image, work.photo)
    models = load_models_once(work.photo)
    paths = []
    for face in reversed(faces):  # the first one's page marks the photo as finished
        path = item.output(face.tag + ".html")
        write_page(path, item, models, image.pixels, face, work.size_px)
        paths.append(path)
    return paths[::-1], facts_of(faces)


def write_page(
    path: Path, item: Item, models: Models, photo: np.ndarray, face: FittedFace, size_px: int
) -> None:
    """Write the page of a face of a photo [H, W, 3], shown with `size_px` pixels at most."""
    photo, head = shrunk_photo(photo, face.head, size_px)
    field = portrait_field_of(models, head, photo)
    composition = composition_of(models, photo, head, field)
    document = packed(photo, head.fit.crop, field, composition, page_maps())
    title = Path(item.name).name + face.tag.replace("_", " ")
    text = page(title, str(item.input_path), document, _strip(photo, head, field, composition))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_index(path: Path, items: Sequence[Item], work: "MakePage") -> None:
    """Write the list of all pages that exist, and print its path."""
    entries = []
    for item in items:
        for made in sorted(item.output_base.parent.glob(f"{_escaped(item.output_base.name)}*.html")):
            tag = made.stem.removeprefix(item.output_base.name)
            if tag == "" if work.photo.face != "all" else tag.startswith("_face"):
                address = made.relative_to(path.parent).as_posix()
                strip = strip_of(made.read_text(encoding="utf-8"))
                entries.append(IndexEntry(item.name + tag.replace("_", " "), address, strip))
    with atomic_path(path) as temporary:
        temporary.write_text(index_page(entries), encoding="utf-8")
    print(path, flush=True)


@cache
def page_maps() -> tuple[PageMap, ...]:
    """A procedural map of each kind, small, with the command that draws it."""
    found = []
    for kind in KINDS:
        pixels, _ = draw_sky(0, 0, _DRAWN_WIDTH_PX, (kind,))
        step = _DRAWN_WIDTH_PX // _MAP_WIDTH_PX
        small = pixels.reshape(_MAP_WIDTH_PX // 2, step, _MAP_WIDTH_PX, step, 3).mean((1, 3))
        command = f"facerf envmap --kind {shlex.quote(kind)} --count 1 -o maps"
        found.append(PageMap(kind, small, command, f"maps/00000_{kind}.exr"))
    return tuple(found)


def portrait_field_of(models: Models, head: Head, photo: np.ndarray) -> PortraitField:
    """The reflectance of a photo's person."""
    field = reflectance_of(models, head, "portrait", photo=photo)
    assert isinstance(field, PortraitField)
    return field


def _strip(photo: np.ndarray, head: Head, field: PortraitField, composition: Composition) -> str:
    """The photo and the person under a few lights, small and side by side."""
    height, width = fitted(photo.shape[0], photo.shape[1], _STRIP_PX)
    images = [photo]
    for light in _STRIP_LIGHTS:
        toward = azel_to_direction(*light)[None].float()
        relit = next(relit_by(composition, head, field, toward, torch.ones(1, 1, 3)))
        ev = composition.exposure_ev(relit, "auto")
        images.append(composition.image(relit, ev).pixels * np.float32(2.0**ev))
    return strip_jpeg([linear_to_srgb(resized(image.clip(0, 1), height, width)) for image in images])


def _escaped(name: str) -> str:
    """A name in a pattern of files."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)
