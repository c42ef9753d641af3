"""Photos of a batch: read, their faces found and fitted, and the models loaded once a process."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli.cli.inputs import Item
from facerf_cli.cli.options import torch_device
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.cli.values import parse_lights, parse_pose
from facerf_cli.colour import named_space
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import Head
from facerf_cli.face.landmarks import FaceBox, face_at, read_landmarks
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.files.images import LinearImage, read_image
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.logs import LOGGER_NAME, Provenance
from facerf_cli.models import NO_GEOMETRY_NETWORK, Models, load_models
from facerf_cli.pipeline import find_for, head_of
from facerf_cli.raster.camera import pose_to_rotation, rotation_to_pose

_LANDMARK_SUFFIXES = (".pts", ".json")
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class FittedFace:
    """One face of a photo; `tag` goes into the names of its outputs: '' or, with `--face all`, '_face0'."""

    tag: str
    found: FaceBox
    head: Head

    @property
    def fit(self) -> FaceFit:
        """The fitted face model."""
        return self.head.fit

    def facts(self) -> dict[str, Any]:
        """The face's entries in the report."""
        pose_deg = [round(angle, 2) for angle in rotation_to_pose(self.fit.rotation)]
        return {**fit_facts(self.fit), "pose_deg": pose_deg}


def prepare_photos(options: PhotoOptions, with_networks: bool = True) -> None:
    """Load what every photo needs; raises UsageError or InputError for what would fail all of them."""
    if options.colourspace is not None:
        named_space(options.colourspace)
    face_model(options)
    if with_networks:
        models = load_models_once(options)
        if options.geometry == "network" and models.geometry is None:
            raise UsageError(f"--geometry network: {models.checkpoint_name} is {NO_GEOMETRY_NETWORK}")


@cache
def load_models_once(options: PhotoOptions) -> Models:
    """The face model and the networks of the checkpoint, on the device, once a process."""
    return load_models(options.settings.checkpoint, options.face_model, torch_device(options.settings))


@cache
def face_model(options: PhotoOptions) -> MorphableModel:
    """The face model alone, once a process."""
    return load_face_model(options.face_model)


def read_photo(item: Item, options: PhotoOptions) -> LinearImage:
    """The item's image, scene-linear Rec.709."""
    return read_image(item.input_path, options.colourspace)


def fit_faces(item: Item, image: LinearImage, options: PhotoOptions) -> list[FittedFace]:
    """Fit the faces of a photo that the options choose, from left to right."""
    found = list(_find(item, image, options))
    tags = [f"_face{index}" for index in range(len(found))] if options.face == "all" else [""]
    return [
        FittedFace(tag, face, _fit_one(item, image, face, options))
        for face, tag in zip(found, tags, strict=True)
    ]


def fit_facts(fit: FaceFit) -> dict[str, Any]:
    """A fit's error and quality for the report; a regressed head has no error."""
    error = {} if math.isnan(fit.error_iod) else {"error_iod": round(fit.error_iod, 5)}
    return {**error, "quality": fit.quality}


def facts_of(faces: list[FittedFace]) -> dict[str, Any]:
    """The report's entries of a photo: of its one face, or of each in a list."""
    return faces[0].facts() if len(faces) == 1 else {"faces": [face.facts() for face in faces]}


def provenance(item: Item, options: PhotoOptions, checkpoint_name: str = "") -> dict[str, str | int]:
    """Metadata for the outputs of a photo."""
    return Provenance(item.input_path.name, checkpoint_name, **face_model(options).stamp).attributes()


def _find(item: Item, image: LinearImage, options: PhotoOptions) -> Iterator[FaceBox]:
    """Find the faces that the options choose; with their landmarks where the fit needs them."""
    if options.landmarks is not None:
        single = not options.landmarks.is_dir()
        path = options.landmarks if single else _landmark_file(item, options.landmarks)
        yield face_at(read_landmarks(path))
    else:
        geometry = options.geometry or load_models_once(options).default_geometry
        yield from find_for(geometry, image.pixels, str(item.input_path), options.face)


def _landmark_file(item: Item, folder: Path) -> Path:
    """The photo's landmarks in a folder that mirrors the photos', or that holds them all in one place."""
    for name in (item.name, item.input_path.stem):
        for suffix in _LANDMARK_SUFFIXES:
            path = folder / f"{name}{suffix}"
            if path.is_file():
                return path
    raise InputError(f"{item.input_path}: no {item.name}.pts or .json in {folder}; add it there")


def _fit_one(item: Item, image: LinearImage, face: FaceBox, options: PhotoOptions) -> Head:
    try:
        models = load_models_once(options)
        head = head_of(models, image.pixels, face, models.sides(options.texture_side))
    except InputError as error:
        raise InputError(f"{item.input_path}: {error}") from None
    if head.fit.quality == "poor":
        log.warning(
            "%s: the fit is poor (landmarks are off by %.1f %% of the eyes' distance); look at it with "
            "`facerf fit-geometry`, or give --landmarks",
            item.input_path,
            100 * head.fit.error_iod,
        )
    return head


def read_matte(path: Path, size_px: tuple[int, ...]) -> np.ndarray:
    """A matte [H, W] in 0..1 of a photo of that size: the file's alpha, or the mean of its values."""
    image = read_image(path, "linear")
    matte = image.pixels.mean(-1) if image.alpha is None else image.alpha
    if matte.shape != tuple(size_px):
        height, width = matte.shape
        raise InputError(
            f"{path}: the matte has {width} x {height} pixels, the photo {size_px[1]} x {size_px[0]}; "
            "give one of the photo's size"
        )
    return matte.clip(0, 1)


def rotation_of(pose: str | None) -> torch.Tensor | None:
    """The head_to_camera rotation [3, 3] of `--pose`; None keeps the photo's pose."""
    pose_deg = parse_pose(pose)
    return None if pose_deg is None else pose_to_rotation(*pose_deg)


def directions_of(rig: str) -> torch.Tensor:
    """Unit directions [L, 3] of `--lights`."""
    parsed = parse_lights(rig)
    if isinstance(parsed, int):
        return rig_directions(parsed)
    azimuth, elevation = torch.tensor(parsed).T
    return azel_to_direction(azimuth, elevation)
