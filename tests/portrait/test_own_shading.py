"""The light of a photo is guessed from the proxy, as well as a matt face of one colour allows."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.portrait import SKIN
from facerf_cli.portrait.proxy import own_shading

SIDE = 64
RIG = rig_directions(48)


def ball() -> tuple[Tensor, Tensor, Tensor]:
    """Normals [3, S, S] and classes [C, S, S] of a ball of skin, and the visibility [L, s, s] of the rig."""
    at = (torch.arange(SIDE) + 0.5) * 2 / SIDE - 1
    y, x = torch.meshgrid(-at, at, indexing="ij")
    inside = x**2 + y**2 < 0.9
    normals = F.normalize(torch.stack([x, y, (1 - x**2 - y**2).clamp_min(0.02).sqrt()]), dim=0)
    classes = torch.zeros(14, SIDE, SIDE)
    classes[SKIN] = inside.float()
    return normals, classes, torch.ones(len(RIG), SIDE // 2, SIDE // 2)


@pytest.mark.parametrize("light", [8, 18, 29])
def test_a_lamp_is_found(light: int) -> None:
    normals, classes, visible = ball()
    cosine = torch.einsum("c,cij->ij", RIG[light], normals).clamp_min(0)
    image = 0.4 * cosine.expand(3, -1, -1) * torch.tensor([1.0, 0.7, 0.5]).view(3, 1, 1)
    shading = own_shading(image, classes, normals, RIG, visible)
    skin = classes[SKIN] > 0
    wanted = cosine / cosine[skin].mean()
    assert shading.shape == (1, SIDE, SIDE)
    assert float(shading[0][skin].mean()) == pytest.approx(1, rel=1e-4)
    assert float((shading[0] - wanted)[skin].abs().mean()) < 0.12
    brighter = own_shading(7 * image, classes, normals, RIG, visible)
    torch.testing.assert_close(brighter, shading, rtol=1e-3, atol=1e-3)


def test_shadows_of_the_proxy_are_in_it() -> None:
    normals, classes, visible = ball()
    light = int((RIG @ torch.tensor([0.0, 0.3, 0.95])).argmax())
    band = slice(SIDE * 3 // 8, SIDE * 5 // 8)  # across the middle, as no unshadowed lights shade a ball
    visible[light, SIDE * 3 // 16 : SIDE * 5 // 16] = 0
    cosine = torch.einsum("c,cij->ij", RIG[light], normals).clamp_min(0)
    cosine[band] *= 0.02
    shading = own_shading(cosine.expand(3, -1, -1), classes, normals, RIG, visible)[0]
    middle = shading[:, SIDE * 3 // 8 : SIDE * 5 // 8]
    assert middle[band].mean() < 0.4 * middle[SIDE // 4 : SIDE * 3 // 8].mean()


def test_without_skin_nothing_is_guessed() -> None:
    normals, classes, visible = ball()
    shading = own_shading(torch.rand(3, SIDE, SIDE), 0 * classes, normals, RIG, visible)
    torch.testing.assert_close(shading, torch.ones(1, SIDE, SIDE))
