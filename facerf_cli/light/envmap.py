"""Environment maps: weights of a rig's lights under a lat-long map, key lights, balls and backdrops.

A light of weight 1 gives a white Lambertian surface that faces it radiance 1. So the weight of a light is (1
/ pi) times the integral of the map's radiance over the light's cell: the directions that are nearer to it
than to any other light of the rig.

The shadows of a map's key light, such as the sun or a small bright source, have hard edges that cells would
blur. A key light is a compact cluster of texels, at most `2 * _REACH_DEG` wide, with more than `_SHARE` of
the map's light. It consists of the texels around the brightest one that are at least `_BRIGHT` times as
bright, and the ring around it has hardly any such texels. It is rendered as one single light from its middle.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Resized, in_strips
from facerf_cli.light.entries import Sampling
from facerf_cli.light.sphere import RigLight, direction_to_uv, latlong_directions, latlong_solid_angles

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_DIRECTIONS_AT_ONCE = 1 << 12  # compared with all triangles of a rig
_MANY_LIGHTS = 400  # above it, a tree finds the nearest light faster
_TEXELS_AT_ONCE = 1 << 13  # compared with all lights of a rig
_OUTSIDE = -1e-4  # barycentric weight below which the rig does not surround a direction
_FLAT = 1e-6  # least distance of a triangle's plane from the origin
_COLUMNS_AT_ONCE = 1 << 10  # of a map, integrated in float64
_LEAST_CELL_ROWS = 256  # of the grid of a rig's cells
_BALL_SAMPLES = 3  # along each side of a pixel of a ball
_IRRADIANCE_ROWS, _SOURCE_ROWS = 32, 64  # of the diffuse ball's maps: both far finer than the cosine lobe
_SHARP_PX = 3.0  # standard deviation of a blur up to which a backdrop is rendered at its full size
_SHARE = 0.2  # of a map's light
_REACH_DEG, _RING_DEG = 6.0, 12.0  # radii of a key light, and of the ring without other bright texels
_BRIGHT = 0.1  # of the brightest texel
_AROUND = 0.1  # of the key's light, in the ring
_ROWS = 256  # largest map in which key lights are searched
_NEIGHBOURS = 8  # lights around a texel
_SPREAD = 0.35  # standard deviation of a light's Gaussian, in spacings of the lights
_SMOOTH_GAINS = 3  # the first is the splat itself


def check_envmap(envmap: Tensor) -> None:
    """Raise InputError if a map [H, W, 3] is not lat-long or has non-finite pixels."""
    if envmap.ndim != 3 or envmap.shape[2] != 3 or envmap.shape[1] != 2 * envmap.shape[0]:
        size = " x ".join(str(side) for side in reversed(envmap.shape[:2]))
        raise InputError(f"the environment map has {size} pixels; use a lat-long map, twice as wide as high")
    if broken := int((~envmap.isfinite()).any(-1).sum()):
        raise InputError(f"the environment map has {broken} NaN or infinite pixels; repair them first")


def envmap_weights(
    envmap: Tensor, directions: Tensor, rotate_deg: float = 0.0, sampling: Sampling = "cell"
) -> Tensor:
    """Return weights [L, 3] float32 of lights at `directions` [L, 3] under a linear map [H, W, 3].

    `rotate_deg` is added to every azimuth of the map. Sampling "cell" integrates the map over cells: pi times
    the sum of the weights is the integral of the map, at any map size. "smooth" distributes each direction of
    the map over the three lights around it, so that weights change without steps as the map turns. "paper"
    takes the map's pixel at the light's direction (paper, 'Relighting'), times an equal fraction of the
    sphere.
    """
    return rotated_weights(envmap, directions, [rotate_deg], sampling)[0]


def rotated_weights(
    envmap: Tensor, directions: Tensor, rotations_deg: Sequence[float], sampling: Sampling = "cell"
) -> Tensor:
    """Compute `envmap_weights` for several rotations: [R, L, 3]."""
    if sampling == "paper":
        envmap, uv = torch.as_tensor(envmap), direction_to_uv(directions.double())
        height, width = envmap.shape[:2]
        row = (uv[:, 1] * height).long().clamp(0, height - 1)
        columns = [((uv[:, 0] + degrees / 360) * width).floor().long() % width for degrees in rotations_deg]
        pixels = torch.stack([envmap[row, column] for column in columns])
        return (pixels.double() * (4 / len(directions))).float()
    height = cell_rows(len(directions))
    if sampling == "smooth":
        texels = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
        index, fractions = lights_around(texels, directions)
    else:
        index = nearest_light(directions, height, 2 * height).reshape(-1, 1)
        fractions = torch.ones(index.shape, dtype=torch.float64)
    rows = _row_integrals(envmap, height)
    rotated = []
    for rotation_deg in rotations_deg:
        power = _texels_of_rows(rows, 2 * height, rotation_deg).reshape(-1, 3) / math.pi
        weights = torch.zeros(len(directions), 3, dtype=torch.float64)
        for light, fraction in zip(index.unbind(1), fractions.unbind(1), strict=True):
            weights = weights.index_add(0, light, fraction[:, None] * power)
        rotated.append(weights)
    return torch.stack(rotated).float()


def cell_rows(lights: int) -> int:
    """Return the rows of the grid of a rig's cells, with dozens of texels per cell."""
    return max(_LEAST_CELL_ROWS, 2 * math.ceil(8 * math.sqrt(lights)))


