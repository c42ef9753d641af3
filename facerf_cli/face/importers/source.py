"""A face model in its publisher's topology."""

from dataclasses import dataclass, field

import numpy as np

_MAX_VERTICES, _MAX_TRIANGLES = 120_000, 240_000


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases in standard deviations.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3], triangles [F, 3] of the outer surface; known: the
    points on the mean of those of the 68 landmarks that the publisher names, by number.
    """

    name: str
    licence: str
    mean: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]
    triangles: np.ndarray
    known: dict[int, np.ndarray] = field(default_factory=dict)


def require_mesh(mean: np.ndarray, triangles: np.ndarray) -> None:
    """Raise ValueError unless mean [N, 3] is finite and triangles [F, 3] name its vertices."""
    if mean.ndim != 2 or mean.shape[1] != 3 or not 100 <= len(mean) <= _MAX_VERTICES:
        raise ValueError(f"its mean has shape {list(mean.shape)}, not [N, 3]")
    if not np.isfinite(mean).all():
        raise ValueError("its mean holds values that are not finite")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not 1 <= len(triangles) <= _MAX_TRIANGLES:
        raise ValueError(f"its triangles have shape {list(triangles.shape)}, not [F, 3]")
    if triangles.min() < 0 or triangles.max() >= len(mean):
        raise ValueError("its triangles name vertices that it does not have")
