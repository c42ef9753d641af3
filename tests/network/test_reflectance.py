"""Every form of the Reflectance Network fits the interface that relighting and training use."""

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.errors import UsageError
from facerf_cli.network.checkpoint import REFLECTANCE_FORMS, new_network
from facerf_cli.network.inputs import to_root
from facerf_cli.network.reflectance import ReflectanceNetwork

SMALL: dict[str, dict[str, Any]] = {  # settings of a test's network, where a small side is not enough
    "default": {"side": 32, "encoder_widths": [8, 12], "decoder_widths": [8, 12], "rig_lights": 5},
    "paper": {"side": 32, "widths": [8, 8, 12, 16], "features": 8},
}


@pytest.fixture(params=REFLECTANCE_FORMS)
def network(request: pytest.FixtureRequest) -> Any:
    torch.manual_seed(0)
    made = new_network("reflectance", request.param, SMALL.get(request.param, {"side": 32}))
    *_, last = (layer for layer in made.modules() if isinstance(layer, nn.Conv2d))
    nn.init.normal_(last.weight, std=0.3)  # an untrained last layer would hide what comes before it
    return made


@torch.no_grad()
@pytest.mark.parametrize("side", [24, 80, 256])
def test_textures_of_any_side_are_linear_and_roots_those_over_the_exposure(
    network: ReflectanceNetwork, side: int
) -> None:
    texture, normals, visible = face(side)
    lights = F.normalize(torch.randn(2, 3, 3), dim=-1)
    encoded = network.encode(texture, normals, visible)
    olats = network.decode(encoded, normals, lights)
    roots = network.decode_root(encoded, normals, lights)
    assert olats.shape == roots.shape == (2, 3, 3, side, side) and encoded.exposure.shape == (2, 1, 1, 1)
    assert olats.min() >= 0 and olats.isfinite().all()
    assert torch.allclose(roots.clamp_min(0), to_root(olats / encoded.exposure[:, None]), atol=1e-5)
    apart = torch.cat([network.decode(encoded, normals, light) for light in lights.split(1, 1)], 1)
    assert torch.allclose(olats, apart, atol=1e-5)  # of the other lights of a batch nothing depends
    assert (olats[:, 0] - olats[:, 1]).abs().max() > 1e-4


@torch.no_grad()
def test_exposure_of_the_photo_passes_straight_through(network: ReflectanceNetwork) -> None:
    texture, normals, visible = face()
    lights = F.normalize(torch.randn(2, 3, 3), dim=-1)
    dim, bright = (
        network.decode(network.encode(texture * gain, normals, visible), normals, lights)
        for gain in (0.1, 20.0)
    )
    assert torch.allclose(dim * 200, bright, rtol=1e-3, atol=1e-4)
    assert network.decode(network.encode(texture * 0, normals, visible * 0), normals, lights).isfinite().all()


def test_the_mean_face_is_stored_by_forms_that_need_it(network: ReflectanceNetwork) -> None:
    lights, side = network.rig_lights, 64
    normals = torch.tensor([0.0, 0, 1]).view(3, 1, 1).expand(3, side, side)
    assert not network.has_mean_face
    network.set_mean_face(normals, torch.ones(lights, side, side), torch.ones(lights, 3))
    assert network.has_mean_face == (lights > 0)


def test_memory_of_a_light_is_that_of_the_shipped_networks() -> None:
    with torch.device("meta"):
        default, paper = (new_network("reflectance", form, {}) for form in ("default", "paper"))
    assert default.bytes_per_light(256**2) == 4 * (220 * 128**2 + 16 * 256**2)
    assert paper.bytes_per_light(256**2) == 4 * (220 * 512**2 + 16 * 256**2)


def face(side: int = 24) -> tuple[Tensor, Tensor, Tensor]:
    normals = F.normalize(torch.randn(2, 3, side, side), dim=1)
    return torch.rand(2, 3, side, side) + 0.1, normals, torch.ones(2, 1, side, side)


def test_a_form_by_its_name_is_its_class_with_its_settings(network: Any) -> None:
    metadata = network.as_metadata()
    assert type(network) is REFLECTANCE_FORMS[metadata["form"]] and isinstance(network, nn.Module)
    assert metadata["side"] == 32
    assert type(network).from_metadata(metadata).as_metadata() == metadata


def test_unknown_forms_and_settings_are_refused() -> None:
    forms = ", ".join(REFLECTANCE_FORMS)
    with pytest.raises(UsageError, match=f"form other: .*{forms}"):
        new_network("reflectance", "other", {})
    with pytest.raises(TypeError):
        new_network("reflectance", "paper", {"rig_lights": 3})