def nearest_light(directions: Tensor, height: int, width: int) -> Tensor:
    """Return the index [H, W] int64 of the light [L, 3] nearest to the centre of each lat-long texel."""
    texels = latlong_directions(height, width, torch.float64)
    lights = directions.double().cpu().numpy()
    if len(lights) > _MANY_LIGHTS:
        from scipy.spatial import cKDTree  # its import takes as long as a few hundred lights without it

        return torch.from_numpy(cKDTree(lights).query(texels.numpy())[1]).long()
    parts = torch.split(texels.view(-1, 3), _TEXELS_AT_ONCE)
    index = np.concatenate([(part.numpy() @ lights.T).argmax(1) for part in parts])
    return torch.from_numpy(index).view(height, width)


def texel_integrals(envmap: Tensor, height: int, width: int, rotate_deg: float = 0.0) -> Tensor:
    """Integrate a map's radiance over the texels of another grid: [height, width, 3] float64.

    `rotate_deg` is added to every azimuth of the map. The integrals are exact for a map that is constant over
    each of its pixels, for any sizes and angle.
    """
    return _texels_of_rows(_row_integrals(envmap, height), width, rotate_deg)


def _row_integrals(envmap: Tensor, height: int) -> Tensor:
    """Integrate a map over rows of elevation, cumulatively over azimuth: [height, W + 1, 3]."""
    envmap = torch.as_tensor(envmap)
    old, new = _row_edges(envmap.shape[0]), _row_edges(height)
    top, bottom = torch.minimum(new[:-1, None], old[:-1]), torch.maximum(new[1:, None], old[1:])
    overlap = (top - bottom).clamp(min=0)  # [height, H] of sin(elevation)
    parts = [
        torch.einsum("nh,hwc->nwc", overlap, part.double())
        for part in torch.split(envmap.cpu(), _COLUMNS_AT_ONCE, dim=1)
    ]
    up_to = torch.cat(parts, 1).cumsum(1) * (2 * math.pi / envmap.shape[1])
    return torch.cat([torch.zeros(height, 1, 3, dtype=torch.float64), up_to], 1)


def _texels_of_rows(up_to: Tensor, width: int, rotate_deg: float) -> Tensor:
    """Return integrals over `width` texels per row [height, width, 3] of the rotated map."""
    pixels = up_to.shape[1] - 1
    # u decreases with azimuth, so the content at u comes from the right.
    u = torch.arange(width + 1, dtype=torch.float64) / width + rotate_deg / 360
    turns = u.floor()
    position = (u - turns) * pixels
    pixel = position.long().clamp(max=pixels - 1)
    before, after = up_to[:, pixel], up_to[:, pixel + 1]
    fraction = (position - pixel)[:, None]
    edges = before + fraction * (after - before) + turns[:, None] * up_to[:, -1:]
    return edges.diff(dim=1)


