"""Flicker of a relit shot: a synthetic head that talks and turns under a fixed light, whose truth is known.

    python benchmarks/flicker.py [--frames 16] [--size 256] [--person 5] [--clip clip.npz] [--sheet sheet.png]
    python benchmarks/flicker.py --video VIDEO|PHOTO [--frames 12]

Temporal error: mean |(result - truth)_t - (result - truth)_{t-1}| over the person, over the same of the
truth, in display values (sRGB); results have one gain a channel for the whole clip. Over patches, all are
blurred first by a Gaussian of 1/64 of the side: flicker is seen in patches, film grain in pixels.
It counts errors that stay where they are on the head, too, since they move past the pixels with it. How many,
tells a steady twin: the truth times the mean over time of result / truth, carried with the head by its known
motion.

Flicker: log of result / truth, carried to where the head is in the middle frame; what of it a parabola over
five frames does not follow, over patches, in percent; white noise counts as in the change from one frame to
the next. So neither an error that moves with the head counts, nor one that grows as the head turns.

Twins: the frames relit one by one, as photos; and the source itself, whose error is its own noise. The
flicker of the source against the truth in the other light is the least that can be measured: it holds the
noise, and what is rough in the motion of the true light.

The still head is one frame of the clip, with new noise in each frame: its truth does not move, so its
temporal errors are over those of the source, which are its noise.

--video measures any video, without truth: the mean difference of a frame from the one before, warped by
optical flow of the source, over the person, in steps of 255. A photo is panned and zoomed by less than a
pixel per frame, with noise, to stand for a video.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from _common import arguments, print_header, print_row
from _talking_head import LIGHTS, TARGET, Clip, kept_clip, recorded, still
from _video_of_photo import frames_of
from PIL import Image
from scipy.ndimage import gaussian_filter
from skimage.registration import optical_flow_ilk
from skimage.transform import warp

from facerf_cli.face.head import Head
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, to_display
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.person import Person
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.fitting import head_of, reflectance_of
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.relighting.portrait_field import SmoothedFrame
from facerf_cli.relighting.shot import SteadyShot
from facerf_cli.relighting.tracking import FaceTracker

PATCH = 1 / 64  # of the side
FLOOR = 0.02  # radiance added to results and truth before their ratio
ROUGH = np.array([3.0, -12, 18, -12, 3])  # what a parabola over five frames leaves at the middle one
ALIKE = 0.03  # difference of the source from its warped neighbour, in 0..1, up to which the flow is trusted


def one_by_one(models: Models, frames: list[np.ndarray]) -> list[np.ndarray]:
    """Relight each frame as a photo."""
    results = []
    for frame in frames:
        face = find_faces(models.networks.people, frame, "frame")[0]
        results.append(relit(models, frame, head_of(models, frame, face)))
    return results


def as_shot(models: Models, frames: list[np.ndarray]) -> list[np.ndarray]:
    """Relight the frames as `facerf relight VIDEO` does."""
    windows = map(steady_shot(models, frames).window, range(len(frames)))
    return [relit(models, frame, one.head, one) for frame, one in zip(frames, windows, strict=True)]


def steady_shot(models: Models, frames: list[np.ndarray]) -> SteadyShot:
    """A shot whose face was followed."""
    tracker = FaceTracker(models.networks.people, "largest")
    sightings = [tracker.track(to_display(frame)) for frame in frames]
    return SteadyShot(models, frames.__getitem__, sightings, models.sides())


def relit(models: Models, frame: np.ndarray, head: Head, steady: SmoothedFrame | None = None) -> np.ndarray:
    """Relight a frame by the target's light."""
    reflectance = reflectance_of(models, head, "portrait", photo=frame, steady=steady)
    light = RigLight(rig_directions(LIGHTS), TARGET)
    return Person(models, frame, head, reflectance).image(light)


def exposed(results: list[np.ndarray], clip: Clip) -> np.ndarray:
    """Results in display values [N, H, W, 3], with the truth's mean colour over the clip."""
    linear, own = np.stack(results), clip.alpha > 0.5
    gain = srgb_to_linear(clip.truth)[own].mean(0) / linear[own].mean(0)
    return shown(linear * gain)


def shown(linear: np.ndarray) -> np.ndarray:
    """Scene-linear values in display values."""
    return np.asarray(linear_to_srgb(linear.clip(0, 1)))


def changes(images: np.ndarray, clip: Clip, patches: bool) -> float:
    """Mean change of images [N, H, W, 3] from frame to frame, over the person."""
    own = clip.alpha > 0.5
    if patches:
        sigma = (0, PATCH * images.shape[1], PATCH * images.shape[1])
        share = gaussian_filter(clip.alpha, sigma)[..., None].clip(0.05)
        images = gaussian_filter(images * clip.alpha[..., None], (*sigma, 0)) / share
    return float(np.abs(np.diff(images, axis=0))[own[1:] & own[:-1]].mean())


