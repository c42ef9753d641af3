import numpy as np
import pytest
import torch
import torch.nn.functional as F

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.network.features import (
    LPIPS_LAYERS,
    AppearanceNetwork,
    AppearanceSettings,
    LightNetwork,
    LightSettings,
    Lpips,
    VggFeatures,
    encode_display,
    feature_distance,
)
from tests.refusals import refused

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
CHANNELS = (64, 128, 256, 512, 512)  # of the published LPIPS heads


def test_tensors_and_layers_have_the_published_names_and_shapes() -> None:
    network = VggFeatures()
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert shapes == {f"{name}.weight": (*channels, 3, 3) for name, channels in PUBLISHED.items()} | {
        f"{name}.bias": channels[:1] for name, channels in PUBLISHED.items()
    }
    layers = [tuple(layer.shape) for layer in network.layers(torch.rand(2, 3, 20, 28))]
    assert layers == [(2, 64, 20, 28), (2, 128, 10, 14), (2, 256, 5, 7)]


def test_the_first_layer_is_that_of_a_display_image_normalised_as_torchvision_does() -> None:
    network = VggFeatures(width=1 / 16)
    image = torch.rand(1, 3, 9, 12)
    mean, deviation = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[..., None, None]
    x = torch.from_numpy((linear_to_srgb(image.numpy()) - mean) / deviation).float()
    for place in (0, 2):
        x = F.conv2d(x, network.features[place].weight, network.features[place].bias, padding=1).relu()
    torch.testing.assert_close(network.layers(image)[0], x, rtol=1e-4, atol=1e-4)


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
    refused(ValueError, "features.7.weight", network.load_published, given)
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


@pytest.fixture(scope="module")
def whole() -> Lpips:
    """One of VGG-16's size, whose numbers mean nothing."""
    return Lpips()


def small() -> Lpips:
    """An LPIPS of few channels with random weights."""
    network = Lpips(width=1 / 16)
    for name, parameter in network.named_parameters():
        torch.nn.init.uniform_(parameter, 0, 1) if "heads" in name else torch.nn.init.normal_(
            parameter, std=0.3
        )
    return network.requires_grad_(False)


def published(count: int = 5) -> dict[str, torch.Tensor]:
    """Heads as the published file has them, of other numbers."""
    return {f"lin{i}.model.1.weight": torch.rand(1, CHANNELS[i], 1, 1) for i in range(count)}


def test_the_distance_weighs_unit_features_and_is_0_between_equals() -> None:
    network = small()
    first, second = torch.rand(3, 3, 20, 24), torch.rand(3, 3, 20, 24)
    second[1] = first[1]
    distance = network(first, second)
    assert distance.shape == (3,) and distance[1] == 0 and distance[0] > 0
    assert torch.allclose(distance, network(second, first))
    assert torch.allclose(distance[2], network(first[2:], second[2:])[0])
    layers = zip(network.trunk.layers(first), network.trunk.layers(second), network.heads, strict=True)
    squared = [((F.normalize(a) - F.normalize(b)) ** 2 * head[:, None, None]).sum(1) for a, b, head in layers]
    assert torch.allclose(distance, sum(one.mean((1, 2)) for one in squared), rtol=1e-4)


def test_heads_and_tensors_have_the_published_names_and_shapes(whole: Lpips) -> None:
    assert [len(head) for head in whole.heads] == list(CHANNELS)
    shapes = [tuple(layer.shape[1:]) for layer in whole.trunk.layers(torch.zeros(1, 3, 32, 48))]
    assert shapes == [(64, 32, 48), (128, 16, 24), (256, 8, 12), (512, 4, 6), (512, 2, 3)]
    assert "features.28.weight" in whole.trunk.state_dict() and list(LPIPS_LAYERS.values()) == [
        3,
        8,
        15,
        22,
        29,
    ]
    heads = published()
    whole.load_heads(heads)
    for mine, (_, given) in zip(whole.heads, sorted(heads.items()), strict=True):
        assert torch.equal(mine, given.flatten())


def test_the_shallow_trunk_gives_the_same_layers_as_the_deep_one() -> None:
    deep, shallow = VggFeatures(1 / 16, LPIPS_LAYERS), VggFeatures(1 / 16)
    shallow.load_published(deep.state_dict())
    image = torch.rand(1, 3, 16, 24)
    for a, b in zip(shallow.layers(image), deep.layers(image)[:3], strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("trouble", ["missing", "negative"])  # the others as for the weights of VGG-16
def test_heads_that_are_none_are_refused_in_words(whole: Lpips, trouble: str) -> None:
    heads, name = published(), "lin3.model.1.weight"
    before = [head.clone() for head in whole.heads]
    if trouble == "missing":
        del heads[name]
    else:
        heads[name][0, 0, 0, 0] = -1
    refused(ValueError, "lin3.model.1.weight", whole.load_heads, heads)
    assert all(torch.equal(a, b) for a, b in zip(whole.heads, before, strict=True))


def test_images_too_small_are_refused_and_gradients_finite_where_nothing_answers() -> None:
    with pytest.raises(ValueError, match="15"):
        small()(torch.zeros(1, 3, 15, 40), torch.zeros(1, 3, 15, 40))
    network = small()
    for parameter in network.trunk.parameters():
        parameter.zero_()  # every feature is 0
    first = torch.rand(1, 3, 16, 16, requires_grad=True)
    network(first, torch.rand(1, 3, 16, 16)).sum().backward()
    assert first.grad is not None and first.grad.isfinite().all()
