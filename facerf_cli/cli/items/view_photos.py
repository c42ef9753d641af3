"""The pages of photos, and the list of them."""

import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.photos import facts_of, fit_faces, load_models_once, read_photo
from facerf_cli.colour import linear_to_srgb
from facerf_cli.files.atomic import atomic_path
from facerf_cli.resize import fitted, resized, shrunk_photo
from facerf_cli.synth.sky.skies import KINDS, draw_sky
from facerf_cli.viewer.basis import BasisSettings, LightBasis, light_basis
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
        photo, head = shrunk_photo(image.pixels, face.head, work.size_px)
        basis = light_basis(models, photo, head, BasisSettings(lights=work.lights))
        path = item.output(face.tag + ".html")
        title = Path(item.name).name + face.tag.replace("_", " ")
        text = page(title, str(item.input_path), packed(basis, page_maps()), _strip(photo, basis))
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        paths.append(path)
    return paths[::-1], facts_of(faces)


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


def _strip(photo: np.ndarray, basis: LightBasis) -> str:
    """The photo and the person under a few lights, small and side by side."""
    height, width = fitted(photo.shape[0], photo.shape[1], _STRIP_PX)
    images = [resized(photo, height, width)]
    for azimuth, elevation in _STRIP_LIGHTS:
        images.append(resized(basis.nearest_image(azimuth, elevation), height, width))
    return strip_jpeg([linear_to_srgb(image.clip(0, 1)) for image in images])


def _escaped(name: str) -> str:
    """A name in a pattern of files."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)
