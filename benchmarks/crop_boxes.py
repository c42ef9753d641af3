"""Crops around a detector's box, beside those around landmarks, and what that does to the Geometry Network.

    python benchmarks/crop_boxes.py [PHOTO|DIR ...] [--dataset DATASET]

Faces are those of photos, and with `--dataset` of every fourth of its people in every camera, under all
lights. For every face: size and place of the crop of `face.crop.from_landmarks` in units of the box, then in
units of the crop of `from_box` (so `dataset/crops.py` gets its spreads). The last figures are landmark
errors of the regressed head, in percent of the distance of the outer eye corners, from each crop.
Naive twin: the box itself as the crop.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from _common import arguments, photos

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_box, from_landmarks
from facerf_cli.face.fit import regressed_fit
from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.files.read import read_image
from facerf_cli.pipeline import regress_head
from facerf_cli.portrait.find import Face, find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models

CROP_PX = 256
EVERY = 4  # of a dataset's people, one is measured


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--checkpoint", type=Path, help="default: the shipped one")
    parser.add_argument("--dataset", type=Path, help="of prepare-dataset")
    given = parser.parse_args()
    models = load_models([given.checkpoint] if given.checkpoint else ())
    places, moves, errors = [], [], []
    for name, photo in images(photos(given.photos), given.dataset):
        try:
            faces = find_faces(SHIPPED_NETWORKS.people, photo, name, "all")
        except InputError as error:
            print(error)
            continue
        for face in faces:
            crops = crops_of(face)
            places.append(relative(crops["landmarks"], crops["the box"]))
            moves.append(relative(crops["landmarks"], crops["box"]))
            errors.append({name: error_percent(models, photo, face, crop) for name, crop in crops.items()})
    print(f"{len(places)} faces")
    report("crop of landmarks in the box", np.array(places))
    report("crop of landmarks in the crop of the box", np.array(moves))
    for name in errors[0]:
        print(f"landmark error from the crop of {name}: {np.mean([e[name] for e in errors]):.1f} %")


def images(paths: list[Path], folder: Path | None) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the photos, and the images of a dataset's people."""
    for path in paths:
        yield str(path), read_image(path).pixels
    if folder is not None:
        dataset = read_dataset(folder)
        for subject in dataset.subjects[::EVERY]:
            for camera in dataset.cameras[subject]:
                header = read_olat_header(dataset.stack_path(subject, camera))
                yield f"{subject}/{camera}", header.source


def crops_of(face: Face) -> dict[str, Crop]:
    """The crops of a face, by what they are cut around."""
    left, top, right, bottom = face.box_px
    naive = Crop(left, top, (right - left + bottom - top) / 2, CROP_PX)
    return {
        "landmarks": from_landmarks(face.landmarks_px, CROP_PX),
        "box": from_box(face.box_px, CROP_PX),
        "the box": naive,
    }


def relative(crop: Crop, to: Crop) -> tuple[float, float, float]:
    """Side of a crop, and its centre's offset to the right and down, in sides of another."""
    x, y = (a + crop.side_px / 2 for a in (crop.x0_px, crop.y0_px))
    return (
        crop.side_px / to.side_px,
        (x - to.x0_px) / to.side_px - 0.5,
        (y - to.y0_px) / to.side_px - 0.5,
    )


def report(name: str, values: np.ndarray) -> None:
    """Print means and deviations of size and place."""
    words = ("side", "right", "down")
    columns = zip(words, values.mean(0), values.std(0), strict=True)
    print(f"{name}: " + ", ".join(f"{word} {mean:.3f} +- {std:.3f}" for word, mean, std in columns))


def error_percent(models: Models, photo: np.ndarray, face: Face, crop: Crop) -> float:
    """Mean distance of the regressed head's landmarks to the detected ones."""
    regressed = regress_head(models, crop.apply(photo))
    found_px = crop.to_photo(regressed_fit(models.face, regressed, crop).landmarks_px.numpy())
    left, right = OUTER_EYE_CORNERS
    eyes_px = np.linalg.norm(face.landmarks_px[left] - face.landmarks_px[right])
    return float(100 * np.linalg.norm(found_px - face.landmarks_px, axis=1).mean() / eyes_px)


if __name__ == "__main__":
    main()
