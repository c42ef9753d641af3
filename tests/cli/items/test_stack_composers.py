"""Sums of a stack's lights as images, with known answers."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.image.strips import filled, whole
from facerf_cli.relighting.composition import Relit
from facerf_cli.work.stack_composers import StackImages

SIDE = 4


def header() -> StackHeader:
    """A grey photo of 0.2 whose left half is a person."""
    seen = np.zeros((SIDE, SIDE), np.float32)
    seen[:, :2] = 1
    return StackHeader(
        kind="photo",
        directions=np.array([[0.0, 0.0, 1.0]]),
        rotation=np.eye(3),
        source=np.full((SIDE, SIDE, 3), 0.2, np.float32),
        seen=seen,
        normals=np.ones((SIDE, SIDE, 3), np.float32),
        layout_version=1,
        fit={},
    )


def lit(radiance: float) -> Relit:
    return Relit(torch.from_numpy(header().seen * radiance).expand(3, -1, -1).float())


def test_alone_the_person_has_its_own_colours_and_the_matte_as_alpha() -> None:
    image = filled(StackImages(header(), Path(), header().seen).bands(lit(0.6), 0.0, None), SIDE, SIDE)
    assert image["A"].mean() == 0.5
    np.testing.assert_allclose(image["rgb"][:, :2], 0.6, rtol=1e-6)


def test_on_a_larger_photo_the_change_of_light_is_enlarged_and_the_photo_keeps_its_detail() -> None:
    photo = np.full((8, 8, 3), 0.2, np.float32)
    photo[0, 0] = 0.4  # a detail
    image = filled(StackImages(header(), Path(), header().seen, photo).bands(lit(0.6), 1.0, None), 8, 8)
    assert set(image) == {"rgb"}
    assert image["rgb"][4, 0, 0] == pytest.approx(0.6, rel=2e-3)  # the offset that keeps the change finite
    assert image["rgb"][0, 0, 0] == pytest.approx(1.2, rel=2e-3)
    np.testing.assert_allclose(image["rgb"][:, -1], photo[:, -1] / 2)  # the background, as it was at 1 EV


def test_layers_of_lights_add_up() -> None:
    composer = StackImages(header(), Path(), header().seen, np.full((8, 8, 3), 0.2, np.float32))
    one, other, both = (whole(composer.light_layer(lit(radiance)), 8, 8) for radiance in (0.2, 0.4, 0.6))
    np.testing.assert_allclose(one + other, both, rtol=1e-5)


def test_a_large_photo_is_composed_in_rows() -> None:
    """The memory at any time is that of the rows that are read, whatever is behind the person."""
    photo = np.full((2048, 512, 3), 0.2, np.float32)
    composer = StackImages(header(), Path(), header().seen, photo)
    behind = np.full((2048, 512, 3), 3.0, np.float32)
    for given in (None, behind.__getitem__):
        image = composer.bands(lit(0.6), 1.0, given)["rgb"]
        tracemalloc.start()
        middle = image(slice(1000, 1010))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert middle.shape == (10, 512, 3) and peak < photo.nbytes / 10
        np.testing.assert_allclose(middle, whole(image, 2048, 512)[1000:1010], rtol=1e-6)
    np.testing.assert_allclose(whole(image, 2048, 512)[:, -1], 3.0)


def test_exposure_and_layers() -> None:
    composer = StackImages(header(), Path(), header().seen)
    assert composer.exposure_ev(lit(0.4), "auto") == -1.0 and composer.exposure_ev(lit(0.4), "face") == 1.0
    assert set(composer.layers(("normal",), lit(1.0))) == {"person.A", "normal"}
    with pytest.raises(UsageError, match="--aov albedo"):
        composer.layers(("albedo",), lit(1.0))
