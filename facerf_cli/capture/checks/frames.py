"""Frames of a camera, shrunk for the checks, and checks of single frames.

A frame may be missing, unreadable, black, clipped or another camera's. Each is read once for all checks, and
one full frame is in memory at a time.
"""

import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.capture import Capture, FrameSizeError
from facerf_cli.capture.findings import Finding
from facerf_cli.errors import InputError

_AT_THE_TOP = 1 - 1e-5  # of a frame's maximum: arithmetic may move clipped values this far apart
_MOST_OF_ANOTHER_SIZE = 0.5  # of a camera's frames: with more, the camera's description is wrong
_BLACK = 1e-3  # of the median of the frames' maxima: less than any light on skin leaves
_FLAT = 1e-6  # of a frame's maximum
_CLIPPED_SHARE = 0.01  # of the pixels: highlights on skin are smaller, a clipped cheek is larger
_CEILING = 1e-4  # relative distance within which values count as the ceiling
# Lights that head, body, hair or brows can hide from the face, in camera space.
_BEHIND = -0.5  # cosine to the camera's axis; the head hides lights below it
_BELOW = -0.7  # sine of the elevation; the body hides lights below it
_ABOVE, _OVERHEAD = 0.85, 0.3  # sine above which hair or brows hide lights of a cosine below the second


# Measurements of a full-size frame with recorded values, not divided by the light's intensity: SHA-256 of its
# pixels, largest value, fraction of pixels that have it in some channel, largest less smallest value.
_MEASURED = np.dtype([("digest", "U64"), ("highest", float), ("share_highest", float), ("spread", float)])


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """Readable frames of a subject in a camera, small and grey."""

    subject: str
    camera: str
    light_ids: list[str]  # of the frames
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    grey: np.ndarray  # [L, h, w] float32 linear, under a light of rgb 1
    measured: np.ndarray  # [L] of `_MEASURED`
    scale: float  # pixels of the camera per pixel of `grey`

    def without(self, broken: Collection[str]) -> "CameraFrames":
        """Remove the frames under these lights."""
        kept = [row for row, light in enumerate(self.light_ids) if light not in broken]
        return replace(
            self,
            light_ids=[self.light_ids[row] for row in kept],
            directions=self.directions[kept],
            grey=self.grey[kept],
            measured=self.measured[kept],
        )

    def error(self, check: str, words: str, row: int | None = None, **figures: float) -> Finding:
        """Make an error about the camera, or about the frame in a row, which is then left out."""
        light = None if row is None else self.light_ids[row]
        return Finding("error", check, self.subject, words, self.camera, light, figures)

    def warning(self, check: str, words: str, **figures: float) -> Finding:
        """Make a warning about the camera."""
        return Finding("warning", check, self.subject, words, self.camera, figures=figures)


def read_frames(
    capture: Capture, subject: str, camera: str, side_px: int
) -> tuple[CameraFrames, dict[str, InputError]]:
    """Read the existing frames of a camera, shrunk to `side_px`; return unreadable ones' errors by light."""
    posed = capture.cameras[camera]
    scale = max(posed.width_px, posed.height_px, side_px) / side_px
    size = (max(round(posed.height_px / scale), 1), max(round(posed.width_px / scale), 1))
    places, greys, measured, unread = [], [], [], {}
    for place, light in enumerate(capture.light_ids):
        if not capture.has_frame(subject, camera, light):
            continue
        try:
            pixels = capture.frame(subject, camera, place)
        except InputError as error:
            unread[light] = error
            continue
        places.append(place)
        measured.append(_measure(pixels * capture.intensities[place].astype(np.float32)))
        red, green, blue = np.moveaxis(pixels, -1, 0)
        grey = (red + green + blue) / np.float32(3)  # many times faster than the mean over an axis of three
        greys.append(F.interpolate(torch.from_numpy(grey)[None, None], size, mode="area")[0, 0].numpy())
    frames = CameraFrames(
        subject=subject,
        camera=camera,
        light_ids=[capture.light_ids[place] for place in places],
        directions=capture.directions_world[places] @ posed.rotation.double().numpy().T,
        grey=np.stack(greys) if greys else np.zeros((0, *size), np.float32),
        measured=np.array(measured, _MEASURED),
        scale=scale,
    )
    return frames, unread


def _measure(pixels: np.ndarray) -> tuple[str | float, ...]:
    highest = float(pixels.max())
    top = (pixels >= highest * _AT_THE_TOP).any(-1) if highest > 0 else np.zeros(1)
    digest = hashlib.sha256(pixels.tobytes()).hexdigest()
    return digest, highest, top.mean(), highest - float(pixels.min())


