"""Environment maps that a user brings, and lights that stand for one."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.headers import read_header
from facerf_cli.files.images import ENVMAP_LIMIT_PX, read_image
from facerf_cli.files.light_files import read_light
from facerf_cli.light.envmap import check_envmap
from facerf_cli.light.forms import LightForms
from facerf_cli.light.rig_light import RigLight
from facerf_cli.light.sh import CONVENTION


def read_map_file(path: Path | str) -> Tensor:
    """A lat-long map [H, W, 3], linear Rec.709; an InputError says what is wrong with it.

    A light of `facerf estimate-light` or `convert-light` (.json) is drawn as one.
    """
    if Path(path).suffix.lower() == ".json":
        return _drawn(Path(path))
    envmap = torch.from_numpy(read_image(path, limit_px=ENVMAP_LIMIT_PX).pixels)
    try:
        check_envmap(envmap)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return envmap


def face_model_of_map(path: Path) -> dict[str, str]:
    """The marks of the face model that a light was estimated with, if its file has them."""
    if path.suffix.lower() == ".json":
        marks = read_light_file(path)[1]
    else:
        header = read_header(path)
        marks = header.metadata if header else {}
    return {name: str(mark) for name, mark in marks.items() if name.startswith("facerf:face_model")}


@lru_cache(maxsize=2)  # a rig's takes a while, and relight asks more than once
def _drawn(path: Path) -> Tensor:
    return read_light_file(path)[0].latlong()


def read_light_file(path: Path) -> tuple[LightForms, Mapping[str, str | int | float]]:
    """A JSON light's rig, or its coefficients where it has no rig; and its provenance."""
    record = read_light(path)
    if len(record.directions):
        return LightForms(rig=RigLight(record.directions, record.weights)), record.attributes
    assert record.sh is not None
    if record.sh.convention != CONVENTION:
        raise InputError(f"{path}: spherical harmonics of another convention; they are to be: {CONVENTION}")
    return LightForms(coefficients=record.sh.coefficients), record.attributes
