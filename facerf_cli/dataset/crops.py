"""Crops of a prepared dataset for the joint stage: a relit source and a light of a stack (paper, 'Dataset').

Each line of relit/pairs.jsonl gives a pair of crops. The source is the image that `relight-dataset` wrote, or
else the weighted sum of the whole stack, which takes a hundred times as long: a stack that is opened gives
the sources of many steps. The target is one part of a
stack. Both have the exposure of the texture stages: the source so that the face's mean radiance is
`MEAN_RADIANCE`, the target so that the mean would be that under a constant map of radiance 1.

Crops move at random, because at test time a crop is cut around a detector's box, not around landmarks. The
spreads are those of `face.crop.from_box` against `face.crop.from_landmarks` on synthetic people in eight
cameras: a detector's box is off to the side where a head is turned.

`open_photos` gives crops of faces in photos, with detected landmarks: found once, kept in a cache.
"""

import logging
import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.batch.recipe import Recipe, key_of, text_of_state
from facerf_cli.dataset.dataset import PREPARE_AGAIN, Dataset, people_of, read_stack
from facerf_cli.dataset.pairs import DRAW_AGAIN, Pair, image_path, load_pairs, read_pairs
from facerf_cli.dataset.weights import relit_images
from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import load_fit
from facerf_cli.files.documents import Document, Points68, read_document, write_document
from facerf_cli.files.olat_stack import StackHeader, read_olats
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.network.inputs import MEAN_RADIANCE, Batch, concatenate, resize
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.run.workers import in_shards

_LOG_SCALE, _SHIFT = 0.07, (0.1, 0.03)  # standard deviations; shifts right and down in sides of the crop
_MOST = 2.0  # standard deviations


@dataclass(frozen=True)
class CropMove:
    """A scale about a crop's centre, then a shift (right, down) in units of its side.

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
        # from the moved crop to the given one, in -1..1
        back = images.new_tensor([[1, 0, -2 * right], [0, 1, -2 * down]]) / self.scale
        grid = F.affine_grid(back[None].expand(len(images), -1, -1), [len(images), 1, side, side], False)
        small = resize(images, side) if images.shape[-1] > side else images  # averages before it samples
        return F.grid_sample(small, grid, padding_mode="border", align_corners=False)


UNMOVED = CropMove()


_STACKS_OPEN, _SOURCES_EACH = 4, 32  # stacks that take turns to give lazy sources, and how many each gives
_LAZY_CACHED = 64  # stacks' lazy sources, as half floats: that is so for 16 samples of a step
_STACKS_MEASURED = 24  # whose lazy sources show the colours of all
_STACKS_CACHED = 2048  # at most 32 KiB each at 512 pixels
_SUBJECTS_AVERAGED = 16  # enough for the mean position of heads
_DARKEST = 1e-4  # least mean radiance, so that exposing a black image does not divide by 0


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
    """The pairs of one split, read as crops of `side_px`."""

    dataset: Dataset
    pairs: list[Pair]
    side_px: int

    def of(self, pairs: list[Pair]) -> "PairReader":
        """A reader of these pairs."""
        return replace(self, pairs=pairs)

    @property
    def _lazy(self) -> bool:
        return not image_path(self.dataset, *self.pairs[0].key).is_file()

    @cached_property
    def _by_stack(self) -> dict[tuple[str, str], list[Pair]]:
        """The pairs by their source's subject and camera."""
        found: dict[tuple[str, str], list[Pair]] = defaultdict(list)
        for pair in self.pairs:
            found[pair.subject, pair.source_camera].append(pair)
        return found

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> CropPairs:
        """Read random pairs, each crop as a detector's box would cut it.

        Sample i depends on `generator_of(i)`, and on `generator_of(i, earlier step)`: of lazy pairs the
        sources of `_SOURCES_EACH` steps come from one stack, and some stacks take turns.
        """
        turn = step // _STACKS_OPEN % _SOURCES_EACH
        drawn = []
        for i in range(count):
            generator, source = generator_of(i), None
            if self._lazy:
                lazy = generator_of(i, step - turn * _STACKS_OPEN)
                any_pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=lazy))]
                of_stack = self._by_stack[any_pair.subject, any_pair.source_camera]
                chosen = torch.randint(len(of_stack), (_SOURCES_EACH,), generator=lazy).tolist()
                pairs = tuple(of_stack[place] for place in chosen)
                pair, source = pairs[turn], _lazy_sources(self.dataset, pairs)[turn].float()
            else:
                pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))]
            drawn.append(self.read(pair, (CropMove.draw(generator), CropMove.draw(generator)), source))
        return concatenate(drawn)

    def read(
        self,
        pair: Pair,
        moves: tuple[CropMove, CropMove] = (UNMOVED, UNMOVED),
        source: Tensor | None = None,
    ) -> CropPairs:
        """Read the crops of a pair, B = 1, the source's and the target's moved; its source may be given."""
        source_stack = _stack_info(self.dataset.stack_path(pair.subject, pair.source_camera))
        path = self.dataset.stack_path(pair.subject, pair.target_camera)
        target_stack = _stack_info(path)
        source = self._read_source(pair) if source is None else source
        target = read_olats(path, slice(pair.target_light, pair.target_light + 1))[0].float()
        if source.shape[-1] != source_stack.side_px or target.shape[-1] != target_stack.side_px:
            raise InputError(f"{path}: the source has another size than the stack; {DRAW_AGAIN}")
        exposed = source * (MEAN_RADIANCE / source_stack.colour_on_face(source).mean())
        moved, moved_target = moves
        return CropPairs(
            source=moved.image(exposed[None], self.side_px),
            target=moved_target.image(target[None] * (MEAN_RADIANCE / target_stack.lit_mean), self.side_px),
            source_landmarks_px=self._landmarks_px(source_stack, moved),
            target_landmarks_px=self._landmarks_px(target_stack, moved_target),
            light=target_stack.directions[pair.target_light][None],
            people=torch.tensor([self.dataset.subjects.index(pair.subject)]),
        )

    def source_colours(self, count: int) -> Tensor:
        """Mean colours [N, 3] of the face in `count` sources, spread over the pairs."""
        if self._lazy:
            stacks = list(self._by_stack.values())
            groups = stacks[:: math.ceil(len(stacks) / _STACKS_MEASURED)]
            chosen = [tuple(pairs[: math.ceil(count / len(groups))]) for pairs in groups]
            sources = [
                part
                for pairs in chosen
                for part in zip(pairs, _lazy_sources(self.dataset, pairs), strict=True)
            ]
        else:
            spread = spread_pairs(self, count, lambda pair: True)
            sources = [(pair, self._read_source(pair)) for pair in spread]
        return torch.stack([self._colour(*one) for one in sources])

    def _colour(self, pair: Pair, source: Tensor) -> Tensor:
        stack = _stack_info(self.dataset.stack_path(pair.subject, pair.source_camera))
        return stack.colour_on_face(source.float())

    def _landmarks_px(self, stack: "_StackInfo", moved: CropMove) -> Tensor:
        return moved.points(stack.landmarks_px / stack.side_px)[None] * self.side_px

    def _read_source(self, pair: Pair) -> Tensor:
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return torch.from_numpy(read_image(path).pixels).permute(2, 0, 1)
        return _lazy_sources(self.dataset, (pair,))[0].float()


