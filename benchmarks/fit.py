"""What the landmark fit is worth: landmark error on photos, normals against photometric stereo, faces a second.

    python benchmarks/fit.py --shared ../shared [--face-model builtin|PATH] [--sweep]

Photos: skimage's astronaut and the portraits in SHARED/data/photos. Normals: Extended Yale B, frontal picture
fitted, least squares over all lights of a subject as the truth. The peer is the unfitted neutral mean with the
fit's pose.
"""

import argparse
import importlib.util
import itertools
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch

from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, FitSettings, fit_batch, fit_landmarks, trust_inside
from facerf_cli.face.landmarks import detect_landmarks
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.files.images import read_image
from facerf_cli.face.landmarks import to_display
from facerf_cli.raster.camera import crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals

SUBJECTS = ("yaleB05", "yaleB15", "yaleB22")
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
    crop = from_landmarks(faces[0].landmarks_px, CROP_PX)
    landmarks_px = crop.to_crop(faces[0].landmarks_px)
    return Photo(name, image, crop, landmarks_px, trust_inside(landmarks_px, crop, *image.shape[:2]))


def photos(shared: Path) -> list[Photo]:
    found = [look_at("astronaut", skimage.data.astronaut())]
    for path in sorted((shared / "data/photos").glob("*.jpg")):
        found.append(look_at(path.stem, to_display(read_image(path).pixels)))
    return found


def fit(model: MorphableModel, photo: Photo, settings: FitSettings) -> FaceFit:
    return fit_landmarks(model, photo.landmarks_px, photo.crop, settings, photo.trust)


def load_yale(shared: Path) -> Any:
    path = shared / "bench/yale_b/yale.py"
    spec = importlib.util.spec_from_file_location("yale", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, module.Yale(str(shared / "data/extended_yale_b"))


def photometric_normals(values: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals [P, 3] of pixels under L lights, values [L, P], and how many lights each was solved from.

    Shadows and saturation are left out; the rest is solved by reweighted least absolute deviations.
    """
    usable = (values < 0.97) & (values > np.maximum(0.04, 0.15 * np.percentile(values, 95, axis=0)))
    weights = usable.astype(np.float64)
    for _ in range(12):
        normal = np.einsum("lp,li,lj->pij", weights, lights, lights) + 1e-6 * np.eye(3)
        scaled = np.linalg.solve(normal, np.einsum("lp,li,lp->pi", weights, lights, values)[..., None])[..., 0]
        misfit = np.abs(lights @ scaled.T - values)
        weights = usable * (lights @ scaled.T > 0.02) / np.maximum(misfit, 0.01)
    return scaled / np.linalg.norm(scaled, axis=1, keepdims=True), usable.sum(0)


def yale_truth(yale: Any, module: Any, subject: str) -> tuple[np.ndarray, np.ndarray]:
    """Photometric-stereo normals [H, W, 3] and where they count [H, W]."""
    lights = [light for light in yale.lights(subject) if abs(light[0]) <= 85]
    values = np.stack([yale.olat(subject, light) for light in lights]).astype(np.float64)
    directions = np.stack([module.light_dir(*light) for light in lights])
    mask = module.MASK
    normals = np.zeros((*mask.shape, 3))
    normals[mask], count = photometric_normals(values[:, mask], directions)
    known = mask.copy()
    known[mask] = count >= 8
    return normals, known


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


def angle_deg(vertices: torch.Tensor, photo: Photo, truth: tuple[np.ndarray, np.ndarray]) -> float:
    normals, covered = fitted_normals(vertices, photo)
    mask = covered & truth[1]
    cosine = (normals[mask] * truth[0][mask]).sum(-1).clip(-1, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


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


def measure(
    model: MorphableModel,
    pictures: list[Photo],
    yale: list[tuple[Photo, tuple[np.ndarray, np.ndarray]]],
    settings: FitSettings,
) -> tuple[list[float], list[float], list[float]]:
    """Landmark errors (share of the inter-ocular distance), angles and the neutral mean's angles in degrees."""
    errors = [fit(model, photo, settings).error_iod for photo in [*pictures, *(photo for photo, _ in yale)]]
    angles, neutral = [], []
    for photo, truth in yale:
        found = fit(model, photo, settings)
        angles.append(angle_deg(found.vertices_camera(model), photo, truth))
        plain = replace(found, alpha=0 * found.alpha, beta=0 * found.beta)
        neutral.append(angle_deg(plain.vertices_camera(model), photo, truth))
    return errors, angles, neutral


def settings_to_try() -> list[FitSettings]:
    grid = itertools.product((0.02, 0.03, 0.045), (0.06, 0.12), (0.05, 0.2, 0.4, 0.7), (0.3, 0.6, 1.0))
    return [FitSettings(inner, contour, identity_std=a, expression_std=b) for inner, contour, a, b in grid]


def report(errors: list[float], angles: list[float], neutral: list[float]) -> str:
    cells = " ".join(f"{100 * error:5.2f}" for error in errors)
    degrees = " ".join(f"{angle:5.2f}" for angle in angles)
    return f"error % {cells} | angle {degrees} mean {np.mean(angles):5.2f} | neutral {np.mean(neutral):5.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--sweep", action="store_true", help="try many priors, on these same pictures")
    options = parser.parse_args()
    model = load_face_model(options.face_model)
    pictures = photos(options.shared)
    module, data = load_yale(options.shared)
    yale = []
    for subject in SUBJECTS:
        frontal = np.round(255 * data.olat(subject, (0, 0))).astype(np.uint8)
        photo = look_at(subject, np.repeat(frontal[..., None], 3, -1))
        yale.append((photo, yale_truth(data, module, subject)))
    print(model.name, "|", " ".join(photo.name for photo in [*pictures, *(photo for photo, _ in yale)]))
    if options.sweep:
        for settings in settings_to_try():
            print(settings, report(*measure(model, pictures, yale, settings)), flush=True)
    print(report(*measure(model, pictures, yale, FitSettings())))
    print(f"{faces_per_second(model):.0f} faces a second at B=64 on {torch.get_num_threads()} thread(s)")


if __name__ == "__main__":
    main()
