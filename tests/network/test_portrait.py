"""The Portrait Network's images against known answers."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.network.portrait import (
    SKIN,
    PortraitInputs,
    PortraitMaps,
    PortraitNetwork,
    PortraitSettings,
    reached_by,
    skin_exposure,
)
from facerf_cli.raster.texture import Pixels

SIDE = 32
TINY = PortraitSettings((8, 8, 12), (0, 1, 1), side=SIDE)


def inputs() -> PortraitInputs:
    random = torch.Generator().manual_seed(0)
    classes = torch.zeros(1, 14, SIDE, SIDE)
    classes[:, SKIN] = 1
    normals = F.normalize(torch.randn(1, 3, SIDE, SIDE, generator=random), dim=1)
    one = torch.ones(1, 1, SIDE, SIDE)
    image = torch.rand(1, 3, SIDE, SIDE, generator=random)
    return PortraitInputs(image, classes, normals, 0 * one, one, one.expand(-1, 16, -1, -1), 2 * one)


def plain_maps() -> PortraitMaps:
    """A matt surface of albedo 0.5 that faces the camera; the proxy's shadows are taken as they are."""
    wide, half = (SIDE, SIDE), (SIDE // 2, SIDE // 2)
    up = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1).expand(1, 3, *wide)
    strands, zeros = torch.tensor([0.0, 1, 0]).view(1, 3, 1, 1).expand_as(up), torch.zeros(1, 3, *wide)
    few, many = torch.zeros(1, 16, *half), torch.zeros(1, 25, *half)
    hair, trust = zeros[:, :1], zeros[:, :1] + 50
    return PortraitMaps(zeros + 1, zeros, zeros + 0.5, up, strands, zeros, hair, trust, few, few, many)