@lru_cache(maxsize=_LAZY_CACHED)  # pairs of a stack follow each other
def _lazy_sources(dataset: Dataset, pairs: tuple[Pair, ...]) -> list[Tensor]:
    """Sources [3, H, W] of pairs of one stack, summed from it."""
    rows, weights = load_pairs(dataset)[pairs[0].subject]
    places = {row.index: place for place, row in enumerate(rows)}
    chosen = torch.from_numpy(np.array(weights[[places[pair.index] for pair in pairs]]))
    stack = dataset.stack_path(pairs[0].subject, pairs[0].source_camera)
    return list(relit_images(stack, chosen))


def open_pairs(dataset: Dataset, split: str, side_px: int) -> PairReader:
    """Open the pairs of a split; raise InputError where it has none or its crops are smaller."""
    people = set(people_of(dataset, split))
    pairs = [pair for pair in read_pairs(dataset) if pair.subject in people]
    if not pairs:
        raise InputError(
            f"{dataset.folder}: no pairs in the split {split}; make them with `facerf relight-dataset`"
        )
    stack = _stack_info(dataset.stack_path(pairs[0].subject, pairs[0].source_camera))
    require_crops(dataset, stack.side_px, side_px)
    return PairReader(dataset, pairs, side_px)


def require_crops(dataset: Dataset, found_px: int, side_px: int) -> None:
    """Raise InputError where a dataset's crops are smaller than the networks need."""
    if found_px < side_px:
        raise InputError(
            f"{dataset.folder}: its crops have {found_px} px, the networks need {side_px}; run "
            f"prepare-dataset with --crop {side_px}, or train with --texture-size {found_px}"
        )


def spread_pairs(reader: PairReader, count: int, wanted: Callable[[Pair], bool]) -> list[Pair]:
    """Choose `count` of the wanted pairs, or all, evenly spread over the subjects; always the same."""
    found = [pair for pair in reader.pairs if wanted(pair)]
    places = np.linspace(0, len(found), min(count, len(found)), endpoint=False).astype(int)
    return [found[place] for place in places]