def _row_edges(height: int) -> Tensor:
    """Return sin(elevation) of the edges of the rows [height + 1], from 1 down to -1."""
    return (math.pi * (0.5 - torch.arange(height + 1, dtype=torch.float64) / height)).sin()


def ball(
    envmap: Tensor, side_px: int, kind: Literal["mirror", "diffuse"] = "mirror", rotate_deg: float = 0.0
) -> Tensor:
    """Render a ball under a linear map [H, W, 3]: radiance [side, side, 3], black around the ball.

    The ball fills the square and is seen from far along +z. Both kinds reflect all light, so under a constant
    map they have the radiance of the map.
    """
    x = (torch.arange(side_px * _BALL_SAMPLES) + 0.5) * (2 / (side_px * _BALL_SAMPLES)) - 1
    y, x = torch.meshgrid(-x, x, indexing="ij")
    z2 = 1 - x * x - y * y
    normals, inside = torch.stack([x, y, z2.clamp(min=0).sqrt()], -1), z2 > 0
    radiance = torch.zeros(*inside.shape, 3)
    if kind == "mirror":
        toward_camera = torch.tensor([0.0, 0, 1])
        reflected = 2 * normals[inside][:, 2:] * normals[inside] - toward_camera
        radiance[inside] = look_up(mean_radiance(envmap, 2 * side_px, rotate_deg), reflected)
    else:
        facing = latlong_directions(_IRRADIANCE_ROWS, 2 * _IRRADIANCE_ROWS)
        sources = latlong_directions(_SOURCE_ROWS, 2 * _SOURCE_ROWS).reshape(-1, 3)
        power = texel_integrals(envmap, _SOURCE_ROWS, 2 * _SOURCE_ROWS, rotate_deg).reshape(-1, 3).float()
        irradiance = (facing @ sources.T).clamp(min=0) @ power
        radiance[inside] = look_up(irradiance / math.pi, normals[inside])
    return F.avg_pool2d(radiance.permute(2, 0, 1), _BALL_SAMPLES).permute(1, 2, 0)


def look_up(latlong: Tensor, directions: Tensor) -> Tensor:
    """Sample a map [H, W, 3] bilinearly in directions [P, 3]: [P, 3]."""
    width = latlong.shape[1]
    wrapped = torch.cat([latlong[:, -1:], latlong, latlong[:, :1]], 1).permute(2, 0, 1)[None]
    uv = direction_to_uv(directions)
    x = (uv[:, 0] * width + 1) * (2 / (width + 2)) - 1
    grid = torch.stack([x, 2 * uv[:, 1] - 1], -1)[None, None]
    return F.grid_sample(wrapped, grid, padding_mode="border", align_corners=False)[0, :, 0].T


def resampled(envmap: Tensor, height: int, rotate_deg: float = 0.0) -> Tensor:
    """Rotate a map and average it over the texels of another size [height, 2 height, 3] float32."""
    integrals = texel_integrals(envmap, height, 2 * height, rotate_deg)
    return (integrals / latlong_solid_angles(height, 2 * height, torch.float64)[..., None]).float()


def mean_radiance(envmap: Tensor, most_rows: int, rotate_deg: float) -> Tensor:
    """Rotate a map and, against aliasing, average it to at most `most_rows` rows [h, 2 h, 3]."""
    return resampled(envmap, min(most_rows, len(envmap)), rotate_deg)


def rig_triangles(lights: np.ndarray) -> np.ndarray:
    """Triangulate neighbouring lights of a rig [L, 3]: [F, 3], empty if they do not surround the face.

    If a rig is open to one side, the triangles that would close it are excluded.
    """
    from scipy.spatial import ConvexHull, QhullError  # not needed for a photo

    try:
        hull = ConvexHull(lights.astype(float))
    except (QhullError, ValueError):  # fewer than four lights, or all in a plane
        return np.zeros((0, 3), np.int64)
    triangles: np.ndarray = hull.simplices[hull.equations[:, 3] < -_FLAT].astype(np.int64)
    return triangles


