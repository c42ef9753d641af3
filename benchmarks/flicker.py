"""Flicker of a relit shot: a synthetic head that talks and turns under a fixed light, whose truth is known.

    python benchmarks/flicker.py [--frames 16] [--size 256] [--person 5] [--sheet sheet.png]

Temporal error: mean |(result - truth)_t - (result - truth)_{t-1}| over the person, over the same of the
truth, in display values (sRGB); results have one gain a channel for the whole clip. Over patches, all are
blurred first by a Gaussian of 1/64 of the side: flicker is seen in patches, the grain of a film in pixels.
Twins: the frames relit one by one, as photos; and the source itself, whose error is its own noise.

The still head is one frame of the clip, with new noise in each frame: its truth does not move, so its
temporal errors are over those of the source, which are its noise.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from _common import arguments, print_header, print_row
from PIL import Image
from scipy.ndimage import gaussian_filter

from facerf_cli import pipeline
from facerf_cli.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.face.head import Head
from facerf_cli.face.landmarks import to_display
from facerf_cli.film.follow import Follower
from facerf_cli.film.shot_view import ShotView
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.models import Models, load_models
from facerf_cli.portrait_field import SteadyFrame
from facerf_cli.synth.animation import Actor, seen_from, turned
from facerf_cli.synth.portraits import bake_portrait, photograph
from facerf_cli.synth.stage_cameras import stage_cameras
from facerf_cli.synth.subjects import draw_subject, subject_model

SEED, RATE, LIGHTS = 101, 24, 48
BAKE = BakeSettings(light_samples=1, bounce_samples=4)
NOISE = 0.006  # standard deviation of the source's noise, display values: 1.5 of 255
MEAN = 0.18  # radiance of the source's person
PATCH = 1 / 64  # of the side


@dataclass(frozen=True)
class Clip:
    """Frames [N, H, W, 3] of the source, display values without noise, and of the truth; alpha [N, H, W]."""

    source: np.ndarray
    truth: np.ndarray
    alpha: np.ndarray


def lamps(*lit: tuple[float, float, float, tuple[float, float, float]], fill: float) -> torch.Tensor:
    """Weights [L, 3] of soft lamps (azimuth, elevation, sharpness, rgb) over an even light."""
    weights = torch.full((LIGHTS, 3), fill / LIGHTS)
    for azimuth_deg, elevation_deg, sharpness, rgb in lit:
        toward = azel_to_direction(azimuth_deg, elevation_deg)
        share = (sharpness * (rig_directions(LIGHTS) @ toward)).softmax(0)
        weights = weights + share[:, None] * torch.tensor(rgb)
    return weights


SOURCE = lamps((-50, 25, 8, (1.0, 0.95, 0.88)), fill=0.8)
TARGET = lamps((70, 20, 12, (1.0, 0.8, 0.6)), (-110, 30, 12, (0.2, 0.35, 0.6)), fill=0.25)


def expression(time_s: float) -> dict[str, float]:
    """A talking face: jaw, lips, smile and brows."""

    def wave(hertz: float, phase: float = 0.0) -> float:
        return math.sin(2 * math.pi * hertz * time_s + phase)

    smile, brows = wave(0.5) ** 2, 1.2 * wave(0.7) ** 2
    return {
        "jaw_open": 0.8 * max(0.0, wave(2.0)),
        "pucker": max(0.0, wave(1.3, 1.0)),
        **dict.fromkeys(("smile_left", "smile_right"), smile),
        **dict.fromkeys(("brow_up_left", "brow_up_right"), brows),
    }


def draw_clip(person: int, frames: int, size_px: int) -> Clip:
    """Photograph a person who talks and turns; lights are fixed to the camera."""
    model = subject_model("builtin")
    actor = Actor(draw_subject(model, person, SEED, size_px), model)
    images, alphas = [], []
    for frame in range(frames):
        turn = 2 * math.pi * frame / RATE
        camera = turned(
            stage_cameras(size_px, "bust")[0], 8 * math.sin(0.35 * turn), 3 * math.sin(0.45 * turn)
        )
        posed = actor.with_expression(expression(frame / RATE))
        baked = bake_portrait(posed, camera, seen_from(rig_directions(LIGHTS), camera), BAKE, 0)
        photos = [photograph(baked, posed.appearance, weights) for weights in (SOURCE, TARGET)]
        images.append([photo.image.permute(1, 2, 0).numpy() for photo in photos])
        alphas.append(photos[0].alpha.numpy())
    alpha = np.stack(alphas)
    linear = np.array(images)
    linear *= MEAN / ((linear[:, 0].mean(-1) * alpha).sum() / alpha.sum())
    wall = np.linspace(0.05, 0.15, size_px)[:, None, None] * np.ones(3)
    behind = (1 - alpha[..., None]) * wall
    source = np.asarray(linear_to_srgb((linear[:, 0] + behind).clip(0, 1)))
    return Clip(source, np.asarray(linear_to_srgb(linear[:, 1].clip(0, 1))), alpha)


def still(clip: Clip, frames: int) -> Clip:
    """One frame of a clip, for as long."""
    return Clip(*(np.repeat(x[:1], frames, 0) for x in (clip.source, clip.truth, clip.alpha)))


def filmed(clip: Clip) -> list[np.ndarray]:
    """Scene-linear frames [H, W, 3] with noise, in 8 bits, as a camera writes them."""
    random = np.random.default_rng(SEED)
    noisy = clip.source + random.normal(0, NOISE, clip.source.shape)
    return [np.asarray(srgb_to_linear(x), np.float32) for x in np.round(noisy.clip(0, 1) * 255) / 255]


def one_by_one(models: Models, frames: list[np.ndarray]) -> list[np.ndarray]:
    """Relight each frame as a photo."""
    results = []
    for frame in frames:
        face = pipeline.find_for("landmarks", frame, "frame")[0]
        results.append(relit(models, frame, pipeline.head_of(models, frame, face)))
    return results


def as_shot(models: Models, frames: list[np.ndarray]) -> list[np.ndarray]:
    """Relight the frames as `facerf relight FILM` does."""
    follower = Follower("largest")
    sightings = [follower.see(to_display(frame)) for frame in frames]
    view = ShotView(models, models.sides(), frames.__getitem__, sightings)
    return [relit(models, frames[n], view.head(n), view.steady(n)) for n in range(len(frames))]


def relit(models: Models, frame: np.ndarray, head: Head, steady: SteadyFrame | None = None) -> np.ndarray:
    """Relight a frame by the target's light."""
    reflectance = pipeline.reflectance_of(models, head, "portrait", photo=frame, steady=steady)
    composition = pipeline.composition_of(models, frame, head, reflectance)
    light = (rig_directions(LIGHTS), TARGET[None])
    return composition.image(next(pipeline.relit_by(composition, head, reflectance, *light))).pixels


