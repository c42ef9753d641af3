"""Depth of a person at the photo's resolution, of a proxy of two cards at known places."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from facerf_cli.face.crop import Crop
from facerf_cli.face.view import photo_camera
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.portrait.proxy import Proxy
from facerf_cli.raster.camera import PIXEL_CENTRE, project
from facerf_cli.relighting.people_in_photo import Surface

SIZE = 200, 300  # of the photo
SMALL = 50, 75  # of the classes
CROP = Crop(100.0, 50.0, 100.0, 64)
HEAD_M, BODY_M = 1.0, 1.2
ROWS = slice(0, SIZE[0])


@pytest.fixture(scope="module")
def surface() -> Surface:
    """A near card, the head, above a far one, whose upper end it hides; hair and cloth go on at the right."""
    near, far = card(HEAD_M, -0.05, 0.02), card(BODY_M, -0.12, -0.01)
    triangles = torch.tensor([[0, 1, 2], [0, 2, 3]])
    proxy = Proxy.of(torch.cat([near, far]), torch.cat([triangles, triangles + 4]))
    label = torch.zeros(SMALL, dtype=torch.long)
    label[:30, 20:70], label[30:, 20:70] = class_index("hair"), class_index("garment")
    classes = torch.nn.functional.one_hot(label, len(CLASSES)).permute(2, 0, 1).float()
    person = SimpleNamespace(
        proxy=proxy, fit=SimpleNamespace(crop=CROP), segmentation=SimpleNamespace(classes=classes)
    )
    return Surface(cast(Any, person), SIZE)


def card(depth_m: float, low: float, high: float) -> torch.Tensor:
    """Corners [4, 3] of a card before the camera, between two heights at the depth of 1 m."""
    corners = [[-0.05, low, -1], [0.05, low, -1], [0.05, high, -1], [-0.05, high, -1]]
    return torch.tensor(corners) * depth_m


def test_depth_and_positions_lie_on_the_surfaces_row_by_row(surface: Surface) -> None:
    """Neither where one hides the other nor beyond them: hair goes on with the head, cloth with the body."""
    depth_m = surface.depth_m(ROWS)[..., 0]
    near, far = (np.abs(depth_m - known) < 1e-3 for known in (HEAD_M, BODY_M))
    assert (near | far)[:, 80:280].all()
    row_of_edge = round(photo_camera(CROP, *SIZE).cy_px + 0.05 * photo_camera(CROP, *SIZE).focal_px)
    assert near[:row_of_edge, 140:160].all() and far[row_of_edge:, 140:160].all()  # the cards
    assert near[:112, 200:280].all() and far[128:, 200:280].all()  # beyond them, by classes
    places_px = project(torch.from_numpy(surface.position_m(ROWS)), photo_camera(CROP, *SIZE))
    x, y = np.meshgrid(*(np.arange(length) + PIXEL_CENTRE for length in SIZE[::-1]))
    np.testing.assert_allclose(places_px, np.stack([x, y], -1), atol=1e-3)
    np.testing.assert_allclose(surface.depth_m(slice(64, 96)), surface.depth_m(ROWS)[64:96], atol=1e-6)
