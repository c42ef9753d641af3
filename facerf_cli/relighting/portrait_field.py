"""Portrait field: light transport of the whole visible person in one photo.

The Portrait Network predicts maps that do not depend on the light (`network/portrait.py`). Together with the
proxy's shadows they render the person under any single light. Inside the face the result is blended with the
neural face field, which is more detailed. A ratio image corrects both, so that the photo's original light
reproduces the photo.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_uv
from facerf_cli.light.light import UNIFORM_LIGHTS, Light, PointLights, uniform_part
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.inputs import MEAN_RADIANCE, is_grey
from facerf_cli.network.portrait import HAIRY, PortraitInputs, PortraitMaps, PortraitNetwork
from facerf_cli.portrait.correction import Correction
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.portrait.proxy import square_camera
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.raster.camera import project
from facerf_cli.raster.texture import Pixels, bake_attributes, blurred, smoothstep
from facerf_cli.relighting.detail import FLOOR, NOISE, contrast, finer_detail, lost_detail, mean_colour
from facerf_cli.relighting.eyes import mirrored_in_cornea
from facerf_cli.relighting.field import Field, add_weighted, shining
from facerf_cli.relighting.photo_light import SourceLight, key_light_fraction
from facerf_cli.relighting.white import BARE, WhiteBalance, even_shade_of, without_baked_in
from facerf_cli.run.threads import in_threads

_SUMMARY_LIGHTS = 48  # lights of the rig whose shadows the network sees
_LIGHTS_AT_ONCE = 4  # more leave the processor's cache
_LEAST_COVERED, _AROUND_PX = 0.02, 2  # coverage of a person's pixels, and shaded pixels around them
_PORTRAIT_WEIGHT = 0.4  # weight of the portrait field in the face, where the face field is finer
_SKIN = class_index("skin")
_APART = 0.01  # blur of everything but skin, as a fraction of the square: skin near it keeps make-up and hair
_CLOTH = ("garment", "headwear")
_DETAIL_PX = 2.0  # standard deviation of the blur of detail, in pixels of the maps
_REAR = (0.35, 0.75)  # -z of light directions above which light is partly, and fully, from behind
_DARK = 0.1  # fraction of a person's mean below which chromaticity is ignored


@dataclass(frozen=True, eq=False)
class PersonShading:
    """Shading of a person under M sums of lights, in the crop square; each map is [M, 3, S, S].

    Radiance is albedo times `shading` plus `specular`; both include the photo's ratio image. `visibility` is
    the fraction of the light that is not shadowed. `rear` [M, 6, S, S] are shading and specular of light from
    behind, which is drawn as a rim. `normal_gradient` [M, 9, S, S] is the derivative of r, g, b of the
    shading with respect to x, y, z of the normal; only if the user supplied normals, which are finer than the
    maps.
    """

    shading: Tensor
    specular: Tensor
    visibility: Tensor
    rear: Tensor
    normal_gradient: Tensor | None = None

    def __getitem__(self, number: int) -> "PersonShading":
        return PersonShading(*(maps[number] for maps in self.tensors))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        maps = (self.shading, self.specular, self.visibility, self.rear, self.normal_gradient)
        return tuple(one for one in maps if one is not None)

    @property
    def with_rear_merged(self) -> "PersonShading":
        """Copy with the rear light added to shading and specular."""
        shading, specular = torch.chunk(self.rear, 2, -3)
        nothing = torch.zeros_like(self.rear)
        return PersonShading(self.shading + shading, self.specular + specular, self.visibility, nothing)


@dataclass(frozen=True, eq=False)
class SmoothedFrame:
    """Person in one frame of a shot, smoothed over neighbouring frames."""

    head: Head  # without skin that is covered
    light: RigLight  # of the whole shot
    segmentation: Segmentation
    portrait: tuple[tuple[SeenPerson, PortraitMaps], ...] = ()  # each view and its maps
    balance: WhiteBalance | None = None  # of the whole shot


class _Sums(NamedTuple):
    """M sums of single lights at N pixels, for a `PersonShading`: [3, M, N]."""

    shading: Tensor
    specular: Tensor
    arriving: Tensor
    unshadowed: Tensor  # [3, M, 1] without near lights
    rear: Tensor | None = None  # [6, M, N]; None: no light comes from behind
    gradient: Tensor | None = None  # [9, M, N]

    def plus(self, one: "_Sums", rgb: Tensor) -> "_Sums":
        """Add another sum, M = 1, times rgb [M, 3]."""
        factor = rgb.T[..., None]
        shading, specular, arriving, unshadowed = (
            torch.addcmul(a, factor, b) for a, b in zip(self[:4], one[:4], strict=True)
        )
        rear, gradient = self.rear, self.gradient
        if one.rear is not None:
            from_behind = factor.repeat(2, 1, 1) * one.rear
            rear = from_behind if rear is None else rear + from_behind
        if gradient is not None and one.gradient is not None:
            gradient = torch.addcmul(gradient, factor.repeat_interleave(3, 0), one.gradient)
        return _Sums(shading, specular, arriving, unshadowed, rear, gradient)

    def shaded(self, pixels: Pixels) -> PersonShading:
        """Return the maps of these pixels."""

        def maps(sums: Tensor) -> Tensor:
            return pixels.maps(sums.transpose(0, 1)[:, :, None])

        shading, specular = maps(self.shading), maps(self.specular)
        dark = shading.new_zeros(()).expand(len(shading), 6, *shading.shape[2:])
        return PersonShading(
            shading,
            specular,
            maps(self.arriving / self.unshadowed.clamp_min(1e-6)),
            dark if self.rear is None else maps(self.rear),
            None if self.gradient is None else maps(self.gradient),
        )


class _LightBatch(NamedTuple):
    """One batch of single lights at N pixels."""

    shading: Tensor  # [l, 1, N]
    specular: Tensor  # [l, 1, N]
    irradiance: Tensor  # [l, 1, N]
    unshadowed: Tensor  # irradiance without shadows, [l, 1, 1] or [l, 1, N]
    weights: Tensor  # [M, l, 3]
    rear: Tensor  # [l] fraction of each light that comes from behind
    toward: Tensor  # [l, 3, 1, 1] or [l, 3, 1, N] directions


@dataclass(frozen=True, eq=False)
class PortraitView:
    """Light transport of a person in one square of the photo."""

    person: SeenPerson
    maps: PortraitMaps  # batch of 1; the albedo is in the units of the network's input
    exposure: Tensor  # radiance of the photo over the maps' radiance in the photo's light, [3, 1, 1]
    pixels: Pixels  # that are shaded; the others stay black
    correction: Correction | None = None  # ratio image
    uniform: _Sums | None = None  # of uniform light of rgb 1, M = 1
    original: PersonShading | None = None  # shading in the photo's light, if the user supplied normals

    @staticmethod
    def of(
        person: SeenPerson,
        maps: PortraitMaps,
        source: SourceLight | None,
        balance: WhiteBalance | None = None,
        texels: Tensor | None = None,
    ) -> "PortraitView":
        """Return the view of a person; texels [T, T, 2] of the face that lie in it are shaded as well."""
        pixels = _shaded_pixels(person, texels)
        exposure = torch.full((3, 1, 1), person.exposure)
        view = PortraitView(person, maps, exposure, pixels)._with_detail()
        if source is None:
            return view.with_white_balance(balance)
        view = view._fit_to_photo(source, balance)
        if person.normals is None:
            return view
        return replace(view, original=view.shade(source.light.directions, source.light.weights[None])[0])

    def _without_baked_in(self, key: Tensor, key_fraction: float) -> "PortraitView":
        """Remove the photo's shading and highlights from the albedo, given the key light's shading [S, S]."""
        person = self.person
        bare = person.classes[BARE].sum(0)
        others = blurred(1 - bare[None], _APART * person.image.shape[-1])[0]
        skin = bare * (1 - 4 * others).clamp_min(0)
        return self._with_albedo(without_baked_in(self.maps.albedo[0], person.image, skin, key, key_fraction))

    def _with_albedo(self, gains: Tensor) -> "PortraitView":
        return replace(self, maps=self.maps._replace(albedo=self.maps.albedo * gains))

    @cached_property
    def shaded_maps(self) -> PortraitMaps:
        """The maps at the shaded pixels."""
        return self.maps.at(self.pixels)

    @property
    def _albedo(self) -> Tensor:
        """Albedo [3, 1, N] of the shaded pixels."""
        return self.pixels.values(self.maps.albedo[0])

    @property
    def typical_skin(self) -> Tensor:
        """Mean radiance [3] of the skin, in the units of the network's input."""
        return mean_colour(self.person.image, self.person.classes[_SKIN]) / self.person.exposure

    def _with_detail(self) -> "PortraitView":
        """Restore the detail of the photo that the albedo has lost (`detail.py`)."""
        person, hair = self.person, self.person.classes[list(HAIRY)].sum(0)
        weight = person.own_pixels
        floor = MEAN_RADIANCE * (NOISE + (FLOOR - NOISE) * hair)
        images = person.exposed, self.maps.albedo[0]
        photo, kept = (contrast(image, weight, _DETAIL_PX, floor) for image in images)
        grey, colour = (one - other for one, other in zip(photo, kept, strict=True))
        return self._with_albedo(lost_detail(grey, colour, weight, _DETAIL_PX, hair))

    def _fit_to_photo(self, source: SourceLight, balance: WhiteBalance | None) -> "PortraitView":
        """Rescale to the photo's exposure and correct, so that the original light reproduces the photo.

        Then apply the white balance. The photo's ambient lights also sample uniform light, so their maps
        give the person in uniform light.
        """
        directions, weights = source.light.directions, source.light.weights
        shading, specular, visibility = self._single_lights(directions, self.person.shadows.along(directions))
        classes, image = (self.pixels.values(maps) for maps in (self.person.classes, self.person.image))
        olats = self._albedo * shading[:, None] + specular[:, None]
        explained = torch.einsum("lc,lcij->cij", weights, olats)
        photo, relit = ((one * classes[_SKIN]).sum((1, 2), True) for one in (image, explained))
        exposure = photo / relit.clamp_min(1e-6)  # the colour of the photo's light is preserved
        plain = replace(self, exposure=exposure)
        plain = plain._without_baked_in(self.pixels.maps(shading[0]), key_light_fraction(source.light))
        olats = plain._albedo * shading[:, None] + specular[:, None]
        correction = Correction.of(image / exposure, olats, weights, 1 - classes[0], self.pixels)
        share = torch.full((1, len(directions), 3), 4 / UNIFORM_LIGHTS)
        parts = [slice(first, first + _LIGHTS_AT_ONCE) for first in range(1, len(share[0]), _LIGHTS_AT_ONCE)]
        ambient = [
            _far_batch(directions[at], share[:, at], (shading[at], specular[at], visibility[at]))
            for at in parts
        ]
        view = replace(plain, correction=correction)
        return replace(view, uniform=view._sums(1, ambient)).with_white_balance(balance)

    def with_white_balance(self, balance: WhiteBalance | None) -> "PortraitView":
        """Return a copy whose albedo is white-balanced."""
        if balance is None:
            return self
        rig, person = rig_directions(UNIFORM_LIGHTS), self.person
        uniform = self.render(self.shade(rig, torch.full((1, len(rig), 3), 1 / len(rig))))[0]
        return self._with_albedo(balance.gains(uniform, person.image, person.classes))

    def _single_lights(self, lights: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return shading, specular and visibility [l, 1, N] of single lights, given the proxy's visibility.

        Lights of rgb 1 are directions [l, 3], or [l, 1, N, 3] per pixel.
        """
        size = self.person.image.shape[1:]
        wide = F.interpolate(visible[None], size=size, mode="bilinear", align_corners=False)
        shading, specular, visibility = self.shaded_maps.shaded(lights[None], self.pixels.values(wide))
        return shading[0], specular[0], visibility[0]

    def _far(self, directions: Tensor, weights: Tensor) -> Iterator[_LightBatch]:
        used = shining(weights)
        if used.any():
            for lights, part in zip(
                torch.split(directions[used], _LIGHTS_AT_ONCE),
                torch.split(weights[:, used], _LIGHTS_AT_ONCE, 1),
                strict=True,
            ):
                visible = self.person.shadows.along(lights.detach())
                yield _far_batch(lights, part, self._single_lights(lights, visible))

    def _near(self, points: PointLights, weights: Tensor) -> Iterator[_LightBatch]:
        toward, irradiance = points.arriving(self.pixels.values(self.person.maps.positions_m))
        rear = rear_fraction(-points.toward)
        for first in range(0, len(toward), _LIGHTS_AT_ONCE):
            batch = slice(first, first + _LIGHTS_AT_ONCE)
            unshadowed = irradiance[batch]
            visible = self.person.shadows.toward(points.places_m[batch])
            shading, specular, visibility = self._single_lights(toward[batch], visible)
            yield _LightBatch(
                shading=unshadowed * shading,
                specular=unshadowed * specular,
                irradiance=unshadowed * visibility,
                unshadowed=unshadowed,
                weights=weights[:, None].expand(-1, len(unshadowed), -1),
                rear=rear.expand(len(unshadowed)),
                toward=toward[batch].permute(0, 3, 1, 2),
            )

    def shade(
        self, directions: Tensor, weights: Tensor, near: Sequence[tuple[PointLights, Tensor]] = ()
    ) -> PersonShading:
        """Shade the person under M sums, rgb weights [M, L, 3], of far lights [L, 3].

        `near` are additional near lights, each with its rgb weights [M, 3].
        """
        rest, rgb = uniform_part(directions, weights)
        uniform = self.uniform if shining(rgb[:, None]).any() else None
        far = self._far(directions[rest], weights[:, rest]) if uniform else self._far(directions, weights)
        sums = self._sums(len(weights), itertools.chain(far, *(self._near(*light) for light in near)))
        return (sums.plus(uniform, rgb) if uniform else sums).shaded(self.pixels)

    def _sums(self, count: int, batches: Iterable[_LightBatch]) -> _Sums:
        """Add up batches of single lights, corrected, for a number of sums."""
        albedo, count_px = self._albedo.mean(0), len(self.pixels.numbers)
        shading, specular, arriving = (torch.zeros(3, count, count_px) for _ in range(3))
        unshadowed, rear = torch.zeros(3, count, 1), None
        gradient = None if self.person.normals is None else torch.zeros(9, count, count_px)
        for batch in batches:
            shades, speculars = (x.expand(3, *x.shape) for x in (batch.shading, batch.specular))
            factor = torch.ones(3, 1, 1, 1)
            if self.correction is not None:
                factor, added = self.correction.terms(albedo * batch.shading + batch.specular)
                shades, speculars = shades * factor, added.addcmul_(batch.specular, factor)
            shades, speculars = shades.flatten(2), speculars.flatten(2)
            weights = batch.weights.permute(2, 0, 1)  # [3, M, l]
            behind = weights * batch.rear
            front = weights - behind
            add_weighted(shading, front, shades)
            add_weighted(specular, front, speculars)
            add_weighted(arriving, weights, batch.irradiance.flatten(1).expand(3, -1, -1))
            unshadowed = unshadowed + weights @ batch.unshadowed.flatten(1)
            if gradient is not None:
                facing = (batch.toward * self.shaded_maps.normals).sum(1) > 0
                slopes = (factor * batch.irradiance * facing).flatten(2)
                toward = batch.toward.flatten(2).expand(-1, -1, count_px)
                gradient += torch.einsum("cml,cln,lkn->ckmn", front, slopes, toward).flatten(0, 1)
            if batch.rear.any():
                rear = torch.zeros(6, count, count_px) if rear is None else rear
                add_weighted(rear[:3], behind, shades)
                add_weighted(rear[3:], behind, speculars)
        return _Sums(shading, specular, arriving, unshadowed, rear, gradient)

    def eye_reflections(self, lights: Light, centre_m: Tensor) -> Tensor:
        """Return the radiance [M, N, 3, s, s] that N irises reflect under M sums of lights.

        Near lights are positioned relative to the centre [3] of the face.
        """
        images = []
        for number in range(len(self.person.eyes.irises_px)):
            shadows, places = self.person.around_iris(number)
            grid = places[None]
            parts = [F.grid_sample(x, grid, padding_mode="border", align_corners=False) for x in self.maps]
            toward, weights = lights.arriving(torch.from_numpy(shadows.origins.mean(0)), centre_m)
            *_, visibility = PortraitMaps(*parts).shaded(toward[None], shadows.along(toward)[None])
            images.append(mirrored_in_cornea(toward, weights, visibility[0].mean((1, 2))))
        return torch.stack(images, 1) if images else torch.zeros(len(lights.weights), 0, 3, 1, 1)

    def render(self, shading: PersonShading) -> Tensor:
        """Return the radiance [M, 3, S, S] of the person, at the resolution of the maps."""
        merged = shading.with_rear_merged
        return (self.maps.albedo * merged.shading + merged.specular) * self.exposure


@dataclass(frozen=True, eq=False)
class PortraitField:
    """Light transport of a person; as a `Reflectance` it renders textures of the face."""

    views: tuple[PortraitView, ...]  # head and shoulders, and the whole person if that square shows more
    field: Field
    texels: Tensor  # coordinates [T, T, 2] of the face's texels in the first view, for grid_sample

    @staticmethod
    @torch.no_grad()
    def of(
        model: MorphableModel,
        head: Head,
        field: Field,
        source: SourceLight | None,
        squares: Sequence[tuple[SeenPerson, PortraitMaps]],
    ) -> "PortraitField":
        """Return the field from maps of each square; all of it uses the face field's white balance."""
        texels = _texels_in_square(model, head, squares[0][0])
        views = tuple(
            PortraitView.of(*one, source, field.balance, None if number else texels)
            for number, one in enumerate(squares)
        )
        return PortraitField(views, field, texels)

    def shade(
        self, directions: Tensor, weights: Tensor, near: Sequence[tuple[PointLights, Tensor]] = ()
    ) -> list[PersonShading]:
        """Shade the person in each view; see `PortraitView.shade`."""
        return [view.shade(directions, weights, near) for view in self.views]

    @property
    def person(self) -> SeenPerson:
        return self.views[0].person

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Return textures [M, 3, T, T] of the face; if the head is turned, from the face field only."""
        textures = self.field.relit(directions, weights, turn)
        if turn is not None:
            return textures
        return self.blended(textures, self.views[0].shade(directions, weights).with_rear_merged)

    def blended(self, textures: Tensor, shading: PersonShading) -> Tensor:
        """Blend textures [M, 3, T, T] of the face field with the portrait field's, shaded in the first view.

        `shading.rear` is not included.
        """
        needs_graph = self.field.face.texture.requires_grad  # the graph serves only one `backward`
        albedo = self._textured_albedo() if needs_graph else self._albedo
        portrait = albedo * self._sampled(shading.shading) + self._sampled(shading.specular)
        return torch.lerp(textures, portrait * self.views[0].exposure, _PORTRAIT_WEIGHT)

    @cached_property
    def _albedo(self) -> Tensor:
        return self._textured_albedo()

    def _textured_albedo(self) -> Tensor:
        """Return the albedo [1, 3, T, T] of the first view with the detail of the face's texture."""
        view = self.views[0]
        texture, source = self.field.face.texture, self._sampled(view.person.image[None])[0]
        typical = view.typical_skin * view.person.exposure
        detail = finer_detail(texture.movedim(0, -1), source.movedim(0, -1), torch.ones(1), typical)
        return self._sampled(view.maps.albedo) * detail.movedim(-1, 0)

    def _sampled(self, maps: Tensor) -> Tensor:
        """Return maps [M, C, S, S] of the first view at the texels of the face, [M, C, T, T]."""
        grid = self.texels[None].expand(len(maps), -1, -1, -1)
        return F.grid_sample(maps, grid, padding_mode="border", align_corners=False)


def _shaded_pixels(person: SeenPerson, texels: Tensor | None) -> Pixels:
    """Return the pixels of a person, of texels [T, T, 2] in -1..1 of the face, and those around them."""
    chosen = (1 - person.classes[0] > _LEAST_COVERED).float()
    if texels is not None:
        side = len(chosen)
        column, row = ((texels + 1) * (side / 2)).long().clamp(0, side - 1).flatten(0, 1).T
        chosen[row, column] = 1
    return Pixels.of(F.max_pool2d(chosen[None], 2 * _AROUND_PX + 1, 1, _AROUND_PX)[0] > 0)


def _far_batch(lights: Tensor, weights: Tensor, maps: tuple[Tensor, Tensor, Tensor]) -> _LightBatch:
    """Return a batch of far lights [l, 3], weights [M, l, 3], from their `_single_lights`."""
    unshadowed = torch.ones(len(lights), 1, 1)
    return _LightBatch(*maps, unshadowed, weights, rear_fraction(lights), lights[..., None, None])


def rear_fraction(directions: Tensor) -> Tensor:
    """Return the fraction [...] of lights from unit directions [..., 3] that counts as light from behind."""
    return smoothstep((-directions[..., 2] - _REAR[0]) / (_REAR[1] - _REAR[0]))


def maps_of(network: PortraitNetwork, person: SeenPerson) -> PortraitMaps:
    """Predict the light transport of a person with the Portrait Network.

    The result is the mean over the image and its mirror image, whose errors differ.
    """
    rig = rig_directions(_SUMMARY_LIGHTS)
    inputs = person.inputs(rig)
    factors = even_shade_of(inputs.image[0], inputs.classes[0])
    inputs = replace(inputs, image=inputs.image * factors)
    device = next(network.parameters()).device
    on_device = inputs.to(device)
    plain, mirrored = in_threads(network, (on_device, on_device.mirrored()))
    maps = PortraitMaps(*(part.cpu() for part in plain.averaged(mirrored.mirrored())))
    maps = _with_own_colours(maps, inputs)
    maps = maps._replace(gain=maps.gain * factors)  # applies to the unmodified photo
    return maps.without_colours() if is_grey(inputs.image[0]) else maps


def _with_own_colours(maps: PortraitMaps, inputs: PortraitInputs) -> PortraitMaps:
    """Give the bias the photo's colours, and limit it on cloth to the photo's brightness.

    A bias of another colour bleaches lips. Where the photo is nearly black and its colours are noise, the
    bias has the colour of its class; neck, ears and hands use the skin's, or a neck in deep shadow would glow
    orange. Cloth in deep shadow gets a larger bias from the network, which would cover dark cloth with haze.
    """
    own = (inputs.image * maps.gain).clamp_min(0)
    own_grey, light = (image.mean(1, keepdim=True) for image in (own, inputs.image))
    person = 1 - inputs.classes[:, :1]
    lit, covered = (image.mean((2, 3), keepdim=True) for image in (light * person, person))
    dark = _DARK * lit / covered.clamp_min(1e-6)
    of_classes = torch.einsum("bkij,bcij->bkc", inputs.classes, own)
    of_classes[:, BARE] = of_classes[:, BARE].sum(1, keepdim=True)
    of_classes = of_classes / of_classes.mean(2, keepdim=True).clamp_min(1e-9)
    typical = torch.einsum("bkij,bkc->bcij", inputs.classes, of_classes)
    sure = light**2 / (light**2 + dark**2).clamp_min(1e-12)
    colour = torch.lerp(typical, own / own_grey.clamp_min(1e-9), sure)
    amount = maps.bias.mean(1, keepdim=True)
    cloth = inputs.classes[:, [class_index(name) for name in _CLOTH]].sum(1, keepdim=True)
    bias = colour * torch.lerp(amount, torch.minimum(amount, own_grey), cloth)
    return maps._replace(bias=bias, albedo=inputs.image * maps.gain + bias)


def _texels_in_square(model: MorphableModel, head: Head, person: SeenPerson) -> Tensor:
    """Return the coordinates [T, T, 2] in -1..1 of each texel of the face in the square."""
    camera = square_camera(head.fit, person.square)
    places = project(head.fit.vertices_camera(model), camera) / person.square.size_px * 2 - 1
    side = head.face.texture.shape[-1]
    grid = round(len(grid_uv()) ** 0.5)
    return bake_attributes(places, grid, side).permute(1, 2, 0)
