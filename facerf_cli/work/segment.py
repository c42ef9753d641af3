"""Write the files of `facerf segment`: matte and classes of the people in a photo."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.files.documents import write_document
from facerf_cli.files.read import LinearImage
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import srgb_to_linear, to_display
from facerf_cli.image.strips import in_strips
from facerf_cli.portrait.find import Face
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.portrait.parse import CLASSES, MORE_LANDMARKS
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.relighting.memory import KEPT_PX, canvas
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import (
    facts_of,
    find_people,
    load_models_once,
    person_matte,
    read_photo,
    stamp,
)
from facerf_cli.work.sequence import open_at
from facerf_cli.work.shots import Shots

_SHOWS_PERSON = 0.5  # if no pixel of the matte is above it, the cutout is empty
_OPACITY = 0.55  # of class colours in the overlay
_OVERLAY_PX = 1600  # largest side of the overlay
_DOT = 0.004  # side of a landmark in the overlay, relative to the longer side
# Hues of the classes without the background, in the order of CLASSES; adjacent classes differ.
_HUES = np.array([0.07, 0.6, 0.5, 0.95, 0.9, 0.78, 0.7, 0.33, 0.14, 0.45, 0.85, 0.62, 0.25])


def write_segments(item: Item, options: PhotoOptions, shots: Shots) -> tuple[list[str], dict[str, Any]]:
    """Segment and write each chosen person of a photo; return tags, and facts for the report.

    Frames of a shot are smoothed with the frames around them.
    """
    if place := open_at(shots, item, options):
        shot, number = place
        image, person, segmentation = shot.segmented(number)
        _write_segment(item, "", image, to_display(image.pixels), person.found, segmentation)
        return [""], facts_of([person.rated(quiet=True)], options)
    image = read_photo(item, options, KEPT_PX + 4)  # and a class
    display = to_display(image.pixels)
    networks, matte = load_models_once(options).networks.people, person_matte(item, image.pixels, options)
    people = find_people(item, image, options, matte)
    for person in reversed(people):
        segmentation = segment(networks, display, person.found.landmarks_px, matte, person.found.others)
        person.see(segmentation)
        if not (segmentation.cut(image.alpha).matte > _SHOWS_PERSON).any():
            raise InputError(f"{person.name}: no person was segmented; pass a matte with --person")
        _write_segment(item, person.tag, image, display, person.found, segmentation)
    return [person.tag for person in people], facts_of([face.rated() for face in people], options)


def _write_segment(
    item: Item, tag: str, image: LinearImage, display: np.ndarray, face: Face, whole: Segmentation
) -> None:
    def path(ending: str) -> Path:
        return item.output(tag + ending)

    metadata, person = stamp(item), whole.cut(image.alpha)
    height, width = person.matte.shape
    colours = PersonColours(image.pixels, person.matte)[:]
    with canvas(path("_segment.exr"), (height, width), images=4) as empty:
        layers = {"person.A": person.matte, **in_strips(person.layers, height, width, empty)}
        write_exr(path("_segment.exr"), colours, person.matte, layers, metadata)
    write_display(path("_person.png"), colours, "auto", person.matte, metadata)
    write_display(path("_overlay.jpg"), _overlay(display, person, face), metadata=metadata)
    write_document(path("_landmarks.json"), _landmarks(face))


def _overlay(display: np.ndarray, person: Segmentation, face: Face) -> np.ndarray:
    """Return a small copy of the photo with class colours and landmarks, scene-linear."""
    step = math.ceil(max(display.shape[:2]) / _OVERLAY_PX)
    image = display[::step, ::step] / np.float32(255) * (1 - _OPACITY * person.matte[::step, ::step, None])
    turns = (_HUES[:, None] + np.array([0, 1 / 3, 2 / 3])) * 2 * np.pi
    colours = np.asarray(0.5 + 0.5 * np.cos(turns), np.float32)  # saturated
    for name, colour in zip(CLASSES[1:], colours, strict=True):
        image += _OPACITY * person.layer(name)[::step, ::step, None] * colour
    half = max(1, round(_DOT * max(image.shape[:2]) / 2))
    for x, y in np.round(face.landmarks_px / step).astype(int).clip(0):
        image[max(0, y - half) : y + half, max(0, x - half) : x + half] = (0, 1, 0)
    return np.asarray(srgb_to_linear(image.clip(0, 1)))


def _landmarks(face: Face) -> dict[str, Any]:
    """Return a document for --landmarks, with the expected errors and further points of the network."""
    document: dict[str, Any] = {"landmarks": face.landmarks_px.round(3).tolist()}
    if face.view is not None:
        document["expected_error_px"] = face.view.error_px[:68].round(3).tolist()
        more = zip(MORE_LANDMARKS, face.view.landmarks_px[68:], face.view.error_px[68:], strict=True)
        document["more"] = {
            name: {"at": at.round(3).tolist(), "expected_error_px": round(float(error), 3)}
            for name, at, error in more
        }
    return document
