"""A case of a protocol: the true image and the methods' predictions of it, computed or read from files."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tokenize import TokenError

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.evaluation import folder_name
from facerf_cli.files.images import PHOTO_LIMIT_PX, read_image
from facerf_cli.files.regular import require_regular

SUFFIXES = (".exr", ".png", ".npy")  # of predictions in files
_LARGEST_NUMBER_BYTES, _HEADER_BYTES = 8, 1 << 16  # limits of a .npy file


@dataclass(frozen=True)
class Case:
    """One image to be measured.

    `name` is a path without suffix, unique in its run; predictions in files are found by it. `person` is
    whose face it shows: intervals resample people. Facts that are text break the tables down
    ('pose': 'same pose'); numbers go to the list of images only.
    """

    name: str
    person: str
    facts: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A case with its images, scene-linear Rec.709 [H, W, 3], all in one frame.

    They are compared inside the mask [H, W] in 0..1. `source` is the image that the methods were given, in
    its own frame. landmarks_px [68, 2] are those of the truth, for the face-recognition distance; without
    them it is not measured. `extra` holds each method's figures that only the protocol can compute
    ('light_error_deg'). `grey_as_given` is that of `Others`.
    """

    case: Case
    truth: np.ndarray
    mask: np.ndarray
    predictions: Mapping[str, np.ndarray]  # by method
    source: np.ndarray | None = None
    landmarks_px: np.ndarray | None = None
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by method
    grey_as_given: bool = False


@dataclass(frozen=True)
class Others:
    """Folders of predictions FOLDER/CASE.exr, .png or .npy; a folder's name is its method's.

    With `grey_as_given` PNGs are read as linear values, too, and the mean of the channels is compared.
    """

    folders: tuple[Path, ...]
    grey_as_given: bool = False

    def predictions(self, case: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """Read the case's predictions [H, W, 3] by method, linear Rec.709, of the truth's `shape`.

        Raises InputError that lists all that are missing or unfit: without its failures a method's mean
        improves.
        """
        found, wrong = {}, []
        for folder in self.folders:
            try:
                found[folder_name(folder)] = _prediction(folder, case, shape, self.grey_as_given)
            except InputError as error:
                wrong.append(str(error))
        if wrong:
            raise InputError("; ".join(wrong))
        return found


def _prediction(folder: Path, case: str, shape: tuple[int, ...], grey_as_given: bool) -> np.ndarray:
    there = [path for suffix in SUFFIXES if (path := folder / f"{case}{suffix}").is_file()]
    if not there:
        raise InputError(f"{folder}: no prediction for case {case}; add it as {', '.join(SUFFIXES)}")
    if len(there) > 1:
        names = " and ".join(path.name for path in there)
        raise InputError(f"{folder}: case {case} has the files {names}; remove all but one")
    space = "linear" if grey_as_given else None
    pixels = read_array(there[0]) if there[0].suffix == ".npy" else read_image(there[0], space).pixels
    if grey_as_given:
        pixels = np.repeat(pixels.mean(-1, keepdims=True), 3, -1)
    if pixels.shape[:2] != tuple(shape[:2]):
        have, wanted = (f"{size[1]} x {size[0]}" for size in (pixels.shape, shape))
        raise InputError(f"{there[0]}: {have} pixels, the truth has {wanted}; give an image in its frame")
    return pixels


def read_array(path: Path) -> np.ndarray:
    """Read an image [H, W, 3] float32 from a .npy of floats [H, W, 3] or [H, W], taken as linear Rec.709."""
    require_regular(path, "give an image as .npy")
    try:
        if path.stat().st_size > PHOTO_LIMIT_PX * 3 * _LARGEST_NUMBER_BYTES + _HEADER_BYTES:
            raise InputError(f"{path}: larger than any image that is read; give one image in a file")
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may promise more than there is
    except (OSError, ValueError, EOFError, SyntaxError, TokenError, OverflowError, TypeError) as error:
        raise InputError(f"{path}: not an array of numbers ({error}); write one by numpy.save") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: an array of shape {list(values.shape)}; give [height, width, 3]")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: values of type {values.dtype}; give floats of linear light, or a PNG")
    image = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: holds values that are NaN or infinite; give finite ones")
    return image
