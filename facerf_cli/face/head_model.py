"""A morphable model's whole head in the topology of its authors: what lies around and inside the chart.

The canonical mesh of `face.topology` ends at the forehead, the cheeks and the chin and runs flat over eyes
and lips. A synthetic light stage needs ears, a skull, eyeballs and teeth; this keeps them, driven by the same
coefficients.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

HEAD_PARTS = ("skin", "eye", "mouth", "teeth")  # of HeadModel.part, by index
_MAX_VERTICES, _MAX_TRIANGLES = 60_000, 120_000
_KEYS = ("mean", "identity", "expression", "triangles", "part", "uv")
_PREFIX = "head_"  # of the arrays in a face model's file


@dataclass(frozen=True, eq=False)
class HeadModel:
    """A linear model of a whole head; metres, head frame, bases scaled as those of the canonical mesh.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3] float32; triangles [F, 3] int64, counter-clockwise
    seen from outside; part [N] uint8, an index into `HEAD_PARTS`: a triangle belongs to the largest of its
    corners'; uv [N, 2]: of skin the chart of `face.topology`, left on all sides, u jumping by a full turn at
    the back of the head; of an eye the unit disc about its gaze axis (radius 1 at 90 degrees).
    """

    mean: Tensor
    identity: Tensor
    expression: Tensor
    triangles: Tensor
    part: Tensor
    uv: Tensor

    def vertices(self, alpha: Tensor, beta: Tensor) -> Tensor:
        """mean + M_id alpha + M_exp beta, for alpha [Ki] and beta [Ke], as [N, 3]."""
        offset = alpha @ self.identity.flatten(1) + beta @ self.expression.flatten(1)
        return self.mean + offset.view(-1, 3)

    def to(self, device: torch.device | str) -> "HeadModel":
        """The same model with its arrays on `device`."""
        return replace(self, **{key: getattr(self, key).to(device) for key in _KEYS})


def head_to_arrays(head: HeadModel | None) -> dict[str, Any]:
    """Arrays for a face model's file; bases in half precision. None for no head."""
    if head is None:
        return {}
    kinds = (np.float32, np.float16, np.float16, np.int32, np.uint8, np.float32)
    return {
        _PREFIX + key: getattr(head, key).numpy().astype(kind) for key, kind in zip(_KEYS, kinds, strict=True)
    }


def head_from_arrays(arrays: dict[str, np.ndarray], identities: int, expressions: int) -> HeadModel | None:
    """The head among a face model's arrays, if one is there; ValueError or KeyError if it is not whole."""
    if not any(_PREFIX + key in arrays for key in _KEYS):
        return None
    found = {key: arrays[_PREFIX + key] for key in _KEYS}
    _require_shapes(found, identities, expressions)
    _require_indices(found)
    kinds = (np.float32, np.float32, np.float32, np.int64, np.uint8, np.float32)
    tensors = {key: torch.from_numpy(found[key].astype(kind)) for key, kind in zip(_KEYS, kinds, strict=True)}
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise ValueError("its head holds values that are not finite")
    return HeadModel(**tensors)


def _require_shapes(found: dict[str, np.ndarray], identities: int, expressions: int) -> None:
    vertices, triangles = (len(found[key]) if found[key].ndim else 0 for key in ("mean", "triangles"))
    if not 3 <= vertices <= _MAX_VERTICES or not 1 <= triangles <= _MAX_TRIANGLES:
        raise ValueError(f"its head has {vertices} vertices and {triangles} triangles")
    expected = {
        "mean": (vertices, 3),
        "identity": (identities, vertices, 3),
        "expression": (expressions, vertices, 3),
        "triangles": (triangles, 3),
        "part": (vertices,),
        "uv": (vertices, 2),
    }
    for key, shape in expected.items():
        if found[key].shape != shape:
            raise ValueError(f"{_PREFIX}{key} has shape {found[key].shape}, not {list(shape)}")


def _require_indices(found: dict[str, np.ndarray]) -> None:
    for key, count in (("triangles", len(found["mean"])), ("part", len(HEAD_PARTS))):
        values = found[key]
        if values.dtype.kind not in "iu" or values.min() < 0 or values.max() >= count:
            raise ValueError(f"{_PREFIX}{key} holds indices out of range")
