"""Light from behind is moved toward the outline, and fades inside."""

import numpy as np
import pytest
import torch

from facerf_cli.image.strips import Window
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.relighting.rims import Rims, from_behind

FACE_PX, EDGE_PX = 200.0, 100
SIZE_PX = (48, 400)


def half_plane() -> Rims:
    """Of a person to the right of a column, to the frame's border."""
    matte = np.zeros(SIZE_PX, np.float32)
    matte[:, EDGE_PX:] = 1
    return Rims(matte, FACE_PX)


@pytest.mark.parametrize("width_px", [2.0, 8.0, 1e9])
def test_light_near_the_outline_stays_and_none_is_added(width_px: float) -> None:
    """The sum over pixels of S(g(d)) g'(d) is that of S, less what fades inside."""
    offsets_px, brightness = half_plane().at(Window(slice(10, 11), slice(EDGE_PX, SIZE_PX[1])))
    inside_px = torch.arange(SIZE_PX[1] - EDGE_PX) + 0.5
    before = torch.exp(-inside_px / width_px)
    after = torch.exp(-(inside_px + offsets_px[0, 0]) / width_px) * brightness[0]
    assert float(after.sum()) < 1.03 * float(before.sum())
    if width_px < 0.04 * FACE_PX:  # nearly all of it lies where nothing fades
        assert float(after.sum()) > 0.9 * float(before.sum())
    assert offsets_px[1].abs().max() < 1e-3 and brightness.min() >= 0


def test_a_rim_is_thinner_and_brighter_and_none_is_far_inside() -> None:
    offsets_px, brightness = half_plane().at(Window(slice(10, 11), slice(EDGE_PX, SIZE_PX[1])))
    inside_px = torch.arange(SIZE_PX[1] - EDGE_PX) + 0.5
    before = torch.exp(-inside_px / 16)
    after = torch.exp(-(inside_px + offsets_px[0, 0]) / 16) * brightness[0]
    assert after[0] > 1.7 * before[0]
    half = [int((line > line[0] / 2).sum()) for line in (before, after)]
    assert half[1] < 0.7 * half[0]
    far = slice(EDGE_PX + round(FACE_PX / 4), SIZE_PX[1])
    whole = Rims(np.ones(SIZE_PX, np.float32), FACE_PX).at(Window(slice(0, SIZE_PX[0]), slice(0, SIZE_PX[1])))
    inside = half_plane().at(Window(slice(0, SIZE_PX[0]), far))
    for (offsets_px, brightness), wanted in ((inside, 0), (whole, 1)):
        assert offsets_px.abs().max() == 0 and (brightness == wanted).all()


def test_rims_lie_along_the_outline_of_a_photo_of_any_size() -> None:
    """Around a disc of a quarter of the frame they are the same in a frame four times as large."""

    def of(side_px: int) -> torch.Tensor:
        at = (np.arange(side_px) + 0.5) / side_px - 0.5
        matte = (np.hypot(*np.meshgrid(at, at)) < 0.25).astype(np.float32)
        offsets_px, brightness = Rims(matte, side_px / 2).at(Window(slice(0, side_px), slice(0, side_px)))
        return torch.cat([offsets_px / side_px, brightness[None]])

    small, large = of(320), of(1280)
    means = torch.nn.functional.avg_pool2d(large, 4)
    assert (small - means).abs().mean() < 0.02 * small.std()


@pytest.mark.parametrize(("azimuth_deg", "share"), [(0, 0), (90, 0), (110, 0), (160, 1)])
def test_a_light_ahead_or_aside_makes_no_rim(azimuth_deg: float, share: float) -> None:
    assert float(from_behind(azel_to_direction(azimuth_deg, 0))) == pytest.approx(share)
