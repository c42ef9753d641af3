"""Read crops of a prepared dataset's pairs for training; sources are summed from OLAT stacks.

A line of relit/pairs.jsonl is a recipe (`dataset/pairs.py`). The source is always summed from its stack, and
the target is one part of a stack; training never reads the images that `relight-dataset` writes. One open
stack provides the sources of many steps. The stage `joint` reads `CropPairs` (paper, 'Dataset'): the source
has a mean radiance of `MEAN_RADIANCE` on the face, the target would have it under a constant map of
radiance 1. The stages that train on textures read crops through `dataset/faces.py`.

Crops are moved at random, because at test time a crop is cut around a detector's box, not around landmarks.
The spreads were measured between `face.crop.from_box` and `face.crop.from_landmarks` on synthetic people in
eight cameras: the box of a turned head is shifted sideways.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.dataset.dataset import PREPARE_AGAIN, Dataset, people_of, read_stack
from facerf_cli.dataset.pairs import Pair, load_pairs, sum_sources
from facerf_cli.dataset.weights import relit_images
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit, load_fit
from facerf_cli.face.topology import grid_triangles, on_device
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.network.inputs import MEAN_RADIANCE, resize
from facerf_cli.raster.camera import Camera, crop_camera
from facerf_cli.raster.texture import UnwrapSettings, point_weights, unwrap
from facerf_cli.synth.bank.texture_samples import draw_light, draw_target_lights

_LOG_SCALE, _SHIFT = 0.07, (0.1, 0.03)  # standard deviations; shifts right and down in sides of the crop
_MOST = 2.0  # standard deviations
_STACKS_OPEN, _SOURCES_EACH = 16, 8  # stacks that take turns, and the number of sources from each
_SOURCES_CACHED = 256  # stacks whose sources are kept, as half floats: enough for 16 samples per step
_STACKS_MEASURED = 24  # used to measure the colours of sources
_STACKS_CACHED = 2048  # at most 32 KiB each at 512 pixels
_SUBJECTS_AVERAGED = 16  # enough for the mean position of heads
_SAME_POSE_SHARE = 0.5  # of samples without pairs
_DARKEST = 1e-4  # lower bound of a mean radiance that images are divided by
# The side of the depth map for unwrapping: a multiple of the crop's, up to a limit.
_DEPTH_PX, _DEPTH_PER_PX = 512, 3


@dataclass(frozen=True)
class CropMove:
    """Scale about a crop's centre, then shift (right, down) in units of its side.

    The crop's camera is fixed: the face moves within the image, as if the box had been another.
    """

    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def draw(generator: torch.Generator) -> "CropMove":
        """Draw a random move."""
        size, right, down = torch.randn(3, generator=generator).clamp(-_MOST, _MOST).tolist()
        return CropMove(float(torch.tensor(_LOG_SCALE * size).exp()), (_SHIFT[0] * right, _SHIFT[1] * down))

    def points(self, share: Tensor) -> Tensor:
        """Move points [..., 2] in units of the crop's side."""
        return (share - 0.5) * self.scale + 0.5 + share.new_tensor(self.shift)

    def image(self, images: Tensor, side: int) -> Tensor:
        """Resample crops [B, C, S, S] to [B, C, side, side]; beyond their border the edge pixels repeat."""
        if self == UNMOVED:
            return resize(images, side)
        right, down = self.shift
        # from the moved crop to the original one, in -1..1
        back = images.new_tensor([[1, 0, -2 * right], [0, 1, -2 * down]]) / self.scale
        grid = F.affine_grid(back[None].expand(len(images), -1, -1), [len(images), 1, side, side], False)
        small = resize(images, side) if images.shape[-1] > side else images  # averages before it samples
        return F.grid_sample(small, grid, padding_mode="border", align_corners=False)


UNMOVED = CropMove()


