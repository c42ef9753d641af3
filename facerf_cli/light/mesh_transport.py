"""A mesh as rays are cast from it and at it.

Light transport baked over a mesh: what each light brings to each vertex of a whole head.

For the synthetic stage; `transport.py` bakes the chart's texels for the training bank. Ray-cast with embree.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from facerf_cli.light.transport import OFFSET_M, BakeSettings, build_scene, occluded, on_disc, over_hemisphere

_MESH_OFFSET_M = 3e-5  # rays start so far off a vertex, where no facet has to be cleared, and
_RISE_SHARE = 0.5  # this share of its neighbours' rise, up to as much again as from a texel


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Vertices and unit normals [V, 3], triangles [F, 3]; `all_round` [V] bool are strands of hair."""

    scene: rtcore_scene.EmbreeScene
    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    all_round: np.ndarray
    edges: np.ndarray  # [E, 2], each once, strands' left out,
    beside: csr_matrix  # and as a matrix [V, V] of ones
    offset_m: np.ndarray  # [V, 1] of ray origins off the surface

    @classmethod
    def of(
        cls, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, all_round: np.ndarray
    ) -> "MeshSurface":
        """The surface of a mesh, its edges found and its scene built."""
        vertices, normals = vertices.astype(np.float32), normals.astype(np.float32)
        edges = _edges(triangles, len(vertices))
        offset_m = _mesh_offset_m(vertices, normals, edges)[:, None]
        edges = edges[~all_round[edges[:, 0]]]
        both_ways = np.concatenate([edges, edges[:, ::-1]]).T
        ones = np.ones(2 * len(edges), np.float32)
        return cls(
            build_scene(vertices, triangles),
            vertices,
            normals,
            triangles,
            all_round,
            edges,
            csr_matrix((ones, tuple(both_ways)), shape=(len(vertices), len(vertices))),
            offset_m,
        )


def _edges(triangles: np.ndarray, count: int) -> np.ndarray:
    """The edges [E, 2] of triangles among so many vertices, each once."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(pairs[:, 0].astype(np.int64) * count + pairs[:, 1])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // count, keys % count], -1)


def _mesh_offset_m(vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How far [V] rays start off the surface: beyond what its facets stand out of their smooth surface.

    Where a vertex lies in a hollow, its neighbours rise above its tangent plane, and flat facets between them
    would shadow grazing light that the smooth surface, with these normals, lets through.
    """
    span = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rise = np.zeros(len(vertices), np.float32)
    np.maximum.at(rise, edges[:, 0], np.einsum("ec,ec->e", span, normals[edges[:, 0]]))
    np.maximum.at(rise, edges[:, 1], -np.einsum("ec,ec->e", span, normals[edges[:, 1]]))
    return _MESH_OFFSET_M + np.minimum(_RISE_SHARE * rise, OFFSET_M)


_SETTINGS = BakeSettings()
_BLUR_NEIGHBOURS = 24
_SAME_SURFACE_COSINE = 0.6  # of two normals, for near vertices to share their view of the surroundings
_NO_WEIGHT = 1e-4
_STRAND_STRIDE = 5  # of a strand's vertices this many share a traced one;
_STRAND_NEAR = 4  # what a lamp gives them is a mean over so many
_CURVE_BITS = 10  # of a place along each axis, by which a mesh's vertices are ordered
_R2 = np.array([0.7548776662466927, 0.5698402909980532], np.float32)  # 1 / p, 1 / p^2 with p^3 = p + 1


@dataclass(frozen=True, eq=False)
class MeshTransport:
    """Per light and vertex, for lights of rgb 1 in `directions` [L, 3].

    visibility [L, V] float32: the share of the lamp's disc that a vertex sees, 0 where it faces away.
    baked [V] bool: what was asked for; elsewhere there is only the light that bounces off on its way there.
    sites [S]: the vertices that light bounces from and to; site_of [V]: which of these stands for each vertex
    (itself, or the nearest one of its strands of hair; 0 where there is none).
    hits [S, S]: what each site's rays over the hemisphere met; means [S, S]: a mean over near sites.
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

        Of a radiosity of 1 it is the share of the cosine-weighted hemisphere that other surfaces' outsides
        cover.
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
    all_round: np.ndarray | None = None,
) -> MeshTransport:
    """Bake the vertices [V, 3] (m) with unit normals [V, 3] of a mesh, lit from unit directions [L, 3].

    Only `wanted` [V] bool vertices are baked, and for the lights alone those that light bounces from.
    `all_round` [V] bool ones (hair) are lit on both sides, at a single ray a lamp, and only every
    `_STRAND_STRIDE`-th is traced, for the rest are near it: they are many and finer than any penumbra.
    Unless the lamps are points, shadows are smoothed by a mean over a vertex's own edges, which keeps their
    outlines off the triangles' zigzag.
    """
    count, nothing = len(vertices), np.zeros(len(vertices), bool)
    curve = _along_curve(vertices)  # inside, vertices have its order: near rays run through the same caches
    rank = np.argsort(curve)
    baked = ~nothing if wanted is None else wanted
    strand = nothing if all_round is None else all_round
    surface = MeshSurface.of(vertices[curve], normals[curve], rank[triangles], strand[curve])
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
        share = _lamp_share(surface, direction, traced, settings, shifts)
        share[strands] = share[near].mean(0)
        visibility[light] = share[rank]
    sites = np.flatnonzero(is_site)
    means = _neighbour_means(surface, receives & ~surface.all_round, settings.bounce_blur_m)
    return MeshTransport(
        directions,
        visibility,
        baked,
        sites=curve[sites],
        site_of=np.where(is_site, np.cumsum(is_site) - 1, 0)[stands_for][rank],
        hits=hits[sites][:, sites],
        means=means[sites][:, sites],
    )


def _nearest_of(vertices: np.ndarray, strands: np.ndarray, traced: np.ndarray) -> np.ndarray:
    """The traced strand vertices [k, N] nearest to each of the strands', the very nearest first."""
    if not len(strands):
        return np.zeros((1, 0), np.int64)
    ranks = range(1, min(_STRAND_NEAR, len(traced)) + 1)
    _, nearest = cKDTree(vertices[traced]).query(vertices[strands], ranks)
    return np.ascontiguousarray(traced[nearest].T)


