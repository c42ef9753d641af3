"""White, shade and glare of relit skin and cloth: the colours of the photo, or those of skin."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from facerf_cli.face.head import Head
from facerf_cli.face.topology import region_mask
from facerf_cli.image.colour import luminance
from facerf_cli.image.skin import skin_albedo
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.field import Field, shrunk
from facerf_cli.relighting.fitting import reflectance_of
from facerf_cli.relighting.photo_light import estimate_light
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.white import SURE, WhiteBalance, without_baked_in, without_colour_of_shade
from tests import astronaut

SIZE = (24, 30)
CAST = torch.tensor([0.8, 1.0, 1.3])  # that a network leaves in a relit person
WARM, ORANGE = torch.tensor([1.15, 1.0, 0.9]), torch.tensor([2.0, 0.8, 0.2])  # lights
PALE = skin_albedo(torch.full((1, 1, 1, 1), 0.02), torch.full((1, 1, 1, 1), 0.015))[0, :, 0, 0]


def of_colour(colour: Tensor) -> Tensor:
    """An image [3, h, w] of one colour, brighter to the right."""
    return colour[:, None, None] * torch.linspace(0.4, 1, SIZE[1]).expand(1, *SIZE)


def balance(mode: BalanceMode, light: Tensor, **given: Tensor) -> WhiteBalance:
    """The balance of pale skin in a light, which is relit with a cast."""
    found = {"relit": of_colour(PALE * CAST), "photo": of_colour(PALE * light), "skin": torch.ones(SIZE)}
    return WhiteBalance.of(mode, **(found | given))


def test_skin_gets_the_photos_chromaticity_at_its_luminance_also_far_from_white() -> None:
    gain = balance("keep", WARM).gain
    white = PALE * CAST * gain
    torch.testing.assert_close(white / white[1], PALE * WARM / (PALE * WARM)[1], rtol=1e-4, atol=0)
    assert luminance(white.numpy()) == pytest.approx(float(luminance((PALE * CAST).numpy())), rel=1e-4)
    found = balance("neutral", ORANGE)
    assert found.is_strongly_coloured and balance("keep", ORANGE).is_strongly_coloured
    white = PALE * CAST * found.gain  # the cast skin is none, so its nearest one is taken
    chroma = (white / white[1])[::2].log()
    skins = torch.rand(1, 2, 300, 300, generator=torch.Generator().manual_seed(0)).square()
    known = skin_albedo(0.6 * skins[:, :1], 0.2 * skins[:, 1:])[0].flatten(1)
    known = (known / known[1])[::2].log()
    assert (known - chroma[:, None]).norm(dim=0).min() < 0.02  # the spacing of the table of skins
    torch.testing.assert_close(
        found.light, (ORANGE * PALE / white / ORANGE[1] * white[1] / PALE[1])[::2].log()
    )
    found = balance("neutral", torch.ones(3))
    assert not found.is_strongly_coloured and found.light.abs().max() < 0.02
    torch.testing.assert_close(found.gain, balance("keep", torch.ones(3)).gain, rtol=0.02, atol=0)
    assert error("keep") < 0.03 < 0.3 < error("neutral")


def test_the_colour_of_shade_has_no_part_in_a_scene() -> None:
    tint = torch.tensor([1.1, 0.8, 1.1])[:, None, None]
    shade = torch.where(torch.arange(SIZE[1]) < 17, tint, 1)  # more than half of the skin, the darker one
    tinted = of_colour(PALE) * shade
    plain = balance("neutral", torch.ones(3)).gain
    torch.testing.assert_close(balance("neutral", torch.ones(3), photo=tinted).gain, plain)
    assert (balance("keep", torch.ones(3), photo=tinted).gain - plain).abs().max() > 0.05


def test_few_grey_clipped_or_black_pixels_of_skin_change_nothing() -> None:
    few = torch.zeros(SIZE)
    few.flatten()[:499] = 1
    grey = of_colour(torch.full((3,), 0.5))
    for found in (balance("keep", WARM, skin=few), balance("keep", WARM, photo=grey)):
        assert (
            found.gain.tolist() == [1, 1, 1]
            and found.light.tolist() == [0, 0]
            and not found.is_strongly_coloured
        )
    few.flatten()[499] = 1
    assert balance("keep", WARM, skin=few).gain.tolist() != [1, 1, 1]
    clean = of_colour(PALE * WARM)
    clean[0] *= torch.linspace(0.8, 1.2, SIZE[1])  # so that a median tells what it is over
    spoilt = clean.clone()
    spoilt[:, :4], spoilt[:, 4:7] = 1.0, 0.001
    gains = [balance("keep", WARM, photo=photo).gain for photo in (clean, spoilt)]
    torch.testing.assert_close(*gains)


def test_cloth_has_a_gain_of_its_own_by_the_same_light() -> None:
    relit, photo = of_colour(PALE * CAST), of_colour(PALE * ORANGE)
    half = torch.zeros(SIZE)
    half[:, :15] = 1
    classes = torch.zeros(len(CLASSES), 2 * SIZE[0], SIZE[1])
    classes[class_index("neck"), : SIZE[0]] = 1
    classes[class_index("garment"), SIZE[0] :] = 1
    shirt = of_colour(torch.full((3,), 0.6))  # white, and relit it is
    for mode, light in (("keep", ORANGE), ("neutral", torch.tensor(1.0))):
        found = balance(mode, ORANGE)  # type: ignore[arg-type]
        gains = found.gains(
            torch.cat([relit, shirt], 1), torch.cat([photo, shirt * ORANGE[:, None, None]], 1), classes
        )
        torch.testing.assert_close(gains[:, 5, 5], found.gain, rtol=1e-3, atol=0)
        cloth = gains[:, -5, 5]
        if mode == "keep":
            torch.testing.assert_close(cloth / cloth[1], light / light[1], rtol=1e-3, atol=0)
        else:  # the light that is taken out of the skin is taken out of the cloth
            taken = torch.stack([found.light[0], found.light.new_zeros(()), found.light[1]]).exp()
            torch.testing.assert_close(cloth / cloth[1], ORANGE / ORANGE[1] / taken, rtol=1e-3, atol=0)


def in_orange() -> Head:
    """The astronaut's head in orange light."""
    head = astronaut.head()
    return replace(head, face=replace(head.face, texture=head.face.texture * ORANGE[:, None, None]))