@dataclass(frozen=True)
class CropPairs(Batch):
    """B pairs of crops of the same people, scene-linear, in the fixed camera of crops of side S.

    source and target [B, 3, S, S], their detected landmarks [B, 68, 2] in crop pixels, the unit vector
    toward the target's light in camera space [B, 3], and the people's places in `Dataset.subjects` [B].
    """

    source: Tensor
    target: Tensor
    source_landmarks_px: Tensor
    target_landmarks_px: Tensor
    light: Tensor
    people: Tensor


@dataclass(frozen=True, eq=False)
class PairReader:
    """Read pairs of some subjects; without pairs, draw random lights and targets.

    Attributes:
        side_px: Side of the crops that `draw` and `read` return.
    """

    dataset: Dataset
    subjects: Sequence[str]
    pairs: list[Pair]
    side_px: int

    @cached_property
    def _by_stack(self) -> dict[tuple[str, str], list[Pair]]:
        pairs_of: dict[tuple[str, str], list[Pair]] = defaultdict(list)
        for pair in self.pairs:
            pairs_of[_source_stack(pair)].append(pair)
        return pairs_of

    def draw_source(
        self, generator_of: Callable[..., torch.Generator], index: int, step: int
    ) -> tuple[Pair, Tensor]:
        """Draw the pair of a sample and its source [3, H, W].

        They depend on `generator_of(index, earlier step)`: the sources of `_SOURCES_EACH` steps come from
        one stack, and `_STACKS_OPEN` stacks take turns.
        """
        turn = step // _STACKS_OPEN % _SOURCES_EACH
        shared = generator_of(index, step - turn * _STACKS_OPEN)
        pair, source = _cached_sources(self, shared.initial_seed())[turn]
        return pair, source.float()

    def draw_sources(self, seed: int) -> list[tuple[Pair, Tensor]]:
        """Draw `_SOURCES_EACH` pairs of one random stack, and their sources [3, H, W] float16."""
        generator = torch.Generator().manual_seed(seed)
        if self.pairs:
            any_pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))]
            of_stack = self._by_stack[_source_stack(any_pair)]
            places = torch.randint(len(of_stack), (_SOURCES_EACH,), generator=generator).tolist()
            pairs = [of_stack[place] for place in places]
            return list(zip(pairs, sum_sources(self.dataset, pairs), strict=True))
        subject = self.subjects[int(torch.randint(len(self.subjects), (), generator=generator))]
        cameras = self.dataset.cameras[subject]
        camera = cameras[int(torch.randint(len(cameras), (), generator=generator))]
        pairs = [self._draw_target(subject, camera, generator) for _ in range(_SOURCES_EACH)]
        path = self.dataset.stack_path(subject, camera)
        directions = stack_info(path).directions
        weights = torch.stack([draw_light(directions, generator) for _ in pairs])
        return list(zip(pairs, relit_images(path, weights), strict=True))

    def _draw_target(self, subject: str, camera: str, generator: torch.Generator) -> Pair:
        """Draw the target of a source whose light no recipe describes."""
        cameras = self.dataset.cameras[subject]
        same_pose = torch.rand((), generator=generator) < _SAME_POSE_SHARE
        other = cameras[int(torch.randint(len(cameras), (), generator=generator))]
        target = camera if same_pose else other
        directions = stack_info(self.dataset.stack_path(subject, target)).directions
        light = int(draw_target_lights(directions, 1, generator))
        return Pair(subject, 0, self.dataset.split_of(subject), camera, "", 0.0, 0, target, light)

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> CropPairs:
        """Draw random pairs, each crop as a detector's box would cut it (see `Objective.draw`)."""
        drawn = []
        for index in range(count):
            pair, source = self.draw_source(generator_of, index, step)
            generator = generator_of(index)
            drawn.append(self._crop(pair, source, CropMove.draw(generator), CropMove.draw(generator)))
        return concatenate(drawn)

    def read(self, pairs: Sequence[Pair]) -> list[CropPairs]:
        """Read the crops of pairs, B = 1, unmoved; neighbouring pairs of a stack open it once."""
        return [
            self._crop(pair, source.float(), UNMOVED, UNMOVED)
            for _, of_stack in groupby(pairs, _source_stack)
            for pairs_of_stack in [list(of_stack)]
            for pair, source in zip(pairs_of_stack, sum_sources(self.dataset, pairs_of_stack), strict=True)
        ]

    def read_target(self, pair: Pair, move: CropMove = UNMOVED) -> Tensor:
        """Read the target [1, 3, S, S] of a pair, exposed."""
        path = self.dataset.stack_path(pair.subject, pair.target_camera)
        target = read_olats(path, [pair.target_light]).float()
        return move.image(target * (MEAN_RADIANCE / stack_info(path).lit_mean), self.side_px)

    def _crop(self, pair: Pair, source: Tensor, moved: CropMove, moved_target: CropMove) -> CropPairs:
        stacks = [
            stack_info(self.dataset.stack_path(pair.subject, camera))
            for camera in (pair.source_camera, pair.target_camera)
        ]
        exposed = source * (MEAN_RADIANCE / stacks[0].colour_on_face(source).mean())
        source_px, target_px = (
            self.side_px * move.points(stack.fit.landmarks_px / stack.side_px)[None]
            for stack, move in zip(stacks, (moved, moved_target), strict=True)
        )
        return CropPairs(
            source=moved.image(exposed[None], self.side_px),
            target=self.read_target(pair, moved_target),
            source_landmarks_px=source_px,
            target_landmarks_px=target_px,
            light=stacks[1].directions[pair.target_light][None],
            people=torch.tensor([self.dataset.subjects.index(pair.subject)]),
        )

    def source_colours(self, count: int) -> Tensor:
        """Measure mean colours [N, 3] of the face in about `count` sources, spread over the stacks."""
        if self.pairs:
            stacks = list(self._by_stack.values())
            some = stacks[:: math.ceil(len(stacks) / _STACKS_MEASURED)]
            parts = [pairs[: math.ceil(count / len(some))] for pairs in some]
            sources = [
                pair for part in parts for pair in zip(part, sum_sources(self.dataset, part), strict=True)
            ]
        else:
            each = math.ceil(count / _STACKS_MEASURED)
            sources = [pair for seed in range(_STACKS_MEASURED) for pair in self.draw_sources(seed)[:each]]
        return torch.stack(
            [
                stack_info(self.dataset.stack_path(*_source_stack(pair))).colour_on_face(source.float())
                for pair, source in sources
            ]
        )


