r"""Head motion that `prepare-dataset --align` undoes: how much of what is planted, and does it do harm?

    python benchmarks/align_motion.py CAPTURE --drift 6
    python benchmarks/align_motion.py --yale ../shared/data/extended_yale_b \
        --shifts ../shared/bench/yale_b/shifts.csv

CAPTURE is a still one, as `facerf synth-stage` writes it: a subject's frames of one camera are moved along a
smooth path, in the order of the list of lights, with a little of each frame's own. Shifts are counted from
their mean, for nobody knows where the head should be. Kinds of lamps: in front of the camera, to the side,
behind. On Extended Yale B there is no truth: what the mean of a subject's pictures gains in sharpness is
shown beside what the list of whole pixels brings that the benchmark of that database goes by.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from capture_copy import Copy
from scipy import ndimage

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.align import with_alignment
from facerf_cli.capture.checks.findings import frames_left_out
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.yale_b import read_shifts

_OWN_PX = 0.3  # what each frame has of its own beside the path
_SMOOTH = 20  # frames over which the path bends
_KINDS = (("front", 0.3, 1.1), ("side", -0.3, 0.3), ("behind", -1.1, -0.3))  # cosines to the camera's axis
Shifts = Mapping[tuple[str, str, str], tuple[float, float]]


def path_px(frames: int, furthest_px: float, seed: int) -> np.ndarray:
    """A smooth path [L, 2] of the head, down and right, as far as `furthest_px` from its mean, and jitter."""
    generator = np.random.default_rng(seed)
    path = ndimage.gaussian_filter1d(generator.normal(size=(frames, 2)), _SMOOTH, axis=0, mode="nearest")
    path -= path.mean(0)
    path *= furthest_px / max(float(np.hypot(*path.T).max()), 1e-9)
    return path + (generator.normal(size=path.shape) * _OWN_PX if furthest_px else 0)


def planted(source: Path, subject: str, furthest_px: float, seed: int) -> None:
    """Print what is left of a path after alignment, by kind of lamp, and of the pictures' differences."""
    with tempfile.TemporaryDirectory() as name:
        copy = Copy(source, Path(name), subject, 1)
        camera, moved_px = copy.cameras[0], path_px(len(copy.ids), furthest_px, seed)
        truth = read_capture(copy.folder)
        still = np.stack(list(frames_of(truth, subject, camera)))
        for light, by in zip(copy.ids, moved_px, strict=True):
            copy.write(light, ndimage.shift(copy.read(light), (*by, 0), order=3, mode="nearest"))
        capture = read_capture(copy.folder)
        aligned = with_alignment(capture, subject, {})
        found = [aligned.shifts.get((subject, camera, light), (0, 0)) for light in copy.ids]
        left_px = moved_px + np.array(found)
        moved, back = (np.stack(list(frames_of(of, subject, camera))) for of in (capture, aligned))
    still = common(still, left_px.mean(0))
    print(
        f"{subject}, path to {furthest_px:g} px: {int(np.any(found, 1).sum())} of {len(found)} frames moved"
    )
    for kind, least, most in (("all", -2, 2), *_KINDS):
        rows = (copy.directions[:, 2] >= least) & (copy.directions[:, 2] < most)
        before, after = rms(moved_px[rows], moved_px.mean(0)), rms(left_px[rows], left_px.mean(0))
        off = [difference(images[rows], still[rows]) for images in (moved, back)]
        print(f"  {kind}, {rows.sum()} frames: {before:.2f} px -> {after:.2f} px RMS; ", end="")
        print(f"frames differ by {off[0]:.1%} -> {off[1]:.1%}")
    sums = [difference(images.mean(0), still.mean(0)) for images in (moved, back)]
    print(f"  their mean differs by {sums[0]:.1%} -> {sums[1]:.1%}")


def rms(shifts_px: np.ndarray, mean_px: np.ndarray) -> float:
    return float(np.sqrt(((shifts_px - mean_px) ** 2).sum(1).mean()))


def common(images: np.ndarray, by_px: np.ndarray) -> np.ndarray:
    """Pictures [L, H, W] moved together, to where the aligned ones are."""
    return np.stack([ndimage.shift(image, by_px, order=3, mode="nearest") for image in images])


