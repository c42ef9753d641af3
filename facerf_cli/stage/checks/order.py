"""Lights in another order than declared: frames under the wrong lamp, a mirrored or a turned rig.

Within the declared order photometric stereo finds normals that explain all frames. A frame whose own light,
solved for on those normals, comes from elsewhere was saved under another lamp's name. Where all lamps are
mirrored or turned together the frames agree with each other, and only the face tells: its normals, known from
a mean face laid over it, are mirrored or turned against those that were found.
"""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.face_normals import FaceNormals
from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import Stereo

# On Extended Yale B's subjects 05, 15 and 22 and synthetic faces the light of a frame is found to 14 degrees
# at worst where its lamp is in front; the rig is found turned by 2 to 11.
_OFF_DEG, _TURN_DEG = 30.0, 20.0
_IN_FRONT, _BELOW = 0.4, -0.7  # cosine to the camera's axis; sine of elevation: others are half in shadow
_MOST = 0.25  # of the frames: when more are off it is the list that is wrong
_BETTER = 0.03  # of the mean cosine between normals, by which a mirrored rig must win
_APART = 45.0  # degrees between normals after the first turn: glasses, hair
_ROUNDS = 4
_LEAN = 0.3  # correlation of a normal's x with the pixel's: 0.6 to 0.9 on heads


def check_frames_order(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame under another lamp than declared, or one for all where they are many."""
    rows = np.flatnonzero((frames.directions[:, 2] > _IN_FRONT) & (frames.directions[:, 1] > _BELOW))
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


def check_rig(frames: CameraFrames, stereo: Stereo, face: FaceNormals) -> Iterator[Finding]:
    """One error where the rig as a whole is mirrored or turned against the face."""
    place = np.full(stereo.lit.size, -1)
    place[stereo.lit.ravel()] = np.arange(stereo.lit.sum())
    rows = place[face.pixels]
    found, known = stereo.normals[rows[rows >= 0]], face.normals[rows >= 0]
    if len(found) < 100:
        return
    turn_deg, likeness = best_turn(found, known)
    mirrored_deg, mirrored = best_turn(found * [-1, 1, 1], known)
    figures = {
        "turned_deg": round(turn_deg, 1),
        "likeness": round(likeness, 3),
        "mirrored": round(mirrored, 3),
    }
    if mirrored > likeness + _BETTER:
        turned = f" and turned by {mirrored_deg:.0f} degrees" if mirrored_deg > _TURN_DEG else ""
        words = f"the lights are mirrored left to right{turned} against the face; mend their directions"
        yield Finding("error", "rig", frames.subject, words, frames.camera, figures=figures)
    elif turn_deg > _TURN_DEG:
        words = (
            f"the lights are turned by {turn_deg:.0f} degrees against the face as this camera sees it; mend "
            "their directions or world_to_camera"
        )
        yield Finding("error", "rig", frames.subject, words, frames.camera, figures=figures)


def best_turn(found: np.ndarray, known: np.ndarray) -> tuple[float, float]:
    """Degrees of the rotation that takes normals onto others [N, 3], and the mean cosine then (Kabsch)."""
    near = np.ones(len(found), bool)
    for _ in range(2):
        u, _, vh = np.linalg.svd(found[near].T @ known[near])
        rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vh))]) @ vh).T
        turned = found @ rotation.T
        near = angle_deg(turned, known) < _APART
        if near.sum() < 50:
            near[:] = True
    cosine = np.clip((np.trace(rotation) - 1) / 2, -1, 1)
    return float(np.degrees(np.arccos(cosine))), float((turned * known).sum(1).mean())


def check_rig_roughly(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """One error where normals lean left on the right of the object: for cameras without a face to compare."""
    columns = np.nonzero(stereo.lit)[1].astype(float)
    leaning = float(np.corrcoef(stereo.normals[:, 0], columns)[0, 1])
    if leaning < -_LEAN:
        words = "what is lit is hollow from left to right; are the lights mirrored, or the pictures?"
        figures = {"leaning": round(leaning, 2)}
        yield Finding("error", "rig", frames.subject, words, frames.camera, figures=figures)
