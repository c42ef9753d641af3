"""The head of one person in every frame of a shot: one identity; pose and expression by smoothed landmarks.

The frames' landmarks are smoothed by those around them (`smoothing.py`). The identity is the mean of the
identities of key frames, each fitted as a photo is. With it held, each frame's pose and expression are fitted
to its smoothed landmarks: the same fit of a model that has one person only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, fit_batch, trust_inside
from facerf_cli.face.morphable import MorphableModel

_KEYS = 12  # frames whose identities are averaged
_AT_ONCE = 32  # frames that are fitted together


def spread_over(frames: Sequence[int], count: int) -> list[int]:
    """At most `count` of some frames, evenly spread, the first and the last among them."""
    at = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[index] for index in dict.fromkeys(at.tolist())]


def identity_of(
    model: MorphableModel, landmarks_px: Sequence[np.ndarray], shape: tuple[int, int], crop_px: int
) -> Tensor:
    """The identity [Ki] of one person from landmarks [68, 2] of several frames of shape [H, W]."""
    keys = [landmarks_px[index] for index in spread_over(range(len(landmarks_px)), _KEYS)]
    crops = [from_landmarks(px, crop_px) for px in keys]
    target, trust = _in_crops(keys, crops, shape)
    return fit_batch(model, target, crops[0].camera, trust=trust).alpha.mean(0).float()


def fit_frames(
    model: MorphableModel,
    alpha: Tensor,
    landmarks_px: Sequence[np.ndarray],
    shape: tuple[int, int],
    crop_px: int,
) -> Iterator[FaceFit]:
    """Fit pose and expression of a person alpha [Ki] to each frame's landmarks [68, 2]."""
    person = _of_one_person(model, tuple(alpha.tolist()))
    for first in range(0, len(landmarks_px), _AT_ONCE):
        some = landmarks_px[first : first + _AT_ONCE]
        crops = [from_landmarks(px, crop_px) for px in some]
        target, trust = _in_crops(some, crops, shape)
        fits = fit_batch(person, target, crops[0].camera, trust=trust)
        for index, crop in enumerate(crops):
            yield FaceFit(
                model=model.name,
                crop=crop,
                rotation=fits.rotation[index].float(),
                translation_m=fits.translation_m[index].float(),
                alpha=alpha,
                beta=fits.beta[index].float(),
                landmarks_px=target[index].float(),
                error_iod=float(fits.error_iod[index]),
            )


@cache
def _of_one_person(model: MorphableModel, alpha: tuple[float, ...]) -> MorphableModel:
    """The face model with one identity only; kept, since the fit keeps what it derives from a model."""
    mean = model.vertices(torch.tensor([alpha]), torch.zeros(1, len(model.expression)))[0]
    return replace(model, name=f"{model.name}-person", mean=mean, identity=model.identity[:0], head=None)


def _in_crops(
    landmarks_px: Sequence[np.ndarray], crops: Sequence[Crop], shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Landmarks [B, 68, 2] in the pixels of their crops, and their trust [B, 68]."""
    inside = [crop.to_crop(px) for crop, px in zip(crops, landmarks_px, strict=True)]
    trust = [trust_inside(px, crop, *shape) for px, crop in zip(inside, crops, strict=True)]
    return torch.from_numpy(np.stack(inside)), torch.from_numpy(np.stack(trust))
