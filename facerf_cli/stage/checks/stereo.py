"""Photometric stereo of a camera's frames: what each frame should look like if its lamp is where it is said.

R. Woodham, *Photometric method for determining surface orientation from multiple images*, Optical Engineering
1980: under a lamp in direction d a matt surface has radiance g . d, where g is its normal times its albedo.
A constant is fitted beside g, for the room's own light. Cast shadows, highlights and broken frames are
outweighed by the rest: weights fall with the residual, and frames in a pixel's own shadow do not count.
"""

from dataclasses import dataclass

import numpy as np

from facerf_cli.stage.checks.frames import CameraFrames

_LEAST_FRAMES = 8  # fewer say nothing of what another should look like
_LEAST_LIT_PX = 100
_ROUNDS = 6
_RIDGE = 1e-3
_LEAST_COSINE = 0.15  # of lamp and normal: nearer to grazing, matt is no good model
_BRIGHT_SHARE = 0.2  # of a pixel's brightest frames: what is darker is taken for shadow at first
_LIT_SHARE = 0.1  # of the brightest pixels: what never gets as bright is background
_BEHIND = -0.5  # cosine to the camera's axis: the head is in the way of lamps further behind
_BELOW = -0.7  # sine of elevation: the body is in the way of lamps further below
_ABOVE, _OVERHEAD = 0.85, 0.3  # and hair or brow in that of lamps further above that are not in front as well


@dataclass(frozen=True, eq=False)
class Stereo:
    """Of the P pixels that `lit` [h, w] has: g [P, 3], normal times albedo, and room [P], not negative."""

    g: np.ndarray
    room: np.ndarray
    lit: np.ndarray

    def lamp(self, directions: np.ndarray) -> np.ndarray:
        """What the lamps alone bring [L, P], without cast shadows."""
        return np.maximum(directions @ self.g.T, 0)

    def predicted(self, directions: np.ndarray) -> np.ndarray:
        """The frames [L, P]."""
        return self.lamp(directions) + self.room

    @property
    def normals(self) -> np.ndarray:
        """Unit [P, 3]."""
        return self.g / np.maximum(np.linalg.norm(self.g, axis=1, keepdims=True), 1e-12)


def reaches_face(directions: np.ndarray) -> np.ndarray:
    """Which lamps [L, 3], in camera space, neither head, hair nor body can hide from the face [L]."""
    _, up, front = directions.T
    return (front > _BEHIND) & (up > _BELOW) & ~((up > _ABOVE) & (front < _OVERHEAD))


def lit_pixels(grey: np.ndarray) -> np.ndarray:
    """Where anything is to be seen [h, w] in frames [L, h, w]: the object, not the dark behind it."""
    bright = np.percentile(grey, 90, axis=0)
    return bright > _LIT_SHARE * np.percentile(bright, 95)


def photometric_stereo(values: np.ndarray, directions: np.ndarray, lit: np.ndarray) -> Stereo:
    """Fit frames [L, P] of the pixels that `lit` [h, w] has, under lamps [L, 3]."""
    terms = np.c_[directions, np.ones(len(directions))]
    outer = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
    top = np.percentile(values, 95, axis=0)
    weights = (values > _BRIGHT_SHARE * top).astype(float)
    ridge = np.diag([_RIDGE] * 3 + [_RIDGE * 10])  # the room's light is the less certain
    for _ in range(_ROUNDS):
        matrices = (weights.T @ outer).reshape(-1, 4, 4) + ridge
        fitted = np.linalg.solve(matrices, ((weights * values).T @ terms)[..., None])[..., 0]  # [P, 4]
        residual = np.abs(values - terms @ fitted.T)
        spread = 1.48 * np.median(residual, axis=0) + 1e-3 * top + 1e-12
        facing = directions @ fitted[:, :3].T > _LEAST_COSINE * np.linalg.norm(fitted[:, :3], axis=1)
        weights = facing / (1 + (residual / (2 * spread)) ** 2)
    return Stereo(fitted[:, :3], np.maximum(fitted[:, 3], 0), lit)


def fit_stereo(frames: CameraFrames) -> Stereo | None:
    """Photometric stereo of the frames; None where they are too few, or nothing is lit."""
    lit = lit_pixels(frames.grey) if len(frames.light_ids) >= _LEAST_FRAMES else np.zeros((1, 1), bool)
    if lit.sum() < _LEAST_LIT_PX:
        return None
    return photometric_stereo(frames.grey[:, lit].astype(float), frames.directions, lit)
