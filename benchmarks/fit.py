"""What the landmark fit is worth: landmark error on photos, normals against photometric stereo, speed.

    python benchmarks/fit.py --shared ../shared [--face-model builtin|PATH] [--sweep] [--all]

Photos: skimage's astronaut and the portraits in SHARED/data/photos. Normals: Extended Yale B, frontal picture
fitted. The truth is photometric stereo over a subject's lights, twice: plain least squares over all of them
(attached shadows flatten it), and one that leaves out shadows and saturation (noisier). The peer is the
unfitted neutral mean in the fit's pose. `--sweep` uses Yale B's development subjects; `--all` scores all 21.
"""

import argparse
import itertools
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import skimage.data
import torch

from facerf_cli.capture.yale_b import read_shifts, read_yale_b
from facerf_cli.evaluation.protocols.yale_b_cases import SETTINGS_SUBJECTS, Sitter, face_mask
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, FitSettings, fit_batch, fit_landmarks, trust_inside
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.files.images import read_image
from facerf_cli.raster.camera import crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals

SUBJECTS = ("yaleB05", "yaleB15", "yaleB22")
Truth = tuple[np.ndarray, np.ndarray]  # normals [H, W, 3], where they are known [H, W]
CROP_PX = 256


@dataclass(frozen=True)
class Photo:
    """A picture's landmarks in its crop, and which of them count."""

    name: str
    image: np.ndarray  # uint8 sRGB [H, W, 3]
    crop: Crop
    landmarks_px: np.ndarray
    trust: np.ndarray


def look_at(name: str, image: np.ndarray) -> Photo:
    faces = detect_landmarks(np.ascontiguousarray(image))
    if not faces:
        raise SystemExit(f"{name}: no face found")
    (face,) = choose_face(faces, "largest", name)
    crop = from_landmarks(face.landmarks_px, CROP_PX)
    landmarks_px = crop.to_crop(face.landmarks_px)
    return Photo(name, image, crop, landmarks_px, trust_inside(landmarks_px, crop, *image.shape[:2]))


def photos(shared: Path) -> list[Photo]:
    found = [look_at("astronaut", skimage.data.astronaut())]
    for path in sorted((shared / "data/photos").glob("*.jpg")):
        found.append(look_at(path.stem, to_display(read_image(path).pixels)))
    return found


def fit(model: MorphableModel, photo: Photo, settings: FitSettings) -> FaceFit:
    return fit_landmarks(model, photo.landmarks_px, photo.crop, settings, photo.trust)


def least_squares(values: np.ndarray, lights: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Albedo times normal [P, 3] of pixels under L lights [L, 3], values and weights [L, P]."""
    normal = np.einsum("lp,li,lj->pij", weights, lights, lights) + 1e-6 * np.eye(3)
    return np.linalg.solve(normal, np.einsum("lp,li,lp->pi", weights, lights, values)[..., None])[..., 0]


def shadow_aware(values: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Least absolute deviations over what is neither shadowed nor saturated."""
    usable = (values > 0.03) & (values < 0.97)
    scaled = least_squares(values, lights, np.ones_like(values))
    for _ in range(8):
        predicted = lights @ scaled.T
        weights = usable * (predicted > 0.02) / np.maximum(np.abs(predicted - values), 0.02)
        scaled = least_squares(values, lights, weights)
    return scaled


def yale_truths(sitter: Sitter) -> list[Truth]:
    """Photometric-stereo normals: plain least squares over all lights, and shadow-aware."""
    mask = face_mask()
    values = sitter.olats.astype(np.float64)[:, mask]
    directions = np.stack([flash.direction for flash in sitter.flashes])
    truths = []
    for scaled in (
        least_squares(values, directions, np.ones_like(values)),
        shadow_aware(values, directions),
    ):
        normals = np.zeros((*mask.shape, 3))
        normals[mask] = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-9)
        truths.append((normals, mask))
    return truths


