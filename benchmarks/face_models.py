"""What an import of FLAME or Basel costs, and how well it finds landmarks that the file does not name.

The models are not to be had without an agreement, so ICT-FaceKit's mean and bases are written in their files'
structure, at their sizes: FLAME's 300 + 100 shapes over 14,388 vertices (it has 5,023), Basel's 199 + 100
over 57,322 (it has 53,490 or fewer). The truth of the landmarks is ICT-FaceKit's own list.

    python benchmarks/face_models.py [../shared/data/ict_facekit/ICT-FaceKit-master.tar.xz]
"""

import argparse
import json
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import scipy.io
from scipy import sparse

from facerf_cli.face.importers.basel import _LANDMARKS_2017 as _LANDMARKS
from facerf_cli.face.importers.basel import read_basel_2009, read_basel_2017
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.importers.resample import landmarks_of

# The kernel's own count, for getrusage begins with what the parent held.
IMPORT = """
import sys, time
from facerf_cli.main import main
if main(sys.argv[1:]): sys.exit("the import failed")
print(time.process_time(), next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
ARCHIVE = Path(__file__).parents[2] / "shared/data/ict_facekit/ICT-FaceKit-master.tar.xz"


@dataclass(frozen=True, eq=False)
class Face:
    """mean [N, 3], triangles [F, 3], identity and expression [K, N, 3], landmarks [68, 3]; metres."""

    mean: np.ndarray
    triangles: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    landmarks: np.ndarray


def read_face(archive: Path, identities: int, expressions: int) -> Face:
    """ICT-FaceKit's outer surface; shapes beyond its own are faint mixtures of them."""
    source = read_ict_facekit(archive)
    used, triangles = np.unique(source.triangles, return_inverse=True)
    bases = (source.identity[:, used], identities), (source.expression[:, used], expressions)
    landmarks = np.stack([source.known[number] for number in range(68)])
    return Face(source.mean[used], triangles.reshape(-1, 3), *(more(*basis) for basis in bases), landmarks)


def more(basis: np.ndarray, count: int) -> np.ndarray:
    mixture = np.random.default_rng(0).normal(0, 0.05, (count - len(basis), len(basis)))
    return np.concatenate([basis, np.tensordot(mixture / np.sqrt(len(basis)), basis, 1)])


def finer(face: Face) -> Face:
    """Each triangle in four, with a vertex in the middle of every edge."""
    edges = np.sort(face.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = face.triangles.T
    ab, bc, ca = len(face.mean) + middle.reshape(-1, 3).T

    def split(field: np.ndarray) -> np.ndarray:
        return np.concatenate([field, field[..., ends, :].mean(-2)], -2)

    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    triangles = np.concatenate([np.stack(corners, -1) for corners in quarters])
    fields = (split(field) for field in (face.identity, face.expression))
    return Face(split(face.mean), triangles, *fields, face.landmarks)


def unit(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of unit length [3 N, K] and their deviations [K]."""
    columns = shapes.reshape(len(shapes), -1).T
    deviations = np.linalg.norm(columns, axis=0)
    return (columns / deviations).astype(np.float32), deviations.astype(np.float32)


def write_flame(path: Path, face: Face) -> None:
    count = len(face.mean)
    weights, regressor = np.zeros((count, 5)), sparse.csc_matrix(np.eye(5, count))
    weights[:, 2] = face.mean[:, 1] < face.landmarks[62:68, 1].mean()
    shapes = np.moveaxis(np.concatenate([face.identity, face.expression]), 0, -1)
    table = {"v_template": face.mean, "f": face.triangles.astype(np.uint32), "shapedirs": shapes,
             "posedirs": np.zeros((count, 3, 36)), "weights": weights, "J_regressor": regressor}  # fmt: skip
    path.write_bytes(pickle.dumps(table))


def write_basel_2009(path: Path, face: Face) -> None:
    basis, deviations = unit(face.identity * 1e6)
    mean = (face.mean * 1e6).reshape(-1, 1).astype(np.float32)
    content = {"shapeMU": mean, "shapePC": basis, "shapeEV": deviations[:, None], "texMU": mean,
               "texPC": basis, "texEV": deviations[:, None], "tl": face.triangles[:, ::-1] + 1.0}  # fmt: skip
    scipy.io.savemat(path, content, do_compression=True)


def write_basel_2019(path: Path, face: Face) -> None:
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
    """Seconds of processor time and peak memory, MB, of `facerf face-model import` on its own (on Linux)."""
    line = ["--quiet", "face-model", "import", kind, str(path), "-o", str(path.with_suffix(".npz"))]
    done = subprocess.run([sys.executable, "-c", IMPORT, *line], capture_output=True, check=True, text=True)
    seconds, _, kilobytes, _ = done.stdout.split()[-4:]
    return float(seconds), int(kilobytes) / 1024


def measure(archive: Path) -> None:
    coarse = read_face(archive, 300, 100)
    fine = finer(read_face(archive, 199, 100))
    models: list[tuple[str, str, Face, Callable, Callable]] = [
        ("flame", "generic_model.pkl", coarse, write_flame, read_flame),
        ("basel-2009", "01_MorphableModel.mat", fine, write_basel_2009, read_basel_2009),
        ("basel-2019", "model2019_bfm.h5", fine, write_basel_2019, read_basel_2017),
    ]
    print("            vertices   file MB    CPU s  peak MB  named  inner mm  contour mm  worst mm")
    with tempfile.TemporaryDirectory() as folder:
        for kind, name, face, write, read in models:
            path = Path(folder) / name
            write(path, face)
            seconds, peak = cost_of_import(kind, path)
            source = read(path)
            off = 1000 * np.linalg.norm(landmarks_of(source) - face.landmarks, axis=-1)
            size = path.stat().st_size / 1e6
            print(
                f"{kind:10}  {len(face.mean):8}  {size:8.0f}  {seconds:7.1f}  {peak:7.0f}  "
                f"{len(source.known):5}  {off[17:].mean():8.2f}  {off[:17].mean():10.2f}  {off.max():8.2f}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("archive", type=Path, nargs="?", default=ARCHIVE)
    measure(parser.parse_args().archive)
