"""A camera's frames, small, read once for all checks; and what is measured at full size on the way.

Held are a grey picture of at most `side_px` a light and some figures; full pictures pass one at a time.

Frames that the capture's pattern promises and the disk lacks, and files that no lamp accounts for.

Photometric stereo of a camera's frames: what each frame should look like if its lamp is where it is said.

R. Woodham, *Photometric method for determining surface orientation from multiple images*, Optical Engineering
1980: under a lamp in direction d a matt surface has radiance g . d, where g is its normal times its albedo.
A constant is fitted beside g, for the room's own light. Cast shadows, highlights and broken frames are
outweighed by the rest: weights fall with the residual, and frames in a pixel's own shadow do not count.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.images import read_image

_FACE_PX = 512  # the longer side of the picture that the face is found on
_BRIGHT = 0.2  # of the brightest blocks
_AT_THE_TOP = 1 - 1e-5  # of a frame's maximum: what a clipped value may lose in arithmetic


@dataclass(frozen=True)
class FrameFigures:
    """What is measured on a frame at its full size, as recorded (times the lamp's intensity)."""

    digest: str  # of the pixels
    highest: float  # of all values
    share_highest: float  # of the pixels that have the highest value in some channel
    spread: float  # highest less lowest
    comb: float  # how odd and even rows differ, over what they have in common
    comb_ratio: float  # over how odd and even columns differ


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The frames of a subject in a camera that could be read: `places` in the capture's lights, ascending."""

    subject: str
    camera: str
    light_ids: tuple[str, ...]  # of the frames
    places: np.ndarray  # [L] in the capture's lights
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    grey: np.ndarray  # [L, h, w] float32 linear, under a light of rgb 1
    figures: tuple[FrameFigures, ...]
    scale: float  # pixels of the camera to one of `grey`
    lit: np.ndarray  # [H, W] float32: the mean of all frames, larger, to find the face on
    lit_scale: float  # pixels of the camera to one of `lit`

    def less(self, broken: set[str]) -> "CameraFrames":
        """Without the frames under these lights."""
        kept = [row for row, light in enumerate(self.light_ids) if light not in broken]
        return CameraFrames(
            subject=self.subject,
            camera=self.camera,
            light_ids=tuple(self.light_ids[row] for row in kept),
            places=self.places[kept],
            directions=self.directions[kept],
            grey=self.grey[kept],
            figures=tuple(self.figures[row] for row in kept),
            scale=self.scale,
            lit=self.lit,
            lit_scale=self.lit_scale,
        )


@dataclass(frozen=True)
class Unread:
    """A frame that could not be read: its light, why, and whether only its size is wrong."""

    light: str
    reason: str
    wrong_size: bool


def read_frames(
    capture: Capture, subject: str, camera: str, side_px: int
) -> tuple[CameraFrames, list[Unread]]:
    """Read a camera's frames that exist; those that cannot be read are told apart."""
    posed = capture.cameras[camera]
    size, scale = _fitted(posed, side_px)
    lit_size, lit_scale = _fitted(posed, _FACE_PX)
    lit = np.zeros(lit_size, np.float32)
    places, greys, figures, unread = [], [], [], []
    for place, light in enumerate(capture.light_ids):
        if not capture.frame_path(subject, camera, light).exists():
            continue
        try:
            pixels = capture.frame(subject, camera, place)
        except InputError as error:
            unread.append(Unread(light, str(error), _decodes(capture, subject, camera, light)))
            continue
        places.append(place)
        figures.append(_measure(pixels * capture.intensities[place].astype(np.float32)))
        grey = grey_of(pixels)
        greys.append(small(grey, size))
        lit += small(grey, lit_size)
    rows = np.array(places, int)
    frames = CameraFrames(
        subject=subject,
        camera=camera,
        light_ids=tuple(capture.light_ids[place] for place in places),
        places=rows,
        directions=capture.directions_world[rows] @ posed.rotation.double().numpy().T,
        grey=np.stack(greys) if greys else np.zeros((0, *size), np.float32),
        figures=tuple(figures),
        scale=scale,
        lit=lit / max(len(places), 1),
        lit_scale=lit_scale,
    )
    return frames, unread


def _fitted(posed: PosedCamera, side_px: int) -> tuple[tuple[int, int], float]:
    """Height and width of a camera's picture made to fit `side_px`, never larger, and its pixels to one."""
    scale = max(posed.width_px, posed.height_px, side_px) / side_px
    return (max(round(posed.height_px / scale), 1), max(round(posed.width_px / scale), 1)), scale


def _decodes(capture: Capture, subject: str, camera: str, light: str) -> bool:
    try:
        read_image(capture.frame_path(subject, camera, light), capture.colour_space, non_finite="zero")
    except InputError:
        return False
    return True


def grey_of(pixels: np.ndarray) -> np.ndarray:
    """The mean of the channels [H, W]; numpy's own is many times slower over an axis of three."""
    return (pixels[..., 0] + pixels[..., 1] + pixels[..., 2]) / np.float32(3)


def small(grey: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A plane made small, each pixel the mean of its area."""
    return F.interpolate(torch.from_numpy(grey)[None, None], size, mode="area")[0, 0].numpy()


def _measure(pixels: np.ndarray) -> FrameFigures:
    """Figures of a full picture [H, W, 3]."""
    highest, grey = float(pixels.max()), grey_of(pixels)
    rows, columns = comb(grey), comb(grey.T)
    top = (pixels >= highest * _AT_THE_TOP).any(-1) if highest > 0 else np.zeros(1)
    return FrameFigures(
        digest=hashlib.sha256(pixels.tobytes()).hexdigest(),
        highest=highest,
        share_highest=float(top.mean()),
        spread=highest - float(pixels.min()),
        comb=rows,
        comb_ratio=rows / max(columns, 1e-6),
    )


def comb(grey: np.ndarray) -> float:
    """How much odd rows of a picture [H, W] differ from even ones, over their mean, median of bright blocks.

    A row's departure from the mean of its neighbours, its sign turned every other row, adds up over a block
    of 8 x 4 pixels only if rows alternate. Blocks are small, for pictures scaled or turned after they were
    taken alternate in step for a few rows only.
    """
    departure = grey[1:-1] - (grey[:-2] + grey[2:]) / 2
    departure = departure * np.where(np.arange(len(departure)) % 2, -1, 1)[:, None]
    if len(departure) < 8 or departure.shape[1] < 4:
        return 0.0
    mean = _blocks(grey[1:-1])
    bright = mean > max(_BRIGHT * float(np.percentile(mean, 95)), 0)
    return float(np.median(np.abs(_blocks(departure))[bright] / mean[bright])) if bright.any() else 0.0


def _blocks(plane: np.ndarray) -> np.ndarray:
    """Means of whole blocks of 8 x 4 pixels."""
    height, width = plane.shape[0] // 8, plane.shape[1] // 4
    return plane[: height * 8, : width * 4].reshape(height, 8, width, 4).mean((1, 3))


_SHOWN = 3
FULL_NAMES = ("full", "full_on", "fullon", "all", "all_on")  # a frame with every lamp on, see `additivity.py`
_NO_LAMP = ("ambient", "dark", "black", "room", "background")  # frames that stages keep for other ends


def check_missing(capture: Capture, subject: str, camera: str) -> Iterator[Finding]:
    """Frames of a camera that are missing, one by one; a whole camera, or extra files, in one warning."""
    paths = {light: capture.frame_path(subject, camera, light) for light in capture.light_ids}
    missing = [light for light, path in paths.items() if not path.is_file()]
    if len(missing) == len(paths):
        example = next(iter(paths.values()))
        words = f"no frame of this camera is there ({example}, ...); is the pattern right?"
        yield Finding("warning", "missing", subject, words, camera)
        missing = []
    for light in missing:
        yield Finding("error", "missing", subject, f"{paths[light]}: no such file", camera, light, {}, True)
    extra = extra_names(capture, subject, camera)
    if extra:
        names = ", ".join(extra[:_SHOWN]) + (", ..." if len(extra) > _SHOWN else "")
        words = f"files of no lamp in the list: {len(extra)} ({names}); are lamps missing from it?"
        yield Finding("warning", "extra", subject, words, camera, figures={"files": len(extra)})


def extra_names(capture: Capture, subject: str, camera: str) -> list[str]:
    """Names in the light's place of files that are of no lamp, sorted; known ones for other ends left out."""
    mark = "\x01"  # in no name
    path = capture.frame_path(subject, camera, mark)
    if path.name.count(mark) != 1 or mark in str(path.parent):  # the light names a folder, or is named twice
        return []
    prefix, after = path.name.split(mark)
    known, names = set(capture.light_ids), []
    for found in path.parent.glob("*"):
        name = found.name
        if found.is_file() and name.startswith(prefix) and name.endswith(after) and name[0] != ".":
            names.append(name[len(prefix) : len(name) - len(after)])
    others = (name for name in names if name and name not in known)
    return sorted(name for name in others if not other_end(name))


def other_end(name: str) -> str:
    """What a picture in a light's place is for: 'full', 'ambient', or nothing where it may be of a lamp."""
    plain = name.lower().strip("_- ")
    if plain in FULL_NAMES:
        return "full"
    return "ambient" if any(word in plain for word in _NO_LAMP) else ""


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
