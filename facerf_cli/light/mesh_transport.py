"""Light transport of a whole head, baked at the vertices of its mesh, for the synthetic light stage.

`transport.py` bakes texels in UV space for the training bank. embree traces the rays.
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

# Rays start off a vertex by `_MESH_OFFSET_M` plus a fraction of its neighbours' rise, up to `OFFSET_M`.
_MESH_OFFSET_M = 3e-5
_RISE_SHARE = 0.5
_BLUR_NEIGHBOURS = 24  # vertices over which bounced light is smoothed
_SAME_SURFACE_COSINE = 0.6  # least cosine of the normals of nearby vertices that share bounced light
_NO_WEIGHT = 1e-4  # smaller entries of a mean are dropped
_STRAND_STRIDE = 5  # one of this many vertices of hair is traced
_THROUGH_HAIR = 0.12  # fraction of light that hair transmits
_STRAND_NEAR = 4  # traced vertices that are averaged for each vertex of hair
_CURVE_BITS = 10  # of a position along each axis, for the order of vertices
_R2 = np.array([0.7548776662466927, 0.5698402909980532], np.float32)  # 1 / p, 1 / p^2 with p^3 = p + 1
_SETTINGS = BakeSettings()


@dataclass(frozen=True, eq=False)
class MeshTransport:
    """Transport per light and vertex, for lights of rgb 1 from `directions` [L, 3].

    visibility [L, V] float32: visible fraction of the area light, 0 where the vertex faces away. baked [V]
    bool: the wanted vertices; the others have transport only where light bounces from them to these. sites
    [S]: the vertices from and to which light bounces; site_of [V]: the index of the site that represents each
    vertex (itself, or the nearest site in the hair; 0 if there is none). hits [S, S]: weights of the sites
    that each site's rays hit; means [S, S]: a mean over nearby sites.
    """

    directions: np.ndarray
    visibility: np.ndarray
    baked: np.ndarray
    sites: np.ndarray
    site_of: np.ndarray
    hits: csr_matrix
    means: csr_matrix

    def gathered(self, radiosity: np.ndarray) -> np.ndarray:
        """Return the irradiance [S, K] that the sites receive from each other's radiosity [S, K].

        For a radiosity of 1, it is the fraction of the cosine-weighted hemisphere that the outer sides of
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

    Unless the lights are points, shadows are averaged over the edges of a vertex, which removes the zigzag of
    the triangles.

    Args:
        vertices: [V, 3], in metres.
        normals: Unit [V, 3].
        triangles: [F, 3].
        directions: Unit [L, 3], toward the lights.
        settings: Numbers of samples and the size of the lights.
        seed: Seed of the samples.
        wanted: Vertices [V] bool to bake, by default all. Vertices from which light bounces to them get only
            their visibility.
        two_sided: Vertices [V] bool (hair) lit on both sides, with one ray per light. Only one in
            `_STRAND_STRIDE` of them is traced, because they are many, close together and finer than any
            penumbra.
        clearance_m: Least distance [V] off the surface at which rays start.
    """
    count, nothing = len(vertices), np.zeros(len(vertices), bool)
    curve = _along_curve(vertices)  # nearby rays use the same processor caches
    rank = np.argsort(curve)
    baked = ~nothing if wanted is None else wanted
    strand = nothing if two_sided is None else two_sided
    clearance_m = np.zeros(count) if clearance_m is None else clearance_m
    shifts = np.random.default_rng(seed).random((count, 2), np.float32)[curve]
    mesh = _Mesh(
        vertices[curve], normals[curve], rank[triangles], strand[curve], clearance_m[curve], shifts, settings
    )
    strands, traced_strands = rank[np.flatnonzero(strand)], rank[np.flatnonzero(strand)[::_STRAND_STRIDE]]
    near = _nearest_of(mesh.vertices, strands, traced_strands)
    represented_by = np.arange(count)
    represented_by[strands] = near[0]
    receives = nothing.copy()
    receives[represented_by[baked[curve]]] = True
    hits = mesh.hits(receives, represented_by)
    is_site = receives | (np.bincount(hits.indices, minlength=count) > 0)
    traced = is_site.copy()
    traced[traced_strands] = True
    visibility = np.empty((len(directions), count), np.float32)
    for light, direction in enumerate(directions):
        visible = mesh.visibility(direction.astype(np.float32), traced)
        visible[strands] = visible[near].mean(0)
        visibility[light] = visible[rank]
    sites = np.flatnonzero(is_site)
    means = mesh.means(receives & ~mesh.two_sided)
    return MeshTransport(
        directions,
        visibility,
        baked,
        sites=curve[sites],
        site_of=np.where(is_site, np.cumsum(is_site) - 1, 0)[represented_by][rank],
        hits=hits[sites][:, sites],
        means=means[sites][:, sites],
    )


class _Mesh:
    """Mesh from which rays are cast: vertices in metres and unit normals [V, 3], triangles [F, 3].

    `two_sided` [V] bool vertices are strands of hair, lit on both sides. Rays start at least `clearance_m`
    [V] off the surface. `shifts` [V, 2] are random numbers in 0..1.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        normals: np.ndarray,
        triangles: np.ndarray,
        two_sided: np.ndarray,
        clearance_m: np.ndarray,
        shifts: np.ndarray,
        settings: BakeSettings,
    ) -> None:
        vertices, normals = vertices.astype(np.float32), normals.astype(np.float32)
        self.vertices, self.normals, self.triangles, self.two_sided = vertices, normals, triangles, two_sided
        self._shifts, self._settings = shifts, settings
        self._scene = build_scene(vertices, triangles)
        self._without_hair = build_scene(vertices, triangles[~two_sided[triangles[:, 0]]])
        edges = _edges(triangles, len(vertices))
        offset_m = np.maximum(_mesh_offset_m(vertices, normals, edges), clearance_m)[:, None]
        self._offset_m = offset_m.astype(np.float32)  # [V, 1] of ray origins off the surface
        self._edges = edges[~two_sided[edges[:, 0]]]  # [E, 2], each once, without those of hair
        both_ways = np.concatenate([self._edges, self._edges[:, ::-1]]).T
        ones = np.ones(2 * len(self._edges), np.float32)
        self._neighbours = csr_matrix((ones, tuple(both_ways)), shape=(len(vertices), len(vertices)))

    def visibility(self, direction: np.ndarray, traced: np.ndarray) -> np.ndarray:
        """Return the visible fraction [V] of an area light; 0 for vertices not traced or facing away.

        Each vertex gets one ray. Where neighbours disagree, a shadow has its edge: these vertices and their
        neighbours get the remaining rays.
        """
        samples, facing = self._settings.light_samples, self.normals @ direction
        lit = traced & ((facing > 0) | self.two_sided)
        visible = np.zeros(len(lit), np.float32)
        first = np.flatnonzero(lit)
        visible[first] = self._visible_by_one_ray(first, facing, direction, 0)
        if self._settings.light_radius_deg == 0:
            return visible
        edge = np.flatnonzero(_shadow_edges(self._edges, visible, lit) & lit)
        for sample in range(1, samples):
            visible[edge] += self._visible_by_one_ray(edge, facing, direction, sample)
        visible[edge] /= samples
        return lit * (visible + self._neighbours @ visible) / (1 + self._neighbours @ lit.astype(np.float32))

    def _visible_by_one_ray(
        self, chosen: np.ndarray, facing: np.ndarray, direction: np.ndarray, sample: int
    ) -> np.ndarray:
        """Return the light [N] that reaches each chosen vertex along a ray; hair transmits a fraction."""
        side = np.where(facing[chosen] < 0, np.float32(-1), np.float32(1))[:, None]  # of hair
        origins = self.vertices[chosen] + self.normals[chosen] * (side * self._offset_m[chosen])
        disc = places_on_disc(self._settings.light_radius_deg, *self._numbers(chosen, sample))
        rays = on_disc(direction, disc)
        blocked = occluded(self._scene, origins, rays)
        passed = (~blocked).astype(np.float32)
        if self.two_sided.any():
            hairy = np.flatnonzero(blocked)
            passed[hairy] = _THROUGH_HAIR * ~occluded(self._without_hair, origins[hairy], rays[hairy])
        return passed

    def _numbers(self, chosen: np.ndarray, sample: int) -> tuple[np.ndarray, np.ndarray]:
        """Return two numbers [N, 1] in 0..1 for one sample of each chosen vertex.

        The samples of a vertex cover the square evenly (Roberts's R2 sequence). Their random shift makes the
        samples of nearby vertices differ.
        """
        numbers = (self._shifts[chosen] + sample * _R2) % 1
        return numbers[:, :1], numbers[:, 1:]

    def hits(self, receives: np.ndarray, represented_by: np.ndarray) -> csr_matrix:
        """Cast hemisphere rays from vertices [V] bool; return the hits' barycentric weights [V, V].

        A column is the vertex that represents a corner of the triangle that was hit.
        """
        count, samples = len(receives), self._settings.bounce_samples
        if samples == 0:
            return csr_matrix((count, count), dtype=np.float32)
        smooth, strands = (np.flatnonzero(receives & side) for side in (~self.two_sided, self.two_sided))
        blocks = [*self._hemisphere_hits(smooth, samples)]
        blocks += self._hemisphere_hits(strands, max(1, samples // 4))
        rows, columns, values = (np.concatenate(column) for column in zip(*blocks, strict=True))
        return csr_matrix((values, (rows, represented_by[columns])), shape=(count, count), dtype=np.float32)

    def _hemisphere_hits(
        self, chosen: np.ndarray, samples: int
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield rows, columns and values of the hits of one ray from every chosen vertex, per sample."""
        normals = self.normals[chosen]
        origins = self.vertices[chosen] + normals * self._offset_m[chosen]
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        outward = np.cross(b - a, c - a)
        strand = self.two_sided[self.triangles[:, 0]]
        for sample in range(samples):
            rays = over_hemisphere(normals, *self._numbers(chosen, sample))
            hits = self._scene.run(origins, rays, output=True)
            triangle = hits["primID"]
            front = np.einsum("nc,nc->n", rays, outward[triangle]) < 0
            # A ray that hits an inner side has left through an open rim: no light returns.
            hit = np.flatnonzero((triangle >= 0) & (front | strand[triangle]))
            u, v = hits["u"][hit], hits["v"][hit]
            weights = np.stack([1 - u - v, u, v], -1) / samples
            columns = self.triangles[triangle[hit]]
            yield chosen[hit].repeat(3), columns.ravel(), weights.astype(np.float32).ravel()

    def means(self, blurred: np.ndarray) -> csr_matrix:
        """Return a Gaussian mean [V, V] over nearby vertices of the same surface, for [V] bool vertices."""
        sigma_m = self._settings.bounce_blur_m
        count, chosen, other = len(blurred), np.flatnonzero(blurred), np.flatnonzero(~blurred)
        if sigma_m == 0 or len(chosen) == 0:
            return csr_matrix((np.ones(count, np.float32), (np.arange(count),) * 2), shape=(count, count))
        points, normals = self.vertices[chosen], self.normals[chosen]
        distance, near = cKDTree(points).query(points, range(1, min(_BLUR_NEIGHBOURS, len(chosen)) + 1))
        alike = np.einsum("nc,nkc->nk", normals, normals[near]) > _SAME_SURFACE_COSINE
        weights = np.exp(-0.5 * (distance / sigma_m) ** 2) * alike + (distance == 0)
        weights /= weights.sum(1, keepdims=True)
        row = np.concatenate([chosen.repeat(near.shape[1]), other])
        column = np.concatenate([chosen[near].ravel(), other])
        value = np.concatenate([weights.ravel(), np.ones(len(other))])
        kept = value > _NO_WEIGHT
        return csr_matrix((value[kept], (row[kept], column[kept])), shape=(count, count), dtype=np.float32)


def _edges(triangles: np.ndarray, count: int) -> np.ndarray:
    """Return the edges [E, 2] of the triangles of `count` vertices, each once."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(pairs[:, 0].astype(np.int64) * count + pairs[:, 1])  # faster than `np.unique`
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // count, keys % count], -1)


def _mesh_offset_m(vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the distance [V] off the surface at which rays clear its flat facets.

    In a hollow, the neighbours of a vertex rise above its tangent plane. The facets between them would block
    grazing light that does not hit the smooth surface, which the normals describe.
    """
    span = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rise = np.zeros(len(vertices), np.float32)
    np.maximum.at(rise, edges[:, 0], np.einsum("ec,ec->e", span, normals[edges[:, 0]]))
    np.maximum.at(rise, edges[:, 1], -np.einsum("ec,ec->e", span, normals[edges[:, 1]]))
    return _MESH_OFFSET_M + np.minimum(_RISE_SHARE * rise, OFFSET_M)


def _nearest_of(vertices: np.ndarray, strands: np.ndarray, traced: np.ndarray) -> np.ndarray:
    """Return the traced vertices [k, N] nearest to each vertex of hair, the nearest first."""
    if not len(strands):
        return np.zeros((1, 0), np.int64)
    ranks = range(1, min(_STRAND_NEAR, len(traced)) + 1)
    _, nearest = cKDTree(vertices[traced]).query(vertices[strands], ranks)
    return np.ascontiguousarray(traced[nearest].T)


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Return the indices of points [N, 3] in the order of Morton's curve (1966) through them."""
    low, size = points.min(0), max(float(np.ptp(points, 0).max()), 1e-9)
    cell = ((points - low) * ((2**_CURVE_BITS - 1) / size)).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _shadow_edges(edges: np.ndarray, visible: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return the vertices [V] bool that differ from a neighbour, and their neighbours."""
    start, end = edges.T
    marked = np.zeros(len(visible), bool)
    differ = (visible[start] != visible[end]) & lit[start] & lit[end]
    for _ in range(2):
        marked[start[differ]] = marked[end[differ]] = True
        differ = marked[start] != marked[end]
    return marked