def lights_around(directions: Tensor, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Return three of the lights [L, 3] around each direction [P, 3]: indices and weights [P, 3].

    The weights are float64 barycentric coordinates in a triangle of lights and sum to 1, so an image changes
    without steps as a light moves; nearest lights would change in steps. If a rig is open to one side,
    directions beyond it use only the nearest light.
    """
    nearest = (directions.double() @ lights.double().T).argmax(1)
    index = nearest[:, None].expand(-1, 3).clone()
    weights = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).repeat(len(directions), 1)
    corners = torch.from_numpy(rig_triangles(lights.numpy()))
    if not len(corners):
        return index, weights
    around = torch.linalg.pinv(lights.double()[corners].mT)  # [F, 3, 3]: from a direction to its weights
    reciprocal = around.sum(1)  # of the distance along a ray
    for first in range(0, len(directions), _DIRECTIONS_AT_ONCE):
        rows = slice(first, first + _DIRECTIONS_AT_ONCE)
        toward = directions[rows].double()
        triangle = (toward @ reciprocal.T).argmax(1)
        barycentric = torch.einsum("pij,pj->pi", around[triangle], toward)
        inside = (barycentric > _OUTSIDE).all(1)
        barycentric = barycentric.clamp(min=0)
        index[rows][inside] = corners[triangle][inside]
        weights[rows][inside] = (barycentric / barycentric.sum(1, keepdim=True).clamp_min(1e-12))[inside]
    return index, weights


class Backdrop:
    """Radiance of a map [H, W, 3] behind a frame, rendered by rows.

    Args:
        envmap: The map [h, 2 h, 3].
        size: Height and width of the frame.
        rays: Returns viewing rays of any length, camera space, of rows of the frame at another size.
        rotate_deg: Angle that is added to every azimuth of the map.
        blur: Standard deviation of a lens's blur, as a fraction of the longer side.
    """

    def __init__(
        self,
        envmap: Tensor,
        size: tuple[int, int],
        rays: Callable[[tuple[int, int], slice], Tensor],
        rotate_deg: float = 0.0,
        blur: float = 0.0,
    ) -> None:
        sigma_px = blur * max(size)
        scale = min(1.0, _SHARP_PX / sigma_px) if sigma_px else 1.0
        small = max(2, round(size[0] * scale)), max(2, round(size[1] * scale))
        self._size, self._rays, self._soft = small, rays, None
        first, last = (self._towards(slice(row, row + 1)) for row in (0, small[0] - 1))
        step = float((first[0, 0] - last[0, -1]).norm()) / math.hypot(*small)  # radians per pixel
        self._mean = mean_radiance(envmap, max(16, round(math.pi / max(step, 1e-6))), rotate_deg)
        if sigma_px:
            sigma = sigma_px * small[1] / size[1]
            drawn = in_strips(lambda rows: {"": self._drawn(rows)}, *small)[""]
            self._soft = Resized(gaussian_filter(drawn, (sigma, sigma, 0), mode="nearest"), size)

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Return rows [h, W, 3] of the frame."""
        return self._drawn(rows) if self._soft is None else self._soft[rows]

    def _towards(self, rows: slice) -> Tensor:
        return F.normalize(self._rays(self._size, rows), dim=-1)

    def _drawn(self, rows: slice) -> np.ndarray:
        directions = self._towards(rows)
        return np.asarray(look_up(self._mean, directions.reshape(-1, 3)).view(directions.shape).numpy())


NO_KEYS = RigLight(torch.zeros(0, 3), torch.zeros(0, 3))


def turned(light: RigLight, rotate_deg: float) -> RigLight:
    """Rotate a light: `rotate_deg` is added to every azimuth."""
    turn = torch.deg2rad(torch.tensor(rotate_deg))
    x, y, z = light.directions.unbind(1)
    directions = torch.stack([x * turn.cos() + z * turn.sin(), y, z * turn.cos() - x * turn.sin()], 1)
    return RigLight(directions, light.weights)


def without_keys(envmap: Tensor) -> tuple[Tensor, RigLight]:
    """Separate the key lights from a lat-long map [H, W, 3], which is unchanged if it has none."""
    rows = min(_ROWS, len(envmap))
    if 180 / rows > 2 * _REACH_DEG:  # a texel is wider than a key light
        return envmap, NO_KEYS
    small = resampled(envmap, rows)
    towards, solid = latlong_directions(rows, 2 * rows), latlong_solid_angles(rows, 2 * rows, torch.float32)
    brightness = torch.from_numpy(luminance(small.detach().numpy())).clamp_min(0)
    light = brightness * solid
    remaining, keys = torch.ones_like(light), list[Tensor]()
    for _ in range(int(1 / _SHARE)):
        left = brightness * remaining
        bright = light * remaining * (left >= _BRIGHT * left.max())
        near = bright * _within(towards, towards.view(-1, 3)[left.argmax()], _RING_DEG)
        middle = F.normalize(torch.einsum("ij,ijc->c", near, towards), dim=0)
        key = (_within(towards, middle, _REACH_DEG) & (bright > 0)).float()
        of_key = (light * key).sum()
        around = (bright * _within(towards, middle, _RING_DEG)).sum() - of_key
        if of_key <= _SHARE * light.sum() or around > _AROUND * of_key:
            break
        keys.append(key)
        remaining = remaining * (1 - key)
    if not keys:
        return envmap, NO_KEYS
    masks = torch.stack(keys)
    middles = torch.einsum("kij,ij,ijc->kc", masks, light, towards)
    weights = torch.einsum("kij,ij,ijc->kc", masks, solid, small) / torch.pi
    return small * remaining[..., None], RigLight(F.normalize(middles, dim=1), weights)


def _within(towards: Tensor, middle: Tensor, reach_deg: float) -> Tensor:
    """Return which directions [H, W, 3] lie within an angle of the middle [3]."""
    return towards @ middle >= math.cos(math.radians(reach_deg))


def rig_to_latlong(light: RigLight, height: int) -> Tensor:
    """Convert a rig's weights [L, 3] to radiance of a smooth map [height, 2 height, 3] float32.

    Three times, the gain that each light's weight lacks in the map is splatted by a Gaussian, normalised over
    the lights around a texel; then each cell is scaled to its weight. So a single light is a soft disc in its
    cell, and non-negative weights give a non-negative map. `envmap_weights` reproduces them within 1 % of the
    largest if a cell is several texels wide: for the rig of 150 lights from a height of 128. Lights of the
    same direction are one light. Negative weights (of a spherical-harmonic model) are converted separately
    and subtracted.
    """
    if bool((light.weights < 0).any()):
        above, below = (RigLight(light.directions, (s * light.weights).clamp(min=0)) for s in (1, -1))
        return rig_to_latlong(above, height) - rig_to_latlong(below, height)
    coarse = cell_rows(len(light.directions)) // 2
    rows = max(height, coarse)
    directions = light.directions.double().cpu()
    with_cell = np.unique(nearest_light(directions, coarse, 2 * coarse).numpy())
    lights = directions[with_cell]
    from scipy.spatial import cKDTree  # not needed for a photo

    tree = cKDTree(lights.numpy())
    _, nearest = tree.query(directions.numpy())
    weights = torch.zeros(len(lights), 3).index_add_(0, torch.from_numpy(nearest), light.weights.cpu())

    def lacking(envmap: Tensor) -> Tensor:
        return weights / envmap_weights(envmap, lights).clamp(min=1e-30)

    gains: list[Tensor] = []
    for _ in range(_SMOOTH_GAINS):
        gains.append(lacking(_splat(gains, tree, coarse)))
    envmap = _splat(gains, tree, rows)
    envmap *= lacking(envmap)[nearest_light(lights, rows, 2 * rows)]
    return envmap if rows == height else resampled(envmap, height)


def _splat(gains: Sequence[Tensor], lights: "cKDTree", rows: int) -> Tensor:
    """Return the product [rows, 2 rows, 3] of gains [L, 3], each a mean over the lights around a texel."""
    envmap = torch.ones(rows, 2 * rows, 3)
    for row, texels in zip(envmap, latlong_directions(rows, 2 * rows, torch.float64).numpy(), strict=True):
        distance, near = lights.query(texels, k=range(1, min(_NEIGHBOURS, lights.n) + 1))
        nearer = (distance[:, :1] ** 2 - distance**2) * lights.n / (4 * math.pi * _SPREAD**2)
        weight = torch.from_numpy(np.exp(0.5 * nearer)).float()
        for gain in gains:
            row *= torch.einsum("nk,nkc->nc", weight / weight.sum(1, keepdim=True), gain[near])
    return envmap
