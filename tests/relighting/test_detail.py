"""The detail of a photo in relit images: what is restored, what is limited, what fades."""

import numpy as np
import torch
from scipy.ndimage import binary_erosion, gaussian_filter
from torch import Tensor

from facerf_cli.light.light import Light
from facerf_cli.relighting.detail import contrast, finer_detail, lost_detail
from tests import astronaut

SKIN = torch.tensor([0.35, 0.25, 0.18])
SIDE, SIGMA = 64, 2.0
ONES = torch.ones(SIDE, SIDE)


def grain(scale: float, channels: int = 1) -> Tensor:
    """Contrast [channels, S, S] as logarithms, finer than the blur."""
    return scale * torch.randn(channels, SIDE, SIDE, generator=torch.Generator().manual_seed(1))


def restored(kept: Tensor, shown: Tensor, hair: float = 0.0) -> Tensor:
    """Factor that an albedo gets, given logarithms of it and of the photo."""
    base = SKIN[:, None, None]
    photo, albedo = (contrast(base * logs.exp(), ONES, SIGMA, 0.0) for logs in (shown, kept))
    grey, colour = (one - other for one, other in zip(photo, albedo, strict=True))
    return lost_detail(grey, colour, ONES, SIGMA, hair)


def test_lost_detail_is_restored() -> None:
    """Colour comes back whatever its strength, luminance as far as it is faint, or that of hair."""
    for logs, hair, least in ((grain(0.05), 0.0, 0.9), (grain(0.4), 1.0, 0.95)):
        logs = logs.expand(3, -1, -1)
        mended = 0.5 * logs + restored(0.5 * logs, logs, hair).log()
        want, have = (contrast(x.exp(), ONES, SIGMA, 0.0)[0] for x in (logs, mended))
        assert least < float((have * want).sum() / (want * want).sum()) < 1.02
    colour = grain(0.15, 3)
    colour = colour - colour.mean(0)
    mended = 0.5 * colour + restored(0.5 * colour, colour).log()
    want, have = (contrast(x.exp(), ONES, SIGMA, 0.0)[1] for x in (colour, mended))
    assert 0.9 < float((have * want).sum() / (want * want).sum()) < 1.02


def test_the_edge_of_a_shadow_that_the_network_removed_stays_removed() -> None:
    shadow = torch.where(torch.arange(SIDE) < SIDE // 2, -1.5, 0.0).expand(3, SIDE, SIDE)
    factor = restored(0 * shadow, shadow)[:, SIDE // 2, SIDE // 2 - 1]
    assert (factor.log().abs() < 0.15).all()  # of .75 that the blur leaves of it


def factor(pixel: Tensor, coarse: Tensor = SKIN, skin: float = 1.0) -> Tensor:
    return finer_detail(pixel[None, None], coarse[None, None], torch.full((1, 1, 1), skin), SKIN)[0, 0]


def test_freckles_stay_and_highlights_of_the_old_light_are_limited() -> None:
    freckle = SKIN * torch.tensor([0.7, 0.6, 0.5])
    torch.testing.assert_close(factor(freckle) * SKIN, freckle, rtol=0.02, atol=0)
    assert (factor(3 * SKIN) < 1.3).all()
    torch.testing.assert_close(factor(3 * SKIN, skin=0.0) * SKIN, 3 * SKIN, rtol=0.03, atol=0)


def test_shade_beyond_an_edge_draws_no_dark_line_on_skin() -> None:
    shaded = 0.02 * SKIN
    assert (factor(shaded) > 0.3).all() and (factor(shaded, skin=0.0) < 0.05).all()


def test_noise_of_black_pixels_gets_no_colour() -> None:
    black = 0.002 * SKIN
    noisy = black * torch.tensor([3.0, 0.1, 3.0])
    assert (factor(noisy, black) / factor(noisy, black).mean() - 1).abs().max() < 0.35  # 1.95 in the photo
    assert (factor(torch.tensor([0.5, 0.0, 0.0])) / factor(torch.tensor([0.5, 0.0, 0.0])).mean() < 2.5).all()


def test_luminance_fades_where_skin_glares() -> None:
    """Glare is brighter and whiter than skin; a lit cheek is only brighter, grey stubble only whiter."""

    def kept(coarse: Tensor) -> float:
        return float(factor(0.8 * coarse, coarse).mean().log() / np.log(0.8))

    assert kept(1.2 * SKIN + 0.3) < 0.4
    assert kept(1.7 * SKIN) > 0.9 and kept(0.5 * SKIN + 0.05) > 0.9


def test_a_relit_face_keeps_the_photos_colour_detail() -> None:
    """Under white light from everywhere, the contrast of red's share on skin, at 1 to 4 pixels."""
    person, photo = astronaut.person(), astronaut.photo()
    relit = np.asarray(person.relight(Light.uniform()))
    skin = binary_erosion(person.reflectance.person.segmentation.layer("skin") > 0.9, iterations=5)

    def detail(image: np.ndarray) -> np.ndarray:
        red = image[..., 0] / image.sum(-1).clip(1e-4)
        return (gaussian_filter(red, 1.0) - gaussian_filter(red, 4.0))[skin]

    of_photo, of_relit = detail(photo), detail(relit)
    assert 0.6 < of_relit.std() / of_photo.std() < 1.1
    assert np.corrcoef(of_photo, of_relit)[0, 1] > 0.85
