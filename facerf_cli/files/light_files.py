"""Lights on disk: JSON of a rig's weights and spherical harmonics, and environment maps.

`facerf estimate-light` writes a JSON light; any image can be an environment map.
"""

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field, PlainValidator, model_validator
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import Document, json_text, read_document
from facerf_cli.files.read import ENVMAP_LIMIT_PX, LINEAR_BYTES, LinearImage, read_image
from facerf_cli.light.envmap import check_envmap, rig_to_latlong
from facerf_cli.light.sh import CONVENTION, positive_latlong
from facerf_cli.light.sphere import RigLight
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
Format = Literal["facerf-light-1"]
FORMAT: Format = "facerf-light-1"
AXES = "camera: x to the picture's right, y up, z toward the camera; directions point to the light"
UNITS = "a light of weight 1 gives a white Lambertian surface that faces it radiance 1; linear Rec.709"
_LIMIT_BYTES = 4 << 20
_MOST_LIGHTS, _MOST_COEFFICIENTS = 4096, 441  # 441: spherical harmonics of order 20
_JSON_ROWS = 256  # of the map that a JSON light is converted to
_LARGEST = 1e30  # magnitude of a number; its square still fits double precision
_GPANO = (
    "FullPanoHeight FullPanoWidth CroppedAreaImageHeight CroppedAreaImageWidth CroppedAreaTop CroppedAreaLeft"
)
_LENGTH_TOLERANCE = 1e-2  # a direction's length may differ from 1 by this, since other programs round
_ADVICE = "give a .json that estimate-light wrote"


@dataclass(frozen=True, eq=False)
class LightRecord:
    """The contents of a JSON light: directions and weights [L, 3] of a rig, or coefficients `sh`, or both.

    Coefficients [(order + 1)^2, 3] are those of `light.sh`. Without a rig, `directions` and `weights` have no
    rows. `rig` describes the directions in words; `attributes` are the provenance
    (`logs.Provenance.attributes`) and how the light was estimated.
    """

    directions: Tensor
    weights: Tensor
    rig: str = ""
    sh: Tensor | None = None
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)


def write_light(path: Path, record: LightRecord) -> None:
    """Write a light as JSON atomically, with a light's direction, weight or coefficient in each line."""
    fields: dict[str, Any] = {"format": FORMAT, "axes": AXES, "units": UNITS}
    if len(record.directions):
        fields |= {"rig": record.rig, "directions": record.directions, "weights": record.weights}
    if record.sh is not None:
        order = math.isqrt(len(record.sh)) - 1
        fields["sh"] = {"order": order, "convention": CONVENTION, "coefficients": record.sh}
    fields["provenance"] = dict(record.attributes)
    with atomic_path(path) as temporary:
        temporary.write_text(_text_of(fields, "") + "\n", encoding="utf-8")


def _text_of(value: Any, indent: str) -> str:
    """Return JSON with each row of a matrix in one line."""
    deeper = indent + "  "
    if isinstance(value, Tensor):
        lines = [f"[{', '.join(map(_number, row))}]" for row in value.float().tolist()]
        return f"[\n{deeper}" + f",\n{deeper}".join(lines) + f"\n{indent}]"
    if isinstance(value, dict) and value:
        lines = [f"{json.dumps(name)}: {_text_of(entry, deeper)}" for name, entry in value.items()]
        return f"{{\n{deeper}" + f",\n{deeper}".join(lines) + f"\n{indent}}}"
    return json_text(value)


def _number(value: float) -> str:
    """Return the shortest decimals that read back as the same float32."""
    if not math.isfinite(value):
        raise ValueError(f"a light has the value {value}")
    return f"{value:.9g}"


def _rows(most: int, value: Any) -> np.ndarray:
    """Finite numbers [N, 3], N of 1 to `most`."""
    try:
        rows = np.array(value)
    except ValueError:  # rows of different lengths
        rows = np.zeros(())
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind not in "if" or not 1 <= len(rows) <= most:
        raise ValueError(f"1 to {most} rows of 3 finite numbers are needed")
    if not (np.abs(rows) < _LARGEST).all():
        raise ValueError(f"numbers below {_LARGEST:g} are needed")
    return rows.astype(np.float32)


