"""Other methods' predictions, looked up by case: none may be missing, for a smaller mean is a better one."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.evaluation.folder_names import folder_name
from facerf_cli.files.images import PHOTO_LIMIT_PX, read_image

SUFFIXES = (".exr", ".png", ".npy")
_LARGEST_NUMBER_BYTES, _HEADER_BYTES = 8, 1 << 16


@dataclass(frozen=True)
class Others:
    """Folders of predictions FOLDER/CASE.exr, .png or .npy; a folder's name is its method's.

    `grey_as_given`: PNGs hold linear values too, and the mean of the channels is what is compared.
    """

    folders: tuple[Path, ...]
    grey_as_given: bool = False

    def predictions(self, case: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """The case's predictions [H, W, 3] by method, linear Rec.709, each of the truth's shape [H, W, ...].

        Raises InputError that names every one that is missing or unfit, a sentence each.
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
    candidates = [folder / f"{case}{suffix}" for suffix in SUFFIXES]
    there = [path for path in candidates if path.is_file()]
    if not there:
        raise InputError(f"{folder}: no prediction for case {case} ({', '.join(SUFFIXES)} looked for)")
    if len(there) > 1:
        raise InputError(f"{folder}: case {case} has {' and '.join(path.name for path in there)}; leave one")
    space = "linear" if grey_as_given else None
    pixels = read_array(there[0]) if there[0].suffix == ".npy" else read_image(there[0], space).pixels
    if grey_as_given:
        pixels = np.repeat(pixels.mean(-1, keepdims=True), 3, -1)
    if pixels.shape[:2] != tuple(shape[:2]):
        have, wanted = (f"{size[1]} x {size[0]}" for size in (pixels.shape, shape))
        raise InputError(
            f"{there[0]}: {have} pixels, the truth has {wanted}; predictions are to have its frame"
        )
    return pixels


def read_array(path: Path) -> np.ndarray:
    """A picture [H, W, 3] float32 from a .npy of numbers [H, W, 3] or [H, W], taken for linear Rec.709."""
    try:
        if path.stat().st_size > PHOTO_LIMIT_PX * 3 * _LARGEST_NUMBER_BYTES + _HEADER_BYTES:
            raise InputError(f"{path}: larger than any picture that is read; is it one picture?")
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may promise more than is there
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not an array of numbers by numpy.save ({error})") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: an array {list(values.shape)}; a picture is [height, width, 3]")
    if values.dtype.kind != "f":
        raise InputError(
            f"{path}: numbers of type {values.dtype}; linear light is floats, and PNG is for bytes"
        )
    picture = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(
        np.float32
    )
    if not np.isfinite(picture).all():
        raise InputError(f"{path}: holds values that are NaN or infinite")
    return picture
