"""Draw random heads and bake their light transport: the shapes of the training bank."""

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.workers import in_shards

# Expression shapes that are never drawn: they do not move skin, or correct another shape.
_LEFT_OUT = ("PupilDilate", "mouthClose", "eyeLook")
_COMMON = ("jawOpen", "jaw_open", "mouthSmile", "smile")  # drawn more often, as in photos
_SIDE = re.compile(r"(?<!jaw)_(L|R|left|right)$")  # paired shapes; the jaw moves to one side only
_BAKE = BakeSettings(light_samples=4, bounce_samples=16)


@dataclass(frozen=True)
class HeadBakeSettings:
    """Distribution of heads, and their bake: `side` texels, `lights` in a rig rotated at random per head."""

    side: int = 128
    lights: int = 150
    identity_std: tuple[float, float] = (0.7, 1.3)  # range of the coefficients' standard deviation
    free_std: float = 0.6  # of the built-in model's deformations, which other models may not span
    neutral_share: float = 0.35
    bake: BakeSettings = _BAKE


def bake_heads(
    folder: Path,
    face_model: str,
    count: int,
    jobs: int,
    seed: int,
    settings: HeadBakeSettings = HeadBakeSettings(),
) -> None:
    """Bake `count` heads into `folder`, from 00000 (the mean face) on; keep finished ones.

    Raises InputError for heads of another face model, which would be used under the wrong name and licence.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _require_face_model(load_face_model(face_model).name, folder)
    missing = [index for index in range(count) if not (folder / f"{index:05d}.safetensors").exists()]
    in_shards(partial(_bake_shard, folder, face_model, seed, settings), missing, jobs)


def _require_face_model(name: str, folder: Path) -> None:
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            found = (file.metadata() or {}).get("face_model")
        if found != name:
            raise InputError(f"{path}: the head is of face model {found}, not of {name}; give another --bank")


def _bake_shard(
    folder: Path, face_model: str, seed: int, settings: HeadBakeSettings, indices: list[int]
) -> None:
    torch.set_num_threads(1)
    model = load_face_model(face_model)
    for index in indices:
        tensors = bake_head(model, index, seed, settings)
        unfinished = folder / f"{index:05d}.partial"
        save_file(tensors, unfinished, metadata={"face_model": model.name})
        unfinished.rename(folder / f"{index:05d}.safetensors")


def bake_head(model: MorphableModel, index: int, seed: int, settings: HeadBakeSettings) -> dict[str, Tensor]:
    """Bake head number `index`, a function of (model, index, seed, settings); head 0 is the mean face.

    Returns vertices [V, 3] (m, head frame), directions [L, 3], and visibility and bounce [L, T, T] in bytes;
    bounce is stored as its square root times 255.
    """
    random = np.random.default_rng([seed, index])
    alpha, beta = draw_coefficients(model, random, settings) if index else mean_coefficients(model)
    vertices = model.vertices(alpha[None], beta[None])[0]
    if index:
        vertices = vertices + _free_deformation(random, settings)
    triangles = grid_triangles()
    positions = bake_attributes(vertices, GRID, settings.side).permute(1, 2, 0).numpy()
    normals = normal_map(vertices, triangles, settings.side).permute(1, 2, 0).numpy()
    turn = Rotation.random(random_state=random).as_matrix() if index else np.eye(3)
    directions = np.asarray(rig_directions(settings.lights)) @ turn.T
    transport = bake_transport(
        positions,
        normals,
        vertices.numpy(),
        triangles.numpy(),
        directions,
        settings.bake,
        int(random.integers(1 << 31)),
    )
    return {
        "vertices": vertices.contiguous(),
        "directions": torch.from_numpy(directions).float(),
        "visibility": _bytes(transport.visibility),
        "bounce": _bytes(np.sqrt(transport.bounce)),
    }


def _free_deformation(random: np.random.Generator, settings: HeadBakeSettings) -> Tensor:
    """Draw a smooth deformation [V, 3] (m) from the built-in model's Gaussian process."""
    basis = load_face_model(BUILTIN).identity
    weights = torch.from_numpy(random.normal(0, settings.free_std, len(basis))).float()
    return torch.einsum("k,kvc->vc", weights, basis)


def _bytes(values: np.ndarray) -> Tensor:
    return torch.from_numpy((np.clip(values, 0, 1) * 255).round().astype(np.uint8))


def mean_coefficients(model: MorphableModel) -> tuple[Tensor, Tensor]:
    """Coefficients alpha [Ki] and beta [Ke] of the mean face."""
    return torch.zeros(len(model.identity)), torch.zeros(len(model.expression))


def draw_coefficients(
    model: MorphableModel, random: np.random.Generator, settings: HeadBakeSettings
) -> tuple[Tensor, Tensor]:
    """Draw an identity alpha [Ki] and an expression beta [Ke] of a few shapes, nearly equal on both sides."""
    spread = random.uniform(*settings.identity_std)
    alpha = torch.from_numpy(random.normal(0, spread, len(model.identity))).float()
    beta = torch.zeros(len(model.expression))
    if random.random() < settings.neutral_share:
        return alpha, beta
    names = [name for name in model.expression_names if not name.startswith(_LEFT_OUT)]
    stems = sorted({_SIDE.sub("", name) for name in names})
    chosen = list(random.choice(stems, random.integers(1, 4), replace=False))
    chosen += [stem for stem in _COMMON if stem in stems and random.random() < 0.4]
    for stem in chosen:
        strength = random.uniform(0.1, 1.6) if stem in _COMMON[:2] else random.uniform(0.2, 2.8)
        for index, name in enumerate(model.expression_names):
            if _SIDE.sub("", name) == stem:
                beta[index] = strength * random.uniform(0.7, 1.0)
    return alpha, beta
