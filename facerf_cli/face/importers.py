"""Face models that a user brings, carried once to the canonical topology (DESIGN, 'One topology inside')."""

import lzma
import re
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.head_model import HEAD_PARTS, HeadModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import (
    GRID,
    LANDMARK_UV,
    LANDMARKS_M,
    chart_rays,
    chart_uv,
    grid_triangles,
    grid_uv,
    landmark_weights,
)
from facerf_cli.records import one_line

EXPRESSION_STD = 0.3  # of a full blendshape: the spread that a coefficient of 1 stands for
_SLIP_M = 0.006  # a ray this far behind its neighbours slipped between the lips or lids
_PULL_M = 0.005  # how far around a landmark the grid is pulled onto it
_LIMBUS_M, _LIMBUS_DEG = 0.006, 29.0  # an iris's radius, and the angle at which eye textures show it
_CANDIDATES = 12  # triangles by their centres, among which the nearest point is sought
_MAX_OBJ_BYTES, _MAX_BYTES = 64 << 20, 2 << 30  # of one .obj, and of all
_DAMAGED = (OSError, EOFError, RuntimeError, zlib.error, lzma.LZMAError, tarfile.TarError, zipfile.BadZipFile)

_ICT_LANDMARKS = (
    "1225 1888 1052 367 1719 1722 2199 1447 966 3661 4390 3927 3924 2608 3272 4088 3443 "
    "268 493 1914 2044 1401 3615 4240 4114 2734 2509 978 4527 4942 4857 1140 2075 1147 "
    "4269 3360 1507 1542 1537 1528 1518 1511 3742 3751 3756 3721 3725 3732 5708 5695 2081 "
    "0 4275 6200 6213 6346 6461 5518 5957 5841 5702 5711 5533 6216 6207 6470 5517 5966"
)
_ICT_SKIN = (slice(0, 11248), slice(21451, 24591))  # face, head and neck; eyeballs
_ICT_VERTICES = 26719
_ICT_PARTS = {  # first and last vertex; an eyeball is its sclera, which wraps the iris and bulges as a cornea
    "skin": ((0, 11247),),
    "mouth": ((11248, 13293), (14062, 17038)),  # socket; gums and tongue
    "teeth": ((17039, 21450),),
    "eye": ((21451, 22220), (23021, 23790)),
}
_ICT_LICENCE = "MIT, Copyright (c) 2020 USC Institute for Creative Technologies"


@dataclass(frozen=True)
class SourceHead:
    """What of a model's own mesh makes its whole head.

    triangles [F, 3] in the source's vertex ids; part [N] uint8 into `HEAD_PARTS`; eyes: the vertex ids of
    each ball, a closed surface whose cornea looks along the gaze.
    """

    triangles: np.ndarray
    part: np.ndarray
    eyes: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases in standard deviations.

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
    head: SourceHead | None = None


