"""Images as arrays of NumPy, .npy."""

import math
from pathlib import Path
from tokenize import TokenError

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.read import PHOTO_LIMIT_PX
from facerf_cli.files.texts import require_regular

_LARGEST_NUMBER_BYTES, _HEADER_BYTES = 8, 1 << 16


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
