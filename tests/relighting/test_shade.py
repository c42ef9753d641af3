"""The colour of skin in the shade."""

import torch

from facerf_cli.relighting.shade import without_colour_of_shade

SKIN, PURPLE = torch.tensor([0.6, 0.35, 0.25]), torch.tensor([0.8, 0.7, 1.8])


def half_in_shade(shade: float, cast: torch.Tensor) -> torch.Tensor:
    """Skin [3, 64, 64] whose left half is in a shade of another colour."""
    image = SKIN[:, None, None].expand(3, 64, 64).clone()
    image[:, :, :32] *= shade * cast[:, None, None]
    return image


def chroma(image: torch.Tensor) -> torch.Tensor:
    return image / image.mean(0)


def test_shaded_skin_gets_the_colour_of_lit_skin_and_nothing_else_changes() -> None:
    image = half_in_shade(0.2, PURPLE)
    even = image * without_colour_of_shade(image, torch.ones(64, 64))
    # the lit skin's mean holds a little of the shade's colour, by its brightness
    torch.testing.assert_close(chroma(even)[:, :, :24], chroma(image)[:, :, 40:], rtol=0.12, atol=0)
    assert (chroma(image)[2, 32, 10] / chroma(image)[2, 32, 50]) > 1.7
    torch.testing.assert_close(even[:, :, :24].mean(0), image[:, :, :24].mean(0), rtol=0.05, atol=0)
    assert torch.equal(even[:, :, 48:], image[:, :, 48:])
    whole, none = torch.ones(64, 64), torch.zeros(64, 64)
    for image, skin in (
        (half_in_shade(1.3, PURPLE), whole),  # a bright lamp
        (half_in_shade(0.2, PURPLE), none),
        (half_in_shade(0.2, torch.ones(3)).mean(0).expand(3, -1, -1), whole),
    ):
        torch.testing.assert_close(without_colour_of_shade(image, skin), torch.ones_like(image))
    image, skin = half_in_shade(0.2, PURPLE), torch.ones(64, 64)
    factor = without_colour_of_shade(image, skin)
    torch.testing.assert_close(without_colour_of_shade(100 * image, skin), factor)
    assert without_colour_of_shade(0 * image, skin).isfinite().all()
