"""The training bank: baked heads and fitted views of them, held in memory.

Synthetic heads with baked light transport: the geometry half of the training bank.

Torch on one thread for a while: sums then come out the same whatever the machine and the other work.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scipy.spatial.transform import Rotation
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.synth.shading import lid_shadows
from facerf_cli.synth.texture_samples import Geometry, Sample, draw_sample
from facerf_cli.synth.views import build_views
from facerf_cli.workers import in_shards


@dataclass(frozen=True)
class Bank:
    """Heads and their views; head 0 is the mean face."""

    geometries: list[Geometry]
    views: list[dict[str, Tensor]]  # as `stage.views` writes them
    provenance: dict[str, Any]

    @property
    def side(self) -> int:
        """Texels along a side of every field."""
        return int(self.geometries[0].normals.shape[-1])

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices of the heads to train on, and of the first `held_out` after the mean face."""
        return torch.arange(held_out + 1, len(self.geometries)), torch.arange(1, held_out + 1)

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """One sample of every head in `heads` [B], with `lights` target lights."""
        chosen = [(self.geometries[int(head)], self.views[int(head)]) for head in heads]
        return draw_sample(chosen, lights, generator)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of head 0, in the head frame."""
        mean = self.geometries[0]
        return mean.normals, mean.visibility.float() / 255, mean.directions


def add_views(geometries: Path, views: Path, fitted_with: str, count: int, jobs: int, seed: int) -> None:
    """Write `count` fitted views of every baked head; finished heads are kept."""
    views.mkdir(parents=True, exist_ok=True)
    missing = [path for path in sorted(geometries.glob("*.safetensors")) if not (views / path.name).exists()]
    in_shards(partial(_add_views_shard, views, fitted_with, count, seed), missing, jobs)


def _add_views_shard(views: Path, fitted_with: str, count: int, seed: int, heads: list[Path]) -> None:
    torch.set_num_threads(1)
    model = load_face_model(fitted_with)
    for path in heads:
        head = load_file(path)
        tensors = build_views(
            head["vertices"], model, count, head["visibility"].shape[-1], seed + int(path.stem)
        )
        with atomic_path(views / path.name) as temporary:
            save_file(tensors, temporary, metadata={"fitted_with": model.name})


def load_bank(geometries: Path, views: Path, provenance: dict[str, Any]) -> Bank:
    """All heads that have both a bake and views."""
    heads = [path for path in sorted(geometries.glob("*.safetensors")) if (views / path.name).exists()]
    if not heads:
        raise InputError(f"{geometries}: no baked heads with views; let `facerf train` build them anew")
    return Bank(
        [geometry_of(load_file(path)) for path in heads],
        [load_file(views / path.name) for path in heads],
        provenance,
    )


def geometry_of(head: dict[str, Tensor]) -> Geometry:
    """The fields of one baked head, as `stage.geometries` writes it."""
    side = head["visibility"].shape[-1]
    positions = bake_attributes(head["vertices"], GRID, side)
    normals = normal_map(head["vertices"], grid_triangles(), side)
    along_u = F.normalize(_central_difference(positions, -1), dim=0)
    along_v = F.normalize(_central_difference(positions, -2), dim=0)
    lit = head["visibility"] * lid_shadows(head["directions"], side)
    visibility = lit.round().byte()
    return Geometry(positions, normals, (along_u, along_v), head["directions"], visibility, head["bounce"])


def _central_difference(field: Tensor, dim: int) -> Tensor:
    return torch.gradient(field, dim=dim)[0]


_LEFT_OUT = ("PupilDilate", "mouthClose", "eyeLook")  # no shape of skin, or correctives of another shape
_COMMON = ("jawOpen", "jaw_open", "mouthSmile", "smile")  # photographs show these more than the rest
_SIDE = re.compile(r"(?<!jaw)_(L|R|left|right)$")  # a jaw that goes left does not go right as well

_BAKE = BakeSettings(lamp_samples=4, bounce_samples=16)


@dataclass(frozen=True)
class GeometrySettings:
    """How heads are drawn and baked: `side` texels, `lights` in a rig that is turned anew for each head."""

    side: int = 128
    lights: int = 150
    identity_std: tuple[float, float] = (0.7, 1.3)  # evenly between, a head
    free_std: float = 0.6  # of the built-in model's smooth deformations, which no other model's shapes span
    neutral_share: float = 0.35
    bake: BakeSettings = _BAKE


def build_geometries(
    folder: Path,
    face_model: str,
    count: int,
    jobs: int,
    seed: int,
    settings: GeometrySettings = GeometrySettings(),
) -> None:
    """Bake `count` heads into `folder`, 00000 (the mean) and on; finished ones are kept.

    Heads of another face model are an InputError: they would be trained on under this one's name and licence.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _require_heads_of(load_face_model(face_model).name, folder)
    missing = [index for index in range(count) if not (folder / f"{index:05d}.safetensors").exists()]
    in_shards(partial(_build_shard, folder, face_model, seed, settings), missing, jobs)


def _require_heads_of(name: str, folder: Path) -> None:
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            found = (file.metadata() or {}).get("face_model")
        if found != name:
            raise InputError(f"{path}: a head of the face model {found}, not of {name}; give another --bank")


def _build_shard(
    folder: Path, face_model: str, seed: int, settings: GeometrySettings, indices: list[int]
) -> None:
    torch.set_num_threads(1)
    model = load_face_model(face_model)
    for index in indices:
        tensors = bake_head(model, index, seed, settings)
        unfinished = folder / f"{index:05d}.partial"
        save_file(tensors, unfinished, metadata={"face_model": model.name})
        unfinished.rename(folder / f"{index:05d}.safetensors")


def bake_head(model: MorphableModel, index: int, seed: int, settings: GeometrySettings) -> dict[str, Tensor]:
    """One head: vertices [V, 3] (m, head frame), directions [L, 3], visibility and bounce [L, T, T] as bytes.

    `bounce` is stored as the square root, times 255.
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


def _free_deformation(random: np.random.Generator, settings: GeometrySettings) -> Tensor:
    """A smooth change of shape [V, 3] (m), of the built-in model's Gaussian process."""
    basis = load_face_model(BUILTIN).identity
    weights = torch.from_numpy(random.normal(0, settings.free_std, len(basis))).float()
    return torch.einsum("k,kvc->vc", weights, basis)


def _bytes(values: np.ndarray) -> Tensor:
    return torch.from_numpy((np.clip(values, 0, 1) * 255).round().astype(np.uint8))


def mean_coefficients(model: MorphableModel) -> tuple[Tensor, Tensor]:
    """alpha [Ki] and beta [Ke] of the mean face."""
    return torch.zeros(len(model.identity)), torch.zeros(len(model.expression))


def draw_coefficients(
    model: MorphableModel, random: np.random.Generator, settings: GeometrySettings
) -> tuple[Tensor, Tensor]:
    """A random person alpha [Ki], and an expression beta [Ke] of a few shapes, mostly alike on both sides."""
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


@contextmanager
def one_thread() -> Iterator[None]:
    """Within the block torch computes on one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
