"""Sums of a stack's lights as images, with known answers."""

from pathlib import Path

import numpy as np
import torch

from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.relighting.relightable import Relit, RenderRequest
from facerf_cli.relighting.stack import StackImages
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
    composer = StackImages(header(), Path(), header().seen)
    assert composer.matte.mean() == 0.5
    np.testing.assert_allclose(composer.image(lit(0.6))[:, :2], 0.6, rtol=1e-6)
    one, other, both = (composer.light_layer(lit(radiance)) for radiance in (0.2, 0.4, 0.6))
    np.testing.assert_allclose(one + other, both, rtol=1e-5)
    assert composer.exposure_ev(lit(0.4), "auto") == -1.0 and composer.exposure_ev(lit(0.4), "face") == 1.0
    assert set(composer.rendered(RenderRequest(lit(1.0), layers=("normal",)))) == {"rgb", "normal"}
    refused(UsageError, "--aov albedo", composer.rendered, RenderRequest(lit(1.0), layers=("albedo",)))
