"""Gradients of the Python API against finite differences; the page in the docs runs."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import binary_erosion
from torch import Tensor

import facerf_cli as facerf
from facerf_cli.errors import UsageError
from facerf_cli.relighting.models import Models
from tests import astronaut
from tests.refusals import refused

ROOT = Path(__file__).parents[1]
POSE = torch.tensor([5.0, 3.0, 1.0])
LINEAR = 1e-4  # the image is linear in them; single precision is left
# Texels are sampled bilinearly, so steps of the pose cross kinks; and at the nose pixels change triangles.
SMOOTH = 0.03
Loss = Callable[[Any], Tensor]


@pytest.fixture(scope="module")
def models() -> Models:
    """Models whose Reflectance and Portrait Networks are no other test's."""
    return facerf.load_models()


@pytest.fixture(scope="module")
def person(models: Models) -> facerf.Person:
    return facerf.fit(models, astronaut.photo(), texture_side=64)


@pytest.fixture(scope="module")
def light() -> facerf.Light:
    rig = torch.from_numpy(facerf.rig(40))
    return facerf.Light(
        rig[rig[:, 2] > 0.2][:3], torch.tensor([[0.8, 0.7, 0.3], [0.2, 0.4, 0.9], [0.5, 0.5, 0.1]])
    )


@pytest.fixture(scope="module")
def loss(person: facerf.Person, light: facerf.Light) -> Loss:
    """The sum of an image under smooth random weights, well inside the face."""
    alpha = person.relight(light, pose=POSE)[..., 3]
    inside = torch.from_numpy(binary_erosion((alpha > 0.99).numpy(), iterations=6))
    random = torch.rand(1, 3, 12, 12, generator=torch.Generator().manual_seed(1))
    marks = F.interpolate(random, alpha.shape, mode="bicubic")[0].permute(1, 2, 0)
    return lambda image: (image[..., :3].double() * marks * inside[..., None]).sum()


def compared(function: Loss, at: Tensor, step: float, along: Tensor | None = None) -> tuple[float, float]:
    """The slope of a function at a tensor, in a direction of length 1, by its gradient and by two values."""
    at = at.detach().clone().requires_grad_()
    function(at).backward()
    assert at.grad is not None
    along = torch.randn(at.shape) if along is None else along
    along = along / along.norm()
    with torch.no_grad():
        difference = function(at + step * along) - function(at - step * along)
    return float((at.grad * along).sum()), float(difference) / (2 * step)


@pytest.mark.parametrize("shown", [{"alone": True}, {"pose": (5, 3, 1)}])
def test_of_the_weights_of_a_light(person: facerf.Person, light: facerf.Light, shown: dict[str, Any]) -> None:
    directions, weights = light.directions, torch.as_tensor(light.weights)
    rows = torch.linspace(-1, 2, astronaut.photo().shape[0], dtype=torch.float64)[:, None, None]

    def lit(weights: Tensor) -> Tensor:
        return (person.relight(facerf.Light(directions, weights), **shown)[..., :3] * rows).sum()

    found, expected = compared(lit, weights, 0.1)
    assert abs(expected) > 1 and found == pytest.approx(expected, rel=LINEAR)


def test_of_the_weights_of_lights_in_a_list_and_of_the_pixels_of_a_map(
    person: facerf.Person, light: facerf.Light, loss: Loss
) -> None:
    def both(weights: Tensor) -> Tensor:
        one, two = facerf.Light(light.directions, weights), facerf.Light.single(40, 10)
        first, second = person.relight([one, two + 2 * one], alone=True)
        return loss(first) + 3 * loss(second)

    found, expected = compared(both, torch.as_tensor(light.weights), 0.1)
    assert found == pytest.approx(expected, rel=LINEAR)

    def lit(envmap: Tensor) -> Tensor:
        return loss(person.relight(facerf.Light.from_envmap(envmap, lights=6), alone=True))

    found, expected = compared(lit, torch.rand(8, 16, 3), 0.1, torch.rand(8, 16, 3))
    assert abs(expected) > 0.1 and found == pytest.approx(expected, rel=LINEAR)


