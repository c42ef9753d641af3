"""Lenses of glasses over images."""

import numpy as np
import pytest
import torch

from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.camera import Camera
from facerf_cli.synth.head.mesh import HeadMesh, strandless
from facerf_cli.synth.renderer import Lenses, lenses_in, reflections
from facerf_cli.synth.views import StageCamera

RIG = rig_directions(150)
SIDE = 32


def lens(tilt: float = 0.0) -> Lenses:
    """One pixel of a lens seen from +z, turned about the vertical axis."""
    normal = torch.tensor([[np.sin(tilt), 0.0, np.cos(tilt)]]).float()
    return Lenses(torch.tensor([0]), normal, torch.tensor([[0.0, 0.0, 1.0]]))


@pytest.mark.parametrize("tilt_deg", [0, 20, -35])
def test_it_mirrors_the_light_at_twice_its_tilt(tilt_deg: float) -> None:
    seen, _ = reflections(lens(np.radians(tilt_deg)), RIG)
    mirrored = torch.tensor([np.sin(2 * np.radians(tilt_deg)), 0.0, np.cos(2 * np.radians(tilt_deg))]).float()
    assert int(seen[0].argmax()) == int((RIG @ mirrored).argmax())


def test_glasses_mirror_grazing_views_and_hide_what_is_behind() -> None:
    _, steep = reflections(lens(np.radians(85)), RIG)
    _, front = reflections(lens(), RIG)
    assert float(steep) < 0.6 < 0.9 < float(front)
    camera = StageCamera(Camera(SIDE * 5.0, SIDE, SIDE, SIDE / 2, SIDE / 2), torch.eye(3), torch.zeros(3))
    depth_m = np.zeros((SIDE, SIDE), np.float32)
    depth_m[: SIDE // 2] = 0.5  # something nearer than the pane above,
    depth_m[SIDE // 2 :, : SIDE // 2] = 2.0  # farther below on the left, and nothing on the right
    found = lenses_in(pane(1.0), camera, depth_m)
    shown = torch.zeros(SIDE * SIDE)
    shown[found.pixels] = 1
    shown = shown.view(SIDE, SIDE)
    assert not shown[: SIDE // 2].any()
    assert shown[SIDE // 2 + 1 : SIDE // 2 + 7, 9:23].all()  # eight pixels around the middle
    assert torch.allclose(found.normals, torch.tensor([0.0, 0, 1]).expand_as(found.normals))
    assert not len(lenses_in(None, camera, depth_m).pixels)


def test_lenses_reflect_a_constant_map_by_fresnel() -> None:
    seen, transmitted = reflections(lens(), RIG)
    even = torch.full((150,), 4 / 150)
    two_surfaces = 2 * 0.04 / 1.04  # of refractive index 1.5, with the light that goes back and forth
    assert float(seen @ even) == pytest.approx(two_surfaces, rel=1e-5)
    assert float(transmitted) == pytest.approx(1 - two_surfaces, rel=1e-5)


def pane(depth_m: float) -> HeadMesh:
    """A square of 10 cm before the camera."""
    corners = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
    points = np.column_stack([corners, np.full(4, -depth_m)])
    normals = np.broadcast_to([0.0, 0, 1], points.shape)
    return strandless("frame", points, normals, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((4, 2)))