def exposed(results: list[np.ndarray], clip: Clip) -> np.ndarray:
    """Results in display values [N, H, W, 3], with the truth's mean colour over the clip."""
    linear, own = np.stack(results), clip.alpha > 0.5
    gain = srgb_to_linear(clip.truth)[own].mean(0) / linear[own].mean(0)
    return np.asarray(linear_to_srgb((linear * gain).clip(0, 1)))


def changes(images: np.ndarray, clip: Clip, patches: bool) -> float:
    """Mean change of images [N, H, W, 3] from frame to frame, over the person."""
    own = clip.alpha > 0.5
    if patches:
        sigma = (0, PATCH * images.shape[1], PATCH * images.shape[1])
        share = gaussian_filter(clip.alpha, sigma)[..., None].clip(0.05)
        images = gaussian_filter(images * clip.alpha[..., None], (*sigma, 0)) / share
    return float(np.abs(np.diff(images, axis=0))[own[1:] & own[:-1]].mean())


Way = Callable[[Models, list[np.ndarray]], list[np.ndarray]]
WAYS: dict[str, Way] = {"frame by frame": one_by_one, "as a shot": as_shot}


def measure(name: str, clip: Clip, models: Models) -> dict[str, np.ndarray]:
    """Print the rows of a clip; return the results in display values."""
    frames = filmed(clip)
    source = np.stack([np.asarray(linear_to_srgb(frame)) for frame in frames])
    shown = {way: exposed(relight(models, frames), clip) for way, relight in WAYS.items()}
    rows = {"the source's own noise": (source, clip.source), **{k: (x, clip.truth) for k, x in shown.items()}}
    moves = name != "still"
    for way, (images, truth) in rows.items():
        cells = []
        for patches in (False, True):
            over = changes(clip.truth, clip, patches) if moves else changes(source, clip, patches)
            cells.append(f"{changes(images - truth, clip, patches) / over:.3f}")
        print_row(name, way, *cells)
    return shown


def sheet(shown: dict[str, np.ndarray], clip: Clip) -> Image.Image:
    """Four frames: source, frame by frame, as a shot, truth."""
    at = np.linspace(0, len(clip.truth) - 1, 4).round().astype(int)
    rows = [clip.source, *shown.values(), clip.truth]
    joined = np.concatenate([np.concatenate(row[at], 1) for row in rows])
    return Image.fromarray((joined.clip(0, 1) * 255).round().astype(np.uint8))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--person", type=int, default=5)
    parser.add_argument("--sheet")
    given = parser.parse_args()
    clip = draw_clip(given.person, given.frames, given.size)
    models = load_models(None, "builtin", torch.device("cpu"))
    print_header("head", "relit", "temporal error of pixels", "of patches")
    shown = measure("talks and turns", clip, models)
    measure("still", still(clip, given.frames), models)
    if given.sheet:
        sheet(shown, clip).save(given.sheet)


if __name__ == "__main__":
    main()
