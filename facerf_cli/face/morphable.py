"""Morphable models on the canonical topology (paper, 'Reflectance Field Representation'), and their files.

The canonical mesh of `face.topology` ends at the forehead, the cheeks and the chin and is flat over eyes and
mouth. A synthetic light stage also needs ears, a skull, eyeballs and teeth: a model can have a whole head in
its authors' topology, driven by the same coefficients.
"""

import math
import zipfile
import zlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.topology import GRID, LAYOUT_VERSION, landmark_weights
from facerf_cli.run import memory
from facerf_cli.run.logs import one_line

BUILTIN = "builtin"
BUILTIN_PATH = Path(__file__).parent.parent / "assets" / "builtin_face.npz"
HEAD_PARTS = ("skin", "eye", "mouth", "teeth")  # values of HeadModel.part, by index
# Errors that reading a damaged .npz can raise.
_ZIP_ERRORS = (zlib.error, zipfile.BadZipFile)
# numpy parses a header as a text of Python, and believes its sizes.
_HEADER_ERRORS = (SyntaxError, TokenError, OverflowError, MemoryError, SystemError)
_ARRAY_ERRORS = (ValueError, OSError, LookupError, EOFError, RuntimeError, TypeError, AttributeError)
NPZ_ERRORS = (*_ARRAY_ERRORS, *_HEADER_ERRORS, *_ZIP_ERRORS)
_HEAD_KEYS = ("mean", "identity", "expression", "triangles", "part", "uv")
_HEAD_PREFIX = "head_"  # of the head's arrays in a face model's file
_MAX_VERTICES, _MAX_TRIANGLES = 60_000, 120_000  # of a head
_MAX_COEFFICIENTS = 500
_MAX_LETTERS = 2000  # of a name or a licence
MAX_ARRAYS = 64  # of a file
_COPIES = 3  # of its arrays: as read, as floats of halves, and in between
_MAX_ARRAY_BYTES = 192 << 20  # 500 shapes of a head in half precision


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
        return replace(self, **{key: getattr(self, key).to(device) for key in _HEAD_KEYS})


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
        corners, weights = landmark_weights()
        return (vertices[:, corners] * weights[..., None].to(vertices)).sum(2)

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


@cache
def _builtin() -> MorphableModel:
    return _read(BUILTIN_PATH)


def _read(path: Path) -> MorphableModel:
    if not path.is_file():
        raise InputError(
            f"{path}: no such face model; give '{BUILTIN}' or a file of `facerf face-model import`"
        )
    try:
        if not zipfile.is_zipfile(path):  # numpy would suggest to unpickle it
            raise ValueError("it is not an .npz")
        check_npz_sizes(path)
        with np.load(path, allow_pickle=False) as file:
            return _from_arrays(path, {key: file[key] for key in file.files})
    except NPZ_ERRORS as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else one_line(str(error))
        raise InputError(
            f"{path}: not a facerf face model ({reason}); import it with `facerf face-model import`"
        ) from None


def _from_arrays(path: Path, arrays: dict[str, np.ndarray]) -> MorphableModel:
    if int(arrays["layout_version"]) != LAYOUT_VERSION:
        raise InputError(
            f"{path}: it has another UV layout; import the face model again with this version of facerf"
        )
    vertices = GRID * GRID
    for key in ("identity", "expression"):
        shape = arrays[key].shape
        if len(shape) != 3 or shape[1:] != (vertices, 3) or shape[0] > _MAX_COEFFICIENTS:
            raise ValueError(f"{key} has shape {shape}, not [K, {vertices}, 3]")
    if arrays["mean"].shape != (vertices, 3):
        raise ValueError(f"mean has shape {arrays['mean'].shape}, not [{vertices}, 3]")
    mean, identity, expression = (
        torch.from_numpy(arrays[key].astype(np.float32)) for key in ("mean", "identity", "expression")
    )
    if not all(tensor.isfinite().all() for tensor in (mean, identity, expression)):
        raise ValueError("it holds values that are not finite")
    names = tuple(str(name) for name in arrays["expression_names"])
    head = _head_from_arrays(arrays, len(identity), len(expression))
    name, licence = (_printable(arrays[key]) for key in ("name", "licence"))
    return MorphableModel(name, licence, mean, identity, expression, names, head)


