"""Coarse maps at the edges of a photo: nothing of the one side is seen on the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Window
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.raster.texture import blurred
from facerf_cli.relighting.portrait_field import PersonShading, rear_fraction
from facerf_cli.relighting.upsampled import EdgeFill, Rims, UpsampledView, colours_of, edge_confidence, places
from tests import astronaut

SIDE, SCALE = 48, 5  # pixels of the maps, and of the photo along each of them
HEIGHT, WIDTH = 180, 240
DARK, BRIGHT = 0.02, 0.4  # radiance of cloth and of skin
BESIDE, FAR = 1.0, 14.0  # pixels of the photo between the edge and what is sure, and pixels of the maps
ONES = torch.ones(SIDE, SIDE)


def skin(side: int, scale: float) -> Tensor:
    """Share of the bright half [side, side], whose edge is slanted and ends in no pixel's corner."""
    fine = (torch.arange(side * 8) + 0.5) / 8 * scale
    bright = (fine[None] > 101.3 + 0.3 * fine[:, None]).float()
    return F.avg_pool2d(bright[None], 8)[0]


def distance(side: int, scale: float) -> Tensor:
    """Distance from the edge [side, side] in pixels of the photo, above 0 in the bright half."""
    at = (torch.arange(side) + 0.5) * scale
    return (at[None] - 101.3 - 0.3 * at[:, None]) / 1.09**0.5


def mixed(share: Tensor, dark: float, bright: float) -> Tensor:
    return dark + share * (bright - dark)


def grid() -> Tensor:
    x, y = ((torch.arange(length) + 0.5) / (SIDE * SCALE) * 2 - 1 for length in (WIDTH, HEIGHT))
    return torch.stack([x.expand(HEIGHT, -1), y[:, None].expand(-1, WIDTH)], -1)


def test_two_sides_of_an_edge_keep_their_own_values() -> None:
    """Maps of 1 and 3, blurred by a pixel as those of a network are: at the photo's pixels they are sharp."""
    colours = colours_of(mixed(skin(SIDE, SCALE), DARK, BRIGHT)).expand(3, -1, -1)
    maps = blurred(mixed(skin(SIDE, SCALE), 1, 3)[None], 1.0)
    trust = edge_confidence(colours, ONES, 0 * ONES)
    photo = mixed(skin(SIDE * SCALE, 1), DARK, BRIGHT)[:HEIGHT, :WIDTH, None].expand(-1, -1, 3)
    read = places(colours, trust, grid(), photo, 1.0)
    found, bled = (
        F.grid_sample(values[None], at[None], padding_mode="border", align_corners=False)[0, 0]
        for values, at in ((EdgeFill.of(colours, trust, ONES, trust).filled(maps), read), (maps, grid()))
    )
    away = distance(SIDE * SCALE, 1)[:HEIGHT, :WIDTH]
    sure = away.abs() > BESIDE
    wanted = torch.where(away > 0, 3.0, 1.0)
    assert (bled - wanted)[sure].abs().max() > 0.5
    assert (found - wanted)[sure].abs().max() < 0.1


def test_a_block_of_light_on_plain_cloth_fades_and_none_of_it_crosses_an_edge() -> None:
    share = skin(SIDE, SCALE)
    colours = colours_of(mixed(share, DARK, BRIGHT)).expand(3, -1, -1)
    trust = edge_confidence(colours, ONES, 0 * ONES)
    away = distance(SIDE, SCALE) / SCALE
    jumps = torch.where(away > 6, 3.0, 1.0)[None]  # within the bright half
    found = EdgeFill.of(colours, trust, ONES, 0 * ONES).filled(jumps)[0]
    rows = slice(8, -8)
    steepest = found[rows].diff(dim=1).abs().max()
    assert steepest < 0.3 * jumps.diff(dim=2).max()
    dark = away < -1
    assert (found[dark] - 1).abs().max() < 0.05


def test_where_there_is_no_edge_nothing_changes() -> None:
    """Nor at edges of what is not solid, as of features of a face, or of what is hair."""
    shades = torch.linspace(0.3, 0.6, SIDE).expand(3, SIDE, -1)
    edges = colours_of(mixed(skin(SIDE, SCALE), DARK, BRIGHT)).expand(3, -1, -1)
    maps = torch.rand(2, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    photo = torch.full((HEIGHT, WIDTH, 3), 0.2)
    for colours, solid, loose in ((shades, 1, 0), (edges, 0, 0), (edges, 1, 1)):
        trust = edge_confidence(colours, solid * ONES, loose * ONES)
        assert torch.equal(EdgeFill.of(colours, trust, ONES, trust).filled(maps), maps)
        assert torch.equal(places(colours, trust, grid(), photo, 1.0), grid())


@pytest.mark.parametrize("glossy", [False, True])
def test_no_light_of_a_hand_is_on_the_cloth_behind_it(glossy: bool) -> None:
    """The hand is cloth to the segmentation, and light on it is four times as bright.

    A block of light elsewhere on the cloth has no hard edge.
    """
    view = astronaut.field().views[0]
    size = view.person.image.shape[-1]
    side_px = 2 * size  # of the square, which the photo is a little wider than
    share = skin(size, 2)
    classes = torch.zeros(len(CLASSES), size, size)
    classes[class_index("garment"), :, :-20] = 1
    classes[class_index("skin"), :, -20:] = 1
    person = replace(
        view.person,
        square=Crop(0.0, 0.0, float(side_px), size),
        image=mixed(share, DARK, BRIGHT).expand(3, -1, -1),
        classes=classes,
    )
    flat = torch.ones(1, 3, size, size)
    maps = view.maps._replace(albedo=flat * person.image / person.exposure)
    lit = blurred(mixed(share, 0.5, 2).expand(3, -1, -1), 1.0)
    lit[..., :20] *= 2
    parts = (0 * lit, lit) if glossy else (lit, 0 * lit)
    light = PersonShading(*parts, visibility=lit, rear=torch.zeros(6, size, size))
    both = skin(side_px + 20, 1)[:side_px], distance(side_px + 20, 1)[:side_px].numpy()
    photo = mixed(both[0], DARK, BRIGHT)[..., None].expand(-1, -1, 3).numpy().copy()
    enlarged = UpsampledView(replace(view, person=person, maps=maps))
    shown = enlarged.over(Window(slice(0, side_px), slice(0, side_px + 20)), photo)
    relit = luminance(shown(enlarged.precompute(light))["rgb"])
    cloth, far = (both[1] < -BESIDE) & (both[1] > -FAR), (both[1] < -FAR) & (both[1] > -3 * FAR)
    assert np.abs(np.diff(relit, axis=1))[:, 30:50].max() < 0.15 * relit[far].mean()
    assert np.abs(relit[cloth] / relit[far].mean() - 1).max() < (0.2 if glossy else 0.15)


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
    assert float(rear_fraction(azel_to_direction(azimuth_deg, 0))) == pytest.approx(share)
