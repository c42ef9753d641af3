import numpy as np
import pytest
import torch

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.network.features import LPIPS_LAYERS, Lpips, VggFeatures
from tests.oracles.lpips import lpips as slow_lpips

CHANNELS = (64, 128, 256, 512, 512)


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


def test_the_distance_is_that_of_the_slow_twin_and_0_between_equals() -> None:
    network = small().double()
    first = torch.rand(1, 3, 16, 33).double() * 0.9
    second = (first + 0.2 * torch.rand_like(first)).clamp(0, 1)
    second[..., :4] = 0  # as masked images are
    tensors = {name: tensor.numpy() for name, tensor in network.trunk.state_dict().items()}
    encoded = [linear_to_srgb(image[0].numpy()).astype(np.float64) for image in (first, second)]
    expected = slow_lpips(tensors, [head.numpy() for head in network.heads], *encoded)
    assert network(first, second).item() == pytest.approx(expected, rel=1e-4) and expected > 0.01
    network = small()
    first, second = torch.rand(3, 3, 20, 24), torch.rand(3, 3, 20, 24)
    second[1] = first[1]
    distance = network(first, second)
    assert distance.shape == (3,) and distance[1] == 0 and distance[0] > 0
    assert torch.allclose(distance, network(second, first))
    assert torch.allclose(distance[2], network(first[2:], second[2:])[0])


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


@pytest.mark.parametrize("trouble", ["missing", "shape", "integers", "nan", "negative"])
def test_heads_that_are_none_are_refused_in_words(whole: Lpips, trouble: str) -> None:
    heads, name = published(), "lin3.model.1.weight"
    before = [head.clone() for head in whole.heads]
    if trouble == "missing":
        del heads[name]
    elif trouble == "shape":
        heads[name] = heads[name][:, :256]
    elif trouble == "integers":
        heads[name] = heads[name].int()
    else:
        heads[name][0, 0, 0, 0] = torch.nan if trouble == "nan" else -1
    with pytest.raises(ValueError, match=r"lin3\.model\.1\.weight"):
        whole.load_heads(heads)
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
