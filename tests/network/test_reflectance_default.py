import pytest
import torch
import torch.nn.functional as F

from facerf_cli.network.inputs import head_rotation
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.raster.camera import pose_to_rotation

SMALL = DefaultReflectanceSettings(
    side=32, encoder_widths=(8, 12, 16), decoder_widths=(8, 12, 16), template_channels=2, rig_lights=12
)


@pytest.fixture(scope="module")
def network() -> DefaultReflectanceNetwork:
    torch.manual_seed(3)
    network = DefaultReflectanceNetwork(SMALL)
    normals = F.normalize(
        torch.randn(3, 16, 16).repeat_interleave(4, 1).repeat_interleave(4, 2) + _front(64), dim=0
    )
    network.set_mean_face(normals, torch.rand(12, 64, 64), F.normalize(torch.randn(12, 3), dim=-1))
    with torch.no_grad():
        network.head.weight.mul_(300)  # an untrained head would hide what comes before it
    return network.eval()


def _front(side: int) -> torch.Tensor:
    return torch.tensor([0.0, 0.0, 2.0]).view(3, 1, 1).expand(3, side, side)


def _face(side: int, faces: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(side)
    texture = torch.rand(faces, 3, side, side, generator=generator)
    normals = F.normalize(torch.randn(faces, 3, side, side, generator=generator) + _front(side), dim=1)
    return texture, normals, (torch.rand(faces, 1, side, side, generator=generator) > 0.2).float()


def _lights(count: int, faces: int = 1) -> torch.Tensor:
    return F.normalize(torch.randn(faces, count, 3, generator=torch.Generator().manual_seed(1)), dim=-1)


@torch.no_grad()
def test_unseen_texels_do_not_set_the_exposure_and_bf16_stays_near_float32(
    network: DefaultReflectanceNetwork,
) -> None:
    texture, normals, visible = _face(64)
    changed = torch.where(visible > 0, texture, 50.0)
    first, second = (network.encode(x, normals, visible).exposure for x in (texture, changed))
    assert torch.allclose(first, second)
    lights = _lights(2)
    exact = network.decode(network.encode(texture, normals, visible), normals, lights)
    with torch.autocast("cpu", torch.bfloat16):
        rough = network.decode(network.encode(texture, normals, visible), normals, lights)
    assert (rough.float() - exact).abs().mean() < 0.03 * exact.abs().mean()
    rotation = pose_to_rotation(31, -12, 8)
    normals = torch.einsum("dc,cij->dij", rotation, network.mean_normals)[None]
    assert torch.allclose(head_rotation(network.mean_normals, normals)[0], rotation, atol=1e-4)


def test_gradients_reach_every_weight_and_stay_finite_in_the_dark(network: DefaultReflectanceNetwork) -> None:
    texture, normals, visible = _face(64)
    encoded = network.encode(texture * 0, normals, visible)
    network.decode_root(encoded, normals, _lights(2)).square().mean().backward()
    missing = [
        name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()
    ]
    network.zero_grad()
    assert not missing
