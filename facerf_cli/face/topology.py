"""Canonical topology: the grid of vertices in UV space to which every face model is resampled.

The grid is bilaterally symmetric and lies on a cylinder about a vertical axis inside the head. The head frame
is right-handed, in metres: x to the image's right, y up, z out of the face; its origin lies on the cylinder's
axis at the height of the underside of the nose. u runs to the image's right over +-`HALF_ANGLE_DEG` of
azimuth, v runs down from the forehead to below the chin. The 68 landmarks (Multi-PIE order) have the same
(u, v) in every model, so a texture network trained on one model fits all others. A change to the grid or the
landmarks needs a new `LAYOUT_VERSION`.

Named regions are soft masks in UV space; their outlines are an asset. `eyes` (between the lids), `brows`,
`lips` (with the slit of the mouth), `nostrils`, `neck` (below the jaw line) and `skin` sum to one everywhere;
`mouth` (only the slit) and `face` (inside jaw and forehead, for compositing) overlap them.

The interior of the face is the mask M_t(omega_h) of the paper's 'Photometric loss': the region `face` without
its soft border, where the mesh faces the camera. It includes brows, eyes and mouth, like the paper's mask.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.raster.rasterize import Fragments, front_facing
from facerf_cli.raster.texture import sample_texture, smoothstep

LAYOUT_VERSION = 1
GRID = 129  # vertices along each side of the grid; odd, so that one column lies on the midline
HALF_ANGLE_DEG = 61.0  # just wide enough for the 68 landmarks of every model
TOP_M, BOTTOM_M = 0.092, -0.082  # heights of v = 0 and v = 1
UV_SIZE_MM = np.array([np.radians(2 * HALF_ANGLE_DEG) * 115, (TOP_M - BOTTOM_M) * 1000])  # at radius 115 mm

CONTOUR = tuple(range(17))  # the landmarks along the jaw, from ear to ear
INNER_MOUTH_CORNERS = (60, 64)  # missing from the paper's 66 landmarks
OUTER_EYE_CORNERS = (36, 45)  # their distance is the inter-ocular distance everywhere in facerf
# Index of each landmark's mirror image.
MIRROR_68 = np.array(
    [
        *[*range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, *range(35, 30, -1)],
        *[45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40],
        *[*range(54, 47, -1), *range(59, 54, -1), *range(64, 59, -1), 67, 66, 65],
    ]
)
# Landmarks of the mean face on the midline and on the image's left: index, x, y, z in millimetres.
_MEASURES_MM = """
 0 -73.5  37   46.5 |  1 -73   15   49.5 |  2 -69.5 -4.5 55.5 |  3 -65.5 -23.5 61.5 |  4 -57  -45   71.5
 5 -43   -62   83.5 |  6 -30.5 -69  97.5 |  7 -15.5 -72.5 112.5 | 8  0 -75.5 114.5 | 17 -58   52   89
