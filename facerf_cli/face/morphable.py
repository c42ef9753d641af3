"""Morphable models on the canonical topology (paper, 'Reflectance Field Representation'), and their files.

The canonical mesh of `face.topology` ends at the forehead, the cheeks and the chin and is flat over eyes and
mouth. A synthetic light stage also needs ears, a skull, eyeballs and teeth: a model can have a whole head in
its authors' topology, driven by the same coefficients.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.topology import GRID, LAYOUT_VERSION, landmark_weights, on_device
from facerf_cli.run.logs import one_line

BUILTIN = "builtin"
BUILTIN_PATH = Path(__file__).parent.parent / "assets" / "builtin_face.npz"
HEAD_PARTS = ("skin", "eye", "mouth", "teeth")  # values of HeadModel.part, by index
EXPRESSION_STD = 0.3  # the share of a full blendshape that a coefficient of 1 means, in imported models
# Types of a head's arrays in a face model's file, under names that begin with `_HEAD_PREFIX`.
_HEAD_TYPES = {
    "mean": np.float32,
    "identity": np.float16,
    "expression": np.float16,
    "triangles": np.int32,
    "part": np.uint8,
    "uv": np.float32,
}
_HEAD_PREFIX = "head_"
_MAX_VERTICES, _MAX_TRIANGLES = 60_000, 120_000  # of a head
_MAX_COEFFICIENTS = 500
_MAX_LETTERS = 2000  # of a name or a licence
MAX_ARRAYS, _MAX_BYTES = 64, 1 << 30  # of a file


@dataclass(frozen=True, eq=False)
class HeadModel:
    """A linear model of a whole head; metres, head frame, bases scaled like those of the canonical mesh.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3] float32; triangles [F, 3] int64, counter-clockwise
    seen from outside; part [N] uint8, an index into `HEAD_PARTS`; a triangle has the largest part of its
    corners. uv [N, 2]: skin has the (u, v) of `face.topology`, continued on all sides, with a jump of u by a
    full turn at the back of the head; an eye has the unit disc about its gaze axis (radius 1 at 90 degrees).
    """

    mean: Tensor
    identity: Tensor
    expression: Tensor
    triangles: Tensor
    part: Tensor
    uv: Tensor

    def vertices(self, alpha: Tensor, beta: Tensor) -> Tensor:
        """The vertices mean + M_id alpha + M_exp beta [N, 3] for alpha [Ki] and beta [Ke]."""
        offset = alpha @ self.identity.flatten(1) + beta @ self.expression.flatten(1)
        return self.mean + offset.view(-1, 3)

    def to(self, device: torch.device | str) -> "HeadModel":
        """The same model with its arrays on `device`."""
        return replace(self, **{key: getattr(self, key).to(device) for key in _HEAD_TYPES})


@dataclass(frozen=True, eq=False)  # caches compare models by identity
class MorphableModel:
    """A linear face model; lengths in metres, head frame, bases scaled by their standard deviations.

    mean [V, 3], identity [Ki, V, 3], expression [Ke, V, 3]; every coefficient has a standard normal prior
    and zeros give the neutral mean. `head` is the whole head in the authors' topology, if they publish one.
    """

    name: str
    licence: str
    mean: Tensor
    identity: Tensor
    expression: Tensor
    expression_names: tuple[str, ...]
    head: HeadModel | None = None

    @property
    def stamp(self) -> dict[str, str]:
        """Name and licence as metadata of everything made with the model."""
        return {"face_model": self.name, "face_model_licence": self.licence}

    @property
    def credit(self) -> str:
        """Name and licence in one text."""
        return f"{self.name} ({self.licence})"

    def vertices(self, alpha: Tensor, beta: Tensor) -> Tensor:
        """The vertices mean + M_id alpha + M_exp beta [B, V, 3] for alpha [B, Ki] and beta [B, Ke]."""
        offset = alpha @ self.identity.flatten(1) + beta @ self.expression.flatten(1)
        return self.mean + offset.view(len(offset), -1, 3)

    def landmarks(self, vertices: Tensor) -> Tensor:
        """The 68 landmarks [B, 68, 3] of vertices [B, V, 3]."""
        corners, weights = on_device(vertices.device, landmark_weights)
        return (vertices[:, corners] * weights[..., None].to(vertices.dtype)).sum(2)

    def pose_only(self) -> "MorphableModel":
        """The model with shapes of zero, so that its fit is a pose alone (paper, 'Ablative Study')."""
        return replace(
            self,
            name=f"{self.name}-mean",
            identity=self.identity[:1] * 0,
            expression=self.expression[:1] * 0,
            expression_names=self.expression_names[:1],
            head=None,
        )

    def to(self, device: torch.device | str) -> "MorphableModel":
        """The same model with its arrays on `device`."""
        mean, identity, expression = (x.to(device) for x in (self.mean, self.identity, self.expression))
        head = self.head and self.head.to(device)
        return replace(self, mean=mean, identity=identity, expression=expression, head=head)


def load_face_model(name_or_path: str | Path = BUILTIN) -> MorphableModel:
    """Load the built-in model (once a process) or a file of `facerf face-model import`.

    Raises InputError for a missing or a different file.
    """
    return _builtin() if str(name_or_path) == BUILTIN else _read(Path(name_or_path))


@cache  # one object, by which other caches are keyed
def _builtin() -> MorphableModel:
    return _read(BUILTIN_PATH)


def _read(path: Path) -> MorphableModel:
    if not path.is_file():
        raise InputError(
            f"{path}: no such face model; give '{BUILTIN}' or a file of `facerf face-model import`"
        )
    try:
        _require_size(path, _MAX_BYTES)
        with np.load(path, allow_pickle=False) as arrays:
            return _from_arrays(path, arrays)
    except InputError:
        raise
    except Exception as error:  # whatever damage makes zipfile and numpy raise
        raise InputError(
            f"{path}: not a facerf face model ({one_line(str(error))}); "
            "import it with `facerf face-model import`"
        ) from None


def _from_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> MorphableModel:
    if int(arrays["layout_version"]) != LAYOUT_VERSION:
        raise InputError(
            f"{path}: it has another UV layout; import the face model again with this version of facerf"
        )
    mean, identity, expression = _shapes(arrays, "", GRID * GRID)
    names = tuple(str(name) for name in arrays["expression_names"])
    name, licence = (_printable(arrays[key]) for key in ("name", "licence"))
    head = _head(arrays, len(identity), len(expression)) if _HEAD_PREFIX + "mean" in arrays else None
    return MorphableModel(name, licence, mean, identity, expression, names, head)


def _head(arrays: Mapping[str, np.ndarray], identities: int, expressions: int) -> HeadModel:
    vertices, faces = (len(arrays[_HEAD_PREFIX + key]) for key in ("mean", "triangles"))
    if not 3 <= vertices <= _MAX_VERTICES or not 1 <= faces <= _MAX_TRIANGLES:
        raise ValueError(f"its head has {vertices} vertices and {faces} triangles")
    mean, identity, expression = _shapes(arrays, _HEAD_PREFIX, vertices, identities, expressions)
    triangles = _indices(arrays, "triangles", (faces, 3), vertices).long()
    part = _indices(arrays, "part", (vertices,), len(HEAD_PARTS)).byte()
    return HeadModel(mean, identity, expression, triangles, part, floats(arrays, "head_uv", (vertices, 2)))


def _shapes(
    arrays: Mapping[str, np.ndarray],
    prefix: str,
    vertices: int,
    identities: int | None = None,
    expressions: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean [N, 3] and shapes [Ki, N, 3] and [Ke, N, 3] of a file's arrays."""
    mean = floats(arrays, prefix + "mean", (vertices, 3))
    identity = floats(arrays, prefix + "identity", (identities, vertices, 3))
    return mean, identity, floats(arrays, prefix + "expression", (expressions, vertices, 3))


