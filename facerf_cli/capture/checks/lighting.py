"""Checks of each frame's light: frames under another light than declared, and lights that did not fire.

In front of the face, the direction of a frame's light is solved for on the normals of photometric stereo.
Lights at the side or behind reach only edges and hair; there, brightness is compared with neighbouring
lights.
"""

from collections.abc import Iterator

import numpy as np

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames
from facerf_cli.capture.checks.numerics import angle_deg
from facerf_cli.capture.checks.stereo import Stereo, reaches_face

# Order of lights in front. On Extended Yale B's subjects 05, 15 and 22 and synthetic faces the light of a
# frame is found to 14 degrees at worst.
_OFF_DEG = 30.0
_IN_FRONT, _BELOW = 0.4, -0.7  # cosine to the camera's axis; sine of elevation: other lights leave shadows
_MOST_SWAPPED = 0.25  # of the frames: with more off, the list of lights is wrong
_ITERATIONS = 4
# Order of lights at the side and behind. Sound frames of synthetic faces reach 1.5 times their neighbours, of
# Extended Yale B 1.1.
_BRIGHTEST_RATIO = 2.5
_AROUND, _LEAST_AROUND = 0.7, 3  # cosine between neighbouring lights; number of them needed
_DARK_FRAME = 0.05  # of the brightest frames: noise and the room dominate darker ones
# Lights that did not fire. Sound frames of Extended Yale B's subjects 05, 15 and 22 have 0.77 of their
# neighbours' gain or more, those of synthetic faces 0.41; a light that did not fire leaves some hundredths.
_LEAST_GAIN = 0.3
_REACH = 0.3  # of the best placed lights' radiance: below it, cast shadows and the room dominate
_NEIGHBOURS = 6
_BRIGHT_PERCENTILE = 98  # of the pixels, above which gains are measured


def check_frames_order(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Report each frame whose light comes from elsewhere than declared; one finding if there are many."""
    rows = np.flatnonzero((frames.directions[:, 2] > _IN_FRONT) & (frames.directions[:, 1] > _BELOW))
    if len(rows) < 4:
        return
    found = np.stack([solve_light(frames.grey[row][stereo.lit], stereo) for row in rows])
    off_deg = angle_deg(found, frames.directions[rows])
    wrong = np.flatnonzero(off_deg > _OFF_DEG)
    if len(wrong) > max(_MOST_SWAPPED * len(rows), 2):
        words = (
            f"{len(wrong)} of {len(rows)} frames are lit from elsewhere than declared (median "
            f"{np.median(off_deg):.0f} degrees off); correct the order of the lights"
        )
        figures = {"frames": len(wrong), "median_off_deg": round(float(np.median(off_deg)), 1)}
        yield Finding("error", "order", frames.subject, words, frames.camera, figures=figures)
        return
    for place in wrong:
        like = frames.light_ids[int(np.argmax(frames.directions @ found[place]))]
        words = (
            f"is lit from {off_deg[place]:.0f} degrees off its light's direction, as under {like}; correct "
            "the file's name"
        )
        figures = {"off_deg": round(float(off_deg[place]), 1)}
        light = frames.light_ids[rows[place]]
        yield Finding("error", "order", frames.subject, words, frames.camera, light, figures, True)


def solve_light(image: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Solve for the direction [3] of a frame's light from its lit pixels [P], by robust least squares."""
    values = image - stereo.room
    weights = (values > 0.2 * np.percentile(values, 95)).astype(float)
    light = np.array([0.0, 0.0, 1.0])
    for _ in range(_ITERATIONS):
        g = stereo.g * weights[:, None]
        light = np.linalg.solve(g.T @ stereo.g + 1e-9 * np.eye(3), g.T @ values)
        residual = np.abs(values - stereo.g @ light)
        spread = 1.48 * np.median(residual[weights > 0.1]) if (weights > 0.1).any() else 1.0
        facing = stereo.normals @ light > 0.15 * np.linalg.norm(light)
        weights = facing / (1 + (residual / (2 * spread + 1e-9)) ** 2)
    return light / max(np.linalg.norm(light), 1e-12)


def check_too_bright(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Report each frame of a light not in front that is far brighter than those of neighbouring lights."""
    means = frames.grey[:, stereo.lit].mean(1)
    near = frames.directions @ frames.directions.T > _AROUND
    np.fill_diagonal(near, False)
    # The second brightest neighbour: of two neighbours that are swapped, each sees the other.
    around = np.sort(np.where(near, means, 0), axis=1)[:, -2]
    judged = (frames.directions[:, 2] <= _IN_FRONT) & (near.sum(1) >= _LEAST_AROUND)
    judged &= means > _DARK_FRAME * np.percentile(means, 95)
    for row in np.flatnonzero(judged & (means > _BRIGHTEST_RATIO * around)):
        times = float(means[row] / max(float(around[row]), 1e-12))
        brighter = f"is {min(times, 999):.0f} times as bright as the frames of neighbouring lights"
        words = f"{brighter}; correct the file's name"
        light, figures = frames.light_ids[row], {"times": round(times, 1)}
        yield Finding("error", "order", frames.subject, words, frames.camera, light, figures, True)


def check_unlit(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Report each frame with far less of its predicted light than the frames of neighbouring lights have."""
    expected, gains = measure_gains(frames, stereo)
    judged = expected > _REACH * np.percentile(expected, 95)
    judged &= reaches_face(frames.directions)
    if judged.sum() <= _NEIGHBOURS:
        return
    rows = np.flatnonzero(judged)
    cosines = frames.directions[rows] @ frames.directions[rows].T
    np.fill_diagonal(cosines, -2)
    neighbours = rows[np.argsort(-cosines, axis=1)[:, :_NEIGHBOURS]]
    for row, usual in zip(rows, np.median(gains[neighbours], axis=1), strict=True):
        if gains[row] < _LEAST_GAIN * usual:
            share = max(float(gains[row] / usual), 0.0)
            words = f"has {share:.0%} of the light that its neighbours predict; check whether the light fired"
            figures = {"share": round(share, 3), "mean": float(frames.grey[row].mean())}
            light = frames.light_ids[row]
            yield Finding("error", "unlit", frames.subject, words, frames.camera, light, figures, True)


def measure_gains(frames: CameraFrames, stereo: Stereo) -> tuple[np.ndarray, np.ndarray]:
    """Expected radiance [L] of the brightest pixels under each light, and the measured share of it [L].

    Hair or a hand may hide a light from most of the face, but some pixel, such as the nose's tip, nearly
    always stays lit.
    """
    predicted = stereo.lit_by(frames.directions)
    seen = frames.grey[:, stereo.lit] - stereo.room
    bright, expected = (np.percentile(values, _BRIGHT_PERCENTILE, axis=1) for values in (seen, predicted))
    return expected, bright / np.maximum(expected, 1e-12)
