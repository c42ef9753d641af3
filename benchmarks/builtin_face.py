"""Distance from the built-in face to the ICT-FaceKit mean face, alone and with its identity basis.

Every vertex of the built-in mesh is taken to the nearest point of the ICT surface (skin and eyeballs), after
a similarity alignment; root mean squares are weighted by area. Coefficients of the basis stay inside +-3.

    python benchmarks/builtin_face.py [../shared/data/ict_facekit/ICT-FaceKit-master.tar.xz]
"""

import argparse
import re
import tarfile
from pathlib import Path

import numpy as np
import trimesh
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles

ARCHIVE = Path(__file__).parents[2] / "shared/data/ict_facekit/ICT-FaceKit-master.tar.xz"
SURFACE_VERTICES = (slice(0, 11248), slice(21451, 24591))  # skin, eyeballs; not mouth and lashes
SIGMAS, ALIGNMENTS, FITS, CANDIDATES = 3.0, 30, 12, 16


def read_ict_mean_mm(archive: Path) -> np.ndarray:
    """Triangles [F, 3, 3] of the ICT mean's outer surface."""
    with tarfile.open(archive) as tar:
        name = next(n for n in tar.getnames() if n.endswith("FaceXModel/generic_neutral_mesh.obj"))
        lines = tar.extractfile(name).read().decode().splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float) * 10
    polygons = [[int(i) - 1 for i in re.findall(r" (\d+)", line)] for line in lines if line.startswith("f ")]
    triangles = np.array([(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)])
    outer = np.zeros(len(vertices), bool)
    for part in SURFACE_VERTICES:
        outer[part] = True
    return vertices[triangles[outer[triangles].all(1)]]


def nearest_points(points: np.ndarray, surface: np.ndarray, tree: cKDTree) -> np.ndarray:
    """Nearest point [N, 3] of the triangles [F, 3, 3] to each point, among those with the nearest centres."""
    ids = tree.query(points, CANDIDATES)[1]
    found = np.stack([trimesh.triangles.closest_point(surface[each], points) for each in ids.T])
    distance = np.linalg.norm(found - points, axis=-1)
    return found[distance.argmin(0), np.arange(len(points))]


def similarity(points: np.ndarray, onto: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scaled rotation [3, 3] and translation [3] of points [N, 3] onto their partners (Umeyama)."""
    weight = weight[:, None] / weight.sum()
    centre, target = (weight * points).sum(0), (weight * onto).sum(0)
    u, spread, vt = np.linalg.svd((weight * (onto - target)).T @ (points - centre))
    handed = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (spread * handed).sum() / (weight * (points - centre) ** 2).sum()
    turn = scale * u @ np.diag(handed) @ vt
    return turn, target - turn @ centre


def area_weights(vertices: np.ndarray) -> np.ndarray:
    triangles = grid_triangles().numpy()
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    return np.bincount(triangles.reshape(-1), np.repeat(area, 3), len(vertices))


def rms(offsets: np.ndarray, weight: np.ndarray) -> float:
    return float(np.sqrt((weight * (offsets**2).sum(-1)).sum() / weight.sum()))


def measure(archive: Path) -> dict[str, float]:
    """Millimetres: `mean`, and `basis` with the coefficient that went furthest as `furthest_sigma`."""
    model = load_face_model()
    mean, basis = (array.double().numpy() * 1000 for array in (model.mean, model.identity))
    surface, weight = read_ict_mean_mm(archive), area_weights(mean)
    tips = mean[mean[:, 2].argmax()], surface.reshape(-1, 3)[surface[..., 2].argmax()]
    surface = surface + tips[0] - tips[1]  # the noses meet
    tree = cKDTree(surface.mean(1))
    turn, shift, alpha = np.eye(3), np.zeros(3), np.zeros(len(basis))
    for _ in range(ALIGNMENTS):
        placed = mean @ turn.T + shift
        turn, shift = similarity(mean, nearest_points(placed, surface, tree), weight)
    figures = {"mean": rms(nearest_points(placed, surface, tree) - placed, weight)}
    for _ in range(FITS):
        shape = mean + np.tensordot(alpha, basis, 1)
        nearest = nearest_points(shape @ turn.T + shift, surface, tree)
        turn, shift = similarity(shape, nearest, weight)
        target = (nearest - shift) @ np.linalg.inv(turn).T - mean
        root = np.sqrt(weight / weight.mean())[:, None]
        columns = (basis * root).reshape(len(basis), -1)
        normal, right = columns @ columns.T, columns @ (target * root).reshape(-1)
        chol = np.linalg.cholesky(normal + 1e-6 * np.eye(len(basis)) * normal.trace() / len(basis))
        alpha = lsq_linear(chol.T, np.linalg.solve(chol, right), bounds=(-SIGMAS, SIGMAS)).x
    placed = (mean + np.tensordot(alpha, basis, 1)) @ turn.T + shift
    figures["basis"] = rms(nearest_points(placed, surface, tree) - placed, weight)
    return figures | {"furthest_sigma": float(np.abs(alpha).max())}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("archive", type=Path, nargs="?", default=ARCHIVE)
    found = measure(parser.parse_args().archive)
    print(f"mean shape alone      {found['mean']:.2f} mm RMS (target 4)")
    print(f"with the basis, +-3   {found['basis']:.2f} mm RMS (target 1.5)")
    print(f"furthest coefficient  {found['furthest_sigma']:.2f} sigma")