def reaches_face(directions: np.ndarray) -> np.ndarray:
    """Return the mask [L] of directions [L, 3] in camera space that no head, hair or body blocks."""
    _, up, front = directions.T
    return (front > _BEHIND) & (up > _BELOW) & ~((up > _ABOVE) & (front < _OVERHEAD))


def check_missing(capture: Capture, subject: str, camera: str) -> Iterator[Finding]:
    """Report each missing frame of a camera; a camera without frames as one warning."""
    paths = {light: capture.frame_path(subject, camera, light) for light in capture.light_ids}
    marked = capture.marked.get(subject, frozenset())
    missing = [light for light in paths if not capture.has_frame(subject, camera, light)]
    if len(missing) == len(paths):
        example = next(iter(paths.values()))
        words = f"has no frames ({example}, ...); copy them, or correct the pattern"
        yield Finding("warning", "missing", subject, words, camera)
        missing = []
    for light in (light for light in missing if light not in marked):
        yield Finding("error", "missing", subject, f"{paths[light]}: no such file; copy it", camera, light)


def check_readable(frames: CameraFrames, unread: Mapping[str, InputError]) -> Iterator[Finding]:
    """Report each unreadable frame, or the camera if most frames have another size."""
    sizes = {light: error for light, error in unread.items() if isinstance(error, FrameSizeError)}
    camera_is_wrong = len(sizes) > _MOST_OF_ANOTHER_SIZE * (len(unread) + len(frames.light_ids))
    if camera_is_wrong:
        words = (
            f"{len(sizes)} frames have another size than the camera ({next(iter(sizes.values()))}); correct "
            "the camera's width, height and K"
        )
        yield frames.error("resolution", words, frames=len(sizes))
    for light, error in unread.items():
        if light not in sizes or not camera_is_wrong:
            check = "resolution" if light in sizes else "unreadable"
            yield Finding("error", check, frames.subject, str(error), frames.camera, light)


def check_black(frames: CameraFrames) -> Iterator[Finding]:
    """Report each frame that is black or has one value throughout, or the camera if most are black.

    A light behind the head may reach nothing visible. So a dark frame counts as black only if its light
    reaches the face; a frame with one value is broken under any light.
    """
    highest, spread = frames.measured["highest"], frames.measured["spread"]
    usual = float(np.median(highest)) if len(highest) else 1.0
    if usual <= 0:
        yield frames.error("black", "most frames are black; check the lens cap and black_level")
        return
    flat, dark = spread <= _FLAT * highest.clip(0), highest < _BLACK * usual
    for row in np.flatnonzero(dark & reaches_face(frames.directions) | flat).tolist():
        words = "is black" if dark[row] else "has one value throughout"
        words += "; check the shutter, the light and the file"
        yield frames.error("black", words, row, highest=float(highest[row]), usual=usual)


def check_clipped(frames: CameraFrames) -> Iterator[Finding]:
    """Warn once per camera about frames with large areas at the sensor's ceiling.

    The ceiling is the largest value of all frames, if two or more frames reach it: noise and highlights
    differ from frame to frame, a clipped sensor does not. EXR files declare no ceiling.
    """
    highest, share = frames.measured["highest"], frames.measured["share_highest"]
    at_ceiling = highest >= highest.max(initial=0) * (1 - _CEILING)
    clipped = np.flatnonzero(at_ceiling & (share > _CLIPPED_SHARE))
    if not len(clipped) or at_ceiling.sum() < 2:
        return
    worst = clipped[share[clipped].argmax()]
    words = (
        f"{len(clipped)} of {len(highest)} frames are clipped over more than {_CLIPPED_SHARE:.0%} of their "
        f"pixels ({frames.light_ids[worst]}: {share[worst]:.1%}); expose less"
    )
    yield frames.warning("clipped", words, frames=len(clipped), worst_share=round(float(share[worst]), 4))


def same_frames(frames: CameraFrames) -> list[list[int]]:
    """Return groups of rows with identical images, among frames that have more than one value."""
    groups: dict[str, list[int]] = {}
    for row in np.flatnonzero(frames.measured["spread"] > 0).tolist():
        groups.setdefault(frames.measured["digest"][row], []).append(row)
    return [rows for rows in groups.values() if len(rows) > 1]


def check_other_cameras(frames: CameraFrames, earlier: Mapping[str, str]) -> Iterator[Finding]:
    """Report a camera with frames of another one; `earlier` maps digests to the others' camera/light."""
    rows = np.flatnonzero(frames.measured["spread"] > 0)
    again = [row for row in rows if frames.measured["digest"][row] in earlier]
    if again:
        light, place = frames.light_ids[again[0]], earlier[frames.measured["digest"][again[0]]]
        words = f"{len(again)} frames are another camera's ({light} is identical to {place}); copy them again"
        yield frames.error("duplicate", words, frames=len(again))
