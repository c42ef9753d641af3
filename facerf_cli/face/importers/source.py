"""Face model in its publisher's topology, and checks of the arrays in its file."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.run.logs import one_line

_MAX_VERTICES, _MAX_TRIANGLES, _MAX_SHAPES = 120_000, 240_000, 500


@dataclass(frozen=True)
class SourceModel:
    """Morphable model in its published topology: metres, y up, z out of the face.

    Raises ValueError for arrays that do not fit each other or are too large.
    """

    name: str
    licence: str
    mean: np.ndarray  # [N, 3]
    identity: np.ndarray  # [Ki, N, 3] per standard deviation
    expression: np.ndarray  # [Ke, N, 3] per standard deviation
    expression_names: tuple[str, ...]
    triangles: np.ndarray  # [F, 3] of the outer surface
    known: dict[int, np.ndarray] = field(default_factory=dict)  # points on the mean by number of the landmark

    def __post_init__(self) -> None:
        sizes = len(self.mean), len(self.triangles), len(self.identity), len(self.expression)
        limits = _MAX_VERTICES, _MAX_TRIANGLES, _MAX_SHAPES, _MAX_SHAPES
        if min(sizes[:3]) < 1 or any(size > limit for size, limit in zip(sizes, limits, strict=True)):
            raise ValueError("it has {} vertices, {} triangles and {} + {} shapes".format(*sizes))
        if not self.identity.shape[1:] == self.expression.shape[1:] == self.mean.shape:
            raise ValueError(f"its shapes do not have the {len(self.mean)} vertices of its mean")
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.mean):
            raise ValueError("its triangles use vertices that it does not have")


@contextmanager
def refusal(path: Path, published: str) -> Iterator[None]:
    """Convert errors of a damaged file to a one-line InputError; `published` describes the right file."""
    try:
        yield
    except FacerfError:
        raise
    except Exception as error:  # damaged archives and arrays raise many kinds
        reason = one_line(str(error) or type(error).__name__)[:160]
        raise InputError(f"{path}: not {published} ({reason}); download it again") from None


def numbers(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an array of a file; raises ValueError if it is missing, has another shape or is not finite."""
    if name not in arrays:
        raise ValueError(f"it lacks {name}")
    array = np.asarray(arrays[name])
    expected = [size if wanted is None else wanted for size, wanted in zip(array.shape, shape, strict=False)]
    if array.dtype.kind not in "fiu" or array.ndim != len(shape) or list(array.shape) != expected:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} is {array.dtype} of shape {list(array.shape)}, not numbers [{wanted}]")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} contains non-finite values")
    return array
