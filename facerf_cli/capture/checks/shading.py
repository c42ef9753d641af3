"""Checks of shading: photometric stereo of a camera's frames, and frames that contradict it.

R. Woodham, *Photometric method for determining surface orientation from multiple images*, Optical Engineering
1980: under a light from direction d a matte surface has radiance g . d, where g is its normal times its
albedo. A constant per pixel is fitted too, for the light of the room. The fit is robust against cast shadows,
highlights and broken frames: weights fall with the residual, and frames under lights behind a pixel do not
count.

**Order.** The fitted normals determine the direction of a frame's light, for lights in front of the face;
others reach only edges and hair.

**Rig.** Lights mirrored or turned as a whole, or swapped cameras, leave frames consistent with each other,
but turn the fitted normals. The visible side of any object faces the camera: normals lean to the right on its
right side, and slopes from outline to outline cancel, so that the mean normal points to the camera (upward by
some 30 degrees, because what faces down is dark).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.capture.checks.frames import CameraFrames, same_frames
from facerf_cli.capture.findings import Finding

# Photometric stereo.
_LEAST_FRAMES = 8  # fewer do not determine what another one should look like
_LEAST_LIT_PX = 100
_ITERATIONS = 6
_RIDGE = 1e-3  # keeps the equations of pixels with few weighted frames solvable
_LEAST_COSINE = 0.15  # of light and normal: at grazing angles a matte surface is a poor model
_BRIGHT_SHARE = 0.2  # of a pixel's brightest frames: darker ones start as shadow
_LIT_SHARE = 0.1  # of the brightest pixels: pixels that never get as bright are background
# Order of lights in front. On Extended Yale B's subjects 05, 15 and 22 and synthetic faces the light of a
# frame is found to 14 degrees at worst.
_OFF_DEG = 30.0
_IN_FRONT, _BELOW = 0.4, -0.7  # cosine to the camera's axis; sine of elevation: other lights leave shadows
_MOST_SWAPPED = 0.25  # of the frames: with more off, the list of lights is wrong
_LIGHT_ITERATIONS = 4
# Rig. Mean normals of synthetic heads, seen from the front and up to 54 degrees from the side, point left or
# right of the camera by 9 degrees at most and up by 14 to 37; they lean by 0.5 to 0.8. On the 21
# subjects of Extended Yale B they point left or right by 5 at most, up by -18 to 14, and lean by 0.9.
_TURN_DEG, _UP_DEG = 20.0, (-45.0, 75.0)
_LEAN = 0.3  # correlation of a normal's x with the pixel's x, negative for mirrored lights


@dataclass(frozen=True, eq=False)
class Stereo:
    """Shape and albedo of the P pixels in `lit`."""

    g: np.ndarray  # [P, 3] normal times albedo, camera space
    room: np.ndarray  # [P] constant light of the room, not negative
    lit: np.ndarray  # [h, w] bool

    def predicted(self, directions: np.ndarray) -> np.ndarray:
        """Predict frames [L, P] under lights from directions [L, 3], without cast shadows."""
        return np.maximum(directions @ self.g.T, 0) + self.room

    @property
    def normals(self) -> np.ndarray:
        """Unit normals [P, 3]."""
        return self.g / np.maximum(np.linalg.norm(self.g, axis=1, keepdims=True), 1e-12)


def fit_stereo(frames: CameraFrames) -> Stereo | None:
    """Fit the frames of a camera; return None if there are too few frames or lit pixels."""
    lit = lit_pixels(frames.grey) if len(frames.light_ids) >= _LEAST_FRAMES else np.zeros((1, 1), bool)
    if lit.sum() < _LEAST_LIT_PX:
        return None
    return photometric_stereo(frames.grey[:, lit].astype(float), frames.directions, lit)


def lit_pixels(grey: np.ndarray) -> np.ndarray:
    """Return the mask [h, w] of the object in frames [L, h, w], without the dark background."""
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


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors [..., 3], in degrees."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def check_duplicates(frames: CameraFrames, stereo: Stereo | None) -> Iterator[Finding]:
    """Report identical frames, except the frame of each group whose light predicts the image best.

    `stereo` must be fitted without these frames; if it is None, whole groups are reported.
    """
    for rows in same_frames(frames):
        words = f"is identical to other frames ({', '.join(frames.light_ids[row] for row in rows)})"
        own = None
        if stereo is not None:
            predicted, image = stereo.predicted(frames.directions[rows]), frames.grey[rows[0]][stereo.lit]
            own = rows[int(np.argmax([np.corrcoef(image, guess)[0, 1] for guess in predicted]))]
            words += f" and fits light {frames.light_ids[own]} best"
        for row in rows:
            if row != own:
                yield frames.error("duplicate", words + "; copy it again", row, frames=len(rows))


def check_frames_order(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Report each frame whose light comes from elsewhere than declared; one finding if there are many."""
    rows = np.flatnonzero((frames.directions[:, 2] > _IN_FRONT) & (frames.directions[:, 1] > _BELOW))
    if len(rows) < 4:
        return
    solved = np.stack([solve_light(frames.grey[row][stereo.lit], stereo) for row in rows])
    off_deg = angle_deg(solved, frames.directions[rows])
    wrong = np.flatnonzero(off_deg > _OFF_DEG)
    if len(wrong) > max(_MOST_SWAPPED * len(rows), 2):
        words = (
            f"{len(wrong)} of {len(rows)} frames are lit from elsewhere than declared (median "
            f"{np.median(off_deg):.0f} degrees off); correct the order of the lights"
        )
        off = round(float(np.median(off_deg)), 1)
        yield frames.error("order", words, frames=len(wrong), median_off_deg=off)
        return
    for place in wrong.tolist():
        like = frames.light_ids[int(np.argmax(frames.directions @ solved[place]))]
        words = (
            f"is lit from {off_deg[place]:.0f} degrees off its light's direction, as under {like}; correct "
            "the file's name, or check whether the light fired"
        )
        yield frames.error("order", words, int(rows[place]), off_deg=round(float(off_deg[place]), 1))


