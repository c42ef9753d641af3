"""The training bank: baked heads and fitted views of them, held in memory."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.stage.baked_faces import Geometry, draw_sample
from facerf_cli.stage.lids import lid_shadows
from facerf_cli.stage.samples import Sample
from facerf_cli.stage.shards import in_shards
from facerf_cli.stage.views import build_views


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