def _head_to_arrays(head: HeadModel | None) -> dict[str, Any]:
    """Convert a head to arrays for a face model's file, bases in half precision; {} for None."""
    if head is None:
        return {}
    kinds = (np.float32, np.float16, np.float16, np.int32, np.uint8, np.float32)
    pairs = zip(_HEAD_KEYS, kinds, strict=True)
    return {_HEAD_PREFIX + key: getattr(head, key).numpy().astype(kind) for key, kind in pairs}


def _head_from_arrays(arrays: dict[str, np.ndarray], identities: int, expressions: int) -> HeadModel | None:
    """The head of a face model's arrays, or None; raises ValueError or KeyError for a damaged head."""
    if not any(_HEAD_PREFIX + key in arrays for key in _HEAD_KEYS):
        return None
    found = {key: arrays[_HEAD_PREFIX + key] for key in _HEAD_KEYS}
    _require_shapes(found, identities, expressions)
    _require_indices(found)
    kinds = (np.float32, np.float32, np.float32, np.int64, np.uint8, np.float32)
    pairs = zip(_HEAD_KEYS, kinds, strict=True)
    tensors = {key: torch.from_numpy(found[key].astype(kind)) for key, kind in pairs}
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
            raise ValueError(f"{_HEAD_PREFIX}{key} has shape {found[key].shape}, not {list(shape)}")


def _require_indices(found: dict[str, np.ndarray]) -> None:
    for key, count in (("triangles", len(found["mean"])), ("part", len(HEAD_PARTS))):
        values = found[key]
        if values.dtype.kind not in "iu" or values.min() < 0 or values.max() >= count:
            raise ValueError(f"{_HEAD_PREFIX}{key} holds indices out of range")


def check_npz_sizes(path: Path, most_bytes: int = _MAX_ARRAY_BYTES) -> None:
    """Check the number and sizes of the arrays in an .npz, and ask the budget for all of them, before a read.

    Raises ValueError for too many or too large ones.
    """
    total = 0
    with zipfile.ZipFile(path) as archive:
        if len(archive.infolist()) > MAX_ARRAYS:
            raise ValueError(f"it holds {len(archive.infolist())} arrays; at most {MAX_ARRAYS} are read")
        for entry in archive.infolist():
            with archive.open(entry) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
                if read is None:
                    raise ValueError(f"{entry.filename} is not an array of version 1.0")
                shape, _, dtype = read(file)
            size = max(entry.file_size, math.prod(shape) * dtype.itemsize)
            if size > most_bytes:
                raise ValueError(f"{entry.filename} is too large")
            total += size
    memory.require(str(path), _COPIES * total, "a smaller file")


def _printable(array: np.ndarray) -> str:
    """A name or licence as one line of limited length, safe for metadata and the terminal."""
    return "".join(letter for letter in one_line(str(array))[:_MAX_LETTERS] if letter.isprintable())


def save_face_model(path: Path, model: MorphableModel) -> None:
    """Write a model as .npz without pickles; bases in half precision (steps below 0.02 mm)."""
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
            **_head_to_arrays(model.head),
        )


@dataclass(frozen=True)
class ModelFacts:
    """A face model's name, licence and number of shapes, and the presence of a head."""

    name: str
    licence: str
    identities: int
    expressions: int
    has_head: bool


def read_model_facts(path: Path) -> ModelFacts | None:
    """Read the facts of a file of `facerf face-model import` without its shapes; None for any other file."""
    try:
        if not zipfile.is_zipfile(path):
            return None
        check_npz_sizes(path)
        with np.load(path, allow_pickle=False) as file:
            if not {"layout_version", "name", "licence", "identity", "expression"} <= set(file.files):
                return None
            name, licence = (_printable(file[key]) for key in ("name", "licence"))
            has_head = "head_mean" in file.files
        return ModelFacts(name, licence, _count(path, "identity"), _count(path, "expression"), has_head)
    except (*NPZ_ERRORS, InputError):
        return None


def _count(path: Path, key: str) -> int:
    """The length of an array in an .npz, from its header alone."""
    with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as file:
        np.lib.format.read_magic(file)
        shape, _, _ = np.lib.format.read_array_header_1_0(file)
    return int(shape[0])
