"""Casts of light are taken off strange photos."""

import pytest
import torch

from facerf_cli.network.inputs import SourceColours, colour_cast

TRAINED = SourceColours((0.318, -0.214), ((0.094, -0.038), (-0.038, 0.081)))  # of the shipped checkpoint
SKIN = torch.tensor([0.5, 0.36, 0.28])


def face(colour: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A texture [1, 3, 6, 6] of one colour with a shadow, and where it is seen."""
    shading = torch.linspace(0.2, 1.5, 36).view(1, 1, 6, 6)
    visible = torch.ones(1, 1, 6, 6)
    visible[..., :2] = 0
    texture = colour.view(1, 3, 1, 1) * shading
    return torch.where(visible > 0, texture, torch.full_like(texture, 9.0)), visible


@pytest.mark.parametrize(
    "colour",
    [SKIN, SKIN * 1e-3, torch.tensor([0.3, 0.3, 0.3]), SKIN * torch.tensor([1.3, 1, 0.7])],
    ids=["skin", "dark", "grey", "lamplight"],
)
def test_ordinary_photos_are_left_alone(colour: torch.Tensor) -> None:
    cast = colour_cast(*face(colour), TRAINED)
    torch.testing.assert_close(cast, torch.ones(1, 3, 1, 1), rtol=1e-6, atol=0)


@pytest.mark.parametrize("light", [(0.2, 0.3, 2.0), (0.1, 1.0, 0.5), (1.0, 0.3, 0.05)])
def test_a_strange_light_is_taken_off(light: tuple[float, float, float]) -> None:
    texture, visible = face(SKIN * torch.tensor(light))
    plain = texture / colour_cast(texture, visible, TRAINED)
    seen = visible.expand_as(texture) > 0
    torch.testing.assert_close(plain[seen].mean(), texture[seen].mean())

    def off(image: torch.Tensor) -> float:
        mean = (image * visible).sum((2, 3))[0]
        return float(((mean / mean[1]) / (SKIN / SKIN[1])).log().norm())

    assert off(plain) < 0.4 * off(texture)


def test_a_stranger_light_leaves_no_more_of_itself_and_black_stays_black() -> None:
    blue = torch.tensor([0.0, 0.0, 1.0])
    left = []
    for strength in (1.0, 1.5, 2.5):
        texture, visible = face(SKIN * torch.exp(strength * blue))
        mean = ((texture / colour_cast(texture, visible, TRAINED)) * visible).sum((2, 3))[0]
        left.append(float(mean[2] / mean[1]))
    assert left == sorted(left, reverse=True)
    texture, visible = torch.zeros(1, 3, 4, 4), torch.ones(1, 1, 4, 4)
    assert not (texture / colour_cast(texture, visible, TRAINED)).any()