def solve_light(image: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Solve for the direction [3] of a frame's light from its lit pixels [P], by robust least squares."""
    values = image - stereo.room
    weights = (values > 0.2 * np.percentile(values, 95)).astype(float)
    light = np.array([0.0, 0.0, 1.0])
    for _ in range(_LIGHT_ITERATIONS):
        g = stereo.g * weights[:, None]
        light = np.linalg.solve(g.T @ stereo.g + 1e-9 * np.eye(3), g.T @ values)
        residual = np.abs(values - stereo.g @ light)
        spread = 1.48 * np.median(residual[weights > 0.1]) if (weights > 0.1).any() else 1.0
        facing = stereo.normals @ light > 0.15 * np.linalg.norm(light)
        weights = facing / (1 + (residual / (2 * spread + 1e-9)) ** 2)
    return light / max(np.linalg.norm(light), 1e-12)


@dataclass(frozen=True)
class RigFit:
    """Mean normal of the object under the declared lights, in a camera's space."""

    camera: str | None
    mirrored: bool  # normals lean to the left on the object's right side
    right_deg: float  # of the mean normal, from the camera's axis
    up_deg: float

    @property
    def faults(self) -> list[str]:
        """Faults of the lights in words."""
        ways = {
            "mirrored left to right": self.mirrored,
            f"turned sideways by {self.right_deg:.0f} degrees": abs(self.right_deg) > _TURN_DEG,
            f"turned up or down by {self.up_deg:.0f} degrees": not _UP_DEG[0] < self.up_deg < _UP_DEG[1],
        }
        return [way for way, is_fault in ways.items() if is_fault]


def measure_rig(camera: str, stereo: Stereo) -> RigFit:
    """Measure the object's normals against the camera's axis."""
    columns = np.nonzero(stereo.lit)[1].astype(float)
    leaning = float(np.corrcoef(stereo.normals[:, 0], columns)[0, 1])
    right, up, toward = stereo.normals.mean(0)
    right_deg, up_deg = np.degrees(np.arctan2([right, up], toward)).tolist()
    return RigFit(camera, leaning < -_LEAN, right_deg, up_deg)


def check_rigs(subject: str, rigs: Sequence[RigFit]) -> Iterator[Finding]:
    """Report lights that are mirrored or turned against the object in most cameras, or each such camera."""
    off = [rig for rig in rigs if rig.faults]
    if not off:
        return
    half = len(rigs) / 2
    right_deg, up_deg = np.median([(rig.right_deg, rig.up_deg) for rig in rigs], axis=0).tolist()
    of_most = RigFit(None, sum(rig.mirrored for rig in rigs) > half, right_deg, up_deg)
    what, advice = "unlike in other cameras, the lights are", "its world_to_camera, or its frames"
    if of_most.faults:
        off, what = off[:1], "the lights are"
        advice = "their directions, their names or world_to_camera"
    for rig in off:
        words = f"{what} {' and '.join(rig.faults)} relative to the object in this camera; correct {advice}"
        figures = {"right_deg": round(rig.right_deg, 1), "up_deg": round(rig.up_deg, 1)}
        check = "rig" if of_most.faults else "camera"
        yield Finding("error", check, subject, words, rig.camera, figures=figures)
