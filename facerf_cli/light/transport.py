"""Light transport of a face, baked in UV space: visibility and bounced light per light and texel.

It is independent of the skin. embree traces the rays. All positions are in one frame: the head's, for a bake
that serves every pose.
"""

from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from scipy.ndimage import gaussian_filter

OFFSET_M = 2e-4  # distance of ray origins from the surface: above float32 precision at a head's size


@dataclass(frozen=True)
class Transport:
    """Transport per light and texel, for lights of rgb 1.

    visibility [L, T, T]: visible fraction of the area light, 0 where the texel faces away. bounce [L, T, T]:
    irradiance after one diffuse bounce off surroundings of albedo 1, in units where a surface that faces an
    unoccluded light receives 1.
    """

    visibility: np.ndarray
    bounce: np.ndarray


@dataclass(frozen=True)
class BakeSettings:
    """Rays per texel: `light_samples` over an area light, a disc of `light_radius_deg`; `bounce_samples`.

    Bounce rays cover the hemisphere. A bounce varies slowly over the face, so its noise is smoothed by a
    Gaussian of `bounce_blur_texels` or, on a mesh, of `bounce_blur_m` over nearby vertices of the same
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

    A bounce ray returns the light of the texel whose position is nearest to its hit.

    Args:
        positions: Positions of the texels [T, T, 3], in metres.
        normals: Unit [T, T, 3].
        vertices: Vertices of the occluder [V, 3], in metres.
        triangles: Triangles of the occluder [F, 3].
        directions: Unit [L, 3], toward the lights.
        settings: Numbers of samples and the size of the lights.
        seed: Seed of the samples.
    """
    from scipy.spatial import cKDTree  # not needed for a photo

    scene = build_scene(vertices, triangles)
    random = np.random.default_rng(seed)
    places, facing = (maps.reshape(-1, 3).astype(np.float32) for maps in (positions, normals))
    origins = places + facing * OFFSET_M

    visibility = np.zeros((len(directions), len(places)), np.float32)
    for light, direction in enumerate(directions):
        lit = np.flatnonzero(facing @ direction.astype(np.float32) > 0)
        for _ in range(settings.light_samples):
            numbers = random.random((len(lit), 1)), random.random((len(lit), 1))
            rays = on_disc(direction, places_on_disc(settings.light_radius_deg, *numbers))
            visibility[light, lit] += ~occluded(scene, origins[lit], rays)
    visibility /= settings.light_samples

    direct = visibility * np.clip(directions.astype(np.float32) @ facing.T, 0, None)  # [L, N]
    corners, nearest_texel = vertices[triangles], cKDTree(places)
    bounce = np.zeros_like(direct)
    for _ in range(settings.bounce_samples):
        rays = over_hemisphere(facing, random.random((len(facing), 1)), random.random((len(facing), 1)))
        hits = scene.run(origins, rays, output=True)
        hit = np.flatnonzero(hits["primID"] >= 0)
        a, b, c = np.moveaxis(corners[hits["primID"][hit]], 1, 0)
        u, v = hits["u"][hit, None], hits["v"][hit, None]
        _, texels = nearest_texel.query(a * (1 - u - v) + b * u + c * v)
        # A ray that hits the inner side of the open surface has left through its rim: no light returns.
        front = np.einsum("nc,nc->n", rays[hit], facing[texels]) < 0
        bounce[:, hit[front]] += direct[:, texels[front]]
    bounce = bounce / max(1, settings.bounce_samples)

    shape, blur = (len(directions), *positions.shape[:2]), settings.bounce_blur_texels
    return Transport(
        visibility.reshape(shape), gaussian_filter(bounce.reshape(shape), (0, blur, blur), mode="nearest")
    )


def build_scene(vertices: np.ndarray, triangles: np.ndarray) -> rtcore_scene.EmbreeScene:
    """Return an embree scene of one triangle mesh."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices[triangles].astype(np.float32))
    return scene


def occluded(
    scene: rtcore_scene.EmbreeScene,
    origins: np.ndarray,
    directions: np.ndarray,
    reach_m: np.ndarray | None = None,
) -> np.ndarray:
    """Return whether rays [N, 3] hit anything, optionally within `reach_m` [N]; bool [N]."""
    reach = None if reach_m is None else np.ascontiguousarray(reach_m, np.float32)
    rays = (np.ascontiguousarray(origins), np.ascontiguousarray(directions))
    return np.asarray(scene.run(*rays, dists=reach, query="OCCLUDED")) != -1


def first_hits_m(scene: rtcore_scene.EmbreeScene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance [N] of the first hit of rays [N, 3]; huge without a hit."""
    rays = (np.ascontiguousarray(origins), np.ascontiguousarray(directions))
    return np.asarray(scene.run(*rays, query="DISTANCE"))


def hits_within(
    scene: rtcore_scene.EmbreeScene, origins: np.ndarray, directions: np.ndarray, reach_m: float
) -> np.ndarray:
    """Return whether rays [N, 3] hit something between `OFFSET_M` and `reach_m`; bool [N]."""
    starts = np.ascontiguousarray(origins + OFFSET_M * directions, np.float32)
    hits = scene.run(starts, np.ascontiguousarray(directions, np.float32), output=True)
    return np.asarray((hits["primID"] >= 0) & (hits["tfar"] < reach_m))


PlacesOnDisc = tuple[np.ndarray, np.ndarray, np.ndarray]  # radius, cosine and sine [N, 1]


def places_on_disc(radius_deg: float, share: np.ndarray, around: np.ndarray) -> PlacesOnDisc:
    """Return points on the disc of an area light from two numbers [N, 1] in 0..1; equal for all lights."""
    radius = np.float32(np.tan(np.radians(radius_deg))) * np.sqrt(share)
    turn = 2 * np.pi * around
    return radius, np.cos(turn), np.sin(turn)


def on_disc(axis: np.ndarray, places: PlacesOnDisc) -> np.ndarray:
    """Return unit directions [N, 3] to points on the disc of an area light.

    `axis` is the direction to its middle: [3], or [N, 3] for a near light.
    """
    axis = axis.astype(np.float32)
    tangent, bitangent = (side.astype(np.float32) for side in tangents(np.atleast_2d(axis)))
    radius, cosine, sine = places
    rays = axis + radius * (cosine * tangent + sine * bitangent)
    return (rays / np.sqrt((rays * rays).sum(-1, keepdims=True))).astype(np.float32)


def over_hemisphere(normals: np.ndarray, share: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Map two uniform numbers [N, 1] in 0..1 to a direction [N, 3] in a cosine lobe around each normal."""
    tangent, bitangent = tangents(normals)
    radius = np.sqrt(share)
    turn = 2 * np.pi * around
    rays = np.sqrt(1 - radius**2) * normals + radius * (np.cos(turn) * tangent + np.sin(turn) * bitangent)
    return rays.astype(np.float32)


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors [N, 3] each, orthogonal to unit normals [N, 3]."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    return tangent, np.cross(normals, tangent)
