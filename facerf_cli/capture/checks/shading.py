"""Between samples: the extremum of a curve that is known at some places.

A display curve in frames that are declared linear: which exponent makes them matt under point lamps.

Frames were photometric stereo's, g . d, and were then raised to some power: at every exponent e, values^e are
fitted, the fit is taken back by 1/e and compared with the values. The comparison is always made on the same
values, for on values^e a low exponent wins by flattening everything.

A display curve told by additivity: the sum of all lamps' frames is the frame with every lamp on.

The sharpest check of linearity there is, for it needs no model of the object; but few stages take the frame.
It is looked for in the place of a light, under one of `FULL_NAMES`.

Lights in another order than declared: frames under the wrong lamp.

Within the declared order photometric stereo finds normals that explain all frames. A frame whose own light,
solved for on those normals, comes from elsewhere was saved under another lamp's name.

Frames under lamps at the side or behind that are far too bright: those of a lamp in front, by their light.

Where a lamp in front lights the face, its direction can be solved for (`order.py`); behind, rims and hair are
lit, and only the frames under the lamps around tell how bright one may be.

Lamps that did not fire: frames far darker than the other frames predict.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import FULL_NAMES, CameraFrames, Stereo, grey_of, reaches_face, small
from facerf_cli.errors import InputError
from facerf_cli.files.images import read_image


def vertex(x: np.ndarray, y: np.ndarray, place: int) -> float:
    """Where the parabola through the least or highest of values y [N] at x [N] and its neighbours turns.

    That is between the neighbours; x[place] at an end, or where the three values are one.
    """
    if not 0 < place < len(x) - 1:
        return float(x[place])
    slopes = np.diff(y[place - 1 : place + 2]) / np.diff(x[place - 1 : place + 2])
    bend = (slopes[1] - slopes[0]) / (x[place + 1] - x[place - 1])
    return float((x[place - 1] + x[place]) / 2 - slopes[0] / (2 * bend)) if bend else float(x[place])


EXPONENTS = np.array([0.35, 0.4, 0.45, 0.55, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8, 2.2, 2.6, 3.0])
# Linear frames of Extended Yale B's subjects 05, 15 and 22 come out at 0.85 to 1, synthetic ones at 1;
# encoded by 1/2.2 they come out at 1.7 to 2.4.
_LINEAR = (0.6, 1.5)
_EXACTLY_LINEAR = (0.93, 1.07)  # where a frame of all lamps tells
_CLEAR = 1.25  # how many times worse than the best exponent 1 must be
_PIXELS, _GAMMA_ROUNDS = 600, 6
_FACING = 0.3
_LIT = 0.25  # of a pixel's brightest frame, values as they are


@dataclass(frozen=True)
class Curve:
    """The exponent that decodes the frames best, and how many times worse 1 is.

    `exact`: it was told by additivity, not by shading.
    """

    exponent: float
    times_worse: float
    exact: bool = False


def fit_exponent(frames: CameraFrames, lit: np.ndarray) -> Curve | None:
    """The best exponent over a camera's lit pixels [h, w]; None where too little is lit to tell."""
    values = np.maximum(frames.grey[:, lit].astype(float), 0)
    step = max(values.shape[1] // _PIXELS, 1)
    values = values[:, ::step]
    top = np.percentile(values, 98, axis=0)
    values = values[:, top > 0] / top[top > 0]
    used = values > _LIT
    if len(values) < 8 or used.sum() < _PIXELS:
        return None
    errors = np.array([_shading_error(values, used, frames.directions, exponent) for exponent in EXPONENTS])
    place = int(errors.argmin())
    exponent = vertex(np.log(EXPONENTS), errors, place)
    at_one = float(errors[np.argmin(np.abs(EXPONENTS - 1))])
    return Curve(float(np.exp(exponent)), at_one / max(float(errors[place]), 1e-9))


def _shading_error(values: np.ndarray, used: np.ndarray, directions: np.ndarray, exponent: float) -> float:
    """The median error of matt shading on values [L, P] that are scaled to 1."""
    linear = values**exponent
    outer = (directions[:, :, None] * directions[:, None]).reshape(len(directions), -1)
    weights = used.astype(float)
    for _ in range(_GAMMA_ROUNDS):
        matrices = (weights.T @ outer).reshape(-1, 3, 3) + 1e-3 * np.eye(3)
        g = np.linalg.solve(matrices, ((weights * linear).T @ directions)[..., None])[..., 0]
        shaded = directions @ g.T
        residual = np.abs(linear - shaded)
        spread = 1.48 * np.median(residual, axis=0) + 1e-3
        weights = (shaded > _FACING * np.linalg.norm(g, axis=1)) / (1 + (residual / (2 * spread)) ** 2)
    back = np.maximum(shaded, 0) ** (1 / exponent)
    return float(np.median(np.abs(values - back)[used]))


def check_gamma(subject: str, curves: Sequence[Curve]) -> Iterator[Finding]:
    """One error for the subject where its cameras agree, in the median, that values are not linear."""
    if not curves:
        return
    exponent = float(np.median([curve.exponent for curve in curves]))
    worse = float(np.median([curve.times_worse for curve in curves]))
    least, most = _EXACTLY_LINEAR if all(curve.exact for curve in curves) else _LINEAR
    if least < exponent < most or worse < _CLEAR:
        return
    words = (
        f"frames are declared linear, but values to the power {exponent:.1f} explain them {worse:.1f} "
        "times better; give the colour space that they are in"
    )
    figures = {"exponent": round(exponent, 2), "times_better": round(worse, 2), "cameras": len(curves)}
    yield Finding("error", "gamma", subject, words, figures=figures)


_EXPONENTS = np.geomspace(EXPONENTS[0], EXPONENTS[-1], 80)  # a sharp minimum wants fine steps
_NOISE = 1e-3  # of log ratios: no sum is better than that
_DARK_PIXEL = 0.02  # of the brightest: darker pixels are noise


def added_exponent(capture: Capture, frames: CameraFrames) -> Curve | None:
    """The exponent under which the lamps' frames add up to the full one; None where there is no such frame.

    Only where all lamps' frames are there: a missing one would look like a curve.
    """
    full = _full_frame(capture, frames)
    if full is None or len(frames.light_ids) < len(capture.light_ids):
        return None
    strength = capture.intensities[frames.places].mean(1)[:, None]
    lit = full > _DARK_PIXEL * full.max()
    each = np.maximum(frames.grey[:, lit] * strength, 0).astype(float)
    together = full[lit].astype(float)
    errors = np.array([_sum_error(each, together, exponent) for exponent in _EXPONENTS])
    at_one = _sum_error(each, together, 1.0)
    return Curve(float(_EXPONENTS[errors.argmin()]), at_one / max(float(errors.min()), _NOISE), exact=True)


def _sum_error(each: np.ndarray, together: np.ndarray, exponent: float) -> float:
    """How far the sum of decoded frames [L, P] is from the decoded full one [P]: median log ratio."""
    return float(np.median(np.abs(np.log((each**exponent).sum(0) + 1e-12) - exponent * np.log(together))))


def _full_frame(capture: Capture, frames: CameraFrames) -> np.ndarray | None:
    """The frame with every lamp on [h, w], as recorded less the black level."""
    for name in FULL_NAMES:
        path = capture.frame_path(frames.subject, frames.camera, name)
        if name in capture.light_ids or not path.is_file():
            continue
        try:
            pixels = read_image(path, capture.colour_space, non_finite="zero").pixels
        except InputError:
            return None
        grey = small(grey_of(pixels) - np.float32(capture.black_level), frames.grey.shape[1:])
        return grey if grey.max() > 0 else None
    return None


# On Extended Yale B's subjects 05, 15 and 22 and synthetic faces the light of a frame is found to 14 degrees
# at worst where its lamp is in front.
_OFF_DEG = 30.0
IN_FRONT, _BELOW = 0.4, -0.7  # cosine to the camera's axis; sine of elevation: others are half in shadow
_MOST_SWAPPED = 0.25  # of the frames: when more are off it is the list that is wrong
_ORDER_ROUNDS = 4


def check_frames_order(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame under another lamp than declared, or one for all where they are many."""
    rows = np.flatnonzero((frames.directions[:, 2] > IN_FRONT) & (frames.directions[:, 1] > _BELOW))
    if len(rows) < 4:
        return
    found = np.stack([solve_light(frames.grey[row][stereo.lit], stereo) for row in rows])
    off_deg = angle_deg(found, frames.directions[rows])
    wrong = np.flatnonzero(off_deg > _OFF_DEG)
    if len(wrong) > max(_MOST_SWAPPED * len(rows), 2):
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


def solve_light(image: np.ndarray, stereo: Stereo) -> np.ndarray:
    """The direction [3] that a frame's lit pixels [P] are lit from, by least squares without its shadows."""
    values = image - stereo.room
    weights = (values > 0.2 * np.percentile(values, 95)).astype(float)
    light = np.array([0.0, 0.0, 1.0])
    for _ in range(_ORDER_ROUNDS):
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


_BRIGHTEST_RATIO = (
    2.5  # times the others; sound frames of synthetic faces have 1.5 at most, of Extended Yale B 1.1
)
_AROUND, _LEAST_AROUND = 0.7, 3  # cosine between lamps, and how many of them say something
_DARK_FRAME = 0.05  # of the brightest frames: in darker ones noise and the room decide


def check_too_bright(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame of a lamp that is not in front and is far brighter than those around it."""
    means = frames.grey[:, stereo.lit].mean(1)
    near = frames.directions @ frames.directions.T > _AROUND
    np.fill_diagonal(near, False)
    around = np.sort(np.where(near, means, 0), axis=1)[:, -2]  # of two that are swapped each has the other
    judged = (frames.directions[:, 2] <= IN_FRONT) & (near.sum(1) >= _LEAST_AROUND)
    judged &= means > _DARK_FRAME * np.percentile(means, 95)
    for row in np.flatnonzero(judged & (means > _BRIGHTEST_RATIO * around)):
        times = float(means[row] / max(float(around[row]), 1e-12))
        brighter = f"is {min(times, 999):.0f} times as bright as the frames under the lamps around"
        words = f"{brighter}; was it saved under a wrong name?"
        light, figures = frames.light_ids[row], {"times": round(times, 1)}
        yield Finding("error", "order", frames.subject, words, frames.camera, light, figures, True)


# Sound frames of Extended Yale B's subjects 05, 15 and 22 have 0.77 of what their neighbours have or more,
# those of synthetic faces 0.41, where the lamp can be judged; one that did not fire leaves some hundredths.
_LEAST_GAIN = 0.3
_REACH = 0.3  # of what the best placed lamps bring: with less, cast shadows and the room decide
_NEIGHBOURS = 6
_PLACES = 98  # per cent of the places are darker than those that are looked at


def check_unlit(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame whose lamp brings far less, over its prediction, than its neighbours' do."""
    lamp, gains = gains_of(frames, stereo)
    judged = lamp > _REACH * np.percentile(lamp, 95)
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
            words = f"has {share:.0%} of the lamp's light that its neighbours predict; did the lamp fire?"
            figures = {"share": round(share, 3), "mean": float(frames.grey[row].mean())}
            light = frames.light_ids[row]
            yield Finding("error", "unlit", frames.subject, words, frames.camera, light, figures, True)


def gains_of(frames: CameraFrames, stereo: Stereo) -> tuple[np.ndarray, np.ndarray]:
    """What each lamp should bring to the brightest places [L], and the share of it that is there [L].

    Hair or a hand may hide a lamp from most of the face; some place, a nose's tip, it reaches nearly always.
    """
    lamp = stereo.lamp(frames.directions)
    there = frames.grey[:, stereo.lit] - stereo.room
    bright, expected = (np.percentile(values, _PLACES, axis=1) for values in (there, lamp))
    return expected, bright / np.maximum(expected, 1e-12)