def difference(images: np.ndarray, truth: np.ndarray) -> float:
    """The mean absolute difference over the mean."""
    return float(np.abs(images - truth).mean() / truth.mean())


def frames_of(capture: Capture, subject: str, camera: str) -> Iterator[np.ndarray]:
    """Grey frames [H, W]."""
    for place, light in enumerate(capture.light_ids):
        if capture.frame_path(subject, camera, light).is_file():
            yield capture.frame(subject, camera, place).mean(-1)


def on_yale(folder: Path, listed: Path) -> None:
    """Print, by subject, the sharpness of the mean of all frames as given, aligned, and by the list."""
    capture = read_capture(folder, "extended-yale-b")
    camera = next(iter(capture.cameras))
    listed_px = {
        (subject, camera, flash.name): (float(by[0]), float(by[1]))
        for (subject, flash), by in read_shifts(listed).items()
    }
    gains = []
    for subject in capture.subjects:
        broken = frames_left_out(check_subject(capture, subject))
        aligned = with_alignment(capture, subject, broken)
        whole = {key: (round(down), round(right)) for key, (down, right) in aligned.shifts.items()}
        tried: tuple[Shifts, ...] = ({}, aligned.shifts, whole, listed_px)
        left_out = broken.get(camera, set())
        energies = [sharpness(capture, subject, camera, shifts, left_out) for shifts in tried]
        gain = [energy / energies[0] for energy in energies]
        gains.append(gain)
        ours, theirs = (
            np.array(
                [shifts.get(key, (0, 0)) for key in in_front(capture, subject, camera) if key in listed_px]
            )
            for shifts in (aligned.shifts, listed_px)
        )
        apart, theirs_px = (rms(by, np.median(by, axis=0)) for by in (ours - theirs, theirs))
        print(
            f"{subject}: sharpness x{gain[1]:.3f} aligned, x{gain[2]:.3f} in whole pixels, x{gain[3]:.3f} by "
            f"the list; lamps in front: {apart:.2f} px RMS from the list, itself of {theirs_px:.2f} px",
            flush=True,
        )
    mean = np.exp(np.log(gains).mean(0))
    print(f"all: x{mean[1]:.3f} aligned, x{mean[2]:.3f} in whole pixels, x{mean[3]:.3f} by the list")


def in_front(capture: Capture, subject: str, camera: str) -> list[tuple[str, str, str]]:
    """Keys of the frames under lamps in front of Yale B's camera."""
    cosines = zip(capture.light_ids, capture.directions_world[:, 2], strict=True)
    return [(subject, camera, light) for light, cosine in cosines if cosine > _KINDS[0][1]]


def sharpness(capture: Capture, subject: str, camera: str, shifts: Shifts, broken: set[str]) -> float:
    """The energy of gradients of the mean of the frames that are not broken."""
    kept = replace(capture, shifts=shifts)
    places = [place for place, light in enumerate(capture.light_ids) if light not in broken]
    there = [
        place for place in places if capture.frame_path(subject, camera, capture.light_ids[place]).is_file()
    ]
    mean = np.mean([kept.frame(subject, camera, place)[..., 0] for place in there], axis=0)
    down, right = np.gradient(mean[8:-8, 8:-8])
    return float((down**2 + right**2).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?", help="a still capture with a stage.json")
    parser.add_argument(
        "--drift", type=float, nargs="+", default=[0, 2, 6], help="how far paths lead, pixels"
    )
    parser.add_argument("--subjects", type=int, default=2)
    parser.add_argument("--yale", type=Path, help="Extended Yale B, a folder a subject")
    parser.add_argument("--shifts", type=Path, help="its list of shifts in whole pixels")
    given = parser.parse_args()
    if given.capture:
        for seed, subject in enumerate(list(read_capture(given.capture).subjects)[: given.subjects]):
            for furthest_px in given.drift:
                planted(given.capture, subject, furthest_px, seed)
    if given.yale and given.shifts:
        on_yale(given.yale, given.shifts)


if __name__ == "__main__":
    main()
