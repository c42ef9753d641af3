"""Light transport of a whole head, baked at the vertices of its mesh, for the synthetic light stage.

`transport.py` bakes texels in UV space for the training bank. Rays are cast with embree.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from facerf_cli.light.transport import (
    OFFSET_M,
    BakeSettings,
    build_scene,
    occluded,
    on_disc,
    over_hemisphere,
    places_on_disc,
)

# Rays start off a vertex by `_MESH_OFFSET_M` plus this share of the rise of its neighbours, up to `OFFSET_M`.
_MESH_OFFSET_M = 3e-5
_RISE_SHARE = 0.5
_BLUR_NEIGHBOURS = 24  # vertices over which bounced light is smoothed
_SAME_SURFACE_COSINE = 0.6  # of two normals, from which on near vertices share bounced light
_NO_WEIGHT = 1e-4  # below it an entry of a mean is left out
_STRAND_STRIDE = 5  # of this many vertices of hair one is traced
_THROUGH_HAIR = 0.12  # share of light that hair between a point and a light lets through
_STRAND_NEAR = 4  # traced vertices of which the visibility of a vertex of hair is a mean
_CURVE_BITS = 10  # of a position along each axis, by which vertices are ordered
_R2 = np.array([0.7548776662466927, 0.5698402909980532], np.float32)  # 1 / p, 1 / p^2 with p^3 = p + 1
_SETTINGS = BakeSettings()


@dataclass(frozen=True, eq=False)
class MeshTransport:
    """Transport of each light and vertex, for lights of rgb 1 from `directions` [L, 3].

    visibility [L, V] float32: the share of the area light that is visible, 0 where the vertex faces away.
    baked [V] bool: the wanted vertices; others have transport only where light bounces off them to these.
    sites [S]: the vertices from and to which light bounces; site_of [V]: the index of the site that
    represents each vertex (itself, or the nearest site in the hair; 0 if there is none). hits [S, S]: weights
    of the sites that each site's rays hit; means [S, S]: a mean over near sites.
    """

    directions: np.ndarray
    visibility: np.ndarray
    baked: np.ndarray
    sites: np.ndarray
    site_of: np.ndarray
    hits: csr_matrix
    means: csr_matrix

    def gathered(self, radiosity: np.ndarray) -> np.ndarray:
        """Irradiance [S, K] that the sites receive from each other's radiosity [S, K].

        For a radiosity of 1 it is the share of the cosine-weighted hemisphere that the outer sides of
        surfaces cover.
        """
        return np.asarray(self.means @ (self.hits @ radiosity))


def bake_mesh(
    vertices: np.ndarray,
    normals: np.ndarray,
    triangles: np.ndarray,
    directions: np.ndarray,
    settings: BakeSettings = _SETTINGS,
    seed: int = 0,
    wanted: np.ndarray | None = None,
    two_sided: np.ndarray | None = None,
    clearance_m: np.ndarray | None = None,
) -> MeshTransport:
    """Bake the light transport of a mesh's vertices.

    Unless the lights are points, shadows are smoothed by a mean over the edges of a vertex, which removes the
    zigzag of the triangles.

    Args:
        vertices: [V, 3], in metres.
        normals: Unit [V, 3].
        triangles: [F, 3].
        directions: Unit [L, 3], toward the lights.
        settings: Samples, and the size of the lights.
        seed: Of the samples.
        wanted: Vertices [V] bool to bake, by default all; of others, from which light bounces to them, the
            visibility alone.
        two_sided: Vertices [V] bool (hair) lit on both sides, with a single ray per light; only every
            `_STRAND_STRIDE`-th of them is traced: they are many, close together and finer than any penumbra.
        clearance_m: Distance [V] off the surface at which rays start, at least.
    """
    count, nothing = len(vertices), np.zeros(len(vertices), bool)
    curve = _along_curve(vertices)  # the order of vertices below: near rays use the same caches
    rank = np.argsort(curve)
    baked = ~nothing if wanted is None else wanted
    strand = nothing if two_sided is None else two_sided
    clearance_m = np.zeros(count) if clearance_m is None else clearance_m
    surface = MeshSurface(vertices[curve], normals[curve], rank[triangles], strand[curve], clearance_m[curve])
    shifts = np.random.default_rng(seed).random((count, 2), np.float32)[curve]
    strands, traced_strands = rank[np.flatnonzero(strand)], rank[np.flatnonzero(strand)[::_STRAND_STRIDE]]
    near = _nearest_of(surface.vertices, strands, traced_strands)
    stands_for = np.arange(count)
    stands_for[strands] = near[0]
    receives = nothing.copy()
    receives[stands_for[baked[curve]]] = True
    hits = _hits(surface, receives, stands_for, settings, shifts)
    is_site = receives | (np.bincount(hits.indices, minlength=count) > 0)
    traced = is_site.copy()
    traced[traced_strands] = True
    visibility = np.empty((len(directions), count), np.float32)
    for light, direction in enumerate(directions):
        share = _visible_share(surface, direction, traced, settings, shifts)
        share[strands] = share[near].mean(0)
        visibility[light] = share[rank]
    sites = np.flatnonzero(is_site)
    means = _neighbour_means(surface, receives & ~surface.two_sided, settings.bounce_blur_m)
    return MeshTransport(
        directions,
        visibility,
        baked,
        sites=curve[sites],
        site_of=np.where(is_site, np.cumsum(is_site) - 1, 0)[stands_for][rank],
        hits=hits[sites][:, sites],
        means=means[sites][:, sites],
    )


class MeshSurface:
    """A mesh from and at which rays are cast: vertices, in metres, unit normals [V, 3], triangles [F, 3].

    `two_sided` [V] bool vertices are strands of hair, lit on both sides; rays start off the surface by at
    least `clearance_m` [V].
    """

    def __init__(
        self,
        vertices: np.ndarray,
        normals: np.ndarray,
        triangles: np.ndarray,
        two_sided: np.ndarray,
        clearance_m: np.ndarray,
    ) -> None:
        vertices, normals = vertices.astype(np.float32), normals.astype(np.float32)
        self.vertices, self.normals, self.triangles, self.two_sided = vertices, normals, triangles, two_sided
        self.scene = build_scene(vertices, triangles)
        self.solid = build_scene(vertices, triangles[~two_sided[triangles[:, 0]]])  # without hair
        edges = _edges(triangles, len(vertices))
        offset_m = np.maximum(_mesh_offset_m(vertices, normals, edges), clearance_m)[:, None]
        self.offset_m = offset_m.astype(np.float32)  # [V, 1] of ray origins off the surface
        self.edges = edges[~two_sided[edges[:, 0]]]  # [E, 2], each once, without those of hair
        both_ways = np.concatenate([self.edges, self.edges[:, ::-1]]).T
        ones = np.ones(2 * len(self.edges), np.float32)
        self.neighbours = csr_matrix((ones, tuple(both_ways)), shape=(len(vertices), len(vertices)))


def _edges(triangles: np.ndarray, count: int) -> np.ndarray:
    """Edges [E, 2] of the triangles of `count` vertices, each once."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(pairs[:, 0].astype(np.int64) * count + pairs[:, 1])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // count, keys % count], -1)