18 -49.5  60  100   | 19 -38   62.5 108.5 | 20 -24  62   115   | 21 -11.5 59  117.5 | 27  0   37.5 117.5
28   0    26.5 125  | 29   0   16  133   | 30   0    4  140.5 | 31 -12.5 -11.5 118.5 | 32 -6 -11.5 124
33   0   -12  125.5 | 36 -44.5 34.5 96   | 37 -38.5 38.5 103.5 | 38 -28  39.5 105.5 | 39 -18.5 32.5 102
40 -27.5  31  104   | 41 -38.5 30.5 102.5 | 48 -25.5 -35 112  | 49 -17  -28 122     | 50 -7.5 -24 127.5
51   0   -25  128.5 | 57   0  -44  125.5 | 58 -10.5 -43 124   | 59 -18  -40.5 119   | 60 -22 -35 111.5
61 -10   -32.4 121  | 62   0  -32.5 122.5 | 66  0   -34.6 122.5 | 67 -10.5 -34.5 120.5
"""

# Rays in UV space run from the nose to the jaw line. Only the outer band of each ray can be the silhouette,
# along which contour landmarks slide (paper, 'Landmark loss').
RAYS_PER_LANDMARK, POINTS_PER_RAY = 8, 10
CONTOUR_RAYS = (len(CONTOUR) - 1) * RAYS_PER_LANDMARK + 1
NOSE = (28, 33)  # the rays begin midway between these landmarks
_BAND = (0.6, 1.0)  # range of a ray, 0 at the nose and 1 at the jaw line, where the silhouette can lie

OUTLINES_PATH = Path(__file__).parent.parent / "assets" / "face_regions.npz"  # tools/face_regions.py
REGIONS = ("skin", "eyes", "brows", "lips", "mouth", "nostrils", "neck", "face")
_NOT_SKIN = ("eyes", "brows", "lips", "nostrils", "neck")
_PAIRED = ("eyes", "brows", "nostrils")  # outlined on the image's left, then mirrored
# Width of the transition from 1 to 0 across a mask's outline, on the mean face.
_EDGE_MM = {"eyes": 1.0, "brows": 3.0, "lips": 1.6, "mouth": 1.0, "nostrils": 2.5, "neck": 5.0, "face": 16.0}


def _landmarks_m() -> np.ndarray:
    points = np.full((68, 3), np.nan)
    for cell in _MEASURES_MM.replace("\n", "|").split("|"):
        if cell.strip():
            index, *xyz = (float(token) for token in cell.split())
            points[int(index)] = xyz
            points[MIRROR_68[int(index)]] = np.array(xyz) * [-1, 1, 1]
    return points / 1000


LANDMARKS_M = _landmarks_m()  # [68, 3], of the mean face, head frame


def cylinder_uv(points_m: np.ndarray) -> np.ndarray:
    """Convert head-frame points [..., 3] in metres to (u, v) [..., 2], by azimuth and height."""
    azimuth_deg = np.degrees(np.arctan2(points_m[..., 0], points_m[..., 2]))
    u = 0.5 + azimuth_deg / (2 * HALF_ANGLE_DEG)
    v = (TOP_M - points_m[..., 1]) / (TOP_M - BOTTOM_M)
    return np.stack([u, v], -1)


def cylinder_rays(uv: np.ndarray, radius_m: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions [..., 3] of rays from outside through (u, v) to the axis."""
    azimuth = np.radians((uv[..., 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    y = TOP_M - uv[..., 1] * (TOP_M - BOTTOM_M)
    outward = np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], -1)
    origins = outward * radius_m
    origins[..., 1] = y
    return origins, -outward


LANDMARK_UV = cylinder_uv(LANDMARKS_M)  # [68, 2]


def grid_uv() -> Tensor:
    """Return the (u, v) [V, 2] of all vertices, row by row from the forehead down; V = GRID * GRID."""
    side = torch.linspace(0, 1, GRID)
    v, u = torch.meshgrid(side, side, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


@cache  # for every render
def grid_triangles() -> Tensor:
    """Return vertex ids [F, 3], counter-clockwise from outside, with diagonals mirrored about the midline."""
    row, col = torch.meshgrid(torch.arange(GRID - 1), torch.arange(GRID - 1), indexing="ij")
    top_left = (row * GRID + col).reshape(-1)
    top_right, bottom_left = top_left + 1, top_left + GRID
    bottom_right = bottom_left + 1
    falling = torch.stack([top_left, bottom_left, bottom_right, top_left, bottom_right, top_right], -1)
    rising = torch.stack([top_left, bottom_left, top_right, top_right, bottom_left, bottom_right], -1)
    left_half = (col < GRID // 2).reshape(-1, 1)
    return torch.where(left_half, falling, rising).reshape(-1, 3)


@cache
def on_device(device: torch.device, constant: Callable[..., Any], *arguments: Any) -> Any:
    """Return a constant tensor or tuple of tensors, such as `grid_triangles`, on a device; copy it once."""
    value = constant(*arguments)
    return value.to(device) if isinstance(value, Tensor) else tuple(part.to(device) for part in value)


def locate(uv: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return vertex ids [N, 3] and barycentric weights [N, 3] of the triangle around each (u, v) [N, 2]."""
    position = np.clip(uv, 0, 1) * (GRID - 1)
    cell = np.minimum(position.astype(np.int64), GRID - 2)
    fraction = position - cell
    triangles = grid_triangles().reshape(GRID - 1, GRID - 1, 2, 3)[cell[:, 1], cell[:, 0]]  # [N, 2, 3]
    corners = grid_uv().double().numpy()[triangles.numpy()] * (GRID - 1) - cell[:, None, None]  # [N, 2, 3, 2]
    a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
    p = fraction[:, None]
    det = _cross(b - a, c - a)
    weights = (
        np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], -1) / det[..., None]
    )
    best = weights.min(-1).argmax(-1)
    rows = np.arange(len(uv))
    return triangles[rows, best], torch.from_numpy(weights[rows, best]).float()


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def landmark_weights() -> tuple[Tensor, Tensor]:
    """Return vertex ids [68, 3] and barycentric weights [68, 3] of the landmarks, equal for all models."""
    return locate(LANDMARK_UV)


@cache  # slow at many texels
def region_mask(name: str, side: int) -> Tensor:
    """Return the mask [T, T] in 0..1 of a region, symmetric in u; row 0 is the forehead."""
    if name == "skin":
        return (1 - torch.stack([region_mask(part, side) for part in _NOT_SKIN]).sum(0)).clamp(0, 1)
    outline, centre = _outline_mm(name) / UV_SIZE_MM, (np.arange(side) + 0.5) / side
    edge_mm = max(_EDGE_MM[name], UV_SIZE_MM.max() / side)  # never sharper than a texel
    margin = edge_mm / UV_SIZE_MM
    bounds = zip(outline.min(0) - margin, outline.max(0) + margin, strict=True)
    columns, rows = (np.flatnonzero((low < centre) & (centre < high)) for low, high in bounds)
    uv = np.stack(np.meshgrid(centre[columns], centre[rows]), -1)
    distance_mm = np.full((side, side), -edge_mm)
    distance_mm[np.ix_(rows, columns)] = inside_mm(name, uv)
    mask = smoothstep(torch.from_numpy(distance_mm / edge_mm + 0.5))
    mirrored = mask.flip(1)
    return (torch.maximum(mask, mirrored) if name in _PAIRED else (mask + mirrored) / 2).float()


def inside_mm(name: str, uv: np.ndarray) -> np.ndarray:
    """Return the distance [...] in mm of (u, v) [..., 2] from a region's outline, positive inside.

    Distances are on the unrolled cylinder. Paired regions use the outline on the image's left (u < 0.5).
    """
    return _inside_outline(uv * UV_SIZE_MM, _outline_mm(name))


def _outline_mm(name: str) -> np.ndarray:
    if name not in _outlines_mm():
        raise ValueError(f"{name!r}: not a region of the face; choose one of {', '.join(REGIONS)}")
    return _outlines_mm()[name]


@cache
def _outlines_mm() -> dict[str, np.ndarray]:
    """Load the closed outlines [N, 2] of all regions on the unrolled cylinder."""
    with np.load(OUTLINES_PATH, allow_pickle=False) as file:
        return dict(file)


def _inside_outline(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the distance [...] of points [..., 2] from a closed outline [N, 2], positive inside."""
    x, y = (np.ascontiguousarray(points[..., axis], np.float32) for axis in (0, 1))  # faster than pairs
    nearest = np.full_like(x, np.inf)  # squared
    inside = np.zeros(x.shape, bool)
    outline = outline.astype(np.float32)
    for start, end in zip(outline, np.roll(outline, -1, 0), strict=True):
        along = end - start
        right, down = x - start[0], y - start[1]
        fraction = ((right * along[0] + down * along[1]) / max(along @ along, 1e-12)).clip(0, 1)
        aside, below = right - fraction * along[0], down - fraction * along[1]
        nearest = np.minimum(nearest, aside * aside + below * below)
        if start[1] != end[1]:
            crosses = (y < start[1]) != (y < end[1])
            inside ^= crosses & (right < down * along[0] / along[1])
    distance = np.sqrt(nearest)
    return np.where(inside, distance, -distance)


def interior_texture(side: int) -> Tensor:
    """Return the interior in UV space [1, T, T]: 0 on the outline of the region `face`, 1 at 8 mm inside."""
    return (2 * region_mask("face", side) - 1).clamp_min(0)[None]


@torch.no_grad()
def interior_mask(vertices_camera: Tensor, fragments: Fragments, uv: Tensor, texture_side: int) -> Tensor:
    """Compute the interior M_t [..., 1, H, W] in 0..1 of a rendered mesh.

    vertices_camera [..., V, 3] is the mesh; fragments and uv [..., H, W, 2] describe its visible point per
    pixel.
    """
    front = front_facing(vertices_camera, on_device(uv.device, grid_triangles))
    pixel_front = front.gather(-1, fragments.triangle.flatten(-2).clamp_min(0)).view_as(fragments.triangle)
    inside = sample_texture(on_device(uv.device, interior_texture, texture_side), uv)[..., 0]
    return (inside * (fragments.covered & pixel_front)).unsqueeze(-3)


def band_uv() -> np.ndarray:
    """Return the (u, v) [R, P, 2] of the band's points, from the right ear to the left, outermost last."""
    ends = _between_landmarks(LANDMARK_UV)
    centre = np.array([0.5, LANDMARK_UV[list(NOSE), 1].mean()])
    fraction = np.linspace(*_BAND, POINTS_PER_RAY)[:, None]
    return centre + fraction * (ends - centre)[:, None]


def contour_rays() -> Tensor:
    """Return the grid's vertices [R, P] closest to the band's points."""
    column_row = np.round(band_uv() * (GRID - 1)).astype(np.int64)
    column_row = column_row.clip(0, GRID - 1)
    return torch.from_numpy(column_row[..., 1] * GRID + column_row[..., 0])


@torch.no_grad()
def silhouette_ids(vertices_px: Tensor, head_to_camera: Tensor) -> Tensor:
    """Return the outline's vertices [B, R]: the outermost vertex of each ray in the image.

    vertices_px [B, V, 2] are the mesh's pixels, head_to_camera [B, 3, 3] the poses.
    """
    rays = on_device(vertices_px.device, contour_rays)
    outward = on_device(vertices_px.device, _outward).to(head_to_camera) @ head_to_camera.mT  # [B, R, 3]
    furthest = outermost(vertices_px[:, rays], outward)
    return rays.expand(len(vertices_px), -1, -1).gather(2, furthest[..., None])[..., 0]


def outermost(px: Tensor, outward: Tensor) -> Tensor:
    """Return the index [B, R] of each ray's outermost point among P pixels [B, R, P, 2].

    outward [B, R, 3] are the rays' directions out of the face in camera space.
    """
    reach = px[..., 0] * outward[..., None, 0] - px[..., 1] * outward[..., None, 1]
    return reach.argmax(-1)


def _outward() -> Tensor:
    """Return the rays' unit directions [R, 3] out of a frontal face, head frame."""
    away = (_between_landmarks(LANDMARKS_M) - LANDMARKS_M[list(NOSE)].mean(0)) * [1, 1, 0]
    return torch.from_numpy(away / np.linalg.norm(away, axis=-1, keepdims=True)).float()


def _between_landmarks(values: np.ndarray) -> np.ndarray:
    """Interpolate landmark values [68, C] linearly to the outer ends of the rays [R, C]."""
    along = np.arange(CONTOUR_RAYS) / RAYS_PER_LANDMARK
    contour = values[list(CONTOUR)]
    return np.stack([np.interp(along, CONTOUR, column) for column in contour.T], -1)
