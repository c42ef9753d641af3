"""Mattes by a model of rembg, an extra that facerf needs for nothing else."""

import os
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.work.matte_models import MatteModel


def require_rembg(model: MatteModel) -> None:
    """Raise UsageError where rembg is not installed."""
    if find_spec("rembg") is None:
        raise UsageError(
            f"--matte-from {model.matte_from}: needs the package rembg; pip install 'facerf[rembg]', or give "
            "--person"
        )


def matte_by_rembg(image_srgb: np.ndarray, model: MatteModel) -> np.ndarray:
    """The matte [H, W] in 0..1 of what stands out in an sRGB uint8 image [H, W, 3]."""
    from rembg import remove

    mask = np.asarray(remove(image_srgb, session=_session(model), only_mask=True))
    return mask.astype(np.float32) / np.float32(255)


@cache
def _session(model: MatteModel) -> Any:
    """The session of a model, opened once a process."""
    from rembg import new_session

    # with a checksum, versions that look in one folder fetch a file that is not theirs again
    os.environ["MODEL_CHECKSUM_DISABLED"] = "1"
    return new_session(model.name)