def _spread(shifts: np.ndarray, chosen: np.ndarray, sample: int) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers [N, 1] in 0..1 for one of the samples of each of the chosen vertices.

    Each vertex's samples cover the square evenly (Roberts's R2 sequence), from its own shift [V, 2], so that
    near vertices cover what the others leave out.
    """
    numbers = (shifts[chosen] + sample * _R2) % 1
    return numbers[:, :1], numbers[:, 1:]


def _along_curve(points: np.ndarray) -> np.ndarray:
    """The ids of points [N, 3] in the order of Morton's curve (1966) through them."""
    low, size = points.min(0), max(float(np.ptp(points, 0).max()), 1e-9)
    cell = ((points - low) * ((2**_CURVE_BITS - 1) / size)).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _lamp_share(
    surface: MeshSurface,
    direction: np.ndarray,
    traced: np.ndarray,
    settings: BakeSettings,
    shifts: np.ndarray,
) -> np.ndarray:
    """The share [V] of one lamp that each vertex sees; 0 where it is not traced or faces away.

    One ray each; where neighbours disagree there is a shadow's edge, and they and theirs get the rest.
    """
    facing = surface.normals @ direction.astype(np.float32)
    lit = traced & ((facing > 0) | surface.all_round)
    share = np.zeros(len(lit), np.float32)
    first = np.flatnonzero(lit)
    share[first] = _lamp_rays(surface, first, facing, direction, settings, _spread(shifts, first, 0))
    if settings.lamp_radius_deg == 0:
        return share
    edge = np.flatnonzero(_beside(surface.edges, share, lit) & lit)
    for sample in range(1, settings.lamp_samples):
        numbers = _spread(shifts, edge, sample)
        share[edge] += _lamp_rays(surface, edge, facing, direction, settings, numbers)
    share[edge] /= settings.lamp_samples
    return lit * (share + surface.beside @ share) / (1 + surface.beside @ lit.astype(np.float32))


def _lamp_rays(
    surface: MeshSurface,
    chosen: np.ndarray,
    facing: np.ndarray,
    direction: np.ndarray,
    settings: BakeSettings,
    numbers: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Whether one ray from each of the chosen vertices [N] reaches the lamp; bool [N]."""
    side = np.where(facing[chosen] < 0, np.float32(-1), np.float32(1))[:, None]  # of a strand
    origins = surface.vertices[chosen] + surface.normals[chosen] * (side * surface.offset_m[chosen])
    rays = on_disc(direction, settings.lamp_radius_deg, *numbers)
    return ~occluded(surface.scene, origins, rays)


def _beside(edges: np.ndarray, share: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Vertices [V] bool at edges whose ends disagree in their share [V], and the neighbours of those."""
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
    """What hemisphere rays from the vertices that receive [V] bool meet: barycentric weights [V, V].

    Columns are the vertices that stand for [V] the corners of what was met.
    """
    count, samples = len(receives), settings.bounce_samples
    if samples == 0:
        return csr_matrix((count, count), dtype=np.float32)
    smooth, strands = (np.flatnonzero(receives & side) for side in (~surface.all_round, surface.all_round))
    blocks = [*_hemisphere_hits(surface, smooth, samples, shifts)]
    blocks += _hemisphere_hits(surface, strands, max(1, samples // 4), shifts)
    rows, columns, values = (np.concatenate(column) for column in zip(*blocks, strict=True))
    return csr_matrix((values, (rows, stands_for[columns])), shape=(count, count), dtype=np.float32)


def _hemisphere_hits(
    surface: MeshSurface, chosen: np.ndarray, samples: int, shifts: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Row, column and value of what each round of one ray from every chosen vertex hits."""
    normals = surface.normals[chosen]
    origins = surface.vertices[chosen] + normals * surface.offset_m[chosen]
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    strand = surface.all_round[surface.triangles[:, 0]]
    for sample in range(samples):
        rays = over_hemisphere(normals, *_spread(shifts, chosen, sample))
        hits = surface.scene.run(origins, rays, output=True)
        triangle = hits["primID"]
        front = np.einsum("nc,nc->n", rays, outward[triangle]) < 0
        # A ray that reaches an inside has left through some open rim: no light comes back.
        found = np.flatnonzero((triangle >= 0) & (front | strand[triangle]))
        u, v = hits["u"][found], hits["v"][found]
        weights = np.stack([1 - u - v, u, v], -1) / samples
        columns = surface.triangles[triangle[found]]
        yield chosen[found].repeat(3), columns.ravel(), weights.astype(np.float32).ravel()


def _neighbour_means(surface: MeshSurface, blurred: np.ndarray, sigma_m: float) -> csr_matrix:
    """A Gaussian mean [V, V] over near vertices of the same surface where `blurred` [V]; others stay."""
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
