"""The portrait field of a photo: its own light gives the photo back, and the whole person is relit."""

from copy import copy
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.face.crop import Crop
from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import Window, strips
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.network.portrait import PortraitInputs
from facerf_cli.person import Person, Target, fit
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.person import SEEN_PX, wider_square
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.photo_light import source_light
from facerf_cli.relighting.portrait_field import PersonShading, PortraitField, PortraitView, maps_of
from facerf_cli.relighting.relightable import Relightable, RenderRequest
from facerf_cli.relighting.upsampled import UpsampledView
from tests import astronaut

NAMES = ("albedo", "specular", "normal", "position", "depth", "shadow")


@pytest.fixture(scope="module")
def models() -> Models:
    return astronaut.models()


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return astronaut.photo()


@pytest.fixture(scope="module")
def person() -> Person:
    return astronaut.person()


@pytest.fixture(scope="module")
def field() -> PortraitField:
    return astronaut.field()


@dataclass
class Seen:
    """A person of whom only the network's inputs are known."""

    given: PortraitInputs

    def inputs(self, rig: Tensor) -> PortraitInputs:
        return self.given


def lamp(azimuth_deg: float, elevation_deg: float = 0.0) -> RigLight:
    return RigLight(azel_to_direction(azimuth_deg, elevation_deg)[None], torch.ones(1, 3))


def one_sum(light: RigLight) -> Light:
    return Light(light.directions, light.weights[None])


