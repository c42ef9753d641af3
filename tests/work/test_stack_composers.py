"""Sums of a stack's lights as images, with known answers."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.relighting.relightable import Relit, RenderRequest
from facerf_cli.work.stack_composers import StackImages
from tests.refusals import refused
from tests.stacks import header_of

SIDE = 4


def header() -> StackHeader:
    """A grey photo of 0.2 whose left half is a person."""
    seen = np.zeros((SIDE, SIDE), np.float32)
    seen[:, :2] = 1
    return header_of([[0.0, 0.0, 1.0]], seen, 0.2, 1.0, "photo")


def lit(radiance: float) -> Relit:
    return Relit(torch.from_numpy(header().seen * radiance).expand(3, -1, -1).float())


def test_the_person_alone_has_its_colours_exposure_and_layers_that_add_up() -> None:
    image = StackImages(header(), Path(), header().seen).image(lit(0.6))
    assert image.alpha is not None and image.alpha.mean() == 0.5
    np.testing.assert_allclose(image.pixels[:, :2], 0.6, rtol=1e-6)
    composer = StackImages(header(), Path(), header().seen, np.full((8, 8, 3), 0.2, np.float32))
    one, other, both = (composer.light_layer(lit(radiance)) for radiance in (0.2, 0.4, 0.6))
    np.testing.assert_allclose(one + other, both, rtol=1e-5)
    composer = StackImages(header(), Path(), header().seen)
    assert composer.exposure_ev(lit(0.4), "auto") == -1.0 and composer.exposure_ev(lit(0.4), "face") == 1.0
    assert set(composer.rendered(RenderRequest(lit(1.0), layers=("normal",)))) == {"rgb", "normal"}
    refused(UsageError, "--aov albedo", composer.rendered, RenderRequest(lit(1.0), layers=("albedo",)))


def test_on_a_larger_photo_the_change_of_light_is_enlarged_and_the_photo_keeps_its_detail() -> None:
    photo = np.full((8, 8, 3), 0.2, np.float32)
    photo[0, 0] = 0.4  # a detail
    image = StackImages(header(), Path(), header().seen, photo).image(lit(0.6), 1.0)
    assert image.alpha is None
    assert image.pixels[4, 0, 0] == pytest.approx(0.6, rel=2e-3)  # the offset that keeps the change finite
    assert image.pixels[0, 0, 0] == pytest.approx(1.2, rel=2e-3)
    np.testing.assert_allclose(image.pixels[:, -1], photo[:, -1] / 2)  # the background, as it was at 1 EV


def test_a_large_photo_is_composed_in_rows() -> None:
    """The memory at any time is that of the rows that are read, whatever is behind the person."""
    photo = np.full((2048, 512, 3), 0.2, np.float32)
    composer = StackImages(header(), Path(), header().seen, photo)
    behind = np.full((2048, 512, 3), 3.0, np.float32)
    for given in (None, behind):
        request = RenderRequest(lit(0.6), ev=1.0, background=given)
        render, whole = composer.renderer(request), composer.rendered(request)["rgb"]
        tracemalloc.start()
        middle = render(slice(1000, 1010))["rgb"]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert middle.shape == (10, 512, 3) and peak < photo.nbytes / 10
        np.testing.assert_allclose(middle, whole[1000:1010], rtol=1e-6)
    np.testing.assert_allclose(whole[:, -1], 3.0)
