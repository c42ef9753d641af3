"""Images as NumPy arrays (.npy)."""

import math
from pathlib import Path
from tokenize import TokenError

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.read import PHOTO_LIMIT_PX
from facerf_cli.files.texts import require_regular


def read_array(path: Path) -> np.ndarray:
    """Read a .npy of floats [H, W, 3] or [H, W], linear Rec.709, as an image [H, W, 3] float32."""
    require_regular(path, "specify an image as .npy")
    try:
        # memory-mapped, since a header may promise more data than exists
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, TokenError, OverflowError, TypeError) as error:
        raise InputError(f"{path}: not an array of numbers ({error}); write it with numpy.save") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: array of shape {list(values.shape)}; use [height, width, 3]")
    if math.prod(values.shape[:2]) > PHOTO_LIMIT_PX:
        raise InputError(f"{path}: more than {PHOTO_LIMIT_PX / 1e6:.0f} megapixels; make it smaller")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: values of type {values.dtype}; use floats of linear light, or a PNG")
    image = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: contains NaN or infinite values; replace them")
    return image
