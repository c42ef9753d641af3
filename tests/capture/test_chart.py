"""The colour chart: its colours, its geometry, and the fit, against rendered charts and colour-science."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

from facerf_cli.capture.chart import GREYS, centres, fit_colours, neutral_matrix, published_colours, sample
from facerf_cli.image.colour import REC709_CHROMATICITIES, luminance, matrix_to_rec709, rgb_to_xyz
from tests.capture.chart_image import CAMERA, CORNERS, chart_image, kept_luminance

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # colour-science warns of optional packages that are not there
    import colour as oracle


def test_published_colours_are_those_of_the_chart() -> None:
    """X-Rite's L*a*b* under D50 of dark skin, orange and neutral 5, by matrices of our own."""
    published = published_colours()
    white_xy = (0.34567, 0.35850)
    primaries = (*REC709_CHROMATICITIES[:6], *white_xy)
    to_rec709 = matrix_to_rec709(primaries) @ np.linalg.inv(rgb_to_xyz(primaries))
    for place, lab in ((0, (37.54, 14.37, 14.92)), (6, (62.73, 35.83, 56.5)), (21, (50.76, -0.13, 0.14))):
        y = (lab[0] + 16) / 116
        xyz = np.array([y + lab[1] / 500, y, y - lab[2] / 200]) ** 3 * rgb_to_xyz(primaries).sum(1)
        np.testing.assert_allclose(published[place], to_rec709 @ xyz, atol=2e-3)
    greys = published[GREYS]
    assert (np.ptp(greys, -1) < 0.06 * greys.max(-1)).all()  # nearly neutral under D65: adapted from D50


def test_a_camera_is_undone_and_luminance_stays() -> None:
    fit = fit_colours(0.37 * published_colours() @ CAMERA.T)
    np.testing.assert_allclose(fit.matrix, kept_luminance(CAMERA), atol=1e-6)
    assert fit.delta_e_after.max() < 1e-3 < 5 < fit.delta_e_before.mean()
    np.testing.assert_allclose(fit.light, 1, atol=1e-6)
    greys = (published_colours() @ CAMERA.T)[GREYS].sum(0)
    assert luminance(fit.matrix @ greys) == pytest.approx(luminance(greys))


def test_light_that_falls_off_is_taken_off_and_greys_stay_exact() -> None:
    light = np.exp(centres() @ [0.07, -0.05])
    fit = fit_colours(published_colours() @ CAMERA.T * light[:, None])
    np.testing.assert_allclose(fit.light / fit.light[0], light / light[0], rtol=1e-3)
    np.testing.assert_allclose(fit.matrix, kept_luminance(CAMERA), atol=2e-3)
    assert fit.delta_e_after.mean() < 0.05
    noisy = published_colours() * np.exp(0.2 * np.random.default_rng(1).standard_normal((24, 3)))
    matrix, level = neutral_matrix(noisy, published_colours())
    greys, wanted = noisy[GREYS].sum(0), published_colours()[GREYS].sum(0)
    np.testing.assert_allclose(matrix @ greys, level * wanted)
    assert luminance(matrix @ greys) == pytest.approx(luminance(greys))


def test_without_bound_greys_it_is_the_least_squares_of_colour_science() -> None:
    """Greys that are where they belong bind nothing: both fits are the same."""
    draw = np.random.default_rng(2)
    measured = published_colours() @ CAMERA.T
    measured[:18] *= 1 + 0.01 * draw.standard_normal((18, 3))
    matrix, level = neutral_matrix(measured, published_colours())
    plain = oracle.matrix_colour_correction(measured, level * published_colours(), "Finlayson 2015", degree=1)
    np.testing.assert_allclose(matrix, plain, atol=0.03)


def test_importing_colour_science_changes_nothing_and_nothing_is_printed_at_the_end() -> None:
    program = (
        "import numpy as np, warnings\n"
        "import OpenImageIO as oiio\n"
        "from facerf_cli.capture.chart import published_colours\n"
        "before, filters = np.get_printoptions(), list(warnings.filters)\n"
        "published_colours()\n"
        "import OpenImageIO\n"
        "assert OpenImageIO is oiio\n"
        "assert np.get_printoptions() == before, np.get_printoptions()\n"
        "assert warnings.filters == filters\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_middles_are_sampled_and_noise_and_clipping_counted() -> None:
    patches = sample(chart_image(noise=0.0, exposure=1.0), CORNERS)
    np.testing.assert_allclose(patches.colours, published_colours(), atol=1e-6)
    assert patches.counts.min() > 150 and patches.noise.max() < 1e-6 and not patches.at_white.any()
    careless = CORNERS + np.array([[4, -4], [-4, 4], [4, 4], [-4, -4]])
    patches = sample(chart_image(noise=0.0, exposure=1.0), careless)
    np.testing.assert_allclose(patches.colours, published_colours(), atol=1e-6)
    patches = sample(chart_image(noise=0.02, exposure=1.13).clip(max=1), CORNERS)
    grey = 1.13 * published_colours()[19, 1]
    assert patches.noise[19] == pytest.approx(0.02 * np.sqrt(grey + 0.01), rel=0.15)
    assert 0.2 < patches.at_white[18] < 0.9 and not patches.at_white[[0, 5, 20]].any()