def floats(arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...]) -> Tensor:
    """An array as float32; raises ValueError for another shape (None: any of a basis), NaN or infinity."""
    array = arrays[key]
    expected = (len(array), *shape[1:]) if shape[0] is None else shape
    if array.shape != expected or (shape[0] is None and len(array) > _MAX_COEFFICIENTS):
        raise ValueError(f"{key} has shape {array.shape}, not {shape}")
    tensor = torch.from_numpy(array.astype(np.float32))
    if not tensor.isfinite().all():
        raise ValueError(f"{key} holds values that are not finite")
    return tensor


def _indices(arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...], count: int) -> Tensor:
    """An array of a head's indices below `count`; raises ValueError for anything else."""
    array = arrays[_HEAD_PREFIX + key]
    if array.shape != shape or array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= count:
        raise ValueError(f"{_HEAD_PREFIX}{key} is not of shape {shape}, or holds indices out of range")
    return torch.from_numpy(array)


def _printable(array: np.ndarray) -> str:
    """A name or licence as one line of limited length, safe for metadata and the terminal."""
    return "".join(letter for letter in one_line(str(array))[:_MAX_LETTERS] if letter.isprintable())


def read_npz(path: Path, most_bytes: int = _MAX_BYTES) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz by name, without pickles; `most_bytes` bounds them together.

    Raises ValueError with a reason in one line for any other file, and for too many or too large arrays.
    """
    try:
        _require_size(path, most_bytes)
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("it holds a file that is not an array")
        return arrays
    except Exception as error:  # whatever damage makes zipfile and numpy raise
        raise ValueError(one_line(str(error))) from None


def _require_size(path: Path, most_bytes: int) -> None:
    """Raise ValueError for an .npz of too many or too large arrays, which a small file may be unpacked to."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    if len(entries) > MAX_ARRAYS:
        raise ValueError(f"it holds {len(entries)} arrays; at most {MAX_ARRAYS} are read")
    if sum(entry.file_size for entry in entries) > most_bytes:
        raise ValueError(f"its arrays are too large; {most_bytes} bytes are read at most")


def save_face_model(path: Path, model: MorphableModel) -> None:
    """Write a model as .npz without pickles; bases in half precision (steps below 0.02 mm)."""
    head: dict[str, Any] = {}
    if model.head is not None:
        for key, kind in _HEAD_TYPES.items():
            head[_HEAD_PREFIX + key] = getattr(model.head, key).numpy().astype(kind)
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            layout_version=LAYOUT_VERSION,
            name=model.name,
            licence=model.licence,
            mean=model.mean.numpy(),
            identity=model.identity.numpy().astype(np.float16),
            expression=model.expression.numpy().astype(np.float16),
            expression_names=np.array(model.expression_names, dtype=np.str_),
            **head,
        )
