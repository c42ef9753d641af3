"""Squares of the people of a prepared dataset, for the stage `portrait` in place of synthetic people.

    portraits-192/SUBJECT/CAMERA.safetensors   OLATs of a stack and their analysis; empty without a face

A view is processed like a user's photo of its crop: the person is found, fitted and segmented in the fully
lit image, and the result is stored in the square that the Portrait Network sees. The albedo, normals and
classes of real people are unknown: the fully lit image replaces the albedo, the predicted classes the true
ones.
"""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset, people_of, provenance_of, read_dataset
from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.files.texts import is_made_from, text_of_state
from facerf_cli.files.write import HALF_MAX
from facerf_cli.light.sphere import rig_directions
from facerf_cli.portrait.person import SIDE_PX
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.bank.portrait_samples import (
    LitPerson,
    PortraitSample,
    sample_of,
    source_light,
)
from facerf_cli.synth.bank.proxies import layers_of, person_in
from facerf_cli.synth.bank.texture_samples import draw_target_lights

_AROUND = 48  # lights from all directions whose shadows are summarised, as for photos
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class DatasetSquares:
    """Prepared dataset and its squares, a `PortraitSource`; people are indices of `views`."""

    dataset: Dataset
    views: list[list[Path]]  # of each person in the split train or validation, those that show a face
    training: int  # number of people of the split train, which come first
    backgrounds: Tensor
    provenance: dict[str, Any]

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """Return indices of the people of the split train, and of at most `held_out` of validation."""
        everyone = list(range(len(self.views)))
        return everyone[: self.training], everyone[self.training :][:held_out]

    def sides_px(self, people: Sequence[int]) -> list[int]:
        """See `PortraitSource`: all are the same."""
        return [SIDE_PX]

    def draw(
        self, people: Sequence[int], targets: int, generator: torch.Generator, side_px: int | None = None
    ) -> PortraitSample:
        """Draw a sample [1, ...] of one of the people, with `targets` lights."""
        views = self.views[people[int(torch.randint(len(people), (), generator=generator))]]
        seen = load_file(views[int(torch.randint(len(views), (), generator=generator))])
        rig, olats, classes = seen["directions"], seen["olats"], seen["classes"].float() / 255
        weights = source_light(rig, generator)
        chosen = draw_target_lights(rig, targets, generator)
        photo = torch.einsum("lc,lcij->cij", weights, olats.float())
        lacking = len(self.dataset.light_ids) - len(rig)  # of this person; a batch has one number of lights
        lit = LitPerson(
            images=torch.cat([photo[None], olats[chosen].float()]),
            albedo=seen["lit"].float(),
            normals=None,
            shares=classes,
            behind=classes[0] * seen["inside"],
            rig=torch.cat([rig, rig[:1].expand(lacking, -1)]),
            weights=F.pad(weights, (0, 0, 0, lacking)),
            chosen=chosen,
        )
        seen["visible"] = F.pad(seen["visible"], (0, 0, 0, 0, 0, lacking))
        return sample_of(lit, seen, self.backgrounds, generator)


def open_squares(folder: Path, backgrounds: Tensor, networks: Networks, jobs: int) -> DatasetSquares:
    """Open the dataset in a folder, and make missing squares of its splits train and validation.

    Raises InputError if no face is found in a split.
    """
    dataset = read_dataset(folder)
    people = {split: people_of(dataset, split) for split in ("train", "validation")}
    _make_missing(dataset, networks, jobs)
    views: dict[str, list[list[Path]]] = {}
    for split, subjects in people.items():
        paths = [[_path(dataset, *view) for view in _of(dataset, [who])] for who in subjects]
        with_a_face = [[path for path in of_one if _shows_a_face(path)] for of_one in paths]
        views[split] = [of_one for of_one in with_a_face if of_one]
        if not views[split]:
            raise InputError(
                f"{folder}: no face was found in the split {split}; run prepare-dataset with another --split"
            )
    provenance = provenance_of(dataset, load_face_model(dataset.face_model))
    everyone = [*views["train"], *views["validation"]]
    return DatasetSquares(dataset, everyone, len(views["train"]), backgrounds, provenance)


def _shows_a_face(path: Path) -> bool:
    with safe_open(path, framework="pt") as file:
        return bool(file.keys())


def _of(dataset: Dataset, subjects: Sequence[str]) -> list[tuple[str, str]]:
    return [(subject, camera) for subject in subjects for camera in dataset.cameras[subject]]


def _path(dataset: Dataset, subject: str, camera: str) -> Path:
    return dataset.folder / f"portraits-{SIDE_PX}" / subject / f"{camera}.safetensors"


def _make_missing(dataset: Dataset, networks: Networks, jobs: int) -> None:
    views = _of(dataset, [*dataset.splits["train"], *dataset.splits["validation"]])
    missing = [
        view
        for view in views
        if not is_made_from(_path(dataset, *view), _made_from(dataset, networks, *view))
    ]
    if missing:
        folder = dataset.folder / f"portraits-{SIDE_PX}"
        log.info("%s: analysing the people of %d stacks (done once)", folder, len(missing))
        in_shards(partial(_make_shard, dataset, networks), missing, jobs)


def _made_from(dataset: Dataset, networks: Networks, subject: str, camera: str) -> str:
    """Return text that changes if the stack or the network that analyses the person changes."""
    stack = text_of_state(dataset.stack_path(subject, camera))
    return f"{LAYOUT_VERSION}-{stack}-{networks.sha256('parsing')}"


def _make_shard(dataset: Dataset, networks: Networks, views: list[tuple[str, str]]) -> None:
    with one_thread():
        for view in views:
            tensors: dict[str, Tensor] = {}
            with suppress(InputError):
                tensors = _portrait_of(networks, dataset.stack_path(*view))
            with atomic_path(_path(dataset, *view)) as temporary:
                save_file(tensors, temporary, {"of": _made_from(dataset, networks, *view)})


@torch.no_grad()
def _portrait_of(networks: Networks, stack: Path) -> dict[str, Tensor]:
    """Analyse the person of a stack; raise InputError if no face is found.

    olats [L, 3, S, S], lit [3, S, S] and inside [S, S], where the crop lies: float16; directions [L, 3];
    around uint8 [48, s, s], the visibility of `around_directions`; the layers of `layers_of`.
    """
    header = read_olat_header(stack)
    directions, around = torch.from_numpy(header.directions).float(), rig_directions(_AROUND)
    person = person_in(networks.people, header.source)
    person = person.within(replace(person.square, size_px=SIDE_PX), header.source)
    squared = [
        _in_square(person.square.apply(olat.permute(1, 2, 0).float().numpy())) for olat in read_olats(stack)
    ]
    layers = layers_of(person, torch.cat([directions, around]))
    visible = layers.pop("visible")
    return {
        **layers,
        "visible": visible[:-_AROUND].contiguous(),
        "around": visible[-_AROUND:].contiguous(),
        "around_directions": around,
        "olats": torch.stack(squared),
        "lit": _in_square(person.square.apply(header.source)),
        "inside": torch.from_numpy(person.square.valid(*header.source.shape[:2])).half(),
        "directions": directions,
    }


def _in_square(image: Any) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1).clamp(0, HALF_MAX).half().contiguous()