def error(white_balance: BalanceMode | None) -> float:
    """How far skin under uniform white light is from its log chromaticity in an orange photo."""
    head = in_orange()
    field = reflectance_of(astronaut.models(), head, "field", white_balance=white_balance)
    assert isinstance(field, Field)
    small, even = shrunk(head.face), field.small_under_uniform_light()
    skin = (small.visible * region_mask("skin", small.texture.shape[-1])) > SURE
    both = (image[:, skin].clamp_min(1e-4).log() for image in (small.texture, even))
    photo, found = (torch.stack([red - green, blue - green]).median(1).values for red, green, blue in both)
    return float((found - photo).norm())


def test_the_whole_person_and_the_faces_own_field_have_the_same_white() -> None:
    photo = astronaut.photo() * ORANGE.numpy()
    skin, shirt = {}, {}
    for mode in ("keep", "neutral"):
        found = reflectance_of(astronaut.models(), in_orange(), "portrait", photo=photo, white_balance=mode)
        assert isinstance(found, PortraitField)
        maps, classes = found.views[0].maps, found.views[0].person.classes
        skin[mode], shirt[mode] = (
            maps.albedo[0][:, classes[class_index(name)] > 0.95].mean(1) for name in ("skin", "garment")
        )
    for part in (skin, shirt):  # both lose the same light
        taken = (part["keep"] / part["neutral"]).log()
        light = [float(taken[k] - taken[1]) for k in (0, 2)]
        assert light[0] > 0.3 and light[1] < -0.3
    toward = torch.nn.functional.normalize(torch.tensor([[0.6, 0.3, 0.8]]), dim=1)
    # Also the network's own field, without a ratio image.
    balanced, plain = (
        reflectance_of(
            astronaut.models(), astronaut.head(), "field", network_alone=True, white_balance=mode
        ).relit(toward, torch.ones(1, 1, 3))
        for mode in ("keep", None)
    )
    ratio = (balanced / plain.clamp_min(1e-6))[0][:, plain[0].amin(0) > 0.01]
    assert ratio.std(1).max() < 1e-3 and (ratio.mean(1) - 1).abs().max() > 0.01


@pytest.mark.slow
def test_the_light_of_a_balanced_photo_is_white_and_that_of_a_party_is_not() -> None:
    head, models = astronaut.head(), astronaut.models()
    white = estimate_light(models, head, white_balance="neutral").light.weights.sum(0)
    assert ((white / white[1]).log().abs() < 0.1).all()
    orange = estimate_light(models, in_orange(), white_balance="neutral").light.weights.sum(0)
    assert orange[0] > 1.7 * orange[1] and orange[2] < 0.5 * orange[1]


SKIN, PURPLE = torch.tensor([0.6, 0.35, 0.25]), torch.tensor([0.8, 0.7, 1.8])


