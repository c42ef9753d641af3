"""Write the pages of `facerf view`, and the list of pages."""

import glob
import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head, shrunk_photo
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.olat_stack import is_olat_stack, read_olat_header, stream_olats
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.strips import fitted, resized
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.person import fit
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.stack import face_in_stack
from facerf_cli.synth.sky.skies import KINDS, draw_sky
from facerf_cli.viewer.basis import Basis, basis_of_photo, basis_of_stack
from facerf_cli.viewer.page import IndexEntry, PageMap, Plate, index_page, packed, page, strip_jpeg, strip_of
from facerf_cli.work.photo_options import PhotoOptions, photo_words
from facerf_cli.work.photo_work import PageWork, Written
from facerf_cli.work.photos import (
    FittedFace,
    face_model,
    load_models_once,
    naming,
    read_normals,
    read_photo,
    write_each,
)

_MAP_WIDTH_PX, _DRAWN_WIDTH_PX = 64, 512
_HEAD_RADIUS = 0.55  # of a head, relative to the side of the crop around its face
_STRIP_PX = 160  # longer side of an image of the strip
_STRIP_LIGHTS = ((-60.0, 15.0), (20.0, 30.0), (150.0, 15.0))  # azimuth and elevation, degrees


def write_pages(item: Item, work: PageWork) -> Written:
    """Write a page for each chosen face of a photo, or for a stack."""
    if is_olat_stack(item.input_path):
        if work.normals_from is not None:
            raise InputError(f"{item.input_path}: a stack contains its normals; remove --normals-from")
        tag = work.photo.first_tag
        return [tag], _write_page_of_stack(item.output(tag + ".html"), item, work)
    image = read_photo(item, work.photo)

    def write(face: FittedFace) -> dict[str, Any]:
        write_page(item.output(face.tag + ".html"), item, image.pixels, face, work)
        return {}

    return write_each(item, image, work.photo, write)


def write_page(path: Path, item: Item, photo: np.ndarray, face: FittedFace, work: PageWork) -> None:
    """Write the page of a face of a photo [H, W, 3]."""
    photo, head = shrunk_photo(photo, face.head, work.size_px)
    matte = None if face.matte is None else resized(face.matte, *photo.shape[:2])
    normals = read_normals(item, work.normals_from, photo.shape[:2])
    with naming(item.input_path):
        basis, plate = of_photo(load_models_once(work.photo), photo, head, matte, work.white_balance, normals)
    title = item.input_path.name + face.tag.replace("_", " ")
    more = ["--white-balance", work.white_balance] if work.white_balance != "keep" else []
    more += [] if work.normals_from is None else ["--normals-from", str(work.normals_from)]
    words = [str(item.input_path), *photo_words(work.photo, face.number), *more]
    _write(path, title, words, basis, plate, head_place(head.fit.crop, plate.matte), item.key)


def of_photo(
    models: Models,
    photo: np.ndarray,
    head: Head,
    matte: np.ndarray | None = None,
    white_balance: BalanceMode | None = None,
    normals: np.ndarray | None = None,
) -> tuple[Basis, Plate]:
    """Return the basis of a photo's person, and the images that a page shows around it."""
    person = fit(models, photo, matte=matte, white_balance=white_balance, head=head, normals=normals)
    people = PeopleInPhoto([person.in_photo()])
    basis = basis_of_photo(person, people)
    return basis, Plate(photo, people.matte, photo - people.original_layer(), person.uniform_intensity)


def _write_page_of_stack(path: Path, item: Item, work: PageWork) -> dict[str, Any]:
    header = read_olat_header(item.input_path)
    face, head = None, (0.5, 0.5, 0.5)
    if header.kind == "photo":
        face_fit, coverage = face_in_stack(item.input_path, header, face_model(work.photo))
        face, head = coverage * header.seen, head_place(face_fit.crop, header.seen)
    olats = stream_olats(item.input_path)
    basis = basis_of_stack(header.directions, olats, header.seen, work.size_px, face, header.source)
    size = basis.guide.shape[:2]
    plate = Plate(resized(header.source, *size), resized(header.seen, *size))
    words = [str(item.input_path), *photo_words(work.photo)]
    _write(path, item.input_path.name, words, basis, plate, head, item.key)
    return {"lights": len(header.directions)}


def head_place(crop: Crop, matte: np.ndarray) -> tuple[float, float, float]:
    """Return the face's centre relative to the photo's sides, and the head's radius to the shorter one."""
    height, width = matte.shape
    middle = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    return middle[0] / width, middle[1] / height, _HEAD_RADIUS * crop.side_px / min(height, width)


def _write(
    path: Path,
    title: str,
    words: Sequence[str],
    basis: Basis,
    plate: Plate,
    head: tuple[float, float, float],
    key: str,
) -> None:
    document = packed(basis, plate, head, page_maps())
    with atomic_path(path) as temporary:
        temporary.write_text(page(title, words, document, _strip(basis, plate), key), encoding="utf-8")


def write_index(path: Path, items: Sequence[Item], options: PhotoOptions) -> None:
    """Write the list of all pages that exist, and print its path."""
    entries = []
    for item in items:
        for file in sorted(item.output_base.parent.glob(f"{glob.escape(item.output_base.name)}*.html")):
            tag = file.stem.removeprefix(item.output_base.name)
            if tag == "" if options.face != "all" else tag.startswith("_face"):
                address = quote(file.relative_to(path.parent).as_posix().encode("utf-8", "surrogateescape"))
                strip = strip_of(file.read_text(encoding="utf-8"))
                entries.append(IndexEntry(item.name + tag.replace("_", " "), address, strip))
    with atomic_path(path) as temporary:
        temporary.write_text(index_page(entries), encoding="utf-8")
    print(path, flush=True)


@cache
def page_maps() -> tuple[PageMap, ...]:
    """Draw a small procedural map of each kind, with the command that draws it."""
    maps = []
    for kind in KINDS:
        pixels, _ = draw_sky(0, 0, _DRAWN_WIDTH_PX, (kind,))
        step = _DRAWN_WIDTH_PX // _MAP_WIDTH_PX
        small = pixels.reshape(_MAP_WIDTH_PX // 2, step, _MAP_WIDTH_PX, step, 3).mean((1, 3))
        command = f"facerf envmap --kind {shlex.quote(kind)} --count 1 -o maps"
        maps.append(PageMap(kind, small, command, f"maps/00000_{kind}.exr"))
    return tuple(maps)


def _strip(basis: Basis, plate: Plate) -> str:
    """Return a JPEG of the photo and the person under a few lights, side by side."""
    size = fitted(plate.matte.shape[0], plate.matte.shape[1], _STRIP_PX)
    images = [resized(plate.before.clip(0, 1), *size)]
    seen = resized(plate.matte, *basis.ratios.shape[1:3])
    for light in _STRIP_LIGHTS:
        image = basis.image(azel_to_direction(*light).numpy())
        exposed = image * np.float32(2.0 ** auto_exposure_ev(image, seen))
        images.append(resized(exposed.clip(0, 1), *size))
    return strip_jpeg([linear_to_srgb(image) for image in images])
