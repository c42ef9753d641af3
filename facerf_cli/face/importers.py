"""Face models that a user brings, carried once to the canonical topology (DESIGN, 'One topology inside')."""

import io
import re
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import GRID, LANDMARK_UV, LANDMARKS_M, chart_rays, chart_uv, grid_uv

EXPRESSION_STD = 0.3  # of a full blendshape: the spread that a coefficient of 1 stands for
_SLIP_M = 0.006  # a ray this far behind its neighbours slipped between the lips or lids
_MAX_OBJ_BYTES = 64 << 20

_ICT_LANDMARKS = (
    "1225 1888 1052 367 1719 1722 2199 1447 966 3661 4390 3927 3924 2608 3272 4088 3443 268 493 1914 2044 1401 "
    "3615 4240 4114 2734 2509 978 4527 4942 4857 1140 2075 1147 4269 3360 1507 1542 1537 1528 1518 1511 3742 3751 "
    "3756 3721 3725 3732 5708 5695 2081 0 4275 6200 6213 6346 6461 5518 5957 5841 5702 5711 5533 6216 6207 6470 "
    "5517 5966"
)
_ICT_SKIN = (slice(0, 11248), slice(21451, 24591))  # face, head and neck; eyeballs
_ICT_VERTICES = 26719
_ICT_LICENCE = "MIT, Copyright (c) 2020 USC Institute for Creative Technologies"


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases scaled by their deviations.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3], triangles [F, 3] of the outer surface,
    landmarks: the vertex ids of the 68 points.
    """

    name: str
    licence: str
    mean: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]
    triangles: np.ndarray
    landmarks: np.ndarray


def carry_over(source: SourceModel) -> MorphableModel:
    """Carry a model to the canonical topology: its landmarks warp the chart, rays find its surface."""
    rotation, translation = rigid_alignment(source.mean[source.landmarks], LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights = register(mean, source.triangles, mean[source.landmarks])

    def carried(field: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.einsum("...vkc,vk->...vc", field[..., corners, :], weights).astype(np.float32))

    return MorphableModel(
        name=source.name,
        licence=source.licence,
        mean=carried(mean),
        identity=carried(source.identity @ rotation.T),
        expression=carried(source.expression @ rotation.T),
        expression_names=source.expression_names,
    )


def register(mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the canonical vertices lie on a mesh: vertex ids [V, 3] and barycentric weights [V, 3].

    The displacement of the landmarks [68, 3] from their canonical (u, v) bends the whole grid (thin plate).
    """
    warp = RBFInterpolator(LANDMARK_UV, chart_uv(landmarks) - LANDMARK_UV, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    origins, directions = chart_rays(uv + warp(uv))
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points, rays, faces = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    if len(rays) < len(uv) * 0.98:
        raise InputError("the face model does not cover the chart: its surface ends inside forehead, cheeks or chin")
    points, faces = _mend_slipped(mesh, uv, origins, directions, points, rays, faces)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    weights = np.clip(weights, 0, None)
    return triangles[faces], weights / weights.sum(-1, keepdims=True)


def _mend_slipped(
    mesh: trimesh.Trimesh,
    uv: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    points: np.ndarray,
    rays: np.ndarray,
    faces: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Surface points [V, 3] and faces [V]; rays that missed or slipped into a slit take the nearest surface."""
    travelled = np.full(len(uv), np.nan)
    travelled[rays] = np.linalg.norm(points - origins[rays], axis=-1)
    usual = median_filter(np.nan_to_num(travelled, nan=np.nanmax(travelled)).reshape(GRID, GRID), 5).ravel()
    slipped = ~(travelled < usual + _SLIP_M)
    all_points, all_faces = np.empty((len(uv), 3)), np.empty(len(uv), np.int64)
    all_points[rays], all_faces[rays] = points, faces
    if slipped.any():
        expected = origins[slipped] + directions[slipped] * usual[slipped, None]
        _, faces_nearby = cKDTree(mesh.triangles_center).query(expected)
        all_points[slipped] = trimesh.triangles.closest_point(mesh.triangles[faces_nearby], expected)
        all_faces[slipped] = faces_nearby
    return all_points, all_faces


def rigid_alignment(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] nearest to `onto` [N, 3] (Kabsch)."""
    centre, target = points.mean(0), onto.mean(0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - target))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target - rotation @ centre


def import_ict_facekit(path: Path) -> MorphableModel:
    """ICT Face Model Light as its authors publish it: a folder, .zip or .tar[.gz|.xz] with `FaceXModel/*.obj`."""
    with _open_members(path) as (names, read):
        objects = {Path(name).stem: name for name in names if re.search(r"FaceXModel/[A-Za-z0-9_]+\.obj$", name)}
        if "generic_neutral_mesh" not in objects:
            raise InputError(f"{path}: no FaceXModel/generic_neutral_mesh.obj in it; give the ICT-FaceKit folder or archive")
        raw = {stem: read(name) for stem, name in objects.items()}
    return carry_over(_ict_source(path, raw))


def _ict_source(path: Path, raw: dict[str, bytes]) -> SourceModel:
    neutral = raw.pop("generic_neutral_mesh")
    mean = _obj_vertices(path, "generic_neutral_mesh", neutral)
    identities = sorted(stem for stem in raw if re.fullmatch(r"identity\d+", stem))
    expressions = sorted(set(raw) - set(identities))
    if not identities or not expressions:
        raise InputError(f"{path}: identity or expression shapes are missing from FaceXModel")

    def offsets(stems: list[str]) -> np.ndarray:
        return np.stack([_obj_vertices(path, stem, raw[stem]) - mean for stem in stems])

    triangles = _obj_triangles(neutral)
    outer = np.zeros(_ICT_VERTICES, bool)
    for part in _ICT_SKIN:
        outer[part] = True
    return SourceModel(
        name="ict-facekit",
        licence=_ICT_LICENCE,
        mean=mean,
        identity=offsets(identities),
        expression=offsets(expressions) * EXPRESSION_STD,
        expression_names=tuple(expressions),
        triangles=triangles[outer[triangles].all(1)],
        landmarks=np.array(_ICT_LANDMARKS.split(), dtype=np.int64),
    )


def _obj_vertices(path: Path, stem: str, text: bytes) -> np.ndarray:
    lines = [line[2:] for line in text.splitlines() if line.startswith(b"v ")]
    try:
        vertices_cm = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(len(lines), -1)[:, :3]
    except ValueError:
        raise InputError(f"{path}: {stem}.obj is damaged; fetch ICT-FaceKit again") from None
    if vertices_cm.shape != (_ICT_VERTICES, 3) or not np.isfinite(vertices_cm).all():
        raise InputError(f"{path}: {stem}.obj has {len(lines)} vertices, not {_ICT_VERTICES}; fetch ICT-FaceKit again")
    return vertices_cm / 100


def _obj_triangles(text: bytes) -> np.ndarray:
    triangles = []
    for line in text.splitlines():
        if line.startswith(b"f "):
            corners = [int(token.split(b"/")[0]) - 1 for token in line.split()[1:]]
            triangles += [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
    return np.array(triangles)


@contextmanager
def _open_members(path: Path) -> Iterator[tuple[list[str], Callable[[str], bytes]]]:
    """Names of the files in a folder or archive, and a function that reads one; sizes bounded."""
    try:
        if path.is_dir():
            yield [p.as_posix() for p in path.rglob("*.obj")], lambda name: Path(name).read_bytes()
        elif zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                yield archive.namelist(), lambda name: _bounded(archive.open(name))
        elif path.is_file() and tarfile.is_tarfile(path):
            yield from _tar_members(path)
        else:
            raise InputError(f"{path}: give the ICT-FaceKit folder, or its .zip or .tar archive")
    except (OSError, tarfile.TarError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{path}: the archive cannot be read ({error}); fetch it again") from None


def _tar_members(path: Path) -> Iterator[tuple[list[str], Callable[[str], bytes]]]:
    # One pass: seeking in a compressed tar would decompress it anew for each of its 150 files.
    with tarfile.open(path, "r|*") as archive:
        files = {
            member.name: _bounded(stream)
            for member in archive
            if member.name.endswith(".obj") and (stream := archive.extractfile(member))
        }
    yield list(files), files.__getitem__


def _bounded(stream: "io.BufferedReader | zipfile.ZipExtFile | object") -> bytes:
    with stream:  # type: ignore[attr-defined]
        data: bytes = stream.read(_MAX_OBJ_BYTES + 1)  # type: ignore[attr-defined]
    if len(data) > _MAX_OBJ_BYTES:
        raise InputError("an .obj in the archive is larger than 64 MB; this is not ICT-FaceKit")
    return data
