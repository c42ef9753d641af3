"""The bank of training heads: baked heads and fitted views of each, loaded into memory."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.files.atomic import atomic_path
from facerf_cli.synth.baked_samples import draw_sample
from facerf_cli.synth.head_fields import HeadFields, head_fields
from facerf_cli.synth.texture_samples import Sample
from facerf_cli.synth.views import build_views
from facerf_cli.workers import in_shards


@dataclass(frozen=True)
class Bank:
    """Baked heads and their views, a `SampleSource`; head 0 is the mean face."""

    baked: list[HeadFields]
    views: list[dict[str, Tensor]]  # from `views.build_views`
    provenance: dict[str, Any]

    @property
    def side(self) -> int:
        """Texels along a side of every field."""
        return int(self.baked[0].normals.shape[-1])

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices of the training heads, and of the first `held_out` heads after the mean face."""
        return torch.arange(held_out + 1, len(self.baked)), torch.arange(1, held_out + 1)

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of each head in `heads` [B], with `lights` target lights."""
        chosen = [(self.baked[int(head)], self.views[int(head)]) for head in heads]
        return draw_sample(chosen, lights, generator)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and light directions [L, 3] of head 0, head frame."""
        mean = self.baked[0]
        return mean.normals, mean.visibility.float() / 255, mean.directions


def add_views(heads: Path, views: Path, fitted_with: str, count: int, jobs: int, seed: int) -> None:
    """Write `count` fitted views of every baked head in `heads` to `views`; keep finished ones."""
    views.mkdir(parents=True, exist_ok=True)
    missing = [path for path in sorted(heads.glob("*.safetensors")) if not (views / path.name).exists()]
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


def load_bank(heads: Path, views: Path, provenance: dict[str, Any]) -> Bank:
    """Load all heads that have both a bake and views; raise InputError if there are none."""
    found = [path for path in sorted(heads.glob("*.safetensors")) if (views / path.name).exists()]
    if not found:
        raise InputError(f"{heads}: no baked heads with views; run `facerf train` to build them")
    return Bank(
        [head_fields(load_file(path)) for path in found],
        [load_file(views / path.name) for path in found],
        provenance,
    )
