"""The built-in face next to ICT-FaceKit's, and the cost and landmarks of imports of FLAME and Basel.

    python benchmarks/face_models.py [--archive ICT-FaceKit.tar.xz] [--skip-imports]

- Distance from the built-in mesh to ICT-FaceKit's mean (skin and eyeballs): every vertex to the nearest point
  of the surface, after a similarity alignment, root mean square weighted by area. Naive twin of the fit with
  the identity basis (coefficients within 3 standard deviations): the mean shape alone.
- FLAME and Basel need an agreement, so ICT-FaceKit's mean and bases are written in the structure of their
  files, at their sizes: FLAME's 300 + 100 shapes over 14,388 vertices (it has 5,023), Basel's 199 + 100 over
  57,322 (it has at most 53,490). Processor time and peak memory of `facerf face-model import`, and the error
  of the landmarks that a file does not name. The truth is ICT-FaceKit's own list of landmarks.
"""

import json
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
import trimesh
from _common import ICT_FACEKIT, arguments, print_header, print_row, required, required_package
from scipy import sparse
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from facerf_cli.face.importers.basel import _LANDMARKS_2017 as _LANDMARKS
from facerf_cli.face.importers.basel import read_basel_2009, read_basel_2017
from facerf_cli.face.importers.find_landmarks import landmarks_of
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles

SIGMAS, ALIGNMENTS, FITS, CANDIDATES = 3.0, 30, 12, 16  # limits and rounds of the distance
# Peak memory as the kernel counts it; getrusage starts from that of the parent process.
IMPORT = """
import sys, time
from facerf_cli.main import main
if main(sys.argv[1:]): sys.exit("the import failed")
print(time.process_time(), next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@dataclass(frozen=True, eq=False)
class WrittenFace:
    """Mean [N, 3], triangles [F, 3], identity and expression [K, N, 3], landmarks [68, 3]; metres."""

    mean: np.ndarray
    triangles: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    landmarks: np.ndarray


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--archive", type=Path, help="of ICT-FaceKit")
    parser.add_argument("--skip-imports", action="store_true", help="only measure the built-in face")
    given = parser.parse_args()
    archive = required(given.archive, "the archive of ICT-FaceKit", "--archive", ICT_FACEKIT)
    source = read_ict_facekit(archive)
    report_builtin(source)
    if not given.skip_imports:
        required_package("h5py", "face-models")
        report_imports(source)


def report_builtin(source: SourceModel) -> None:
    """Print the distance of the built-in face in millimetres, without and with its identity basis."""
    model = load_face_model()
    mean, basis = (array.double().numpy() * 1000 for array in (model.mean, model.identity))
    surface, weight = 1000 * source.mean[source.triangles], area_weights(mean)
    tips = mean[mean[:, 2].argmax()], surface.reshape(-1, 3)[surface[..., 2].argmax()]
    surface = surface + tips[0] - tips[1]  # the tips of the noses meet
    tree = cKDTree(surface.mean(1))
    turn, shift, alpha = np.eye(3), np.zeros(3), np.zeros(len(basis))
    for _ in range(ALIGNMENTS):
        placed = mean @ turn.T + shift
        turn, shift = similarity(mean, nearest_points(placed, surface, tree), weight)
    mean_mm = rms(nearest_points(placed, surface, tree) - placed, weight)
    for _ in range(FITS):
        shape = mean + np.tensordot(alpha, basis, 1)
        nearest = nearest_points(shape @ turn.T + shift, surface, tree)
        turn, shift = similarity(shape, nearest, weight)
        target = (nearest - shift) @ np.linalg.inv(turn).T - mean
        alpha = bounded_coefficients(basis, target, weight)
    placed = (mean + np.tensordot(alpha, basis, 1)) @ turn.T + shift
    fitted_mm = rms(nearest_points(placed, surface, tree) - placed, weight)
    print(f"built-in face to ICT-FaceKit: {mean_mm:.2f} mm RMS, with the identity basis {fitted_mm:.2f} mm")
    print(f"  largest coefficient {np.abs(alpha).max():.2f} standard deviations", flush=True)


def bounded_coefficients(basis: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients [K] within SIGMAS that bring basis [K, N, 3] nearest to offsets [N, 3]."""
    root = np.sqrt(weight / weight.mean())[:, None]
    columns = (basis * root).reshape(len(basis), -1)
    normal, right = columns @ columns.T, columns @ (target * root).reshape(-1)
    factor = np.linalg.cholesky(normal + 1e-6 * np.eye(len(basis)) * normal.trace() / len(basis))
    return lsq_linear(factor.T, np.linalg.solve(factor, right), bounds=(-SIGMAS, SIGMAS)).x