def _units(rows: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    if np.abs(lengths - 1).max() > _LENGTH_TOLERANCE:
        raise ValueError("unit vectors are needed")
    return rows / lengths


def _whole_orders(coefficients: np.ndarray) -> np.ndarray:
    if math.isqrt(len(coefficients)) ** 2 != len(coefficients):
        raise ValueError(f"1, 4, 9, 16, ... rows are needed, not {len(coefficients)}")
    return coefficients


_Rows = Annotated[np.ndarray, PlainValidator(partial(_rows, _MOST_LIGHTS))]
_Coefficients = Annotated[np.ndarray, PlainValidator(partial(_rows, _MOST_COEFFICIENTS))]


def _ours(convention: str) -> str:
    if convention != CONVENTION:
        raise ValueError(f"another convention; convert the coefficients to: {CONVENTION}")
    return convention


class _HarmonicsEntry(Document):
    coefficients: Annotated[_Coefficients, AfterValidator(_whole_orders)]
    convention: Annotated[str, AfterValidator(_ours)]


class _LightDocument(Document):
    """The document; a light has directions and weights, or coefficients, or both."""

    format: Format
    rig: str = ""
    directions: Annotated[_Rows, AfterValidator(_units)] | None = None
    weights: _Rows | None = None
    sh: _HarmonicsEntry | None = None
    provenance: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_light(self) -> "_LightDocument":
        counts = [0 if rows is None else len(rows) for rows in (self.directions, self.weights)]
        if counts[0] != counts[1]:
            raise ValueError(f"{counts[0]} directions but {counts[1]} weights")
        if not counts[0] and self.sh is None:
            raise ValueError("both directions and sh are missing")
        return self


def read_light(path: Path) -> LightRecord:
    """Read and check a JSON light; directions are normalized to unit length."""
    if path.suffix.lower() != ".json":
        raise InputError(f"{path}: not a .json file; {_ADVICE}")
    light = read_document(path, _LightDocument, _ADVICE, _LIMIT_BYTES)
    none = np.zeros((0, 3), np.float32)
    return LightRecord(
        torch.from_numpy(none if light.directions is None else light.directions),
        torch.from_numpy(none if light.weights is None else light.weights),
        light.rig,
        torch.from_numpy(light.sh.coefficients) if light.sh else None,
        {name: value for name, value in light.provenance.items() if _is_attribute(value)},
    )


def _is_attribute(value: Any) -> bool:
    """Return whether an image's header can store the value."""
    return isinstance(value, str) or (isinstance(value, int | float) and abs(value) < 1 << 31)


def read_map_file(path: Path | str) -> Tensor:
    """Read a lat-long map [H, W, 3], linear Rec.709; a JSON light is converted to one."""
    if Path(path).suffix.lower() == ".json":
        return _latlong(Path(path))
    image = read_image(path, limit_px=ENVMAP_LIMIT_PX, with_alpha=False)
    envmap = torch.from_numpy(_in_sphere(path, image))
    try:
        check_envmap(envmap)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return envmap


def _in_sphere(path: Path | str, image: LinearImage) -> np.ndarray:
    """Return a map's pixels [H, W, 3]; those of a part of the sphere in their place, and black around them.

    GPano, metadata of panoramas, has sizes in pixels of the camera's image; the file may be a smaller one.
    """
    try:
        numbers = [int(image.metadata[f"GPano:{name}Pixels"]) for name in _GPANO.split()]
    except (KeyError, TypeError, ValueError, OverflowError):  # there is none, or it is no number
        return image.pixels
    full, part, start = numbers[:2], numbers[2:4], numbers[4:]
    if full == part:
        return image.pixels
    fits = all(0 <= a < a + b <= c < 1 << 31 for a, b, c in zip(start, part, full, strict=True))
    if not fits:
        raise InputError(f"{path}: its GPano metadata name no part of a sphere; correct or remove them")
    height, width = image.pixels.shape[:2]
    rows = round(full[0] * height / part[0])
    columns = round(rows * full[1] / full[0])
    said = f"{path}: a part of a sphere (GPano) of {columns} x {rows} pixels"
    memory.require(said, rows * columns * LINEAR_BYTES, "make it smaller")
    log.info("%s; the rest is black", said)
    sphere = np.zeros((rows, columns, 3), np.float32)
    top, left = round(start[0] * height / part[0]), round(start[1] * width / part[1])
    place = sphere[top : top + height, left : left + width]
    place[:] = image.pixels[: place.shape[0], : place.shape[1]]  # roundings may differ by a pixel
    return sphere


@lru_cache(maxsize=2)  # converting a rig takes seconds, and relight reads the same light several times
def _latlong(path: Path) -> Tensor:
    """Convert a JSON light's rig, or its coefficients if it has no rig, to a map."""
    record = read_light(path)
    if len(record.directions):
        return rig_to_latlong(RigLight(record.directions, record.weights), _JSON_ROWS)
    assert record.sh is not None
    return positive_latlong(record.sh, _JSON_ROWS)