def test_under_its_own_light_the_photo_comes_back_and_no_face_is_seen_through_what_is_before_it(
    photo: np.ndarray, person: Person, field: PortraitField
) -> None:
    models, head = person.models, person.head
    image = person.image(source_light(models, head.face).light)
    inside = field.person.segmentation.matte > 0.9
    error = ((image - photo)[inside] ** 2).mean()
    assert 10 * np.log10(1 / error) > 30  # the maps are coarse, and grain is of a photo without light
    # Hair and glasses over the face are not the face's field.
    shown = copy(person.in_photo())
    height, width = shown.size_px
    half = np.tile(np.arange(width) < width // 2, (height, 1))
    shown._covered = (~half)[None].astype(np.float32)
    share = shown._face_weight(shown.view.window)
    np.testing.assert_array_equal(share, shown.view.mask.numpy() * half[shown.view.window])


def test_a_grey_photo_stays_grey_in_white_light(models: Models, photo: np.ndarray) -> None:
    grey = np.repeat(photo[::2, ::2].mean(2, keepdims=True), 3, 2)
    face = find_faces(SHIPPED_NETWORKS.people, grey, "grey")[0]
    person = fit(models, grey, face=face, texture_side=64, white_balance=None)
    image = person.image(lamp(60), Target(background="none"))
    np.testing.assert_allclose(image, np.repeat(image[..., 1:2], 3, 2), atol=1e-5)


@pytest.mark.parametrize(("name", "may_be_more"), [("garment", False), ("headwear", False), ("hair", True)])
def test_dark_cloth_lies_in_no_haze(field: PortraitField, name: str, may_be_more: bool) -> None:
    """Of cloth the photo shows at least half of the albedo."""
    rig, person = rig_directions(48), field.person
    inputs = person.inputs(rig)
    classes = torch.zeros_like(inputs.classes)
    classes[:, class_index(name)] = 1
    maps = maps_of(SHIPPED_NETWORKS.portrait, cast(Any, Seen(replace(inputs, classes=classes))))
    own = (inputs.image * maps.gain).mean(1, keepdim=True)
    assert (maps.bias.mean(1, keepdim=True) > own + 1e-6).any() == may_be_more


def test_the_bias_and_a_nearly_black_neck_have_the_photos_colours(field: PortraitField) -> None:
    """A bias of its own colour would bleach lips."""
    view = field.views[0]
    own, bias = view.person.image / view.person.exposure * view.maps.gain[0], view.maps.bias[0]
    bright = (own.mean(0) > own.mean()) & (view.person.classes[0] < 0.1)
    shown, found = (colour[:, bright] / colour[:, bright].mean(0) for colour in (own, bias))
    assert shown.std(1).max() > 0.1
    torch.testing.assert_close(found, shown, atol=0.05, rtol=0)
    # The few values that a dark neck has are saturated; with gain and bias it would glow.
    rig, person = rig_directions(48), field.person
    inputs = person.inputs(rig)
    image, classes = inputs.image.clone(), inputs.classes.clone()
    neck = slice(3 * image.shape[-1] // 4, None)
    image[:, :, neck] = torch.tensor([0.004, 0.001, 0.0])[:, None, None]
    classes[:, :, neck] = 0
    classes[:, class_index("neck"), neck] = 1
    inputs = replace(inputs, image=image, classes=classes)
    maps = maps_of(SHIPPED_NETWORKS.portrait, cast(Any, Seen(inputs)))
    skin = (maps.albedo[0] * classes[0, class_index("skin")]).sum((1, 2))
    found = maps.bias[0, :, neck].mean((1, 2))
    torch.testing.assert_close(found / found.mean(), skin / skin.mean(), atol=0.15, rtol=0)
    # A dark, saturated neck beside a lit chin becomes no orange neck under a light from below.
    inputs = person.inputs(rig)
    neck = inputs.classes[:, [class_index("neck")]]
    cast_on_neck = torch.tensor([0.15, 0.06, 0.03])[:, None, None] * neck + 1 - neck
    maps = maps_of(
        SHIPPED_NETWORKS.portrait, cast(Any, Seen(replace(inputs, image=inputs.image * cast_on_neck)))
    )
    skin = inputs.classes[0, class_index("skin")] > 0.95
    on_neck, on_face = (maps.albedo[0][:, mask].mean(1) for mask in (neck[0, 0] > 0.95, skin))
    colour = (on_neck / on_neck.mean()) / (on_face / on_face.mean())
    assert colour[2] > 0.7  # of the photo: 0.38 where the face has 1


def test_a_coloured_shade_leaves_the_albedo_and_the_photo_its_colour(field: PortraitField) -> None:
    """The albedo is the photo, with the shade's colour, times the gain, plus the bias."""
    rig, person = rig_directions(48), field.person
    inputs = person.inputs(rig)
    side = inputs.image.shape[-1]
    cast_in_shade = torch.ones(3, 1, side)
    cast_in_shade[..., : side // 2] = torch.tensor([0.2, 0.1, 0.4])[:, None, None]
    image = inputs.image * cast_in_shade
    maps = maps_of(SHIPPED_NETWORKS.portrait, cast(Any, Seen(replace(inputs, image=image))))
    torch.testing.assert_close(image * maps.gain + maps.bias, maps.albedo)
    skin = inputs.classes[0, class_index("skin")] > 0.95
    left, right = (maps.albedo[0, :, :, half][:, skin[:, half]].mean(1) for half in halves_of(side))
    colour = (left / left.mean()) / (right / right.mean())
    assert colour.min() > 0.6  # of the photo: 0.43


def test_the_person_and_the_faces_texture_are_shaded_and_nothing_else(field: PortraitField) -> None:
    """Also where something hides a half of the face."""
    person, light = field.person, lamp(20)
    hidden = torch.zeros_like(person.classes[0])
    hidden[:, : len(hidden) // 2] = 1
    classes = person.classes * (1 - hidden)
    classes[0] += hidden
    seen = replace(person, classes=classes)
    view = PortraitView.of(seen, field.views[0].maps, None, None, field.texels)
    chosen = view.pixels.maps(torch.ones(1, 1, len(view.pixels.numbers)))
    assert chosen[0, seen.own_pixels > 0].all()
    at_texels = F.grid_sample(chosen[None], field.texels[None], padding_mode="border", align_corners=False)
    assert at_texels.min() > 1 - 1e-6  # none mixes in black
    assert chosen.mean() < 0.6
    assert (view.shade(light.directions, light.weights[None]).shading[0, :, chosen[0] == 0] == 0).all()


def test_the_person_is_as_white_as_the_photos_light_leaves_them(field: PortraitField) -> None:
    """Half of the photo's blue light doubles the blue of all that the view shows under white light."""
    view, own = field.views[0], source_light(astronaut.models(), field.field.face)

    def exposure(blue: float) -> Tensor:
        light = RigLight(own.light.directions, own.light.weights * torch.tensor([1, 1, blue]))
        return PortraitView.of(view.person, view.maps, replace(own, light=light)).exposure

    torch.testing.assert_close(exposure(0.5), exposure(1.0) * torch.tensor([1, 1, 2.0])[:, None, None])


def halves_of(side: int) -> tuple[slice, slice]:
    return slice(0, side // 2), slice(side // 2, side)


def test_left_and_right_are_treated_alike_and_without_light_all_is_black(field: PortraitField) -> None:
    rig = rig_directions(48)
    given = field.person.inputs(rig)
    seen, in_mirror = (
        maps_of(SHIPPED_NETWORKS.portrait, cast(Any, Seen(inputs))) for inputs in (given, given.mirrored())
    )
    light, everywhere = azel_to_direction(50, 20)[None, None], torch.ones(1, 1, *seen.gain.shape[-2:])
    one, two = (maps.olats(light, everywhere) for maps in (seen, in_mirror.mirrored()))
    torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-3)  # rounding, through some 40 layers
    lit = field.shade(lamp(0).directions, torch.zeros(2, 1, 3))
    for view, one in zip(field.views, lit, strict=True):
        assert one.shading.shape == (2, *view.person.image.shape)
        assert max(float(maps.abs().max()) for maps in one.tensors) == 0
    light, turn = lamp(20), torch.eye(3)
    turned = field.relit(light.directions, light.weights[None], turn)
    torch.testing.assert_close(turned, field.field.relit(light.directions, light.weights[None], turn))
    as_seen = field.relit(light.directions, light.weights[None])
    assert (as_seen - turned).abs().mean() > 1e-3


def test_a_lamp_lights_its_side_and_one_behind_leaves_the_face_dark(
    photo: np.ndarray, person: Person, field: PortraitField
) -> None:
    """Hair, neck and garment, too: halves of the person beside the head's middle."""
    target = Target(background="none")
    right, left = (person.image(lamp(azimuth), target).mean(-1) for azimuth in (75, -75))
    matte = field.person.segmentation.matte > 0.5
    columns = np.arange(photo.shape[1])
    middle = field.person.square.x0_px + field.person.square.side_px / 2
    hair = field.person.segmentation.layer("hair")[:] > 0.5
    for region in (matte, hair):
        on_right = region & (columns > middle + 15)
        on_left = region & (columns < middle - 15)
        assert right[on_right].mean() > 1.3 * left[on_right].mean()
        assert left[on_left].mean() > 1.3 * right[on_left].mean()
    behind, ahead = (person.image(lamp(azimuth, 10), target) for azimuth in (180, 0))
    skin = field.person.segmentation.layer("skin")[:] > 0.9
    assert behind[skin].mean() < 0.15 * ahead[skin].mean()


def test_light_from_behind_is_none_of_the_face_fields_and_adds_up(person: Person) -> None:
    """The field of a face knows no hair beside it: it would light a temple through the hair."""
    directions = torch.cat([lamp(azimuth, 20).directions for azimuth in (30, 140, 175)])
    people = person.prepare(Target(background="none"))
    weights = torch.cat([torch.eye(3), torch.ones(1, 3)])[..., None].expand(-1, -1, 3)
    relit = list(people.relit(Light(directions, weights)))
    ahead, behind = relit[0][0].texture, relit[2][0].texture
    assert behind.abs().max() < 1e-4 * ahead.max()
    *each, together = (people.image(one) for one in relit)
    np.testing.assert_allclose(sum(each), together, atol=1e-4 * together.max())
    assert min(one.min() for one in each) > -1e-12  # rounding


def test_a_light_of_the_photo_and_its_layers_are_finite_and_not_negative(
    photo: np.ndarray, person: Person, field: PortraitField
) -> None:
    people = person.prepare()
    relit = next(people.relit(one_sum(lamp(40, 30))))
    names = (*NAMES, "classes", "face", "uv")
    layers = people.rendered(RenderRequest(relit, layers=names))
    assert {"rgb", "albedo", "class.hair", "face.A", "uv"} <= set(layers)
    for name, layer in layers.items():
        assert layer.shape[:2] == photo.shape[:2] and np.isfinite(layer).all()
        assert name in ("normal", "position") or layer.min() >= 0
    face_alone = replace(person, photo=None).prepare()
    with pytest.raises(UsageError, match="--aov albedo"):
        face_alone.rendered(RenderRequest(relit[0], layers=("albedo",)))


def test_uniform_light_that_was_rendered_with_the_photo_is_the_sum_of_its_lights(
    field: PortraitField,
) -> None:
    light = Light.uniform((1.0, 0.5, 0.25))
    directions, weights = torch.from_numpy(light.directions), torch.from_numpy(light.weights)[None]
    apart = weights.repeat(2, 1, 1)  # two sums that are not uniform
    apart[0, ::2], apart[1, 1::2] = 0, 0
    view = field.views[0]
    whole, halves = view.shade(directions, weights), view.shade(directions, apart)
    for name in ("shading", "specular", "rear"):
        assert torch.allclose(getattr(whole, name)[0], getattr(halves, name).sum(0), atol=1e-5), name
    assert field.field.known is not None
    fresh = replace(field.field, known=None)
    kept, again = (one.relit(directions, weights) for one in (field.field, fresh))
    assert torch.allclose(kept, again, atol=1e-5)


def test_layers_of_colour_are_cut_by_the_matte_as_those_of_lights_are(
    photo: np.ndarray, person: Person
) -> None:
    """No hard edge where a little of a neighbour is in a pixel; where the photo has no alpha is nothing."""
    alpha = np.ones(photo.shape[:2], np.float32)
    alpha[:, : photo.shape[1] // 2] = 0
    people = person.prepare(Target(alpha=alpha))
    request = RenderRequest(next(people.relit(one_sum(lamp(40, 30)))), layers=NAMES)
    cut, matte = people.rendered(request), people.matte
    assert ((matte > 0.02) & (matte < 0.9)).sum() > 100
    assert isinstance(people, PeopleInPhoto)
    whole = copy(people.people[0])
    whole.matte = np.ones_like(alpha)  # of the same colours
    all_over = PeopleInPhoto([whole]).rendered(request)
    for name in NAMES:
        share = matte[..., None]
        expected = all_over[name] * (share if name in ("albedo", "specular") else share > 0.02)
        np.testing.assert_allclose(cut[name], expected, atol=1e-6)


def test_no_pixel_depends_on_the_strip_that_it_is_in(
    photo: np.ndarray, person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Image and layers of a photo are the same in one strip and in strips of 32 rows."""
    names = (*NAMES, "classes", "face", "uv")

    key, behind = lamp(40, 30), lamp(160, 10)
    lights = RigLight(torch.cat([key.directions, behind.directions]), torch.ones(2, 3))

    def shown() -> list[np.ndarray]:
        people = person.prepare()
        relit = next(people.relit(one_sum(lights)))
        return list(people.rendered(RenderRequest(relit, layers=names)).values())

    at_once = shown()
    monkeypatch.setattr("facerf_cli.image.strips.STRIP_PX", 1)
    assert len(list(strips(photo.shape))) > 4
    image, *layers = shown()
    # its detail is kept in half floats, which round a last bit to a step of 2**-11
    np.testing.assert_allclose(at_once[0], image, atol=1e-4, rtol=2**-9)
    for one, other in zip(at_once[1:], layers, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4 * max(1.0, float(np.abs(one).max())))


def test_lights_one_after_the_other_are_rendered_like_each_alone(person: Person) -> None:
    """Also light from behind, which is read elsewhere in the maps."""
    lights = [one_sum(lamp(40, 30)), one_sum(lamp(170, 10)), one_sum(lamp(-30))]

    def image(people: Relightable, light: Light) -> np.ndarray:
        return people.rendered(RenderRequest(next(iter(people.relit(light)))))["rgb"]

    people = person.prepare()
    for light in lights:
        np.testing.assert_array_equal(image(people, light), image(person.prepare(), light))


def test_wider_squares_hold_the_person_and_go_on_where_that_of_the_head_ends(field: PortraitField) -> None:
    """Over even grey, maps of one brightness in each view show no border between the views."""
    head, wide = field.views
    assert wide.person.square.side_px > head.person.square.side_px
    matte = head.person.segmentation.matte
    part, weight = UpsampledView(head).weight(Window(*(slice(0, length) for length in matte.shape)))
    assert weight.max() == 1 and weight[matte[part] > 0.5].min() == 0
    assert np.abs(np.diff(weight, axis=1)).max() < 0.05 and weight[:, [0, -1]].max() < 0.05
    head, matte = Crop(40, 30, 60, SEEN_PX), np.zeros((300, 200), np.float32)
    matte[40:80, 50:90] = 1
    assert wider_square(head, matte) is None
    matte[40:160, 20:90] = 1
    wide = wider_square(head, matte)
    assert wide is not None and wide.y0_px <= 30 and wide.y0_px + wide.side_px >= 160
    assert wide.x0_px <= 20 and wide.x0_px + wide.side_px >= 100
    matte[40:] = 1
    largest = wider_square(head, matte)
    assert largest is not None and largest.side_px == pytest.approx(140) and largest.y0_px == 30


def test_the_photos_detail_is_in_light_from_the_front_and_from_behind(field: PortraitField) -> None:
    """Shading of 1: both lights show the same image, which in hair has the photo's contrast."""
    view, photo = field.views[0], astronaut.photo()
    enlarged, window = UpsampledView(view), Window(slice(0, len(photo)), slice(0, photo.shape[1]))
    ones = torch.ones(3, *view.person.image.shape[1:])
    lit = PersonShading(ones, 0 * ones, ones, torch.cat([ones, 0 * ones]))
    where_they_are = SimpleNamespace(at=lambda window: (torch.zeros(2, *window.shape), torch.tensor(1.0)))
    shown = enlarged.over(window, photo, cast(Any, where_they_are))(enlarged.precompute(lit, rear=True))
    front, behind = shown["rgb"], shown["rear"]
    np.testing.assert_allclose(behind, front, rtol=1e-5)
    classes = F.grid_sample(view.person.classes[None], enlarged._grid(window)[None], align_corners=False)
    hair = classes[0, class_index("hair")].numpy() > 0.8
    of_relit, of_photo = (_fine(luminance(image))[hair] for image in (front, photo))
    assert np.corrcoef(of_relit, of_photo)[0, 1] > 0.9 and of_relit.std() > 0.7 * of_photo.std()


def _fine(image: np.ndarray) -> np.ndarray:
    """Contrast of an image [H, W] finer than two pixels."""
    logs = np.log(image.clip(1e-3))
    return logs - gaussian_filter(logs, 2.0)
