"""Lights on disk: environment maps, and JSON with a rig's weights or spherical harmonics.

`facerf estimate-light` writes the JSON; any image can be an environment map.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, PlainValidator, model_validator
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.documents import Document, read_document, write_document
from facerf_cli.files.read import ENVMAP_LIMIT_PX, read_image
from facerf_cli.light.envmap import check_envmap, rig_to_latlong
from facerf_cli.light.sh import CONVENTION
from facerf_cli.light.sphere import RigLight

Format = Literal["facerf-light-1"]
FORMAT: Format = "facerf-light-1"
AXES = "camera: x to the image's right, y up, z toward the camera; directions point to the light"
UNITS = "a light of weight 1 gives a white Lambertian surface that faces it radiance 1; linear Rec.709"
_MOST_LIGHTS, _MOST_COEFFICIENTS = 4096, 441  # 441: spherical harmonics of order 20
_JSON_ROWS = 256  # of the map that a JSON light is converted to
_LARGEST = 1e30  # magnitude of a number; its square still fits double precision
_LENGTH_TOLERANCE = 1e-2  # of a direction's length, since other programs round
_GPANO, _SIDES = ("CroppedAreaImage", "FullPano"), ("Width", "Height")
_ADVICE = "use a .json that estimate-light wrote"


@dataclass(frozen=True, eq=False)
class LightRecord:
    """Contents of a JSON light: directions and weights [L, 3] of a rig, and optionally coefficients `sh`.

    Coefficients [(order + 1)^2, 3] are those of `light.sh`. `rig` describes the directions in words;
    `attributes` are the provenance (`image_metadata.Provenance.attributes`) and how the light was estimated.
    """

    directions: Tensor
    weights: Tensor
    rig: str = ""
    sh: Tensor | None = None
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)


def write_light(path: Path, record: LightRecord) -> None:
    """Write a light as JSON atomically; raises ValueError for NaN and infinity."""
    fields: dict[str, Any] = {"format": FORMAT, "axes": AXES, "units": UNITS}
    fields["rig"] = record.rig
    fields |= {"directions": _numbers(record.directions), "weights": _numbers(record.weights)}
    if record.sh is not None:
        order = math.isqrt(len(record.sh)) - 1
        fields["sh"] = {"order": order, "convention": CONVENTION, "coefficients": _numbers(record.sh)}
    fields["provenance"] = dict(record.attributes)
    write_document(path, fields)


def _numbers(rows: Tensor) -> list[list[float]]:
    """Return the shortest decimals that read back as the same float32."""
    return [[float(f"{value:.9g}") for value in row] for row in rows.float().tolist()]


def _rows(most: int, value: Any) -> np.ndarray:
    """Return finite numbers [N, 3], N from 1 to `most`."""
    try:
        rows = np.array(value)
    except ValueError:  # rows of different lengths
        rows = np.zeros(())
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind not in "if" or not 1 <= len(rows) <= most:
        raise ValueError(f"use 1 to {most} rows of 3 finite numbers")
    if not (np.abs(rows) < _LARGEST).all():
        raise ValueError(f"use numbers below {_LARGEST:g}")
    return rows.astype(np.float32)


_Rows = Annotated[np.ndarray, PlainValidator(partial(_rows, _MOST_LIGHTS))]


class _HarmonicsEntry(Document):
    coefficients: Annotated[np.ndarray, PlainValidator(partial(_rows, _MOST_COEFFICIENTS))]
    convention: str


class _LightDocument(Document):
    format: Format
    rig: str = ""
    directions: _Rows
    weights: _Rows
    sh: _HarmonicsEntry | None = None
    provenance: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_light(self) -> "_LightDocument":
        if len(self.directions) != len(self.weights):
            raise ValueError(f"{len(self.directions)} directions but {len(self.weights)} weights")
        if np.abs(np.linalg.norm(self.directions, axis=1) - 1).max() > _LENGTH_TOLERANCE:
            raise ValueError("use directions that are unit vectors")
        if self.sh and self.sh.convention != CONVENTION:
            raise ValueError(f"sh has another convention; convert the coefficients to: {CONVENTION}")
        if self.sh and math.isqrt(count := len(self.sh.coefficients)) ** 2 != count:
            raise ValueError(f"sh needs 1, 4, 9, 16, ... rows, not {count}")
        return self


def read_light(path: Path) -> LightRecord:
    """Read and validate a JSON light; directions are normalized to unit length."""
    light = read_document(path, _LightDocument, _ADVICE)
    return LightRecord(
        torch.from_numpy(light.directions / np.linalg.norm(light.directions, axis=1, keepdims=True)),
        torch.from_numpy(light.weights),
        light.rig,
        torch.from_numpy(light.sh.coefficients) if light.sh else None,
        {  # values that an image's header can store
            name: value
            for name, value in light.provenance.items()
            if isinstance(value, str) or (isinstance(value, int | float) and abs(value) < 1 << 31)
        },
    )


def read_map_file(path: Path | str) -> Tensor:
    """Read an environment map [H, W, 3], linear Rec.709; a JSON light is converted to one."""
    if Path(path).suffix.lower() == ".json":
        return _latlong(Path(path))
    image = read_image(path, limit_px=ENVMAP_LIMIT_PX, with_alpha=False)
    sizes = [[image.metadata.get(f"GPano:{name}{side}Pixels") for name in _GPANO] for side in _SIDES]
    if any(part != full for part, full in sizes):
        raise InputError(
            f"{path}: covers only a part of the sphere (GPano metadata); extend it to 360 x 180 degrees, for"
            " example in Hugin, and save it without these metadata"
        )
    envmap = torch.from_numpy(image.pixels)
    try:
        check_envmap(envmap)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return envmap


@lru_cache(maxsize=2)  # converting a rig takes seconds, and relight reads the same light several times
def _latlong(path: Path) -> Tensor:
    """Convert a JSON light's rig to a map."""
    record = read_light(path)
    return rig_to_latlong(RigLight(record.directions, record.weights), _JSON_ROWS)
