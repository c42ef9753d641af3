"""Portraits shade as the bake renderer does, under any lights and appearance."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from facerf_cli.face.topology import GRID
from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.parse import MORE_LANDMARKS, class_index
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.synth import renderer
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.head.mesh import PARTS, joined, strandless
from facerf_cli.synth.portraits import (
    BakedPortrait,
    albedo_of,
    bake_subject,
    images_under,
    materials_of,
    view_of,
)
from facerf_cli.synth.renderer import RenderSettings
from facerf_cli.synth.subjects import Subject
from facerf_cli.synth.views import StageCamera
from tests.synth import shapes

EAR = "left ear top"
LIGHTS = rig_directions(24).numpy().astype(np.float64)
BAKE = BakeSettings(light_radius_deg=0, bounce_samples=8)
SIDE_PX = 48


def appearance(albedo: tuple[float, float, float] = (0.5, 0.4, 0.3)) -> Appearance:
    return shapes.appearance(shapes.material(albedo, roughness=0.45))


@pytest.fixture(scope="module")
def subject() -> Subject:
    """A ball of skin beside a board of hair, turned a little."""
    skin, (u, v, faces) = shapes.ball(), shapes.square(25)
    wall = np.stack([0.12 * u - 0.06, 0.06 - 0.12 * v, 0 * u - 0.055], -1).reshape(-1, 3)
    hair = strandless("hair", wall, np.broadcast_to([0, 0, 1.0], wall.shape), faces, np.full((625, 2), 0.5))
    hair = replace(hair, tangents=np.broadcast_to(np.float32([0, -1, 0]), wall.shape).copy())
    turn = pose_to_rotation(10, 5, 0)
    return Subject(
        joined(skin, hair),
        appearance(),
        turn,
        torch.zeros(GRID * GRID, 3),
        np.zeros((68, 3)),
        {EAR: [0, 0.02, 0]},
        {},
    )


@pytest.fixture(scope="module")
def camera() -> StageCamera:
    return shapes.camera(SIDE_PX, 0.14, yaw_deg=-15)


@pytest.fixture(scope="module")
def portrait(subject: Subject, camera: StageCamera) -> BakedPortrait:
    return view_of(subject, bake_subject(subject, [camera], LIGHTS, BAKE, 0), camera)


def photograph(portrait: BakedPortrait, look: Appearance, weights: torch.Tensor) -> torch.Tensor:
    return images_under(portrait, materials_of(portrait, look), weights[None])[0]


def weights(seed: int) -> torch.Tensor:
    return torch.rand(24, 3, generator=torch.Generator().manual_seed(seed)) ** 4 / 6


@pytest.mark.parametrize("seed", range(3))
def test_it_shades_as_the_bake_renderer_does(
    subject: Subject, camera: StageCamera, portrait: BakedPortrait, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("facerf_cli.synth.portraits._HIGHLIGHTS", 24)
    mesh, other = subject.mesh, appearance((0.3, 0.3, 0.3))
    transport = bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        LIGHTS,
        BAKE,
        0,
        two_sided=mesh.part == PARTS.index("hair"),
    )
    settings = RenderSettings(bounces=1, scattering=False, relief=False)
    olats, _ = renderer.photograph(mesh, other, transport, camera, settings)
    expected = torch.einsum("lchw,lc->chw", olats, weights(seed))
    photo = photograph(portrait, other, weights(seed))
    # Bytes of irradiance and smooth harmonics of the bounce, whose white balls tint it by one mean albedo.
    off = (photo - expected).abs()
    assert off.mean() < 0.015 * expected.mean()
    # On the rim of the ball a facet spans many angles, and the mean of products is not that of the factors.
    assert off.flatten().quantile(0.99) < 0.04 * expected.max()


def test_truth_lies_beside_the_photo(portrait: BakedPortrait) -> None:
    photo, alpha = photograph(portrait, appearance(), weights(0)), portrait.alpha
    albedo, normals = albedo_of(portrait, materials_of(portrait, appearance()))
    assert photo.shape == albedo.shape == normals.shape == (3, SIDE_PX, SIDE_PX)
    background = portrait.classes[..., class_index("background")].float() / 255
    assert (alpha + background - 1).abs().max() < 0.15  # other samples of a pixel
    assert (alpha + background - 1).abs().mean() < 0.01
    assert torch.allclose(albedo[0][alpha > 0.99], torch.tensor(0.5), atol=2e-3)
    assert (photo[:, alpha == 0] == 0).all()


def test_landmarks_and_pose_are_those_of_the_camera(subject: Subject, portrait: BakedPortrait) -> None:
    assert torch.allclose(portrait.landmarks_px[:68], torch.tensor([SIDE_PX / 2, SIDE_PX / 2]), atol=1e-3)
    ear = portrait.landmarks_px[68 + MORE_LANDMARKS.index(EAR)]
    assert portrait.landmarks_px[68:].isnan().all(1).sum() == len(MORE_LANDMARKS) - 1
    assert float(ear[1]) == pytest.approx(SIDE_PX / 2 - 0.02 / 0.14 * SIDE_PX, abs=0.05)
    assert torch.allclose(portrait.rotation, pose_to_rotation(-15, 0, 0) @ subject.head_to_world, atol=1e-6)