def ratio(images: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Radiance of images over that of their truth; both in display values."""
    return np.asarray((srgb_to_linear(images) + FLOOR) / (srgb_to_linear(truth) + FLOOR))


def steady_twin(images: np.ndarray, clip: Clip) -> np.ndarray:
    """The truth [N, H, W, 3] with the mean error of images, which moves with the head."""
    own = ratio(images, clip.truth)
    mean = masked_mean(clip.in_middle(own))
    carried = clip.from_the_middle(mean)
    kept = np.where(np.isnan(carried), own, carried)
    return shown((srgb_to_linear(clip.truth) + FLOOR) * kept - FLOOR)


def masked_mean(values: np.ndarray) -> np.ndarray:
    """Mean [...] over the first axis of what is not NaN; NaN where nothing is."""
    known = np.isfinite(values)
    return np.asarray(np.where(known, values, 0).sum(0) / np.where(known.any(0), known.sum(0), np.nan))


def flicker(images: np.ndarray, truth: np.ndarray, clip: Clip) -> float:
    """Mean roughness in time, in percent, of images [N, H, W, 3] in the head's own frame; see above."""
    error = clip.in_middle(np.log(ratio(images, truth)))
    error[:, clip.alpha[clip.middle] <= 0.5] = np.nan
    steps = range(len(error) - len(ROUGH) + 1)
    rough = np.stack([np.tensordot(ROUGH, error[n : n + len(ROUGH)], 1) for n in steps])
    rough *= np.sqrt(2 / (ROUGH**2).sum())
    known, sigma = np.isfinite(rough), (0, PATCH * images.shape[1], PATCH * images.shape[1], 0)
    blurred = gaussian_filter(np.where(known, rough, 0), sigma) / gaussian_filter(known * 1.0, sigma).clip(
        0.05
    )
    return 100 * float(np.abs(blurred)[known].mean())


Way = Callable[[Models, list[np.ndarray]], list[np.ndarray]]
WAYS: dict[str, Way] = {"frame by frame": one_by_one, "as a shot": as_shot}


def measure(name: str, clip: Clip, models: Models) -> dict[str, np.ndarray]:
    """Print the rows of a clip; return the results in display values."""
    frames = recorded(clip)
    source = np.stack([shown(frame) for frame in frames])
    found = {way: exposed(relight(models, frames), clip) for way, relight in WAYS.items()}
    steady = steady_twin(found["as a shot"], clip)
    rows = {
        "the source's own noise": (source, clip.source),
        "the source, against the truth": (source, clip.truth),
        **{way: (images, clip.truth) for way, images in found.items()},
        "steady, with the errors of the shot": (steady, clip.truth),
    }
    moves = name != "still"
    for way, (images, truth) in rows.items():
        cells = []
        for patches in (False, True):
            over = changes(clip.truth, clip, patches) if moves else changes(source, clip, patches)
            cells.append(f"{changes(images - truth, clip, patches) / over:.3f}")
        print_row(name, way, *cells, f"{flicker(images, truth, clip):.2f}")
    return found


def sheet(found: dict[str, np.ndarray], clip: Clip) -> Image.Image:
    """Four frames: source, frame by frame, as a shot, truth."""
    at = np.linspace(0, len(clip.truth) - 1, 4).round().astype(int)
    rows = [clip.source, *found.values(), clip.truth]
    joined = np.concatenate([np.concatenate(row[at], 1) for row in rows])
    return Image.fromarray((joined.clip(0, 1) * 255).round().astype(np.uint8))


def flow_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Optical flow [2, H, W], rows and columns, by which a frame `after` lies in the one `before`."""
    greys = (image.mean(-1) for image in (after, before))
    return np.asarray(optical_flow_ilk(*greys, radius=7, gaussian=True))


def warped(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] at the places to which a flow [2, H, W] leads."""
    at = np.mgrid[: flow.shape[1], : flow.shape[2]] + flow
    return np.stack([warp(image[..., c], at, mode="edge", order=3) for c in range(3)], -1)


def warped_errors(
    videos: dict[str, list[np.ndarray]], source: list[np.ndarray], mattes: list[np.ndarray]
) -> dict[str, tuple[float, float]]:
    """Mean and 99 % of the difference of each frame from the one before, warped, in steps of 255.

    All are in display values; mattes [H, W] show the person. Left out is where the source itself differs.
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in videos}
    for n in range(1, len(source)):
        flow = flow_between(source[n - 1], source[n])
        smooth = gaussian_filter(warped(source[n - 1], flow) - source[n], (1, 1, 0))
        trusted = (np.abs(smooth).max(-1) < ALIKE) & (mattes[n] > 0.5)
        for name, video in videos.items():
            found[name].append(np.abs(warped(video[n - 1], flow) - video[n])[trusted])
    every = {name: 255 * np.concatenate(parts) for name, parts in found.items()}
    return {name: (float(x.mean()), float(np.percentile(x, 99))) for name, x in every.items()}


def measure_video(path: Path, count: int, models: Models) -> None:
    """Print the warped errors of a video."""
    frames = frames_of(path, count)
    view = steady_shot(models, frames)
    mattes = [view.segmentation(n).matte for n in range(len(frames))]
    source = [shown(frame) for frame in frames]
    videos = {"the source itself": source}
    for way, relight in WAYS.items():
        linear = np.stack(relight(models, frames))
        own = np.stack(mattes) > 0.5
        gain = np.stack(frames)[own].mean() / linear[own].mean()
        videos[way] = list(shown(linear * gain))
    print_header(path.name, "warped error, mean", "99 %")
    for name, (mean, most) in warped_errors(videos, source, mattes).items():
        print_row(name, f"{mean:.2f}", f"{most:.1f}")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--person", type=int, default=5)
    parser.add_argument("--clip", type=Path, help="keep the synthetic clip here; read it from here")
    parser.add_argument("--video", type=Path)
    parser.add_argument("--sheet")
    given = parser.parse_args()
    models = load_models()
    if given.video:
        measure_video(given.video, given.frames, models)
        return
    clip = kept_clip(given.clip, given.person, given.frames, given.size)
    print_header("head", "relit", "temporal error of pixels", "of patches", "flicker, %")
    found = measure("talks and turns", clip, models)
    measure("still", still(clip, len(clip.alpha)), models)
    if given.sheet:
        sheet(found, clip).save(given.sheet)


if __name__ == "__main__":
    main()
