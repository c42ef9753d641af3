"""The outlines in the package are those that their recipe draws, through splines like scipy's."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from facerf_cli.face.topology import OUTLINES_PATH, REGIONS
from tools.face_regions import build, cubic_spline


def test_the_asset_is_what_the_recipe_draws() -> None:
    outlines = build()
    with np.load(OUTLINES_PATH, allow_pickle=False) as stored:
        assert set(stored) == set(outlines) == set(REGIONS) - {"skin"}
        for name, outline in outlines.items():
            np.testing.assert_allclose(stored[name], outline, atol=1e-9)


@pytest.mark.parametrize("count", [4, 5, 17])
def test_an_outline_is_the_spline_of_scipy(count: int) -> None:
    points = np.cumsum(np.random.default_rng(count).random((count, 2)), 0)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    at = np.interp(np.linspace(0, count - 1, 6 * count - 5), np.arange(count), length)
    np.testing.assert_allclose(cubic_spline(points), CubicSpline(length, points)(at), atol=1e-12)
