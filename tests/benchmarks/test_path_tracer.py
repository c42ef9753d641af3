import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import _path_tracer as path_tracer
from _path_tracer import PathSettings

from facerf_cli.light.mesh_transport import bake_mesh
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import Camera
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.shading import Material
from facerf_cli.synth.views import StageCamera
from tests.synth.shapes import photograph, square, with_materials

LIGHTS = np.array([[-0.48, 0.36, 0.8], [-0.6, 0.0, 0.8]], np.float32)  # they miss the wall
CAMERA = StageCamera(Camera(400, 60, 40, 24.0, 25.0), torch.eye(3), torch.tensor([0.0, 0.0, -1.0]))


@pytest.fixture(autouse=True)
def _needs_mitsuba() -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (extra [dev])")


def _corner() -> HeadMesh:
    """A floor that faces +z and, 1 mm away, a wall on the right that faces -x; each 8 x 8 cm."""
    side, count = 0.08, 17
    u, v, faces = square(count)
    floor = np.stack([(u - 0.5) * side, (0.5 - v) * side, 0 * u], -1).reshape(-1, 3)
    wall = np.stack([0 * u + side / 2 + 0.001, (0.5 - v) * side, u * side], -1).reshape(-1, 3)
    normals = np.repeat(np.array([[0, 0, 1.0], [-1, 0, 0]]), count * count, 0)
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return HeadMesh(
        np.concatenate([floor, wall]).astype(np.float32),
        normals.astype(np.float32),
        np.concatenate([faces, faces + count * count]),
        np.repeat(np.array([PARTS.index("skin"), PARTS.index("cloth")], np.uint8), count * count),
        np.concatenate([uv, uv]).astype(np.float32),
        np.zeros((2 * count * count, 3), np.float32),
        np.zeros(2 * count * count, np.uint8),
    )


def _appearance() -> Appearance:
    """Each of a texture's corners has another colour; slopes in both directions."""
    corners = torch.tensor([[[0.8, 0.2], [0.5, 0.4]], [[0.1, 0.7], [0.4, 0.3]], [[0.3, 0.2], [0.9, 0.6]]])
    albedo = torch.nn.functional.interpolate(corners[None], (32, 32), mode="bilinear")[0]
    flat = torch.ones(1, 32, 32)
    slopes = torch.tensor([0.2, 0.1]).view(2, 1, 1).expand(2, 32, 32)
    material = Material(albedo, 0.05 * flat, 0.5 * flat, slopes)
    return Appearance({"skin": material, "cloth": material}, torch.zeros(3), {})


def _both(settings: PathSettings) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Images and coverage of both renderers."""
    head, person = _corner(), _appearance()
    bake = BakeSettings(light_radius_deg=0, bounce_samples=256 if settings.bounces else 0)
    transport = bake_mesh(head.vertices, head.normals, head.triangles, LIGHTS, bake)
    flat = person if settings.relief else with_materials(person, relief=0)
    return (
        *photograph(head, flat, transport, CAMERA, highlights=24 if settings.gloss else 0),
        *path_tracer.photograph(head, person, LIGHTS, CAMERA, settings),
    )


def _relative_rms(ours: torch.Tensor, theirs: torch.Tensor, coverage: torch.Tensor) -> float:
    """RMS inside the head's outline, relative to the mean there."""
    inside = coverage > 0.99
    difference = (ours - theirs)[..., inside]
    return float(difference.square().mean().sqrt() / theirs[..., inside].mean())


def test_both_cameras_see_the_same_place_in_an_image_that_is_not_square() -> None:
    plain = PathSettings(samples=64, bounces=0, gloss=False, relief=False)
    ours, coverage, theirs, their_coverage = _both(plain)
    assert ours.shape == theirs.shape == (2, 3, 40, 60) and coverage.shape == their_coverage.shape
    assert (coverage - their_coverage).abs().max() < 0.3 and 0.3 < coverage.mean() < 0.7
    assert (coverage - their_coverage).abs().mean() < 0.005
    assert _relative_rms(ours, theirs, coverage) < 0.05


def test_relief_and_bounces_are_the_same_in_both() -> None:
    settings = PathSettings(samples=256, bounces=2, gloss=False, relief=False)
    ours, coverage, theirs, _ = _both(settings)
    assert _relative_rms(ours, theirs, coverage) < 0.05
    dark, _, _, _ = _both(replace(settings, bounces=0))
    assert _relative_rms(dark, theirs, coverage) > 0.06  # the bounce is worth being measured
    bumpy, _, their_bumpy, _ = _both(PathSettings(samples=64, bounces=0, gloss=False, relief=True))
    plain, _, _, _ = _both(PathSettings(samples=1, bounces=0, gloss=False, relief=False))
    # Bumps are there to first order only, and softened on purpose.
    assert _relative_rms(bumpy, their_bumpy, coverage) < 0.6 * _relative_rms(plain, their_bumpy, coverage)


def test_highlights_are_the_same_in_both() -> None:
    glossy = PathSettings(samples=16, gloss_samples=128, bounces=0, gloss=True, relief=False)
    head, person = _corner(), _appearance()
    black = with_materials(person, albedo=0)
    bake = BakeSettings(light_radius_deg=0, bounce_samples=0)
    transport = bake_mesh(head.vertices, head.normals, head.triangles, LIGHTS, bake)
    ours, coverage = photograph(head, with_materials(black, relief=0), transport, CAMERA)
    theirs, _ = path_tracer.photograph(head, black, LIGHTS, CAMERA, glossy)
    assert theirs[0].max() > 0.02
    assert _relative_rms(ours[:1], theirs[:1], coverage) < 0.15


def test_a_seed_repeats_an_image() -> None:
    settings = PathSettings(samples=2, gloss_samples=1)
    first, second, other = (
        path_tracer.photograph(_corner(), _appearance(), LIGHTS[:1], CAMERA, settings, seed)[0]
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, second) and not torch.equal(first, other)


@pytest.mark.slow
def test_the_benchmark_holds_on_a_small_image_of_the_builtin_head(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    benchmark = importlib.import_module("transport")
    from facerf_cli.face.morphable import load_face_model
    from facerf_cli.synth.appearance.materials import draw_appearance

    model = load_face_model()
    generator = torch.Generator().manual_seed(1)
    alpha = 0.7 * torch.randn(len(model.identity), generator=generator)
    appearance = draw_appearance(128, generator)
    lights = np.stack([azel_to_direction(*angle).numpy() for angle in ((-30.0, 10.0), (60.0, 50.0))])
    cameras = [benchmark.stage_camera(128, 0.0)]
    times: dict[str, list[float]] = {"bake": [], "irradiance": [], "photograph": [], "mitsuba": []}

    def render(bounces: int) -> tuple:
        settings = PathSettings(samples=12, bounces=bounces, gloss=False, relief=False)
        return benchmark.render_both(model, alpha, appearance, lights, cameras, settings, 0, times)

    direct, truth = render(0)
    total, their_total = render(1)
    assert benchmark.compare(model, alpha, cameras, direct, truth, truth).errors[-1] < 0.05
    assert benchmark.compare(model, alpha, cameras, total, their_total, truth).errors[-1] < 0.10
    dim = [0.9 * images for images in direct]
    assert benchmark.compare(model, alpha, cameras, dim, truth, truth).errors[-1] > 0.05  # it can fail