def test_of_the_pose_and_of_lights_that_do_not_shine_yet(
    person: facerf.Person, light: facerf.Light, loss: Loss
) -> None:
    along = torch.eye(3)
    pairs = [compared(lambda x: loss(person.relight(light, pose=x)), POSE, 0.1, axis) for axis in along]
    found, expected = torch.tensor(pairs).T
    assert expected.norm() > 10 and (found - expected).norm() < SMOOTH * expected.norm()
    field, weights = person.reflectance, torch.zeros(1, 3, 3, requires_grad=True)
    field.relit(torch.as_tensor(light.directions), weights).sum().backward()
    assert weights.grad is not None and (weights.grad[0].abs().sum(1) > 0).all()


@pytest.mark.parametrize("pose", [None, POSE])
def test_of_the_texture(person: facerf.Person, light: facerf.Light, loss: Loss, pose: Tensor | None) -> None:
    texture = torch.from_numpy(person.texture)

    def lit(texture: Tensor) -> Tensor:
        return loss(person.with_texture(texture).relight(light, pose=pose, alone=True))

    found, expected = compared(lit, texture, 0.1, texture)  # brighter by a share
    assert abs(expected) > 1 and found == pytest.approx(expected, rel=SMOOTH)


def test_another_texture_is_seen_in_the_photo(person: facerf.Person) -> None:
    key = facerf.Light.single(60, 30)
    face = person.relight(key, alone=True)[..., 3] > 0.9
    relit, same, darker = (
        person.with_texture(share * person.texture).relight(key) for share in (1, 1 + 1e-7, 0.5)
    )
    np.testing.assert_allclose(same, relit, atol=1e-5)
    assert 0.5 < darker[face].mean() / relit[face].mean() < 0.65  # a part of the portrait field's stays
    np.testing.assert_array_equal(darker[:40], relit[:40])


def test_black_texels_do_not_lead_the_gradient(person: facerf.Person, light: facerf.Light) -> None:
    texture = torch.from_numpy(person.texture)
    texture[20:24, 20:24] = 1e-7  # where the square root is steep
    texture.requires_grad_()
    person.with_texture(texture).relight(light, alone=True)[..., :3].square().mean().backward()
    squares = texture.grad.square().sum(-1)
    assert squares[20:24, 20:24].sum() < 0.5 * squares.sum()


def test_a_texture_keeps_its_gradient_under_lights_of_numpy(
    person: facerf.Person, light: facerf.Light
) -> None:
    texture = torch.from_numpy(person.texture).requires_grad_()
    plain = facerf.Light(np.asarray(light.directions), np.asarray(light.weights))
    person.with_texture(texture).relight(plain, alone=True).sum().backward()
    assert texture.grad is not None and texture.grad.abs().sum() > 0
    assert person.with_texture(texture).uv_olat(plain.directions).requires_grad
    assert isinstance(person.with_texture(texture.detach()).relight(plain), np.ndarray)


def test_images_in_the_photo_have_no_gradients_and_say_so(
    models: Models, person: facerf.Person, light: facerf.Light
) -> None:
    directions, weights = (torch.as_tensor(one).clone() for one in (light.directions, light.weights))
    plain = facerf.Light.single(60, 30)
    each = {
        "weights": (person, facerf.Light(directions, weights.clone().requires_grad_())),
        "directions": (person, facerf.Light(directions.clone().requires_grad_(), weights)),
        "original": (person, facerf.Light.original() * torch.ones((), requires_grad=True)),
        "texture": (person.with_texture(torch.from_numpy(person.texture).requires_grad_()), plain),
    }
    for one, lit in each.values():
        refused(UsageError, "gradients: ... pass alone=True", one.relight, lit)
        with torch.no_grad():
            assert not torch.as_tensor(one.relight(lit)).requires_grad
    for network in (models.networks.reflectance, models.networks.portrait):
        weight = next(network.parameters()).requires_grad_(True)
        refused(UsageError, "gradients: ... pass alone=True", person.relight, plain)
        weight.requires_grad_(False)
    assert isinstance(person.relight(facerf.Light(directions, weights)), Tensor)


def test_of_the_directions_of_a_light(person: facerf.Person, light: facerf.Light, loss: Loss) -> None:
    directions = torch.as_tensor(light.directions)

    def lit(x: Tensor) -> Tensor:
        return loss(person.relight(facerf.Light(F.normalize(x, dim=1), light.weights), pose=POSE))

    found, expected = compared(lit, directions, 0.02)
    assert abs(expected) > 1 and found == pytest.approx(expected, rel=SMOOTH)


