"""Lights in another order than declared: frames under the wrong lamp.

Within the declared order photometric stereo finds normals that explain all frames. A frame whose own light,
solved for on those normals, comes from elsewhere was saved under another lamp's name.
"""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import Stereo

# On Extended Yale B's subjects 05, 15 and 22 and synthetic faces the light of a frame is found to 14 degrees
# at worst where its lamp is in front.
_OFF_DEG = 30.0
IN_FRONT, _BELOW = 0.4, -0.7  # cosine to the camera's axis; sine of elevation: others are half in shadow
_MOST = 0.25  # of the frames: when more are off it is the list that is wrong
_ROUNDS = 4


def check_frames_order(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame under another lamp than declared, or one for all where they are many."""
    rows = np.flatnonzero((frames.directions[:, 2] > IN_FRONT) & (frames.directions[:, 1] > _BELOW))
    if len(rows) < 4:
        return
    found = np.stack([solve_light(frames.grey[row][stereo.lit], stereo) for row in rows])
    off_deg = angle_deg(found, frames.directions[rows])
    wrong = np.flatnonzero(off_deg > _OFF_DEG)
    if len(wrong) > max(_MOST * len(rows), 2):
        words = (
            f"{len(wrong)} of {len(rows)} frames are lit from elsewhere than declared (by "
            f"{np.median(off_deg):.0f} degrees in the median); are the lights in another order?"
        )
        figures = {"frames": len(wrong), "median_off_deg": round(float(np.median(off_deg)), 1)}
        yield Finding("error", "order", frames.subject, words, frames.camera, figures=figures)
        return
    for place in wrong:
        like = frames.light_ids[int(np.argmax(frames.directions @ found[place]))]
        words = (
            f"is lit from {off_deg[place]:.0f} degrees off its lamp, as under {like}; was it saved under a "
            "wrong name?"
        )
        figures = {"off_deg": round(float(off_deg[place]), 1)}
        light = frames.light_ids[rows[place]]
        yield Finding("error", "order", frames.subject, words, frames.camera, light, figures, True)


def solve_light(picture: np.ndarray, stereo: Stereo) -> np.ndarray:
    """The direction [3] that a frame's lit pixels [P] are lit from, by least squares without its shadows."""
    values = picture - stereo.room
    weights = (values > 0.2 * np.percentile(values, 95)).astype(float)
    light = np.array([0.0, 0.0, 1.0])
    for _ in range(_ROUNDS):
        g = stereo.g * weights[:, None]
        light = np.linalg.solve(g.T @ stereo.g + 1e-9 * np.eye(3), g.T @ values)
        residual = np.abs(values - stereo.g @ light)
        spread = 1.48 * np.median(residual[weights > 0.1]) if (weights > 0.1).any() else 1.0
        facing = stereo.normals @ light > 0.15 * np.linalg.norm(light)
        weights = facing / (1 + (residual / (2 * spread + 1e-9)) ** 2)
    return light / max(np.linalg.norm(light), 1e-12)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between unit vectors [..., 3]."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))