_cached_sources = lru_cache(maxsize=_SOURCES_CACHED)(PairReader.draw_sources)


def _source_stack(pair: Pair) -> tuple[str, str]:
    return pair.subject, pair.source_camera


def open_pairs(dataset: Dataset, split: str, side_px: int) -> PairReader:
    """Open the pairs of a split; raise InputError if it has none or its crops are too small."""
    reader = pairs_of_split(dataset, split, side_px)
    if not reader.pairs:
        raise InputError(
            f"{dataset.folder}: no pairs in the split {split}; make them with `facerf relight-dataset`"
        )
    require_crops(dataset, stack_info(dataset.stack_path(*_source_stack(reader.pairs[0]))).side_px, side_px)
    return reader


def pairs_of_split(dataset: Dataset, split: str, side_px: int) -> PairReader:
    """Open a split, with its pairs if there are any; raise InputError if it has no subjects."""
    people, rows = people_of(dataset, split), load_pairs(dataset)
    pairs = [pair for subject in sorted(people) for pair in rows.get(subject, ([],))[0]]
    return PairReader(dataset, people, pairs, side_px)


def require_crops(dataset: Dataset, crop_px: int, side_px: int) -> None:
    """Raise InputError if a dataset's crops are smaller than the networks need."""
    if crop_px < side_px:
        raise InputError(
            f"{dataset.folder}: its crops have {crop_px} px, the networks need {side_px}; run "
            f"prepare-dataset with --crop {side_px}, or train with --texture-size {crop_px}"
        )


