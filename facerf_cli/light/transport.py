"""Light transport of a face, baked in UV space: the visibility and the bounced light of each light and texel.

It is independent of the skin. Rays are cast with embree. All positions are in one frame: for a bake that
serves every pose, the head's.
"""

from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from scipy.ndimage import gaussian_filter

OFFSET_M = 2e-4  # by which rays start off the surface: more than a step of float32 at the size of a head


@dataclass(frozen=True)
class Transport:
    """Transport of each light and texel, for lights of rgb 1.

    visibility [L, T, T]: the share of the area light that is visible, 0 where the texel faces away.
    bounce [L, T, T]: irradiance after one diffuse bounce off surroundings of albedo 1, in units where a
    surface that faces an unoccluded light receives 1.
    """

    visibility: np.ndarray
    bounce: np.ndarray


@dataclass(frozen=True)
class BakeSettings:
    """Rays per texel: `light_samples` over an area light, a disc of `light_radius_deg`; `bounce_samples`.

    Rays of the bounce cover the hemisphere. A bounce varies slowly over the face, so its noise is smoothed by
    a Gaussian of `bounce_blur_texels`, or, on a mesh, of `bounce_blur_m` over near vertices of the same
    surface.
    """

    light_samples: int = 4
    light_radius_deg: float = 1.5
    bounce_samples: int = 16
    bounce_blur_texels: float = 1.5
    bounce_blur_m: float = 0.002


def bake_transport(
    positions: np.ndarray,
    normals: np.ndarray,
    vertices: np.ndarray,
    triangles: np.ndarray,
    directions: np.ndarray,
    settings: BakeSettings = BakeSettings(),
    seed: int = 0,
) -> Transport:
    """Bake the light transport of texels under an occluder.

    A ray of the bounce takes the light of the texel whose position is nearest to its hit.

    Args:
        positions: Of the texels [T, T, 3], in metres.
        normals: Unit [T, T, 3].
        vertices: Of the occluder [V, 3], in metres.
        triangles: Of the occluder [F, 3].
        directions: Unit [L, 3], toward the lights.
        settings: Samples, and the size of the lights.
        seed: Of the samples.
    """
    scene = build_scene(vertices, triangles)
    random = np.random.default_rng(seed)
    flat_positions = positions.reshape(-1, 3).astype(np.float32)
    flat_normals = normals.reshape(-1, 3).astype(np.float32)
    visibility = _light_visibility(scene, flat_positions, flat_normals, directions, settings, random)
    direct = visibility * np.clip(directions.astype(np.float32) @ flat_normals.T, 0, None)  # [L, N]
    bounce = _one_bounce(scene, flat_positions, flat_normals, vertices[triangles], direct, settings, random)
    shape = (len(directions), *positions.shape[:2])
    blur = settings.bounce_blur_texels
    smooth_bounce = gaussian_filter(bounce.reshape(shape), (0, blur, blur), mode="nearest")
    return Transport(visibility.reshape(shape), smooth_bounce)


def _light_visibility(
    scene: rtcore_scene.EmbreeScene,
    positions: np.ndarray,
    normals: np.ndarray,
    directions: np.ndarray,
    settings: BakeSettings,
    random: np.random.Generator,
) -> np.ndarray:
    """Share of unoccluded samples of each area light [L, N]."""
    visibility = np.zeros((len(directions), len(positions)), np.float32)
    origins = positions + normals * OFFSET_M
    for light, direction in enumerate(directions):
        facing = np.flatnonzero(normals @ direction.astype(np.float32) > 0)
        for _ in range(settings.light_samples):
            numbers = random.random((len(facing), 1)), random.random((len(facing), 1))
            rays = on_disc(direction, places_on_disc(settings.light_radius_deg, *numbers))
            visibility[light, facing] += ~occluded(scene, origins[facing], rays)
    return visibility / settings.light_samples


