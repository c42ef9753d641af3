"""Simple bodies of one material, and a camera that looks at them."""

from dataclasses import replace

import numpy as np
import torch
import trimesh

from facerf_cli.face.topology import GRID
from facerf_cli.light.mesh_transport import MeshTransport
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, strandless
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.renderer import images_under, light_of, view_of
from facerf_cli.synth.shading import Material
from facerf_cli.synth.views import StageCamera


def material(
    albedo: float | tuple[float, float, float] = 0.5,
    specular: float = 0.04,
    roughness: float = 0.4,
    relief: tuple[float, float] = (0.0, 0.0),
) -> Material:
    """A material that is the same everywhere."""
    one = torch.ones(1, 8, 8)
    colour, slopes = (torch.tensor(x).view(-1, 1, 1) * one for x in (albedo, relief))
    return Material(colour.expand(3, 8, 8), specular * one, roughness * one, slopes)


def appearance(one: Material, scattering_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Appearance:
    """All parts of one material."""
    return Appearance(dict.fromkeys(PARTS, one), torch.tensor(scattering_mm), {})


def ball(radius_m: float = 0.05, divisions: int = 4) -> HeadMesh:
    sphere = trimesh.creation.icosphere(divisions, radius_m)
    points = np.array(sphere.vertices)
    return strandless("skin", points, points, np.array(sphere.faces), np.full((len(points), 2), 0.5))


def square(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u (right) and v (down) [N, N] of the vertices of a square that faces the viewer, and its triangles."""
    v, u = np.meshgrid(*2 * [np.linspace(0, 1, count)], indexing="ij")
    cells = np.arange(count * count).reshape(count, count)[:-1, :-1].ravel()
    first = np.stack([cells, cells + count, cells + count + 1], -1)
    second = np.stack([cells, cells + count + 1, cells + 1], -1)
    return u, v, np.concatenate([first, second])


def camera(
    side_px: int = 64, field_m: float = 0.12, distance_m: float = 10.0, yaw_deg: float = 0.0
) -> StageCamera:
    """A camera far away that shows a square of `field_m` around the origin."""
    lens = Camera(side_px * distance_m / field_m, side_px, side_px, side_px / 2, side_px / 2)
    return StageCamera(lens, pose_to_rotation(yaw_deg, 0, 0), torch.tensor([0.0, 0, -distance_m]))


def with_materials(person: Appearance, **factors: float) -> Appearance:
    """Return a person with fields of all materials multiplied by factors."""
    materials = {
        name: replace(part, **{field: factor * getattr(part, field) for field, factor in factors.items()})
        for name, part in person.materials.items()
    }
    return replace(person, materials=materials)


def person_of(mesh: HeadMesh, person: Appearance) -> SyntheticPerson:
    return SyntheticPerson(mesh, person, torch.eye(3), torch.zeros(GRID * GRID, 3), np.zeros((68, 3)), {}, {})


def photograph(
    mesh: HeadMesh, person: Appearance, transport: MeshTransport, camera: StageCamera, highlights: int = 12
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render images [L, 3, S, S] in each light, and coverage [S, S]."""
    subject = person_of(mesh, person)
    view, surface = view_of(subject, light_of(subject, transport), camera)
    single = torch.eye(len(transport.directions))[..., None].expand(-1, -1, 3)
    return images_under(view, surface, single, highlights), view.alpha
