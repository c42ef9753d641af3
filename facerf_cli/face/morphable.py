"""Morphable models on the canonical topology, and their files (paper, 'Reflectance Field Representation')."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.topology import GRID, LAYOUT_VERSION, landmark_weights, on_device
from facerf_cli.run.logs import one_line

BUILTIN = "builtin"
MEAN = "-mean"  # suffix of the name of a model with only a pose
BUILTIN_PATH = Path(__file__).parent.parent / "assets" / "builtin_face.npz"
EXPRESSION_STD = 0.3  # fraction of a full blendshape at coefficient 1, in imported models
_MAX_COEFFICIENTS = 500
_MAX_LETTERS = 2000  # of a name or a licence
MAX_ARRAYS, _MAX_BYTES = 64, 1 << 30  # of a file


@dataclass(frozen=True, eq=False)  # caches compare models by identity
class MorphableModel:
    """Linear face model in metres, head frame.

    Every coefficient has a standard normal prior; zeros give the neutral mean.
    """

    name: str
    licence: str
    mean: Tensor  # [V, 3]
    identity: Tensor  # [Ki, V, 3], scaled by the standard deviations
    expression: Tensor  # [Ke, V, 3], scaled by the standard deviations
    expression_names: tuple[str, ...]

    @property
    def stamp(self) -> dict[str, str]:
        """Name and licence, for the metadata of outputs made with the model."""
        return {"face_model": self.name, "face_model_licence": self.licence}

    @property
    def credit(self) -> str:
        """Name and licence in one text."""
        return f"{self.name} ({self.licence})"

    def vertices(self, alpha: Tensor, beta: Tensor) -> Tensor:
        """Compute vertices mean + M_id alpha + M_exp beta [B, V, 3] from alpha [B, Ki] and beta [B, Ke]."""
        offset = alpha @ self.identity.flatten(1) + beta @ self.expression.flatten(1)
        return self.mean + offset.view(len(offset), -1, 3)

    def landmarks(self, vertices: Tensor) -> Tensor:
        """Interpolate the 68 landmarks [B, 68, 3] of vertices [B, V, 3]."""
        corners, weights = on_device(vertices.device, landmark_weights)
        return (vertices[:, corners] * weights[..., None].to(vertices.dtype)).sum(2)

    def pose_only(self) -> "MorphableModel":
        """Return a model with zero shapes, so that a fit only yields the pose (paper, 'Ablative Study')."""
        return replace(
            self,
            name=self.name + MEAN,
            identity=self.identity[:1] * 0,
            expression=self.expression[:1] * 0,
            expression_names=self.expression_names[:1],
        )

    def to(self, device: torch.device | str) -> "MorphableModel":
        """Return a copy with its arrays on `device`."""
        mean, identity, expression = (x.to(device) for x in (self.mean, self.identity, self.expression))
        return replace(self, mean=mean, identity=identity, expression=expression)


def load_face_model(name_or_path: str | Path = BUILTIN) -> MorphableModel:
    """Load the built-in model, once per process, or a file of `facerf face-model import`.

    Raises InputError for a missing file or any other file.
    """
    return _builtin() if str(name_or_path) == BUILTIN else _read(Path(name_or_path))


@cache  # other caches are keyed by this object
def _builtin() -> MorphableModel:
    return _read(BUILTIN_PATH)


def _read(path: Path) -> MorphableModel:
    if not path.is_file():
        raise InputError(
            f"{path}: no such face model; use '{BUILTIN}' or a file of `facerf face-model import`"
        )
    try:
        _require_size(path, _MAX_BYTES)
        with np.load(path, allow_pickle=False) as arrays:
            return _from_arrays(path, arrays)
    except InputError:
        raise
    except Exception as error:  # damaged files raise many kinds in zipfile and numpy
        raise InputError(
            f"{path}: not a facerf face model ({one_line(str(error))}); "
            "import it with `facerf face-model import`"
        ) from None


def _from_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> MorphableModel:
    if int(arrays["layout_version"]) != LAYOUT_VERSION:
        raise InputError(
            f"{path}: uses another UV layout; import the face model again with this version of facerf"
        )
    mean = floats(arrays, "mean", (GRID * GRID, 3))
    identity, expression = (floats(arrays, key, (None, GRID * GRID, 3)) for key in ("identity", "expression"))
    names = tuple(str(name) for name in arrays["expression_names"])
    name, licence = (_printable(arrays[key]) for key in ("name", "licence"))
    return MorphableModel(name, licence, mean, identity, expression, names)


def floats(arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...]) -> Tensor:
    """Return an array as float32; raises ValueError for another shape (None: any length), NaN or infinity."""
    array = arrays[key]
    expected = (len(array), *shape[1:]) if shape[0] is None else shape
    if array.shape != expected or (shape[0] is None and len(array) > _MAX_COEFFICIENTS):
        raise ValueError(f"{key} has shape {array.shape}, not {shape}")
    tensor = torch.from_numpy(array).float()  # far faster than numpy from half precision
    if not tensor.sum().isfinite():
        raise ValueError(f"{key} contains non-finite values")
    return tensor


def _printable(array: np.ndarray) -> str:
    """Convert a name or licence to one line of limited length, safe for metadata and the terminal."""
    return "".join(letter for letter in one_line(str(array))[:_MAX_LETTERS] if letter.isprintable())


def read_npz(path: Path, most_bytes: int = _MAX_BYTES) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz by name, without pickles, up to a total of `most_bytes`.

    Raises ValueError with a one-line reason for other files, and for too many or too large arrays.
    """
    try:
        _require_size(path, most_bytes)
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("it contains a file that is not an array")
        return arrays
    except Exception as error:  # damaged files raise many kinds in zipfile and numpy
        raise ValueError(one_line(str(error))) from None


def _require_size(path: Path, most_bytes: int) -> None:
    """Raise ValueError for an .npz with too many arrays, or arrays that are too large when unpacked."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    if len(entries) > MAX_ARRAYS:
        raise ValueError(f"it contains {len(entries)} arrays, more than {MAX_ARRAYS}")
    if sum(entry.file_size for entry in entries) > most_bytes:
        raise ValueError(f"its arrays are too large: more than {most_bytes} bytes")


def save_face_model(path: Path, model: MorphableModel) -> None:
    """Write a model to an .npz without pickles; bases are in half precision (steps below 0.02 mm)."""
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
        )
