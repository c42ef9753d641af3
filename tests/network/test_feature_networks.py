import numpy as np
import pytest
import torch

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.network.features import (
    AppearanceNetwork,
    AppearanceSettings,
    LightNetwork,
    LightSettings,
    VggFeatures,
    encode_display,
    feature_distance,
)
from tests.oracles.vgg import features as slow_features

# torchvision.models.vgg16().features, as its documentation prints them: place, channels out x in, 3 x 3.
PUBLISHED = {
    "features.0": (64, 3),
    "features.2": (64, 64),
    "features.5": (128, 64),
    "features.7": (128, 128),
    "features.10": (256, 128),
    "features.12": (256, 256),
    "features.14": (256, 256),
}


def test_tensors_and_layers_have_the_published_names_and_shapes() -> None:
    network = VggFeatures()
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert shapes == {f"{name}.weight": (*channels, 3, 3) for name, channels in PUBLISHED.items()} | {
        f"{name}.bias": channels[:1] for name, channels in PUBLISHED.items()
    }
    layers = [tuple(layer.shape) for layer in network.layers(torch.rand(2, 3, 20, 28))]
    assert layers == [(2, 64, 20, 28), (2, 128, 10, 14), (2, 256, 5, 7)]


def test_features_are_those_of_the_slow_twin() -> None:
    network = VggFeatures(width=1 / 16).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    image = torch.rand(1, 3, 9, 12) * 1.5
    image[..., 0] = 0.001  # where the curve is straight
    tensors = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    slow = slow_features(tensors, image[0].double().numpy())
    for fast, expected in zip(network.layers(image), slow.values(), strict=True):
        assert torch.allclose(fast[0], torch.from_numpy(expected), rtol=1e-4, atol=1e-4)
        assert (expected > 0).any() and (expected == 0).any()


def test_encoding_is_srgb_with_a_gradient_everywhere() -> None:
    linear = torch.tensor([0.0, 1e-3, 0.0031308, 0.18, 1.0, 4.0, -0.5], requires_grad=True)
    encoded = encode_display(linear)
    expected = linear_to_srgb(linear.detach().numpy())
    assert np.allclose(encoded.detach().numpy()[:6], expected[:6], atol=1e-6)
    encoded.sum().backward()
    assert linear.grad is not None and linear.grad.isfinite().all() and (linear.grad > 0).all()


def test_distance_is_a_sum_over_layers_of_means_for_each_image_and_the_target_has_no_gradient() -> None:
    network = VggFeatures(1 / 8).requires_grad_(False)
    a, b = (torch.rand(3, 3, 16, 16, requires_grad=True) for _ in range(2))
    with torch.no_grad():
        b[1] = a[1]
    distance = feature_distance(network, a, b)
    layers = zip(network.layers(a), network.layers(b), strict=True)
    expected = sum(((x - y) ** 2)[2].mean() for x, y in layers)
    assert distance.shape == (3,) and distance[1] == 0 and distance[0] > 0
    assert torch.allclose(distance[2], expected)
    distance.sum().backward()
    assert a.grad is not None and a.grad.abs().sum() > 0 and b.grad is None


@pytest.mark.parametrize("trouble", ["missing", "shape", "integers", "nan"])
def test_weights_that_are_no_vggs_are_refused_in_words(trouble: str) -> None:
    network = VggFeatures()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    given = {name: torch.rand_like(tensor) for name, tensor in before.items()}
    name = "features.7.weight"
    if trouble == "missing":
        del given[name]
    elif trouble == "shape":
        given[name] = given[name][:64]
    elif trouble == "integers":
        given[name] = given[name].int()
    else:
        given[name][0, 0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match=r"features\.7\.weight"):
        network.load_published(given)
    assert all(torch.equal(tensor, before[key]) for key, tensor in network.state_dict().items())


def test_the_light_network_gives_unit_directions() -> None:
    network, textures = LightNetwork(LightSettings(width=1 / 16, grid=4, hidden=8)), torch.rand(5, 3, 32, 32)
    assert torch.allclose(network(textures).norm(dim=-1), torch.ones(5), atol=1e-6)
    assert [layer.shape[1] for layer in network.layers(textures)] == [4, 8, 16]
    assert feature_distance(network, textures, textures.flip(0)).shape == (5,)


def test_the_appearance_network_tells_people_and_lights() -> None:
    network = AppearanceNetwork(AppearanceSettings(people=3, side=32, width=1 / 16, grid=2, hidden=4))
    scores, lights = network(torch.rand(5, 3, 40, 40))
    assert scores.shape == (5, 3) and torch.allclose(lights.norm(dim=-1), torch.ones(5), atol=1e-6)


@pytest.mark.parametrize("kind", ["light", "appearance"])
def test_features_are_those_of_the_side_of_training(kind: str) -> None:
    """A texture of another side is resampled: its features would be those of another scale."""
    light = LightSettings(width=1 / 16, grid=2, hidden=4, side=32)
    appearance = AppearanceSettings(people=3, side=32, width=1 / 16, grid=2, hidden=4)
    network = LightNetwork(light) if kind == "light" else AppearanceNetwork(appearance)
    small = torch.rand(1, 3, 32, 32)
    large = small.repeat_interleave(2, -1).repeat_interleave(2, -2)
    for found, wanted in zip(network.layers(large), network.layers(small), strict=True):
        torch.testing.assert_close(found, wanted)
