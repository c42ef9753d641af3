"""The landmark fit: its error on photos, its normals next to photometric stereo, its speed in a batch.

    python benchmarks/fit.py [PHOTO|DIR ...] [--face-model builtin|PATH] [--all]

- Landmark error of each photo, against dlib's landmarks, in percent of the inter-ocular distance.
- Mean angle of the normals to those of photometric stereo over all flashes of a subject of Extended Yale B,
  whose frontal image is fitted. Naive twin: the mean face without expression in the fit's pose.
- Faces a second in a batch. Naive twin: one face at a time.

Without Extended Yale B the normals are left out.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from _common import SHIFTS, YALE_B, arguments, best_s, photos

from facerf_cli.capture.checks.stereo import photometric_stereo
from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.composite import Composition, Target
from facerf_cli.evaluation.protocols.yale_b_cases import Sitter, face_mask
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.images import read_image
from facerf_cli.models import Models, load_models
from facerf_cli.pipeline import fit_photo
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import crop_camera, project

SUBJECTS = ["yaleB05", "yaleB15", "yaleB22"]  # of which normals are measured, unless --all
CROP_PX = 256
BATCH, ONE_BY_ONE = 64, 8  # faces
_ROUNDS = 3


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--all", action="store_true", help="all 21 subjects of Extended Yale B, not three")
    given = parser.parse_args()
    models = load_models(None, given.face_model, torch.device("cpu"))
    for path in photos(given.photos):
        error_iod = fitted(models, read_image(path).pixels, str(path)).fit.error_iod
        print(f"{path.stem}: landmark error {100 * error_iod:.2f} %", flush=True)
    if YALE_B.is_dir() and SHIFTS.is_file():
        database = read_yale_b(YALE_B, read_shifts(SHIFTS))
        report_normals(models, database, database.subjects if given.all else SUBJECTS)
    else:
        print(f"normals: left out, needs Extended Yale B in {YALE_B}")
    report_speed(models.face)


def fitted(models: Models, photo: np.ndarray, name: str) -> Head:
    """Fit the face of a photo [H, W, 3] to dlib's landmarks."""
    return fit_photo(models, photo, find_faces(photo, name)[0].landmarks_px)


def report_normals(models: Models, database: YaleB, subjects: list[str]) -> None:
    """Print mean angles in degrees to the normals of photometric stereo, of the fit and of the mean face."""
    angles_deg = []
    for subject in subjects:
        sitter = Sitter(database, subject)
        photo = np.repeat(sitter.image("frontal")[..., None], 3, -1)
        head = fitted(models, photo, subject)
        mean_face = replace(head.fit, alpha=0 * head.fit.alpha, beta=0 * head.fit.beta)
        directions = np.stack([flash.direction for flash in sitter.flashes])
        inside = face_mask()
        truth = np.zeros((*inside.shape, 3))
        values = sitter.olats[:, inside].astype(float)
        truth[inside] = photometric_stereo(values, directions, inside).normals
        row = [
            angle_deg(models.face, photo, head, Target(fit), truth, inside) for fit in (head.fit, mean_face)
        ]
        angles_deg.append(row)
        print(f"{subject}: normals {row[0]:.1f} degrees off, of the mean face {row[1]:.1f}", flush=True)
    ours, naive = np.mean(angles_deg, 0)
    print(f"{len(angles_deg)} subjects: {ours:.2f} degrees, mean face {naive:.2f} ({ours / naive:.2f} of it)")


def angle_deg(
    model: MorphableModel,
    photo: np.ndarray,
    head: Head,
    target: Target,
    truth: np.ndarray,
    inside: np.ndarray,
) -> float:
    """The mean angle between rendered normals and the true ones [H, W, 3] in a mask [H, W]."""
    view = Composition(model, photo, head, target).view
    covered = inside & (view.full(view.mask) > 0.5)
    normals = view.full(view.normal)[covered]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    cosine = (normals * truth[covered]).sum(-1).clip(-1, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


def report_speed(model: MorphableModel) -> None:
    """Print faces a second of a batch and of one face at a time."""
    generator = torch.Generator().manual_seed(0)
    alpha = torch.randn(BATCH, len(model.identity), generator=generator)
    beta = 0.3 * torch.randn(BATCH, len(model.expression), generator=generator)
    camera = crop_camera(CROP_PX)
    vertices = model.vertices(alpha, beta) + torch.tensor([0.0, 0.0, -0.95])
    landmarks_px = project(model.landmarks(vertices), camera)
    fit_batch(model, landmarks_px[:1], camera)  # the first call is slower
    ways = {
        "batch": lambda: [fit_batch(model, landmarks_px, camera)],
        "one by one": lambda: [fit_batch(model, face[None], camera) for face in landmarks_px[:ONE_BY_ONE]],
    }
    seconds, _ = best_s(ways, _ROUNDS)
    rates = BATCH / seconds["batch"], ONE_BY_ONE / seconds["one by one"]
    print(
        f"{rates[0]:.0f} faces a second in a batch of {BATCH}, {rates[0] / rates[1]:.1f} times as many as "
        f"one by one ({torch.get_num_threads()} threads)"
    )


if __name__ == "__main__":
    main()