def mean_translation_m(dataset: Dataset) -> tuple[float, float, float]:
    """Mean head position in the crops' camera over the fits of some subjects.

    A Geometry Network's estimate starts there.
    """
    subjects = dataset.splits["train"][:_SUBJECTS_AVERAGED] or dataset.subjects[:_SUBJECTS_AVERAGED]
    paths = [dataset.fit_path(subject, camera) for subject in subjects for camera in dataset.cameras[subject]]
    if not paths:
        raise InputError(f"{dataset.folder}: no subject has a fit; {PREPARE_AGAIN}")
    x, y, z = torch.stack([load_fit(path).translation_m for path in paths]).mean(0).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class _StackInfo:
    """The part of a stack's header that crops need."""

    directions: Tensor  # [L, 3] camera space
    landmarks_px: Tensor  # [68, 2]
    side_px: int
    lit_mean: float  # mean radiance of the face under a constant map of radiance 1
    face_bits: np.ndarray  # pixels that show the face, eight to a byte

    def colour_on_face(self, image: Tensor) -> Tensor:
        """Mean colour [3] of the face in an image [3, H, W]."""
        bits = np.unpackbits(self.face_bits, count=self.side_px**2)
        face = torch.from_numpy(bits).view(self.side_px, self.side_px).bool()
        return image[:, face].mean(1).clamp_min(_DARKEST)


@lru_cache(maxsize=_STACKS_CACHED)  # every step of training needs some
def _stack_info(path: Path) -> _StackInfo:
    header, fit = read_stack(path)
    return _StackInfo(
        directions=torch.from_numpy(header.directions).float(),
        landmarks_px=fit.landmarks_px,
        side_px=fit.crop.size_px,
        lit_mean=lit_mean_of(path, header),
        face_bits=np.packbits(header.seen > 0.5),
    )


def lit_mean_of(path: Path, header: StackHeader) -> float:
    """Mean radiance of the face under a constant map of radiance 1; InputError where none is shown."""
    face = header.seen > 0.5
    if not face.any():
        raise InputError(f"{path}: does not show the face; {PREPARE_AGAIN}")
    return max(float(header.source[face].mean()), _DARKEST)


CACHED_SIDE_PX = 512  # the side of the paper's crops
log = logging.getLogger(LOGGER_NAME)


class _PhotoRecord(Document):
    landmarks_px: Points68 | None


@dataclass(frozen=True)
class PhotoCrops(Batch):
    """B crops of photos [B, 3, S, S], scene-linear, and detected landmarks [B, 68, 2] in crop pixels."""

    crops: Tensor
    landmarks_px: Tensor


@dataclass(frozen=True, eq=False)
class Photos:
    """Detected faces, drawn as crops of `side_px`."""

    paths: tuple[Path, ...]  # crops in the cache
    landmarks_px: Tensor  # [N, 68, 2] in crops of `CACHED_SIDE_PX`
    side_px: int

    def draw(self, generator: torch.Generator) -> PhotoCrops:
        """Draw a random face, B = 1, its crop as a detector's box would cut it."""
        place = int(torch.randint(len(self.paths), (), generator=generator))
        crop = torch.from_numpy(read_image(self.paths[place]).pixels).permute(2, 0, 1)[None]
        move = CropMove.draw(generator)
        points = move.points(self.landmarks_px[place] / CACHED_SIDE_PX)
        return PhotoCrops(move.image(crop, self.side_px), self.side_px * points[None])


def open_photos(
    paths: Iterable[Path], cache: Path, networks: Networks, side_px: int, jobs: int = 1
) -> Photos:
    """Open the faces of photos; detect those that are not in `cache`, with a warning for a photo without one.

    Raises InputError where no photo has a face.
    """
    records = {path: cache / f"{key_of(_made_from(path, networks))}.json" for path in sorted(paths)}
    missing = [item for item in records.items() if not item[1].is_file()]
    if missing:
        log.info("%s: detecting faces in %d photos (done once)", cache, len(missing))
        work = partial(_detect, networks)
        if jobs > 1 and len(missing) > 1:
            in_shards(work, missing, jobs)
        else:
            work(missing)
    landmarks_px = {
        record.with_suffix(".jpg"): read_document(record, _PhotoRecord, "delete the folder").landmarks_px
        for record in records.values()
    }
    found = {path: points for path, points in landmarks_px.items() if points is not None}
    if not found:
        raise InputError(
            f"--photos: no face in any of {len(records)} photos; give a folder of photos of faces"
        )
    return Photos(tuple(found), torch.from_numpy(np.stack(list(found.values()))).float(), side_px)


def _made_from(photo: Path, networks: Networks) -> Recipe:
    """List all that the crop of a photo's face depends on."""
    read = [str(photo.absolute()), text_of_state(photo)]
    return {"photo": read, "parsing": networks.sha256("parsing"), "side": CACHED_SIDE_PX}


def _detect(networks: Networks, records: list[tuple[Path, Path]]) -> None:
    """Write the crop and the record of each photo."""
    for photo, record in records:
        landmarks_px = None
        try:
            pixels = read_image(photo).pixels
            face = find_faces(networks.people, pixels, str(photo))[0]
            crop = from_landmarks(face.landmarks_px, CACHED_SIDE_PX)
            write_display(record.with_suffix(".jpg"), crop.apply(pixels), "auto")
            landmarks_px = crop.to_crop(face.landmarks_px).round(3).tolist()
        except InputError as error:
            log.warning("%s", error)
        write_document(record, {"photo": str(photo), "landmarks_px": landmarks_px})