def fitted_normals(vertices: torch.Tensor, photo: Photo) -> tuple[np.ndarray, np.ndarray]:
    """Camera-space normals of the fit at the photo's pixels [H, W, 3], and where the face is [H, W]."""
    side_px = 2 * CROP_PX
    triangles = grid_triangles()
    with torch.no_grad():
        fragments = rasterize(vertices, triangles, crop_camera(side_px))
        normals = interpolate(vertex_normals(vertices, triangles), triangles, fragments).numpy()
    height, width = photo.image.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    at = np.floor(photo.crop.to_crop(np.stack([x, y], -1)) * side_px / CROP_PX).astype(int)
    inside = ((at >= 0) & (at < side_px)).all(-1)
    column, row = at.clip(0, side_px - 1)[..., 0], at.clip(0, side_px - 1)[..., 1]
    sampled = normals[row, column]
    sampled = sampled / np.maximum(np.linalg.norm(sampled, axis=-1, keepdims=True), 1e-9)
    return sampled, inside & (fragments.triangle.numpy()[row, column] >= 0)


def angles_deg(vertices: torch.Tensor, photo: Photo, truths: list[Truth]) -> list[float]:
    """Mean angle of a fit's normals to each truth."""
    normals, covered = fitted_normals(vertices, photo)
    angles = []
    for truth, known in truths:
        mask = covered & known
        cosine = (normals[mask] * truth[mask]).sum(-1).clip(-1, 1)
        angles.append(float(np.degrees(np.arccos(cosine)).mean()))
    return angles


def faces_per_second(model: MorphableModel, batch: int = 64) -> float:
    torch.manual_seed(0)
    alpha, beta = torch.randn(batch, len(model.identity)), 0.3 * torch.randn(batch, len(model.expression))
    vertices = model.vertices(alpha, beta) + torch.tensor([0.0, 0.0, -0.95])
    camera = crop_camera(CROP_PX)
    landmarks_px = project(model.landmarks(vertices), camera)
    fit_batch(model, landmarks_px, camera)
    start = time.perf_counter()
    fit_batch(model, landmarks_px, camera)
    return batch / (time.perf_counter() - start)


def score(
    model: MorphableModel, images: list[Photo], yale: list[tuple[Photo, list[Truth]]], settings: FitSettings
) -> str:
    """One line: landmark errors in percent of the inter-ocular distance, angles in degrees."""
    errors = [100 * fit(model, photo, settings).error_iod for photo in images]
    yale_errors, fitted, neutral = [], [], []
    for photo, truths in yale:
        found = fit(model, photo, settings)
        yale_errors.append(100 * found.error_iod)
        fitted.append(angles_deg(found.vertices_camera(model), photo, truths))
        plain = replace(found, alpha=0 * found.alpha, beta=0 * found.beta)
        neutral.append(angles_deg(plain.vertices_camera(model), photo, truths))
    each = np.array(fitted)
    return (
        f"photos % {np.round(errors, 2)} | yale % {np.mean(yale_errors):.2f} | "
        f"angle {each.mean(0).round(2)} (least squares, shadow-aware) "
        f"neutral {np.mean(neutral, 0).round(2)} | "
        f"worst {each.max(0).round(1)} each {each[:4, 0].round(1)}"
    )


def settings_to_try() -> list[FitSettings]:
    grid = itertools.product((0.02, 0.03, 0.045), (0.06, 0.12), (0.05, 0.2, 0.4, 0.7), (0.3, 0.6, 1.0))
    return [FitSettings(inner, contour, identity_std=a, expression_std=b) for inner, contour, a, b in grid]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--sweep", action="store_true", help="try many priors, on these same pictures")
    parser.add_argument("--all", action="store_true", help="all subjects of Yale B")
    options = parser.parse_args()
    model = load_face_model(options.face_model)
    images = photos(options.shared)
    shifts = read_shifts(options.shared / "bench/yale_b/shifts.csv")
    database = read_yale_b(options.shared / "data/extended_yale_b", shifts)
    chosen = SETTINGS_SUBJECTS if options.sweep else SUBJECTS
    subjects = [name for name in database.subjects if options.all or name in chosen]
    yale = []
    for subject in subjects:
        sitter = Sitter(database, subject)
        frontal = np.round(255 * sitter.image("frontal")).astype(np.uint8)
        photo = look_at(subject, np.repeat(frontal[..., None], 3, -1))
        yale.append((photo, yale_truths(sitter)))
    print(model.name, "| photos:", *(photo.name for photo in images), "| yale:", *subjects)
    if options.sweep:
        for settings in settings_to_try():
            print(settings, score(model, images, yale, settings), flush=True)
    print(score(model, images, yale, FitSettings()))
    print(f"{faces_per_second(model):.0f} faces a second at B=64 on {torch.get_num_threads()} thread(s)")


if __name__ == "__main__":
    main()