def _one_bounce(
    scene: rtcore_scene.EmbreeScene,
    positions: np.ndarray,
    normals: np.ndarray,
    corners: np.ndarray,
    direct: np.ndarray,
    settings: BakeSettings,
    random: np.random.Generator,
) -> np.ndarray:
    """Mean [L, N] of the direct irradiance [L, N] over the hits of a cosine-weighted hemisphere."""
    from scipy.spatial import cKDTree  # a photo does without it

    nearest_texel = cKDTree(positions)
    origins = positions + normals * OFFSET_M
    bounce = np.zeros_like(direct)
    for _ in range(settings.bounce_samples):
        rays = over_hemisphere(normals, random.random((len(normals), 1)), random.random((len(normals), 1)))
        hits = scene.run(origins, rays, output=True)
        found = np.flatnonzero(hits["primID"] >= 0)
        triangles = corners[hits["primID"][found]]
        u, v = hits["u"][found, None], hits["v"][found, None]
        points = triangles[:, 0] * (1 - u - v) + triangles[:, 1] * u + triangles[:, 2] * v
        _, texels = nearest_texel.query(points)
        # A ray that hits the inner side of the open surface has left through its rim: no light comes back.
        front = np.einsum("nc,nc->n", rays[found], normals[texels]) < 0
        bounce[:, found[front]] += direct[:, texels[front]]
    return bounce / max(1, settings.bounce_samples)


def build_scene(vertices: np.ndarray, triangles: np.ndarray) -> rtcore_scene.EmbreeScene:
    """An embree scene of one triangle mesh."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices[triangles].astype(np.float32))
    return scene


def occluded(
    scene: rtcore_scene.EmbreeScene,
    origins: np.ndarray,
    directions: np.ndarray,
    reach_m: np.ndarray | None = None,
) -> np.ndarray:
    """Test rays [N, 3] for any hit, or for one within `reach_m` [N]; bool [N]."""
    reach = None if reach_m is None else np.ascontiguousarray(reach_m, np.float32)
    rays = (np.ascontiguousarray(origins), np.ascontiguousarray(directions))
    return np.asarray(scene.run(*rays, dists=reach, query="OCCLUDED")) != -1


def first_hits_m(scene: rtcore_scene.EmbreeScene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance [N] of the first hit of rays [N, 3]; huge where there is none."""
    rays = (np.ascontiguousarray(origins), np.ascontiguousarray(directions))
    return np.asarray(scene.run(*rays, query="DISTANCE"))


def hits_within(
    scene: rtcore_scene.EmbreeScene, origins: np.ndarray, directions: np.ndarray, reach_m: float
) -> np.ndarray:
    """Test if rays [N, 3] hit something between `OFFSET_M` and `reach_m`; bool [N]."""
    starts = np.ascontiguousarray(origins + OFFSET_M * directions, np.float32)
    hits = scene.run(starts, np.ascontiguousarray(directions, np.float32), output=True)
    return np.asarray((hits["primID"] >= 0) & (hits["tfar"] < reach_m))


PlacesOnDisc = tuple[np.ndarray, np.ndarray, np.ndarray]  # radius, cosine and sine [N, 1]


def places_on_disc(radius_deg: float, share: np.ndarray, around: np.ndarray) -> PlacesOnDisc:
    """Points on the disc of an area light, from two numbers [N, 1] in 0..1; the same for all lights."""
    radius = np.float32(np.tan(np.radians(radius_deg))) * np.sqrt(share)
    turn = 2 * np.pi * around
    return radius, np.cos(turn), np.sin(turn)


def on_disc(axis: np.ndarray, places: PlacesOnDisc) -> np.ndarray:
    """Unit directions [N, 3] to points on the disc of an area light.

    `axis` is the direction to its middle, [3], or [N, 3] of a near one.
    """
    axis = axis.astype(np.float32)
    tangent, bitangent = (side.astype(np.float32) for side in tangents(np.atleast_2d(axis)))
    radius, cosine, sine = places
    rays = axis + radius * (cosine * tangent + sine * bitangent)
    return (rays / np.sqrt((rays * rays).sum(-1, keepdims=True))).astype(np.float32)


def over_hemisphere(normals: np.ndarray, share: np.ndarray, around: np.ndarray) -> np.ndarray:
    """A direction [N, 3] about each normal from two numbers [N, 1]; uniform in 0..1: a cosine lobe."""
    tangent, bitangent = tangents(normals)
    radius = np.sqrt(share)
    turn = 2 * np.pi * around
    rays = np.sqrt(1 - radius**2) * normals + radius * (np.cos(turn) * tangent + np.sin(turn) * bitangent)
    return rays.astype(np.float32)


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [N, 3] each, orthogonal to unit normals [N, 3]."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    return tangent, np.cross(normals, tangent)