def _mesh_offset_m(vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Distance [V] off the surface at which rays start, to clear its flat facets.

    In a hollow the neighbours of a vertex rise above its tangent plane, and the facets between them would
    block grazing light that does not hit the smooth surface which the normals describe.
    """
    span = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rise = np.zeros(len(vertices), np.float32)
    np.maximum.at(rise, edges[:, 0], np.einsum("ec,ec->e", span, normals[edges[:, 0]]))
    np.maximum.at(rise, edges[:, 1], -np.einsum("ec,ec->e", span, normals[edges[:, 1]]))
    return _MESH_OFFSET_M + np.minimum(_RISE_SHARE * rise, OFFSET_M)


def _nearest_of(vertices: np.ndarray, strands: np.ndarray, traced: np.ndarray) -> np.ndarray:
    """The traced vertices [k, N] that are nearest to each vertex of hair, the nearest first."""
    if not len(strands):
        return np.zeros((1, 0), np.int64)
    ranks = range(1, min(_STRAND_NEAR, len(traced)) + 1)
    _, nearest = cKDTree(vertices[traced]).query(vertices[strands], ranks)
    return np.ascontiguousarray(traced[nearest].T)


def _spread(shifts: np.ndarray, chosen: np.ndarray, sample: int) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers [N, 1] in 0..1 for one sample of each chosen vertex.

    The samples of a vertex cover the square evenly (Roberts's R2 sequence), shifted by a random shift [V, 2]
    of the vertex, so that near vertices have different samples.
    """
    numbers = (shifts[chosen] + sample * _R2) % 1
    return numbers[:, :1], numbers[:, 1:]


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Indices of points [N, 3] in the order of Morton's curve (1966) through them."""
    low, size = points.min(0), max(float(np.ptp(points, 0).max()), 1e-9)
    cell = ((points - low) * ((2**_CURVE_BITS - 1) / size)).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _visible_share(
    surface: MeshSurface,
    direction: np.ndarray,
    traced: np.ndarray,
    settings: BakeSettings,
    shifts: np.ndarray,
) -> np.ndarray:
    """Share [V] of an area light that is visible from each vertex; 0 if it is not traced or faces away.

    Each vertex gets one ray. Where neighbours disagree lies the edge of a shadow: they and their neighbours
    get the remaining rays.
    """
    facing = surface.normals @ direction.astype(np.float32)
    lit = traced & ((facing > 0) | surface.two_sided)
    share = np.zeros(len(lit), np.float32)
    first = np.flatnonzero(lit)
    share[first] = _visible_by_one_ray(surface, first, facing, direction, settings, _spread(shifts, first, 0))
    if settings.light_radius_deg == 0:
        return share
    edge = np.flatnonzero(_shadow_edges(surface.edges, share, lit) & lit)
    for sample in range(1, settings.light_samples):
        numbers = _spread(shifts, edge, sample)
        share[edge] += _visible_by_one_ray(surface, edge, facing, direction, settings, numbers)
    share[edge] /= settings.light_samples
    return lit * (share + surface.neighbours @ share) / (1 + surface.neighbours @ lit.astype(np.float32))


def _visible_by_one_ray(
    surface: MeshSurface,
    chosen: np.ndarray,
    facing: np.ndarray,
    direction: np.ndarray,
    settings: BakeSettings,
    numbers: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Share of light [N] that reaches each chosen vertex along a ray: 0, 1, or what hair lets through."""
    side = np.where(facing[chosen] < 0, np.float32(-1), np.float32(1))[:, None]  # of hair
    origins = surface.vertices[chosen] + surface.normals[chosen] * (side * surface.offset_m[chosen])
    rays = on_disc(direction, places_on_disc(settings.light_radius_deg, *numbers))
    blocked = occluded(surface.scene, origins, rays)
    passed = (~blocked).astype(np.float32)
    if surface.two_sided.any():
        hairy = np.flatnonzero(blocked)
        passed[hairy] = _THROUGH_HAIR * ~occluded(surface.solid, origins[hairy], rays[hairy])
    return passed


def _shadow_edges(edges: np.ndarray, share: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Vertices [V] bool whose share [V] differs from that of a neighbour, and their neighbours."""
    start, end = edges.T
    found = np.zeros(len(share), bool)
    differ = (share[start] != share[end]) & lit[start] & lit[end]
    for _ in range(2):
        found[start[differ]] = found[end[differ]] = True
        differ = found[start] != found[end]
    return found


def _hits(
    surface: MeshSurface,
    receives: np.ndarray,
    stands_for: np.ndarray,
    settings: BakeSettings,
    shifts: np.ndarray,
) -> csr_matrix:
    """Cast hemisphere rays from the vertices that receive [V] bool: barycentric weights [V, V] of the hits.

    A column is the vertex that represents a corner of the triangle that was hit (`stands_for` [V]).
    """
    count, samples = len(receives), settings.bounce_samples
    if samples == 0:
        return csr_matrix((count, count), dtype=np.float32)
    smooth, strands = (np.flatnonzero(receives & side) for side in (~surface.two_sided, surface.two_sided))
    blocks = [*_hemisphere_hits(surface, smooth, samples, shifts)]
    blocks += _hemisphere_hits(surface, strands, max(1, samples // 4), shifts)
    rows, columns, values = (np.concatenate(column) for column in zip(*blocks, strict=True))
    return csr_matrix((values, (rows, stands_for[columns])), shape=(count, count), dtype=np.float32)


def _hemisphere_hits(
    surface: MeshSurface, chosen: np.ndarray, samples: int, shifts: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield rows, columns and values of the hits of one ray from every chosen vertex, round by round."""
    normals = surface.normals[chosen]
    origins = surface.vertices[chosen] + normals * surface.offset_m[chosen]
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    strand = surface.two_sided[surface.triangles[:, 0]]
    for sample in range(samples):
        rays = over_hemisphere(normals, *_spread(shifts, chosen, sample))
        hits = surface.scene.run(origins, rays, output=True)
        triangle = hits["primID"]
        front = np.einsum("nc,nc->n", rays, outward[triangle]) < 0
        # A ray that hits an inner side has left through an open rim: no light comes back.
        found = np.flatnonzero((triangle >= 0) & (front | strand[triangle]))
        u, v = hits["u"][found], hits["v"][found]
        weights = np.stack([1 - u - v, u, v], -1) / samples
        columns = surface.triangles[triangle[found]]
        yield chosen[found].repeat(3), columns.ravel(), weights.astype(np.float32).ravel()


def _neighbour_means(surface: MeshSurface, blurred: np.ndarray, sigma_m: float) -> csr_matrix:
    """Gaussian mean [V, V] over near vertices of the same surface for `blurred` [V]; identity for others."""
    count, chosen, other = len(blurred), np.flatnonzero(blurred), np.flatnonzero(~blurred)
    if sigma_m == 0 or len(chosen) == 0:
        return csr_matrix((np.ones(count, np.float32), (np.arange(count),) * 2), shape=(count, count))
    points, normals = surface.vertices[chosen], surface.normals[chosen]
    distance, near = cKDTree(points).query(points, range(1, min(_BLUR_NEIGHBOURS, len(chosen)) + 1))
    alike = np.einsum("nc,nkc->nk", normals, normals[near]) > _SAME_SURFACE_COSINE
    weights = np.exp(-0.5 * (distance / sigma_m) ** 2) * alike + (distance == 0)
    weights /= weights.sum(1, keepdims=True)
    row = np.concatenate([chosen.repeat(near.shape[1]), other])
    column = np.concatenate([chosen[near].ravel(), other])
    value = np.concatenate([weights.ravel(), np.ones(len(other))])
    kept = value > _NO_WEIGHT
    return csr_matrix((value[kept], (row[kept], column[kept])), shape=(count, count), dtype=np.float32)
