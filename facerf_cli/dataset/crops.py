"""Pairs of crops from a prepared dataset: a source under a map, and one light of a stack (paper, 'Dataset').

Pairs are the lines of relit/pairs.jsonl: the source is the picture that `relight-dataset` wrote, or, where it
wrote none, the lights' weights times the whole stack, which takes a hundred times as long; the target is one
part of a stack, read alone. Both are exposed as the pictures of the chart's stages are: the source so that
the face's mean is `MEAN_RADIANCE`, and the target so that it would be under a constant map of radiance 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path, read_pairs
from facerf_cli.dataset.relight import relit_images
from facerf_cli.dataset.weights import load_pairs
from facerf_cli.errors import InputError
from facerf_cli.face.fit import fit_from_arrays, load_fit
from facerf_cli.files.images import read_image
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.network.reflectance import MEAN_RADIANCE, resize

_VIEWS_KEPT = 2048  # of cameras and subjects; at most 32 KiB each at 512 pixels
_SUBJECTS_ASKED = 16  # for where heads stand
_DARKEST = 1e-4  # mean radiance that is told from none


@dataclass(frozen=True)
class CropPairs:
    """B pairs of crops of the same people, linear, in the fixed camera of crops of side S.

    source and target [B, 3, S, S], their detected landmarks [B, 68, 2] in crop pixels, and the unit vector
    toward the target's light in camera space [B, 3].
    """

    source: Tensor
    target: Tensor
    source_landmarks_px: Tensor
    target_landmarks_px: Tensor
    light: Tensor

    def to(self, device: torch.device) -> "CropPairs":
        """The same pairs on `device`."""
        return CropPairs(*(getattr(self, field.name).to(device) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class PairReader:
    """A dataset's pairs of one split, as crops of a side."""

    dataset: Dataset
    pairs: list[Pair]
    side_px: int

    def draw(self, generator: torch.Generator) -> CropPairs:
        """One pair of all of them."""
        return self.read(self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))])

    def read(self, pair: Pair) -> CropPairs:
        """The crops of a pair, B = 1."""
        source_view = _view(self.dataset.stack_path(pair.subject, pair.source_camera))
        path = self.dataset.stack_path(pair.subject, pair.target_camera)
        target_view = _view(path)
        source = self._source(pair)
        target = read_olats(path, slice(pair.target_light, pair.target_light + 1))[0].float()
        if source.shape != target.shape or source.shape[-1] != source_view.side_px:
            raise InputError(f"{path}: not of the size of its source; run relight-dataset with --overwrite")
        exposed = source * (MEAN_RADIANCE / source_view.mean_on_face(source))
        return CropPairs(
            source=self._sized(exposed),
            target=self._sized(target * (MEAN_RADIANCE / target_view.lit_mean)),
            source_landmarks_px=source_view.landmarks_px[None] * (self.side_px / source_view.side_px),
            target_landmarks_px=target_view.landmarks_px[None] * (self.side_px / target_view.side_px),
            light=target_view.directions[pair.target_light][None],
        )

    def _sized(self, image: Tensor) -> Tensor:
        return resize(image[None], self.side_px)

    def _source(self, pair: Pair) -> Tensor:
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return torch.from_numpy(read_image(path).pixels).permute(2, 0, 1)
        rows, weights = load_pairs(self.dataset)[pair.subject]
        row = torch.from_numpy(np.array(weights[[other.index for other in rows].index(pair.index)]))
        stack = self.dataset.stack_path(pair.subject, pair.source_camera)
        return next(relit_images(stack, row[None])).float()


def open_pairs(dataset: Dataset, split: str, side_px: int) -> PairReader:
    """The pairs of a split; an InputError where it has none."""
    pairs = [pair for pair in read_pairs(dataset) if pair.split == split]
    if not pairs:
        raise InputError(
            f"{dataset.folder}: no pairs of sources and targets in the split {split}; make them with "
            "`facerf relight-dataset`, after a prepare-dataset whose --split leaves somebody there"
        )
    return PairReader(dataset, pairs, side_px)


def spread_pairs(reader: PairReader, count: int, wanted: Callable[[Pair], bool]) -> list[Pair]:
    """`count` of the pairs that are wanted, or all, evenly spread over the subjects; always the same."""
    found = [pair for pair in reader.pairs if wanted(pair)]
    places = np.linspace(0, len(found), min(count, len(found)), endpoint=False).astype(int)
    return [found[place] for place in places]


@dataclass(frozen=True, eq=False)
class _View:
    """What is kept of a stack's header."""

    directions: Tensor  # [L, 3] camera space
    landmarks_px: Tensor  # [68, 2]
    side_px: int
    lit_mean: float  # of the face's radiance under a constant map of radiance 1
    face_bits: np.ndarray  # of the pixels that see the face, eight to a byte

    def mean_on_face(self, image: Tensor) -> float:
        """Mean radiance of a picture [3, H, W] where it sees the face."""
        bits = np.unpackbits(self.face_bits, count=self.side_px**2)
        face = torch.from_numpy(bits).view(self.side_px, self.side_px).bool()
        return max(float(image[:, face].mean()), _DARKEST)


@lru_cache(maxsize=_VIEWS_KEPT)
def _view(path: Path) -> _View:
    header = read_olat_header(path)
    try:
        fit = fit_from_arrays(header.fit)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: the fit in it is of no use: {error}") from None
    face = header.seen > 0.5
    side_px = fit.crop.size_px
    if header.kind != "image" or face.shape != (side_px, side_px) or not face.any():
        raise InputError(f"{path}: no stack of a face's crop; run prepare-dataset again")
    return _View(
        directions=torch.from_numpy(header.directions).float(),
        landmarks_px=fit.landmarks_px,
        side_px=side_px,
        lit_mean=max(float(header.source[face].mean()), _DARKEST),
        face_bits=np.packbits(face),
    )


def mean_translation_m(dataset: Dataset) -> tuple[float, float, float]:
    """Where heads stand before the crops' camera by the fits of some subjects: a Geometry Network's start."""
    subjects = dataset.splits["train"][:_SUBJECTS_ASKED] or dataset.subjects[:_SUBJECTS_ASKED]
    paths = [dataset.fit_path(subject, camera) for subject in subjects for camera in dataset.cameras[subject]]
    if not paths:
        raise InputError(f"{dataset.folder}: no subject has a fit; run prepare-dataset again")
    x, y, z = torch.stack([load_fit(path).translation_m for path in paths]).mean(0).tolist()
    return x, y, z
