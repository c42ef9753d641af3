import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork, PaperReflectanceSettings
from tests.refusals import refused

SMALL = PaperReflectanceSettings(side=32, widths=(8, 8, 12, 16), features=8)


@pytest.fixture(scope="module")
def network() -> PaperReflectanceNetwork:
    torch.manual_seed(3)
    network = PaperReflectanceNetwork(SMALL)
    with torch.no_grad():
        network.light_convolutions[-1].weight.mul_(30)  # an untrained one would hide what comes before it
    return network.eval()


def _face(side: int, faces: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(side)
    normals = F.normalize(torch.randn(faces, 3, side, side, generator=generator), dim=1)
    texture = torch.rand(faces, 3, side, side, generator=generator)
    return texture, normals, (torch.rand(faces, 1, side, side, generator=generator) > 0.2).float()


def _lights(count: int, faces: int = 1) -> Tensor:
    return F.normalize(torch.randn(faces, count, 3, generator=torch.Generator().manual_seed(1)), dim=-1)


def test_structure_is_the_papers() -> None:
    """At 128 texels the eighth halving finds a single texel; the weights are those of 512."""
    with torch.device("meta"):
        network, small = (
            PaperReflectanceNetwork(),
            PaperReflectanceNetwork(PaperReflectanceSettings(side=128)),
        )
        convolutions = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
        for side, model, sides in (
            (512, network, [256, 128, 64, 32, 16, 8, 4, 2]),
            (128, small, [64, 32, 16, 8, 4, 2, 1, 1]),
        ):
            texture = torch.zeros(1, 3, side, side)
            encoded = model.encode(texture, texture, texture[:, :1])
            assert [f.shape[-1] for f in encoded.features] == sides
            assert model.decode(encoded, texture, torch.zeros(1, 2, 3)).shape == (1, 2, 3, side, side)
    assert all(m.kernel_size == (3, 3) for m in convolutions)
    assert (len(network.down), len(network.up), len(network.light_convolutions)) == (8, 8, 5)
    assert len(convolutions) == 8 + 8 + 5
    assert [m.stride[0] for m in convolutions] == [2] * 8 + [1] * 13
    assert network.down[0].convolution.in_channels == 6
    shapes = [{k: v.shape for k, v in model.state_dict().items()} for model in (network, small)]
    assert shapes[0] == shapes[1]


@torch.no_grad()
def test_what_each_input_reaches() -> None:
    """The skips carry the finest source, the light comes in below, the target's normals above."""
    torch.manual_seed(0)
    network = PaperReflectanceNetwork(SMALL)
    seen: dict[str, Tensor] = {}
    for name, module in (("down", network.down[-1]), ("up", network.up[0])):
        module.register_forward_hook(lambda _m, _i, out, name=name: seen.__setitem__(name, out))
    texture, normals, visible = _face(32)
    results = []
    for target, light in ((normals, _lights(1)), (-normals, _lights(1)), (normals, -_lights(1))):
        network.decode(network.encode(texture, normals, visible), target, light)
        results.append(dict(seen))
    assert all(torch.equal(results[0]["down"], other["down"]) for other in results)
    assert torch.equal(results[0]["up"], results[1]["up"])  # N_t comes after the U-Net
    assert not torch.allclose(results[0]["up"], results[2]["up"], atol=1e-4)
    encoded = network.encode(texture, normals, visible)
    before = network.decode(encoded, normals, _lights(1))
    for feature in encoded.features:
        kept = feature.clone()
        feature.add_(1)
        assert not torch.allclose(network.decode(encoded, normals, _lights(1)), before, atol=1e-6)
        feature.copy_(kept)


@torch.no_grad()
def test_skips_are_convolved_as_if_stacked_and_both_normal_maps_matter(
    network: PaperReflectanceNetwork,
) -> None:
    up = network.up[2]
    x, skip = torch.randn(2, 12, 4, 4), torch.randn(2, 12, 4, 4)
    stacked = F.interpolate(torch.cat([x, skip], 1), scale_factor=2.0)
    expected = F.leaky_relu(up.norm(up.convolution(stacked)), 0.2)
    assert torch.allclose(up(x, skip, 8), expected, atol=1e-5)
    texture, normals, visible = _face(32)
    turned, light = normals.roll(1, 1), _lights(1)
    plain = network.decode(network.encode(texture, normals, visible), normals, light)
    by_source = network.decode(network.encode(texture, turned, visible), normals, light)
    by_target = network.decode(network.encode(texture, normals, visible), turned, light)
    for other in (by_source, by_target):
        assert (other - plain).abs().max() > 1e-3 * plain.max()
    bare = PaperReflectanceNetwork(PaperReflectanceSettings(32, (8, 8, 12, 16), 8, normals=False))
    one = bare.decode(bare.encode(texture, normals, visible), normals, light)
    assert torch.equal(one, bare.decode(bare.encode(texture, -normals, visible), normals * 0, light))
    assert bare.down[0].convolution.in_channels == 3


def test_a_side_that_cannot_be_halved_is_refused() -> None:
    assert PaperReflectanceNetwork(SMALL).as_metadata()["form"] == "paper"
    refused(ValueError, "halved 4 times", PaperReflectanceNetwork, PaperReflectanceSettings(40, (8, 8, 8, 8)))


def test_every_weight_learns() -> None:
    network = PaperReflectanceNetwork(SMALL)
    texture, normals, visible = _face(32)
    network.decode(network.encode(texture, normals, visible), normals, _lights(2)).mean().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())