def random_maps(seed: int) -> PortraitMaps:
    random = torch.Generator().manual_seed(seed)
    wide, half = (1, 3, SIDE, SIDE), (SIDE // 2, SIDE // 2)
    return plain_maps()._replace(
        albedo=torch.rand(wide, generator=random),
        normals=F.normalize(torch.randn(wide, generator=random), dim=1),
        strands=F.normalize(torch.randn(wide, generator=random), dim=1),
        gloss=torch.rand(wide, generator=random),
        trust=torch.rand(1, 1, SIDE, SIDE, generator=random),
        lit=torch.randn(1, 16, *half, generator=random),
        around=torch.randn(1, 16, *half, generator=random),
        shadow=torch.randn(1, 25, *half, generator=random),
    )


def one_light(azimuth_deg: float, elevation_deg: float) -> Tensor:
    return azel_to_direction(azimuth_deg, elevation_deg)[None, None]


def lit_everywhere(lights: int = 1) -> Tensor:
    return torch.ones(1, lights, SIDE, SIDE)


def test_a_matt_surface_follows_the_cosine_and_the_proxys_shadow() -> None:
    visible = lit_everywhere()
    visible[..., SIDE // 2 :] = 0
    image = plain_maps().olats(one_light(60, 0), visible)[0, 0]
    torch.testing.assert_close(image[..., : SIDE // 2], torch.full((3, SIDE, SIDE // 2), 0.25))
    assert image[..., SIDE // 2 :].max() < 1e-6
    behind = plain_maps().olats(one_light(120, 0), lit_everywhere())
    assert behind.abs().max() == 0


def test_shadows_are_moved_by_the_corrections_of_their_direction() -> None:
    """logit V' = a (2 V - 1) + sum_k b_k W_k."""
    light = one_light(30, 20)
    constant = torch.zeros(1, 25, SIDE // 2, SIDE // 2)
    constant[:, 0] = 3.0
    maps = plain_maps()._replace(trust=torch.full((1, 1, SIDE, SIDE), 2.0), shadow=constant)
    _, _, visible = maps.shaded(light, 0 * lit_everywhere())
    y0 = float(sh_basis(light, 0))
    torch.testing.assert_close(visible, torch.full_like(visible, 1 / (1 + math.exp(2 - 3 * y0))))


def test_light_round_corners_needs_no_visibility_and_is_never_negative() -> None:
    around = torch.zeros(1, 16, SIDE // 2, SIDE // 2)
    around[:, 3] = 1.0  # degree 1 along x
    maps = plain_maps()._replace(around=around)
    right, left = (maps.olats(one_light(azimuth, 0), 0 * lit_everywhere()) for azimuth in (90, -90))
    expected = 0.5 * float(sh_basis(one_light(90, 0), 1)[..., 3])
    torch.testing.assert_close(right, torch.full_like(right, expected))
    assert left.max() == 0


def test_highlights_lie_at_the_half_vector_and_strands_shine_across_themselves() -> None:
    """Lobe j: (sharpness / 8) (n . h) ^ sharpness, in shadow none."""
    gloss = torch.zeros(1, 3, SIDE, SIDE)
    gloss[:, 1] = 0.1
    maps = plain_maps()._replace(gloss=gloss)
    ahead = maps.olats(one_light(0, 0), lit_everywhere())
    torch.testing.assert_close(ahead, torch.full_like(ahead, 0.5 + 0.1 * 45 / 8), rtol=1e-3, atol=0)
    aside = maps.olats(one_light(60, 0), lit_everywhere())
    wanted = 0.25 + 0.1 * 45 / 8 * math.cos(math.radians(30)) ** 45
    torch.testing.assert_close(aside, torch.full_like(aside, wanted), rtol=1e-3, atol=0)
    assert maps.olats(one_light(0, 0), 0 * lit_everywhere()).max() < 1e-6
    gloss = torch.zeros(1, 3, SIDE, SIDE)
    gloss[:, 2] = 0.1
    maps = plain_maps()._replace(gloss=gloss, hair=1 + gloss[:, :1])  # the strands are upright
    aside, above = (
        maps.shaded(one_light(*at), lit_everywhere())[1].mean() for at in ((60.0, 0.0), (0.0, 60.0))
    )
    assert aside == pytest.approx(0.1, rel=1e-3) and above < 0.05


def test_near_lights_have_a_direction_for_each_pixel() -> None:
    """Where all directions are one, they are that of a far light; halves lit apart are two far lights."""
    pixels = Pixels.of(torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(6)) < 0.4)
    maps, visible = random_maps(seed=3), pixels.values(lit_everywhere(2))
    seen, half = maps.at(pixels), len(pixels.numbers) // 2
    lights = torch.cat([one_light(40, 20), one_light(-60, 10)], 1)
    far = pixels.values(maps.olats(lights, lit_everywhere(2)))
    by_pixel = lights[:, :, None, None].expand(-1, -1, 1, len(pixels.numbers), -1)
    torch.testing.assert_close(seen.olats(by_pixel, visible), far, rtol=1e-4, atol=1e-6)
    split = torch.cat([by_pixel[:, :1, :, :half], by_pixel[:, 1:, :, half:]], 3)
    found = seen.olats(split, visible[:, :1])[0, 0]
    wanted = torch.cat([far[0, 0, ..., :half], far[0, 1, ..., half:]], -1)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-6)


def test_some_pixels_are_shaded_like_all_of_them() -> None:
    chosen = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    chosen[3:20, 5:9] = chosen[-1, -1] = True
    pixels, maps = Pixels.of(chosen), random_maps(seed=7)
    lights = torch.cat([one_light(40, 20), one_light(-60, 10)], 1)
    visible = torch.rand(1, 2, SIDE, SIDE, generator=torch.Generator().manual_seed(8))
    found = pixels.maps(maps.at(pixels).olats(lights, pixels.values(visible)))
    wanted = maps.olats(lights, visible)
    torch.testing.assert_close(found[..., chosen], wanted[..., chosen], rtol=1e-4, atol=1e-6)
    assert (found[..., ~chosen] == 0).all()


def test_mirrored_people_and_inputs_are_the_mirrored_image() -> None:
    maps, light = random_maps(seed=4), one_light(50, 20)
    visible = torch.rand(1, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(5))
    mirrored = maps.mirrored().olats(one_light(-50, 20), visible.flip(-1))
    torch.testing.assert_close(mirrored, maps.olats(light, visible).flip(-1), rtol=1e-4, atol=1e-5)
    for one, two in zip(maps.mirrored().mirrored(), maps, strict=True):
        torch.testing.assert_close(one, two)
    rig = rig_directions(48)
    opposite = rig * torch.tensor([-1.0, 1, 1])
    visible = torch.rand(48, 8, 8, generator=torch.Generator().manual_seed(6))
    given = replace(inputs(), reached=reached_by(rig, visible, SIDE)[None])
    seen = given.mirrored()
    torch.testing.assert_close(seen.reached[0], reached_by(opposite, visible.flip(-1), SIDE))
    torch.testing.assert_close(seen.image, given.image.flip(-1))
    torch.testing.assert_close(seen.normals[:, 0], -given.normals[:, 0].flip(-1))
    torch.testing.assert_close(seen.normals[:, 1:], given.normals[:, 1:].flip(-1))


def test_the_mean_of_two_predictions_takes_a_strand_and_its_opposite_as_one() -> None:
    maps, other = random_maps(seed=4), random_maps(seed=7)
    mean = maps.averaged(other)
    torch.testing.assert_close(mean.albedo, (maps.albedo + other.albedo) / 2)
    torch.testing.assert_close(mean.normals.norm(dim=1), torch.ones(1, SIDE, SIDE))
    turned = maps.averaged(maps._replace(strands=-maps.strands))
    torch.testing.assert_close(turned.strands, maps.strands)


def test_the_gain_starts_from_the_quotient_of_the_proxys_own_shading() -> None:
    network = PortraitNetwork(TINY)
    torch.nn.init.zeros_(network.predict.weight)
    assert network.predict.bias is not None
    torch.nn.init.zeros_(network.predict.bias)
    given = inputs()
    maps = network(given)
    torch.testing.assert_close(maps.gain, torch.full_like(maps.gain, 1.15 / 2.15))
    torch.testing.assert_close(maps.albedo, given.image * maps.gain + maps.bias)
    torch.testing.assert_close(maps.normals, given.normals)
    assert maps.lit.shape == (1, 16, SIDE // 2, SIDE // 2) and maps.gloss.shape == (1, 3, SIDE, SIDE)


def test_every_input_matters() -> None:
    network, given = PortraitNetwork(TINY), inputs()
    before = network(given).gain
    for name in PortraitInputs.__dataclass_fields__:
        changed = replace(given, **{name: getattr(given, name) * 0.5 + 0.1})
        assert not torch.allclose(network(changed).gain, before, atol=1e-4), name


def test_exposure_is_that_of_the_skin_and_what_reaches_a_point_is_summed_over_the_rig() -> None:
    given = inputs()
    given.classes[:, SKIN, :, SIDE // 2 :] = 0
    given.image[..., SIDE // 2 :] = 100
    exposed = given.image / skin_exposure(given.image, given.classes)
    assert float(exposed[..., : SIDE // 2].mean()) == pytest.approx(0.25, rel=1e-4)
    rig = rig_directions(48)
    summary = reached_by(rig, torch.ones(48, 4, 4), 8)
    assert summary.shape == (16, 8, 8)
    assert float(summary[0, 0, 0]) == pytest.approx(3 / math.sqrt(4 * math.pi), rel=1e-4)
    assert summary[1:].abs().max() < 0.2
    from_right = (rig[:, 0] > 0).float()[:, None, None].expand(-1, 4, 4)
    assert reached_by(rig, from_right, 8)[3].min() > 0.3  # degree 1 along x


def test_what_is_turned_away_does_not_shine_but_hair_does() -> None:
    gloss = torch.full((1, 3, SIDE, SIDE), 0.1)
    skin, hair = (plain_maps()._replace(gloss=gloss, hair=share + 0 * gloss[:, :1]) for share in (0, 1))
    behind, ahead = one_light(170, 0), one_light(10, 0)
    assert skin.shaded(behind, lit_everywhere())[1].max() == 0
    assert hair.shaded(behind, lit_everywhere())[1].min() > 0.05
    assert skin.shaded(ahead, lit_everywhere())[1].min() > 0
    gloss[:, :2] = 0
    assert skin.shaded(ahead, lit_everywhere())[1].max() == 0  # strands are hair's
