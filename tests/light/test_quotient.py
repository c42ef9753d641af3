import torch

from facerf_cli.light.quotient import Quotient

SEEN = torch.ones(16, 16)


def _images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    explained = 0.3 + 0.4 * torch.rand(3, 16, 16, generator=generator)
    return explained * (0.8 + 0.4 * torch.rand(3, 16, 16, generator=generator)), explained


def test_under_the_photos_own_light_the_error_goes() -> None:
    photo, explained = _images()
    corrected = Quotient.of(photo, explained, SEEN).corrected(explained[None])[0]
    assert (corrected - photo).norm() < 0.25 * (explained - photo).norm()


def test_a_light_that_shades_otherwise_is_left_alone() -> None:
    photo, explained = _images()
    side = torch.zeros(1, 3, 16, 16)
    side[..., :2] = 0.5
    other = Quotient.of(photo, explained, SEEN).corrected(side)
    assert torch.allclose(other, side, rtol=0.02)


def test_texels_that_the_photo_does_not_show_are_left_alone_and_ratios_are_bounded() -> None:
    photo, explained = _images()
    seen = SEEN.clone()
    seen[:8] = 0
    quotient = Quotient.of(100 * photo, explained, seen)
    assert (quotient.ratio[:, :8] == 1).all()
    assert quotient.ratio.max() <= 3


def test_black_and_larger_textures_stay_finite_and_keep_their_shape() -> None:
    photo, explained = _images()
    quotient = Quotient.of(torch.zeros_like(photo), torch.zeros_like(explained), SEEN)
    corrected = quotient.corrected(torch.zeros(2, 3, 64, 64))
    assert corrected.shape == (2, 3, 64, 64) and (corrected == 0).all()
