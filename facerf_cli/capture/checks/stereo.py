"""Photometric stereo of a camera's frames, which predicts each frame from the direction of its light.

R. Woodham, *Photometric method for determining surface orientation from multiple images*, Optical Engineering
1980: under a light from direction d a matte surface has radiance g . d, where g is its normal times its
albedo. A constant per pixel is fitted too, for the light of the room. The fit is robust against cast shadows,
highlights and broken frames: weights fall with the residual, and frames under lights behind a pixel do not
count.
"""

from dataclasses import dataclass

import numpy as np

from facerf_cli.capture.checks.frames import CameraFrames

_LEAST_FRAMES = 8  # fewer do not determine what another one should look like
_LEAST_LIT_PX = 100
_ITERATIONS = 6
_RIDGE = 1e-3  # keeps the equations of pixels with few weighted frames solvable
_LEAST_COSINE = 0.15  # of light and normal: at grazing angles a matte surface is a poor model
_BRIGHT_SHARE = 0.2  # of a pixel's brightest frames: darker ones start as shadow
_LIT_SHARE = 0.1  # of the brightest pixels: pixels that never get as bright are background
# Lights that head, body, hair or brows can hide from the face, in camera space.
_BEHIND = -0.5  # cosine to the camera's axis: the head hides lights further behind
_BELOW = -0.7  # sine of the elevation: the body hides lights further below
_ABOVE, _OVERHEAD = 0.85, 0.3  # sine above which hair or brows hide lights of a cosine below the second


@dataclass(frozen=True, eq=False)
class Stereo:
    """Shape and albedo of the P pixels that `lit` covers."""

    g: np.ndarray  # [P, 3] normal times albedo, camera space
    room: np.ndarray  # [P] constant light of the room, not negative
    lit: np.ndarray  # [h, w] bool

    def lit_by(self, directions: np.ndarray) -> np.ndarray:
        """Radiance [L, P] under lights from directions [L, 3], without the room's light and cast shadows."""
        return np.maximum(directions @ self.g.T, 0)

    def predicted(self, directions: np.ndarray) -> np.ndarray:
        """Predicted frames [L, P] under lights from directions [L, 3]."""
        return self.lit_by(directions) + self.room

    @property
    def normals(self) -> np.ndarray:
        """Unit normals [P, 3]."""
        return self.g / np.maximum(np.linalg.norm(self.g, axis=1, keepdims=True), 1e-12)


def fit_stereo(frames: CameraFrames) -> Stereo | None:
    """Fit the frames of a camera; None where there are too few frames or lit pixels."""
    lit = lit_pixels(frames.grey) if len(frames.light_ids) >= _LEAST_FRAMES else np.zeros((1, 1), bool)
    if lit.sum() < _LEAST_LIT_PX:
        return None
    return photometric_stereo(frames.grey[:, lit].astype(float), frames.directions, lit)


def lit_pixels(grey: np.ndarray) -> np.ndarray:
    """Mask [h, w] of the object in frames [L, h, w], without the dark background."""
    bright = np.percentile(grey, 90, axis=0)
    return bright > _LIT_SHARE * np.percentile(bright, 95)


def photometric_stereo(values: np.ndarray, directions: np.ndarray, lit: np.ndarray) -> Stereo:
    """Fit the values [L, P] of the pixels in `lit` [h, w] under lights from directions [L, 3]."""
    terms = np.c_[directions, np.ones(len(directions))]
    outer = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
    top = np.percentile(values, 95, axis=0)
    weights = (values > _BRIGHT_SHARE * top).astype(float)
    ridge = np.diag([_RIDGE] * 3 + [_RIDGE * 10])  # the room's light is the least certain
    for _ in range(_ITERATIONS):
        matrices = (weights.T @ outer).reshape(-1, 4, 4) + ridge
        fitted = np.linalg.solve(matrices, ((weights * values).T @ terms)[..., None])[..., 0]  # [P, 4]
        residual = np.abs(values - terms @ fitted.T)
        spread = 1.48 * np.median(residual, axis=0) + 1e-3 * top + 1e-12
        facing = directions @ fitted[:, :3].T > _LEAST_COSINE * np.linalg.norm(fitted[:, :3], axis=1)
        weights = facing / (1 + (residual / (2 * spread)) ** 2)
    return Stereo(fitted[:, :3], np.maximum(fitted[:, 3], 0), lit)


def reaches_face(directions: np.ndarray) -> np.ndarray:
    """Mask [L] of directions [L, 3], camera space, that neither head, hair nor body hides from the face."""
    _, up, front = directions.T
    return (front > _BEHIND) & (up > _BELOW) & ~((up > _ABOVE) & (front < _OVERHEAD))