def spread_pairs(reader: PairReader, count: int, wanted: Callable[[Pair], bool]) -> list[Pair]:
    """Choose `count` of the wanted pairs, or all, evenly spread over the subjects; always the same."""
    pairs = [pair for pair in reader.pairs if wanted(pair)]
    places = np.linspace(0, len(pairs), min(count, len(pairs)), endpoint=False).astype(int)
    return [pairs[place] for place in places]


def mean_translation_m(dataset: Dataset) -> tuple[float, float, float]:
    """Return the mean head position in the crops' camera over the fits of some subjects.

    A Geometry Network's estimate starts there.
    """
    subjects = dataset.splits["train"][:_SUBJECTS_AVERAGED] or dataset.subjects[:_SUBJECTS_AVERAGED]
    paths = [dataset.fit_path(subject, camera) for subject in subjects for camera in dataset.cameras[subject]]
    if not paths:
        raise InputError(f"{dataset.folder}: no subject has a fit; {PREPARE_AGAIN}")
    x, y, z = torch.stack([load_fit(path).translation_m for path in paths]).mean(0).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class StackInfo:
    """Part of a stack's header that crops need."""

    directions: Tensor  # [L, 3] camera space
    rotation: Tensor  # [3, 3] head_to_camera
    fit: FaceFit
    lit_mean: float  # mean radiance of the face under a constant map of radiance 1
    lit_colour: Tensor  # [3], its colour there
    face_bits: np.ndarray  # pixels that show the face, eight to a byte

    @property
    def side_px(self) -> int:
        return self.fit.crop.size_px

    @property
    def face(self) -> Tensor:
        """Boolean mask [H, W] of the face."""
        bits = np.unpackbits(self.face_bits, count=self.side_px**2)
        return torch.from_numpy(bits).view(self.side_px, self.side_px).bool()

    def colour_on_face(self, image: Tensor) -> Tensor:
        """Mean colour [3] of the face in an image [3, H, W]."""
        return image[:, self.face].mean(1).clamp_min(_DARKEST)


@lru_cache(maxsize=_STACKS_CACHED)  # every step of training needs some
def stack_info(path: Path) -> StackInfo:
    """Read what crops need of a stack; raise InputError if it does not show the face."""
    header, fit = read_stack(path)
    face = header.seen > 0.5
    if not face.any():
        raise InputError(f"{path}: does not show the face; {PREPARE_AGAIN}")
    return StackInfo(
        directions=torch.from_numpy(header.directions).float(),
        rotation=torch.from_numpy(header.rotation).float(),
        fit=fit,
        lit_mean=max(float(header.source[face].mean()), _DARKEST),
        lit_colour=torch.from_numpy(header.source[face].mean(0)).clamp_min(_DARKEST),
        face_bits=np.packbits(face),
    )


def unwrap_crops(
    images: Tensor, vertices: Tensor, side: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Unwrap crops [B, C, S, S] of meshes [B, V, 3]: textures [B, C, T, T], visibility [B, T, T].

    `weights` are the meshes' `crop_weights`, if they are known.
    """
    camera, settings = _unwrapping(images.shape[-1], side)
    return unwrap(images, vertices, on_device(images.device, grid_triangles), camera, side, settings, weights)


def crop_weights(vertices: Tensor, crop_px: int, side: int) -> Tensor:
    """Return the weights of points of meshes [B, V, 3], most of the work of `unwrap_crops` on a CPU."""
    camera, settings = _unwrapping(crop_px, side)
    return point_weights(vertices, on_device(vertices.device, grid_triangles), camera, side, settings)


def _unwrapping(crop_px: int, side: int) -> tuple[Camera, UnwrapSettings]:
    depth_px, samples = min(_DEPTH_PX, _DEPTH_PER_PX * crop_px), math.ceil(crop_px / side)
    return crop_camera(crop_px), UnwrapSettings(depth_side_px=depth_px, samples=samples, measured=False)
