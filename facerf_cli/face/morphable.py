"""Morphable models on the canonical topology (paper, 'Reflectance Field Representation'), and their files."""

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
MEAN = "-mean"  # ends the name of a model of pose alone
BUILTIN_PATH = Path(__file__).parent.parent / "assets" / "builtin_face.npz"
EXPRESSION_STD = 0.3  # the share of a full blendshape that a coefficient of 1 means, in imported models
_MAX_COEFFICIENTS = 500
_MAX_LETTERS = 2000  # of a name or a licence
MAX_ARRAYS, _MAX_BYTES = 64, 1 << 30  # of a file


@dataclass(frozen=True, eq=False)  # caches compare models by identity
class MorphableModel:
    """A linear face model; lengths in metres, head frame, bases scaled by their standard deviations.

    mean [V, 3], identity [Ki, V, 3], expression [Ke, V, 3]; every coefficient has a standard normal prior
    and zeros give the neutral mean.
    """

    name: str
    licence: str
    mean: Tensor
    identity: Tensor
    expression: Tensor
    expression_names: tuple[str, ...]

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
            name=self.name + MEAN,
            identity=self.identity[:1] * 0,
            expression=self.expression[:1] * 0,
            expression_names=self.expression_names[:1],
        )

    def to(self, device: torch.device | str) -> "MorphableModel":
        """The same model with its arrays on `device`."""
        mean, identity, expression = (x.to(device) for x in (self.mean, self.identity, self.expression))
        return replace(self, mean=mean, identity=identity, expression=expression)


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
    mean = floats(arrays, "mean", (GRID * GRID, 3))
    identity, expression = (floats(arrays, key, (None, GRID * GRID, 3)) for key in ("identity", "expression"))
    names = tuple(str(name) for name in arrays["expression_names"])
    name, licence = (_printable(arrays[key]) for key in ("name", "licence"))
    return MorphableModel(name, licence, mean, identity, expression, names)


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
