"""Steadiness of matte and landmarks in a shot: a still photo under a camera that pans, with noise.

    python benchmarks/steady_matte.py [PHOTO ...] [--frames 12]

What moves against the photo from one frame to the next is an error. Of the matte: the area that changes, over
the length of the outline in the same part of the photo (a part is 32 pixels wide), which is how far the edge
moves, in pixels; its mean and 95th percentile over parts and frames, and the largest. Of the landmarks: the
mean distance that one moves, in pixels. A shot as `facerf relight FILM` sees it, and its frames one by one.
"""

from pathlib import Path

import numpy as np
from _common import arguments, photos, print_header, print_row
from _film_of_photo import camera_at, frames_of
from skimage.measure import block_reduce
from skimage.transform import warp

from facerf_cli.face.landmarks import to_display
from facerf_cli.portrait.find import detect_faces
from facerf_cli.portrait.segment import segment
from facerf_cli.relighting.models import load_models
from facerf_cli.relighting.sequence import Follower, SteadyShot

PART_PX = 32
LEAST_PX = 8  # of outline in a part that counts


def main() -> None:
    """Print a row for each photo and way."""
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()
    models = load_models()
    people = models.networks.people
    print_header("photo", "", "edge, px: mean", "95 %", "largest", "landmarks, px")
    for path in photos(options.photos):
        frames = frames_of(path, options.frames)
        shown = [to_display(frame) for frame in frames]
        follower = Follower(people, "largest")
        view = SteadyShot(models, frames, [follower.see(one) for one in shown], models.sides())
        numbers = range(len(frames))
        alone = [detect_faces(people, one)[0].landmarks_px for one in shown]
        ways = {
            "shot": ([view.segmentation(n).matte for n in numbers], [view.landmarks_px(n) for n in numbers]),
            "one by one": ([segment(people, *pair).matte for pair in zip(shown, alone, strict=True)], alone),
        }
        for way, (mattes, landmarks) in ways.items():
            moves = np.concatenate([edge_moves(mattes, n) for n in numbers[1:]])
            figures = (moves.mean(), np.percentile(moves, 95), moves.max(), landmarks_move(landmarks, mattes))
            print_row(path.stem, way, *(f"{figure:.2f}" for figure in figures))


def edge_moves(mattes: list[np.ndarray], frame: int) -> np.ndarray:
    """How far a matte's edge moved since the frame before, in pixels, in each part that has outline."""
    before, now = (in_photo(mattes[n], n) for n in (frame - 1, frame))
    inside = np.isfinite(before + now)
    changed = np.where(inside, np.abs(now - before), 0)
    person = np.where(inside, before > 0.5, False)
    outline = (person[1:, 1:] != person[:-1, 1:]) | (person[1:, 1:] != person[1:, :-1])
    area, length = (block_reduce(one.astype(float), (PART_PX, PART_PX)) for one in (changed[1:, 1:], outline))
    return np.asarray((area / length.clip(1))[length >= LEAST_PX])


def in_photo(matte: np.ndarray, frame: int) -> np.ndarray:
    """A frame's matte where it lies in the photo; NaN where the frame does not show it."""
    return np.asarray(warp(matte, camera_at(frame, matte.shape).inverse, order=1, cval=np.nan))


def landmarks_move(landmarks: list[np.ndarray], mattes: list[np.ndarray]) -> float:
    """Mean distance that landmarks [68, 2] of frames move in the photo from one to the next, in pixels."""
    still = np.stack([camera_at(n, mattes[0].shape)(points) for n, points in enumerate(landmarks)])
    return float(np.linalg.norm(np.diff(still, axis=0), axis=-1).mean())


if __name__ == "__main__":
    main()