def half_in_shade(shade: float, cast: torch.Tensor) -> torch.Tensor:
    """Skin [3, 64, 64] whose left half is in a shade of another colour."""
    image = SKIN[:, None, None].expand(3, 64, 64).clone()
    image[:, :, :32] *= shade * cast[:, None, None]
    return image


def chroma(image: torch.Tensor) -> torch.Tensor:
    return image / image.mean(0)


def test_shaded_skin_gets_the_colour_of_lit_skin_and_nothing_else_changes() -> None:
    image = half_in_shade(0.2, PURPLE)
    even = image * without_colour_of_shade(image, torch.ones(64, 64))
    # the lit skin's mean holds a little of the shade's colour, by its brightness
    torch.testing.assert_close(chroma(even)[:, :, :24], chroma(image)[:, :, 40:], rtol=0.12, atol=0)
    assert (chroma(image)[2, 32, 10] / chroma(image)[2, 32, 50]) > 1.7
    torch.testing.assert_close(even[:, :, :24].mean(0), image[:, :, :24].mean(0), rtol=0.05, atol=0)
    assert torch.equal(even[:, :, 48:], image[:, :, 48:])
    whole, none = torch.ones(64, 64), torch.zeros(64, 64)
    for image, skin in (
        (half_in_shade(1.3, PURPLE), whole),  # a bright lamp
        (half_in_shade(0.2, PURPLE), none),
        (half_in_shade(0.2, torch.ones(3)).mean(0).expand(3, -1, -1), whole),
    ):
        torch.testing.assert_close(without_colour_of_shade(image, skin), torch.ones_like(image))
    image, skin = half_in_shade(0.2, PURPLE), torch.ones(64, 64)
    factor = without_colour_of_shade(image, skin)
    torch.testing.assert_close(without_colour_of_shade(100 * image, skin), factor)
    assert without_colour_of_shade(0 * image, skin).isfinite().all()


SIDE = 224
SKIN_RGB = torch.tensor([0.5, 0.3, 0.22])
WHOLE, SPOT = torch.ones(SIDE, SIDE), (slice(100, 116), slice(100, 116))


def plain() -> Tensor:
    """Skin [3, S, S] with freckles a pixel wide."""
    image = SKIN_RGB[:, None, None].expand(3, SIDE, SIDE).clone()
    image[:, 3::8, 3::8] *= 0.7
    return image


def test_what_the_key_does_not_reach_becomes_as_the_skin_around_and_keeps_its_freckles() -> None:
    albedo, key = plain(), WHOLE.clone()
    key[SPOT] = 0
    albedo[:, *SPOT] *= torch.tensor([0.8, 0.6, 0.5])[:, None, None]
    found = albedo * without_baked_in(albedo, plain() * key.clamp_min(0.05), WHOLE, key, 1.0)
    middle = found[:, 104:112, 104:112]  # of which no pixel is near the border
    wanted = plain()[:, 104:112, 104:112].mean((1, 2))
    torch.testing.assert_close(middle.mean((1, 2)), wanted, rtol=0.03, atol=0)
    assert (found[:, 107, 107] / found[:, 111, 111] < 0.8).all()  # a freckle
    assert torch.equal(found[:, :, :64], albedo[:, :, :64])


def test_what_is_brighter_and_whiter_than_the_skin_around_is_glare() -> None:
    albedo, photo = plain(), plain()
    photo[:, *SPOT] += 0.15
    albedo[:, *SPOT] += 0.05
    found = albedo * without_baked_in(albedo, photo, WHOLE, WHOLE, 1.0)
    torch.testing.assert_close(found[:, 109, 109], SKIN_RGB, rtol=0.08, atol=0)


def test_bright_skin_of_its_colour_grey_photos_and_what_is_no_skin_stay_and_all_in_soft_light() -> None:
    one = torch.ones(3, SIDE, SIDE)
    lit, white = plain(), plain()
    lit[:, *SPOT] *= 1.6
    white[:, *SPOT] += 0.15
    grey = white.mean(0).expand(3, -1, -1)
    part, unlit = WHOLE.clone(), WHOLE.clone()
    part[SPOT], unlit[SPOT] = 0.5, 0
    for photo, skin, key, share in (
        (lit, WHOLE, WHOLE, 1.0),
        (grey, WHOLE, WHOLE, 1.0),
        (white, part, unlit, 1.0),
        (white, WHOLE, WHOLE, 0.4),
    ):
        torch.testing.assert_close(without_baked_in(photo, photo, skin, key, share), one, rtol=0, atol=1e-4)