def carry_over(source: SourceModel) -> MorphableModel:
    """Carry a model to the canonical topology: its landmarks warp the chart, rays find its surface."""
    rotation, translation = rigid_alignment(source.mean[source.landmarks], LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights = register(mean, source.triangles, mean[source.landmarks])

    def carried(field: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(
            np.einsum("...vkc,vk->...vc", field[..., corners, :], weights).astype(np.float32)
        )

    return MorphableModel(
        name=source.name,
        licence=source.licence,
        mean=carried(mean),
        identity=carried(source.identity @ rotation.T),
        expression=carried(source.expression @ rotation.T),
        expression_names=source.expression_names,
        head=None if source.head is None else _carried_head(source, source.head, carried(mean).numpy()),
    )


def _carried_head(source: SourceModel, head: SourceHead, canonical: np.ndarray) -> HeadModel:
    """The source's own head in the head frame, its skin in the chart of the canonical mean [V, 3]."""
    rotation, translation = rigid_alignment(source.mean[source.landmarks], LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    uv = chart_uv(mean)
    skin = np.flatnonzero(head.part == HEAD_PARTS.index("skin"))
    uv[skin] = _skin_uv(mean[skin], canonical)
    for eye in head.eyes:
        uv[eye] = _eye_uv(mean[eye])
    used, triangles = np.unique(head.triangles, return_inverse=True)

    def kept(field: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(field[..., used, :].astype(np.float32))

    return HeadModel(
        mean=kept(mean),
        identity=kept(source.identity @ rotation.T),
        expression=kept(source.expression @ rotation.T),
        triangles=torch.from_numpy(triangles.reshape(-1, 3)),
        part=torch.from_numpy(head.part[used]),
        uv=kept(uv),
    )


def _skin_uv(points: np.ndarray, canonical: np.ndarray) -> np.ndarray:
    """(u, v) [N, 2] of skin: that of the nearest canonical point, and around the chart its formula.

    What the formula is off by at the chart's border fades into what lies beyond, so that nothing jumps.
    """
    grid = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(canonical, grid_triangles().numpy(), process=False)
    nearest, faces = _nearest(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], nearest)
    inner = (weights[..., None] * grid[mesh.faces[faces]]).sum(1)
    formula = chart_uv(points)
    inside = ((inner > 1e-3) & (inner < 1 - 1e-3) & (np.abs(formula - 0.5) < 0.7)).all(-1)
    border = ((grid == 0) | (grid == 1)).any(-1)
    at = chart_uv(canonical[border])
    pull = 1 / (cdist(formula, at) ** 4 + 1e-12)  # inverse distance: exact at the border, smooth beyond
    beyond = formula + (pull @ (grid[border] - at)) / pull.sum(-1, keepdims=True)
    return np.where(inside[:, None], inner, beyond)


def _eye_uv(points: np.ndarray) -> np.ndarray:
    """(u, v) [N, 2] of an eyeball: direction and angle about the axis through its cornea, as a disc.

    Angles are stretched so that an iris of `_LIMBUS_M` has the same place in every model's eyes, however
    large their balls.
    """
    centre = (points.min(0) + points.max(0)) / 2
    offset = points - centre
    radius = np.linalg.norm(offset, axis=-1)
    axis = offset[radius > np.percentile(radius[offset[:, 2] > 0], 90)]
    axis = axis[axis[:, 2] > 0].mean(0)
    axis /= np.linalg.norm(axis)
    along = offset @ axis
    side = np.cross([0.0, 1, 0], axis)
    side /= np.linalg.norm(side)
    across = np.stack([offset @ side, -(offset @ np.cross(axis, side))], -1)
    lateral = np.linalg.norm(across, axis=-1)
    angle_deg = np.degrees(np.arctan2(lateral, along))
    front = np.argsort(angle_deg)[: len(points) // 2]
    limbus_deg = np.interp(_LIMBUS_M, lateral[front], angle_deg[front])
    stretched = np.minimum(angle_deg * _LIMBUS_DEG / limbus_deg, 90)
    return 0.5 + 0.5 * across / np.maximum(lateral, 1e-9)[:, None] * (stretched / 90)[:, None]


def register(mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the canonical vertices lie on a mesh: vertex ids [V, 3] and barycentric weights [V, 3].

    The displacement of the landmarks [68, 3] from their canonical (u, v) bends the whole grid (thin plate).
    """
    warp = RBFInterpolator(LANDMARK_UV, chart_uv(landmarks) - LANDMARK_UV, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points = _cast(mesh, *chart_rays(uv + warp(uv)))
    points, faces = _nearest(mesh, _pulled(points, landmarks))
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    weights = np.clip(weights, 0, None)
    return triangles[faces], weights / weights.sum(-1, keepdims=True)


def _cast(mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where the grid's rays meet the mesh [V, 3]; one that slips into a slit ends where its neighbours do."""
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    if len(rays) < len(origins) * 0.98:
        raise InputError(
            "the face model does not cover the chart: its surface ends inside forehead, cheeks or chin"
        )
    travelled = np.full(len(origins), np.inf)
    travelled[rays] = np.linalg.norm(points - origins[rays], axis=-1)
    filled = np.where(np.isfinite(travelled), travelled, travelled[rays].max())
    usual = median_filter(filled.reshape(GRID, GRID), 5).ravel()
    return origins + directions * np.where(travelled < usual + _SLIP_M, travelled, usual)[:, None]


def _pulled(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Points [V, 3] moved, smoothly and near landmarks alone, so that the grid's come to lie on the model's.

    Rays cannot do that where a landmark hides from them, as the inner corners of the mouth behind the lips.
    """
    corners, weights = (tensor.numpy() for tensor in landmark_weights())
    reached = (points[corners] * weights[..., None]).sum(1)
    kernel = np.exp(-((cdist(reached, reached) / _PULL_M) ** 2))
    strength = np.linalg.solve(kernel + 1e-3 * np.eye(len(reached)), landmarks - reached)
    return points + np.exp(-((cdist(points, reached) / _PULL_M) ** 2)) @ strength


def _nearest(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh's points [N, 3] nearest to `points` [N, 3], and their faces [N]."""
    _, nearby = cKDTree(mesh.triangles_center).query(points, _CANDIDATES)
    closest = np.stack(
        [trimesh.triangles.closest_point(mesh.triangles[faces], points) for faces in nearby.T]
    )  # [candidates, N, 3]
    best = np.linalg.norm(closest - points, axis=-1).argmin(0)
    rows = np.arange(len(points))
    return closest[best, rows], nearby[rows, best]


def rigid_alignment(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] nearest to `onto` [N, 3] (Kabsch)."""
    centre, target = points.mean(0), onto.mean(0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - target))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target - rotation @ centre


def import_ict_facekit(path: Path) -> MorphableModel:
    """ICT Face Model Light as its authors publish it: `FaceXModel/*.obj` in a folder, a .zip or a .tar.xz."""
    raw: dict[str, bytes] = {}
    try:
        for name, read in _members(path):
            if found := re.search(r"FaceXModel/([A-Za-z0-9_]+)\.obj$", name):
                raw[found[1]] = read(_MAX_OBJ_BYTES + 1)
                if len(raw[found[1]]) > _MAX_OBJ_BYTES or sum(map(len, raw.values())) > _MAX_BYTES:
                    raise InputError(f"{path}: {name} is too large; this is not ICT-FaceKit")
    except _DAMAGED as error:
        raise InputError(
            f"{path}: cannot be read ({one_line(str(error))}); fetch ICT-FaceKit again"
        ) from None
    if "generic_neutral_mesh" not in raw:
        raise InputError(
            f"{path}: no FaceXModel/generic_neutral_mesh.obj in it; give ICT-FaceKit's folder or archive"
        )
    source = _ict_source(path, raw)
    try:
        return carry_over(source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _ict_source(path: Path, raw: dict[str, bytes]) -> SourceModel:
    neutral = raw.pop("generic_neutral_mesh")
    mean = _obj_vertices(path, "generic_neutral_mesh", neutral)
    identities = sorted(stem for stem in raw if re.fullmatch(r"identity\d+", stem))
    expressions = sorted(set(raw) - set(identities))
    if not identities or not expressions:
        raise InputError(f"{path}: identity or expression shapes are missing from FaceXModel")

    def offsets(stems: list[str]) -> np.ndarray:
        return np.stack([_obj_vertices(path, stem, raw[stem]) - mean for stem in stems])

    triangles = _obj_triangles(path, neutral)
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
        head=_ict_head(triangles),
    )


def _ict_head(triangles: np.ndarray) -> SourceHead:
    """Skin, mouth, teeth and eyeballs; the sockets behind the eyes and the film before them are left out."""
    part = np.full(_ICT_VERTICES, 255, np.uint8)
    for name, spans in _ICT_PARTS.items():
        for first, last in spans:
            part[first : last + 1] = HEAD_PARTS.index(name)
    eyes = tuple(np.arange(first, last + 1) for first, last in _ICT_PARTS["eye"])
    return SourceHead(triangles[(part[triangles] < 255).all(1)], part, eyes)


def _obj_vertices(path: Path, stem: str, text: bytes) -> np.ndarray:
    lines = [line[2:] for line in text.splitlines() if line.startswith(b"v ")]
    try:
        vertices_cm = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(len(lines), -1)[:, :3]
    except ValueError:
        raise InputError(f"{path}: {stem}.obj is damaged; fetch ICT-FaceKit again") from None
    if vertices_cm.shape != (_ICT_VERTICES, 3) or not np.isfinite(vertices_cm).all():
        raise InputError(
            f"{path}: {stem}.obj has {len(lines)} vertices, not {_ICT_VERTICES}; fetch ICT-FaceKit again"
        )
    return vertices_cm / 100


def _obj_triangles(path: Path, text: bytes) -> np.ndarray:
    triangles = []
    try:
        for line in text.splitlines():
            if line.startswith(b"f "):
                corners = [int(token.split(b"/")[0]) - 1 for token in line.split()[1:]]
                triangles += [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
    except ValueError:
        triangles = []
    if not triangles or not 0 <= np.min(triangles) <= np.max(triangles) < _ICT_VERTICES:
        raise InputError(f"{path}: the neutral mesh's faces are damaged; fetch ICT-FaceKit again")
    return np.array(triangles)


def _members(path: Path) -> Iterator[tuple[str, Callable[[int], bytes]]]:
    """Each file in a folder or archive: its name, and what reads at most so many bytes of it."""
    if path.is_dir():
        for file in sorted(path.rglob("*.obj")):
            with file.open("rb") as stream:
                yield file.as_posix(), stream.read
    elif zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as member:
                    yield name, member.read
    elif path.is_file() and tarfile.is_tarfile(path):
        # One pass: seeking in a compressed tar would decompress it anew for each of its 150 files.
        with tarfile.open(path, "r|*") as tar:
            for entry in tar:
                if entry.isfile() and (content := tar.extractfile(entry)):
                    yield entry.name, content.read
    else:
        raise InputError(f"{path}: give the ICT-FaceKit folder, or its .zip or .tar archive")
