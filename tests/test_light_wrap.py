"""Light of a background over a matte's edge, and the haze of a picture, as PNG shows them."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from facerf_cli.image.haze import Haze, haze_of
from facerf_cli.image.light_wrap import LightWrap
from facerf_cli.image.strips import STRIP_PX


@pytest.mark.parametrize("size", [(96, 150), (1037, 523), (531, 1290)])
def test_it_is_the_blurred_background_within_the_matte_at_any_size(size: tuple[int, int]) -> None:
    """A person with a soft outline, before a picture that is brighter and warmer to the right."""
    y, x = (np.arange(length)[:, None] / max(size) for length in size)
    matte = np.clip(0.5 - 40 * (np.hypot(y - 0.2, x.T - 0.25) - 0.12), 0, 1).astype(np.float32)
    picture = (x.T[..., None] * (1.0, 0.8, 0.5) + 0.1 + 0 * y[..., None]).astype(np.float32)
    sigma = 0.012 * max(size)
    blurred = gaussian_filter((1 - matte[..., None]) * picture, (sigma, sigma, 0), mode="nearest")
    wrap = LightWrap(picture, matte, 0.7)
    found = np.concatenate([wrap[slice(0, 40)], wrap[slice(40, size[0])]])
    assert found.dtype == np.float32 and found.max() > 0.03
    np.testing.assert_allclose(found, 0.7 * matte[..., None] * blurred, atol=0.004)


def test_a_large_background_is_read_in_strips() -> None:
    most = 0

    class Wall:
        def __getitem__(self, rows: slice, /) -> np.ndarray:
            nonlocal most
            most = max(most, 3000 * (rows.stop - rows.start))
            return np.ones((rows.stop - rows.start, 3000, 3), np.float32)

    matte = np.broadcast_to(np.float32(0.5), (2000, 3000))
    np.testing.assert_allclose(LightWrap(Wall(), matte, 1.0)[slice(1990, 2000)], 0.25, rtol=1e-5)
    assert most <= STRIP_PX


def test_a_person_is_kept_within_the_tones_of_a_picture() -> None:
    ramp = np.linspace(0.05, 0.6, 400, dtype=np.float32)
    grey = np.broadcast_to(ramp[None, :, None], (300, 400, 3))
    haze = haze_of(grey, (300, 400))
    assert haze.black == pytest.approx(0.0555, abs=2e-3) and haze.white == pytest.approx(0.5945, abs=2e-3)
    person = np.array([0, 0.1, 0.5, 1, 8], np.float32)[None, :, None].repeat(3, -1)
    shown = haze.over(person, np.ones((1, 5), np.float32))[0, :, 0]
    assert shown[0] == pytest.approx(haze.black) and shown[-1] == pytest.approx(haze.white)
    assert (np.diff(shown) > 0).all()
    assert shown[1] == pytest.approx(haze.black + 0.1 * (1 - haze.black))
    np.testing.assert_array_equal(haze.over(person, np.zeros((1, 5), np.float32)), person)
    half = haze.over(person, np.full((1, 5), 0.5, np.float32))[0, :, 0]
    np.testing.assert_allclose(half, (shown + person[0, :, 0]) / 2, rtol=1e-6)


def test_grass_is_no_haze_and_a_wall_veils_little() -> None:
    grass = np.broadcast_to(np.float32((0.2, 0.4, 0.0)), (30, 40, 3))
    assert haze_of(grass, (30, 40)) == Haze(0.0, pytest.approx(0.4))
    night = np.zeros((30, 40, 3), np.float32)
    assert haze_of(night, (30, 40)) == Haze(0.0, 0.4)
    assert haze_of(night + 1.5, (30, 40)) == Haze(0.1, 1.5)
    bright = np.full((1, 2, 3), 0.9, np.float32)
    np.testing.assert_array_equal(Haze(0.0, 1.5).over(bright, np.ones((1, 2), np.float32)), bright)
