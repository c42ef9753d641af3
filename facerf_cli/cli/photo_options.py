"""What every verb does with a photo before it predicts anything: read it, find faces, crop, fit, unwrap."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.options import Settings, torch_device
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME, Provenance

if TYPE_CHECKING:
    import numpy as np

    from facerf_cli.face.fit import FaceFit
    from facerf_cli.face.morphable import MorphableModel
    from facerf_cli.files.images import LinearImage
    from facerf_cli.pipeline import FaceTexture, Models

_LANDMARK_SUFFIXES = (".pts", ".json")
_TEXTURE_STEP, _TEXTURE_MOST = 256, 2048
_CROP_PER_TEXTURE = 2  # the crop's side over the texture's, so that unwrapping averages and does not enlarge
log = logging.getLogger(LOGGER_NAME)

FaceOption = Annotated[
    str,
    typer.Option("--face", metavar="largest|all|INDEX", help="Which face; counted from the left, from 0."),
]
LandmarksOption = Annotated[
    Path | None,
    typer.Option(
        "--landmarks",
        metavar="FILE|DIR",
        help="68 landmarks (.pts or .json) instead of the detector's: a file, or a folder with one a photo.",
        show_default="found by the detector",
    ),
]
TextureSizeOption = Annotated[
    int, typer.Option("--texture-size", metavar="T", help="Side of the UV texture; a multiple of 256.")
]


@dataclass(frozen=True)
class PhotoOptions:
    """How photos are read and fitted; settings only, so that it can be sent to other processes."""

    settings: Settings
    colourspace: str | None = None
    face_model: str = "builtin"
    face: str = "largest"
    landmarks: Path | None = None
    texture_side: int = 256

    def check(self) -> None:
        """Raise for what would fail every photo alike."""
        if self.face not in ("largest", "all") and not self.face.isdecimal():
            raise UsageError(f"--face takes largest, all or a number from 0, not {self.face!r}")
        if self.texture_side % _TEXTURE_STEP or not 0 < self.texture_side <= _TEXTURE_MOST:
            raise UsageError(
                f"--texture-size {self.texture_side}: give a multiple of 256 up to {_TEXTURE_MOST}"
            )
        if self.landmarks is not None and not self.landmarks.exists():
            raise UsageError(f"--landmarks {self.landmarks}: no such file or folder")
        if self.colourspace is not None:
            from facerf_cli.colour import named_space

            named_space(self.colourspace)
        face_model(self)

    @property
    def first_tag(self) -> str:
        """The tag of a photo's first face in the names of its outputs; write faces last to first.

        How many faces `--face all` finds is not known beforehand; the first one's outputs, written last, say
        that the photo is finished.
        """
        return "_face0" if self.face == "all" else ""


@dataclass(frozen=True, eq=False)
class FittedFace:
    """One face of a photo; `tag` goes into the names of its outputs: '' or, with `--face all`, '_face0'."""

    tag: str
    cropped: "np.ndarray"  # [S, S, 3] linear; fit.crop is where it lies in the photo
    fit: "FaceFit"
    texture: "FaceTexture"

    def facts(self) -> dict[str, Any]:
        """What the report says of it."""
        from facerf_cli.raster.camera import rotation_to_pose

        pose_deg = [round(angle, 2) for angle in rotation_to_pose(self.fit.rotation)]
        return {"error_iod": round(self.fit.error_iod, 5), "quality": self.fit.quality, "pose_deg": pose_deg}


@cache
def load_models_once(options: PhotoOptions) -> "Models":
    """The face model and the network of the checkpoint, on the device, once a process."""
    from facerf_cli.pipeline import load_models

    return load_models(options.settings.checkpoint, options.face_model, torch_device(options.settings))


@cache
def face_model(options: PhotoOptions) -> "MorphableModel":
    """The face model alone, once a process."""
    from facerf_cli.face.morphable import load_face_model

    return load_face_model(options.face_model)


def read_photo(item: Item, options: PhotoOptions) -> "LinearImage":
    """The item's picture, scene-linear Rec.709."""
    from facerf_cli.files.images import read_image

    return read_image(item.input_path, options.colourspace)


def fit_faces(item: Item, image: "LinearImage", options: PhotoOptions) -> list[FittedFace]:
    """The faces of a photo that were asked for, each cropped, fitted and unwrapped; from left to right."""
    found = list(_landmarks_px(item, image, options))
    tags = [f"_face{index}" for index in range(len(found))] if options.face == "all" else [""]
    return [
        _fit_one(item, image, landmarks_px, tag, options)
        for landmarks_px, tag in zip(found, tags, strict=True)
    ]


def facts_of(faces: list[FittedFace]) -> dict[str, Any]:
    """The report's facts of a photo: of its one face, or of each in a list."""
    return faces[0].facts() if len(faces) == 1 else {"faces": [face.facts() for face in faces]}


def provenance(item: Item, options: PhotoOptions, checkpoint_name: str = "") -> dict[str, str | int]:
    """Metadata for what is made of a photo."""
    return Provenance(item.input_path.name, checkpoint_name, **face_model(options).stamp).attributes()


def _landmarks_px(item: Item, image: "LinearImage", options: PhotoOptions) -> Iterator["np.ndarray"]:
    from facerf_cli.face.landmarks import find_faces, read_landmarks

    if options.landmarks is None:
        faces = find_faces(image.pixels, str(item.input_path), options.face)
        yield from (face.landmarks_px for face in faces)
    elif options.landmarks.is_dir():
        yield read_landmarks(_landmark_file(item, options.landmarks))
    else:
        yield read_landmarks(options.landmarks)


def _landmark_file(item: Item, folder: Path) -> Path:
    """The photo's landmarks in a folder that mirrors the photos', or that holds them side by side."""
    for name in (item.name, item.input_path.stem):
        for suffix in _LANDMARK_SUFFIXES:
            path = folder / f"{name}{suffix}"
            if path.is_file():
                return path
    raise InputError(f"{item.input_path}: no {item.name}.pts or .json in {folder}")


def _fit_one(
    item: Item, image: "LinearImage", landmarks_px: "np.ndarray", tag: str, options: PhotoOptions
) -> FittedFace:
    from facerf_cli.pipeline import crop_face, fit_face, see_head, unwrap_face

    model, side = face_model(options), options.texture_side
    try:
        crop, cropped = crop_face(image.pixels, landmarks_px, side * _CROP_PER_TEXTURE)
        start = see_head(load_models_once(options), cropped)
        fit = fit_face(model, crop, landmarks_px, image.pixels.shape, start)
        texture = unwrap_face(model, fit, cropped, side, image.pixels.shape)
    except InputError as error:
        raise InputError(f"{item.input_path}: {error}") from None
    if fit.quality == "poor":
        log.warning(
            "%s: the fit is poor (landmarks are off by %.1f %% of the eyes' distance); look at it with "
            "`facerf fit-geometry`, or give --landmarks",
            item.input_path,
            100 * fit.error_iod,
        )
    return FittedFace(tag, cropped, fit, texture)