def slopes(value: Callable[[], Tensor], weight: Tensor, step: float) -> tuple[float, float]:
    """The slope of a value in a network's weight, as `compared` gives it."""
    (gradient,) = torch.autograd.grad(value(), weight)
    along = torch.randn(weight.shape)
    along = along / along.norm()
    with torch.no_grad():
        ends = []
        for change in (step, -2 * step, step):
            weight.add_(change * along)
            ends.append(float(value()))
    return float((gradient * along).sum()), (ends[0] - ends[1]) / (2 * step)


def test_of_the_weights_of_the_reflectance_network(
    models: Models, person: facerf.Person, light: facerf.Light, loss: Loss
) -> None:
    """Also after an image without gradients, and again: what is encoded with gradients is not kept."""
    network: Any = models.networks.reflectance
    first = next(network.parameters()).requires_grad_(True)
    for _ in range(2):
        (gradient,) = torch.autograd.grad(loss(person.relight(light, alone=True)), first)
        assert gradient.abs().sum() > 0
    first.requires_grad_(False)
    weight = network.head.weight.requires_grad_(True)
    found, expected = slopes(lambda: loss(person.relight(light, alone=True)), weight, 0.03)
    weight.requires_grad_(False)
    assert abs(expected) > 1 and found == pytest.approx(expected, rel=SMOOTH)


def test_layers_and_the_mesh_have_no_gradients(person: facerf.Person, light: facerf.Light) -> None:
    weights = torch.as_tensor(light.weights).clone().requires_grad_()
    texture = torch.from_numpy(person.texture).requires_grad_()
    pose = POSE.clone().requires_grad_()
    lit = facerf.Light(light.directions, weights)
    turned = person.relight(lit, pose=pose, layers=["normal", "depth"])
    assert turned["image"].requires_grad and not turned["normal"].requires_grad
    assert person.with_texture(texture).mesh.visual.material.image.size == (64, 64)


def test_a_light_times_a_tensor_has_gradients() -> None:
    factor = torch.tensor(2.0, requires_grad=True)
    light = facerf.Light.single(0, 0, (1, 2, 3)) * factor
    light.weights.sum().backward()
    assert factor.grad == 6
    assert light.to_envmap(16).shape == (16, 32, 3)


def test_tensors_in_tensors_out(models: Models) -> None:
    pixels = astronaut.photo()[::2, ::2].copy()
    photo = torch.from_numpy(pixels)
    one = facerf.fit(models, photo, reflectance="field", texture_side=64)
    key = facerf.Light.single(60, 30)
    for found in (one.relight(key), one.texture, one.matte, one.normals, one.olat(2), one.uv_olat(2)):
        assert isinstance(found, Tensor) and found.device == models.device
    layers = one.relight(key, layers=["depth"], background=torch.full((4, 4, 3), 0.2))
    assert set(layers) == {"image", "person.A", "depth"} and not layers["image"].requires_grad
    rig = torch.from_numpy(facerf.rig(4))
    arrays = facerf.fit(models, pixels, reflectance="field", texture_side=64)
    assert isinstance(arrays.backdrop(torch.rand(8, 16, 3, requires_grad=True)), Tensor)
    assert isinstance(arrays.relight(key), np.ndarray) and isinstance(arrays.uv_olat(rig), Tensor)
    np.testing.assert_array_equal(one.relight(key).numpy(), arrays.relight(key))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:No complete tensor found")
def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    page = (ROOT / "docs/python.md").read_text().partition("\n## Gradients\n")[2]
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(compile(block, "docs/python.md", "exec"), names)
    light, toward = names["light"], torch.from_numpy(facerf.Light.single(60, 30).directions)[0]
    brightest = names["directions"][light.weights.sum(1).argmax()]
    assert float(brightest @ toward) > 0.6  # the nearest of the rig
    assert names["loss"].item() < 1e-3
    vertices = names["vertices"].grad
    assert vertices[:, 2].sum() == pytest.approx(-1, abs=1e-4)  # depth falls as all of it comes nearer
    network, face = names["network"], names["face"]
    with torch.no_grad():
        normals = face.normals[None]
        own = network.decode(network.encode(*names["source"]), normals, names["directions"][None, :5])
    torch.testing.assert_close(names["olats"], own)
