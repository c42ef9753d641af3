"""Sums of a stack's lights as images, with known answers."""

import numpy as np
import pytest
import torch

from facerf_cli.cli.items.stack_composers import PersonStack
from facerf_cli.composite import Relit
from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader

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
    image = PersonStack(header(), header().seen).rows(lit(0.6), 0.0, None).whole()
    assert image.alpha is not None and image.alpha.mean() == 0.5
    np.testing.assert_allclose(image.pixels[:, :2], 0.6, rtol=1e-6)


def test_on_a_larger_photo_the_change_of_light_is_enlarged_and_the_photo_keeps_its_detail() -> None:
    photo = np.full((8, 8, 3), 0.2, np.float32)
    photo[0, 0] = 0.4  # a detail
    image = PersonStack(header(), header().seen, photo).rows(lit(0.6), 1.0, None).whole()
    assert image.alpha is None
    assert image.pixels[4, 0, 0] == pytest.approx(0.6, rel=2e-3)  # the offset that keeps the change finite
    assert image.pixels[0, 0, 0] == pytest.approx(1.2, rel=2e-3)
    np.testing.assert_allclose(image.pixels[:, -1], photo[:, -1] / 2)  # the background, as it was at 1 EV


def test_layers_of_lights_add_up() -> None:
    composer = PersonStack(header(), header().seen, np.full((8, 8, 3), 0.2, np.float32))
    apart = composer.light_layer(lit(0.2)) + composer.light_layer(lit(0.4))
    np.testing.assert_allclose(apart, composer.light_layer(lit(0.6)), rtol=1e-5)


def test_exposure_and_layers() -> None:
    composer = PersonStack(header(), header().seen)
    assert composer.exposure_ev(lit(0.4), "auto") == -1.0 and composer.exposure_ev(lit(0.4), "face") == 1.0
    assert set(composer.layers(("normal",), lit(1.0))) == {"person.A", "normal"}
    with pytest.raises(UsageError, match="--aov albedo"):
        composer.layers(("albedo",), lit(1.0))