def nearest_points(points: np.ndarray, surface: np.ndarray, tree: cKDTree) -> np.ndarray:
    """The nearest point [N, 3] on triangles [F, 3, 3] to each point, among those with the nearest centres."""
    ids = tree.query(points, CANDIDATES)[1]
    found = np.stack([trimesh.triangles.closest_point(surface[each], points) for each in ids.T])
    distance = np.linalg.norm(found - points, axis=-1)
    return found[distance.argmin(0), np.arange(len(points))]


def similarity(points: np.ndarray, onto: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The scaled rotation [3, 3] and translation [3] that move points [N, 3] onto others (Umeyama)."""
    weight = weight[:, None] / weight.sum()
    centre, target = (weight * points).sum(0), (weight * onto).sum(0)
    u, spread, vt = np.linalg.svd((weight * (onto - target)).T @ (points - centre))
    handed = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (spread * handed).sum() / (weight * (points - centre) ** 2).sum()
    turn = scale * u @ np.diag(handed) @ vt
    return turn, target - turn @ centre


def area_weights(vertices: np.ndarray) -> np.ndarray:
    """The area [N] around each vertex of the built-in mesh."""
    triangles = grid_triangles().numpy()
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    return np.bincount(triangles.reshape(-1), np.repeat(area, 3), len(vertices))


def rms(offsets: np.ndarray, weight: np.ndarray) -> float:
    """The weighted root mean square length of offsets [N, 3]."""
    return float(np.sqrt((weight * (offsets**2).sum(-1)).sum() / weight.sum()))


def report_imports(source: SourceModel) -> None:
    """Print the cost of each import, and the error of its landmarks in millimetres."""
    coarse = written_face(source, 300, 100)
    fine = finer(written_face(source, 199, 100))
    models: list[tuple[str, str, WrittenFace, Callable, Callable]] = [
        ("flame", "generic_model.pkl", coarse, write_flame, read_flame),
        ("basel-2009", "01_MorphableModel.mat", fine, write_basel_2009, read_basel_2009),
        ("basel-2019", "model2019_bfm.h5", fine, write_basel_2019, read_basel_2017),
    ]
    print_header("", "vertices", "file MB", "CPU s", "peak MB", "named", "inner mm", "contour mm", "worst mm")
    with tempfile.TemporaryDirectory() as folder:
        for kind, name, face, write, read in models:
            path = Path(folder) / name
            write(path, face)
            seconds, peak = cost_of_import(kind, path)
            found = read(path)
            off = 1000 * np.linalg.norm(landmarks_of(found) - face.landmarks, axis=-1)
            errors = (f"{value:.2f}" for value in (off[17:].mean(), off[:17].mean(), off.max()))
            size = f"{path.stat().st_size / 1e6:.0f}"
            print_row(kind, len(face.mean), size, f"{seconds:.1f}", f"{peak:.0f}", len(found.known), *errors)


def written_face(source: SourceModel, identities: int, expressions: int) -> WrittenFace:
    """ICT-FaceKit's outer surface with so many shapes."""
    used, triangles = np.unique(source.triangles, return_inverse=True)
    bases = (source.identity[:, used], identities), (source.expression[:, used], expressions)
    landmarks = np.stack([source.known[number] for number in range(68)])
    identity, expression = (more(*basis) for basis in bases)
    return WrittenFace(source.mean[used], triangles.reshape(-1, 3), identity, expression, landmarks)


def more(basis: np.ndarray, count: int) -> np.ndarray:
    """Extend a basis to `count` shapes by faint mixtures of its own."""
    mixture = np.random.default_rng(0).normal(0, 0.05, (count - len(basis), len(basis)))
    return np.concatenate([basis, np.tensordot(mixture / np.sqrt(len(basis)), basis, 1)])


def finer(face: WrittenFace) -> WrittenFace:
    """Split each triangle in four, with a vertex in the middle of every edge."""
    edges = np.sort(face.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = face.triangles.T
    ab, bc, ca = len(face.mean) + middle.reshape(-1, 3).T

    def split(field: np.ndarray) -> np.ndarray:
        return np.concatenate([field, field[..., ends, :].mean(-2)], -2)

    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    triangles = np.concatenate([np.stack(corners, -1) for corners in quarters])
    return WrittenFace(
        split(face.mean), triangles, split(face.identity), split(face.expression), face.landmarks
    )


def unit(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of unit length [3 N, K] and their standard deviations [K]."""
    columns = shapes.reshape(len(shapes), -1).T
    deviations = np.linalg.norm(columns, axis=0)
    return (columns / deviations).astype(np.float32), deviations.astype(np.float32)


def write_flame(path: Path, face: WrittenFace) -> None:
    """Write a face in the structure of FLAME's pickle."""
    count = len(face.mean)
    weights, regressor = np.zeros((count, 5)), sparse.csc_matrix(np.eye(5, count))
    weights[:, 2] = face.mean[:, 1] < face.landmarks[62:68, 1].mean()
    shapes = np.moveaxis(np.concatenate([face.identity, face.expression]), 0, -1)
    table = {"v_template": face.mean, "f": face.triangles.astype(np.uint32), "shapedirs": shapes,
             "posedirs": np.zeros((count, 3, 36)), "weights": weights, "J_regressor": regressor}  # fmt: skip
    path.write_bytes(pickle.dumps(table))


def write_basel_2009(path: Path, face: WrittenFace) -> None:
    """Write a face in the structure of the MAT file of Basel 2009."""
    basis, deviations = unit(face.identity * 1e6)
    mean = (face.mean * 1e6).reshape(-1, 1).astype(np.float32)
    content = {"shapeMU": mean, "shapePC": basis, "shapeEV": deviations[:, None], "texMU": mean,
               "texPC": basis, "texEV": deviations[:, None], "tl": face.triangles[:, ::-1] + 1.0}  # fmt: skip
    scipy.io.savemat(path, content, do_compression=True)


def write_basel_2019(path: Path, face: WrittenFace) -> None:
    """Write a face in the structure of the HDF5 file of Basel 2019."""
    import h5py  # type: ignore[import-untyped]  # an optional package

    marks = [
        {"id": name, "coordinates": (1000 * face.landmarks[n]).tolist()} for name, n in _LANDMARKS.items()
    ]
    with h5py.File(path, "w") as file:
        for group, mean, shapes in (
            ("shape", face.mean, face.identity),
            ("expression", face.expression[0], face.expression),
        ):
            basis, deviations = unit(shapes * 1000)
            file[f"{group}/model/mean"] = (1000 * mean).ravel().astype(np.float32)
            file[f"{group}/model/pcaBasis"], file[f"{group}/model/pcaVariance"] = basis, deviations**2
        file["shape/representer/cells"] = face.triangles.T.astype(np.int32)
        file["metadata/landmarks/json"] = np.array([json.dumps(marks).encode()])


def cost_of_import(kind: str, path: Path) -> tuple[float, float]:
    """Processor seconds and peak memory in MB of `facerf face-model import` (on Linux)."""
    line = ["--quiet", "face-model", "import", kind, str(path), "-o", str(path.with_suffix(".npz"))]
    done = subprocess.run([sys.executable, "-c", IMPORT, *line], capture_output=True, check=True, text=True)
    seconds, _, kilobytes, _ = done.stdout.split()[-4:]
    return float(seconds), int(kilobytes) / 1024


if __name__ == "__main__":
    main()
