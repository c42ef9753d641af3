"""Light of a background over a matte's edge."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

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
