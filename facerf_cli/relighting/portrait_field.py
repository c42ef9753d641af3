"""The portrait field: the light transport of all that a photo shows of a person.

Fixed maps of the Portrait Network and the shadows of a proxy give an image of the whole person under any
single light (`network/portrait.py`). In the face, where the neural reflectance field sees more detail, both
are mixed. As the field's, the maps are corrected by the photo's quotient, so that its own light gives the
photo back.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_uv
from facerf_cli.light.light import Light, PointLights
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.inputs import MEAN_RADIANCE, is_grey
from facerf_cli.network.portrait import HAIRY, PortraitInputs, PortraitMaps, PortraitNetwork
from facerf_cli.portrait.correction import Correction
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.portrait.proxy import square_camera
from facerf_cli.portrait.segment import Segmentation
from facerf_cli.raster.camera import project
from facerf_cli.raster.texture import bake_attributes, blurred, smoothstep
from facerf_cli.relighting.detail import FLOOR, NOISE, contrast, finer_detail, lost_detail, mean_colour
from facerf_cli.relighting.eyes import mirrored_in_cornea
from facerf_cli.relighting.field import Field, shining
from facerf_cli.relighting.photo_light import SourceLight, share_of_lamp
from facerf_cli.relighting.white import BARE, Balance, even_shade_of, without_baked_in
from facerf_cli.run.threads import in_threads

_SUMMARY_LIGHTS = 48  # of the rig whose shadows the network sees
_LIGHTS_AT_ONCE = 16
_EVEN_LIGHTS = 16  # that shine as even light does
_SHARE = 0.4  # of the portrait field in the face, where the other one is finer
_SKIN = class_index("skin")
_APART = 0.01  # blur of what is no skin, in sides: skin near to it keeps its make-up and its hair
_CLOTH = ("garment", "headwear")
_DETAIL_PX = 2.0  # standard deviation of the blur of detail, in pixels of the maps
_BEHIND = (0.35, 0.75)  # -z of the directions from which on light is partly, and wholly, from behind
_DARK = 0.1  # of the mean of a person: what is darker has no colour of its own


@dataclass(frozen=True, eq=False)
class PortraitLight:
    """A person under M sums of lights, in the square: each [M, 3, S, S].

    Radiance is albedo times shading, plus highlights; both hold the photo's correction. `reached` is the
    share of the light that is not in shadow. Light from behind is kept apart, as it is drawn as rims:
    `behind` [M, 6, S, S] are its shading and highlights. Where normals are given, which are finer than the
    maps, `slopes` [M, 9, S, S] are the change of the shading of r, g, b with the normal's x, y, z.
    """

    shading: Tensor
    highlights: Tensor
    reached: Tensor
    behind: Tensor
    slopes: Tensor | None = None

    def __getitem__(self, number: int) -> "PortraitLight":
        """One of the sums: maps [3, S, S]."""
        return PortraitLight(*(maps[number] for maps in self.tensors))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All maps."""
        maps = (self.shading, self.highlights, self.reached, self.behind, self.slopes)
        return tuple(one for one in maps if one is not None)

    @property
    def whole(self) -> "PortraitLight":
        """The same with light from behind as any other."""
        shading, highlights = torch.chunk(self.behind, 2, -3)
        nothing = torch.zeros_like(self.behind)
        return PortraitLight(self.shading + shading, self.highlights + highlights, self.reached, nothing)


@dataclass(frozen=True, eq=False)
class SteadyFrame:
    """A person in one frame of a shot, steadied by the frames around it, and the light held over the shot.

    `head` is without what covers its skin. `portrait` is for the portrait field alone: the person in each
    view, and their maps. `balance` is that of the shot.
    """

    head: Head
    light: RigLight
    segmentation: Segmentation
    portrait: tuple[tuple[SeenPerson, PortraitMaps], ...] = ()
    balance: Balance | None = None


class _Some(NamedTuple):
    """Some lights: maps [l, S, S] and weights [M, l, 3]; `sent` is what would arrive without shadows.

    `behind` [l] is the share of each that comes from behind; `toward` is [l, 3, 1, 1] or [l, 3, S, S].
    """

    shading: Tensor
    highlights: Tensor
    arrives: Tensor
    sent: Tensor
    weights: Tensor
    behind: Tensor
    toward: Tensor


@dataclass(frozen=True, eq=False)
class PortraitView:
    """The light transport of a person as seen in one square of the photo."""

    person: SeenPerson
    maps: PortraitMaps  # of one person; albedo in the units of the network's input
    exposure: Tensor  # [3, 1, 1] radiance of the photo over that of the maps in the photo's light
    correction: Correction | None = None
    own: PortraitLight | None = None  # the photo's light, where normals are given

    @staticmethod
    def of(person: SeenPerson, maps: PortraitMaps, source: SourceLight | None) -> "PortraitView":
        """The view of a person with its maps, corrected by the photo's estimated light."""
        found = PortraitView(person, maps, torch.full((3, 1, 1), person.exposure))._with_detail()
        if source is None:
            return found
        found = found._corrected(source)
        if person.normals is None:
            return found
        return replace(found, own=found.lit(source.light.directions, source.light.weights[None])[0])

    def _without_baked_in(self, key: Tensor, share: float) -> "PortraitView":
        """The view without shade and glare of the photo in its albedo, by the shading [S, S] of the key.

        `share` is that of the key in the photo's light.
        """
        person = self.person
        bare = person.classes[BARE].sum(0)
        others = blurred(1 - bare[None], _APART * person.image.shape[-1])[0]
        skin = bare * (1 - 4 * others).clamp_min(0)
        return self._with_albedo(without_baked_in(self.maps.albedo[0], person.image, skin, key, share))

    def _with_albedo(self, gains: Tensor) -> "PortraitView":
        """The view whose albedo is multiplied by gains [3, S, S]."""
        return replace(self, maps=self.maps._replace(albedo=self.maps.albedo * gains))

    @property
    def typical_skin(self) -> Tensor:
        """Mean radiance [3] of the skin, in the units of the network's input."""
        return mean_colour(self.person.image, self.person.classes[_SKIN]) / self.person.exposure

    def _with_detail(self) -> "PortraitView":
        """Return the view with the detail of the photo that its albedo has lost (`detail.py`)."""
        person, hair = self.person, self.person.classes[list(HAIRY)].sum(0)
        weight = person.own_pixels
        floor = MEAN_RADIANCE * (NOISE + (FLOOR - NOISE) * hair)
        images = person.exposed, self.maps.albedo[0]
        shown, kept = (contrast(image, weight, _DETAIL_PX, floor) for image in images)
        grey, colour = (one - other for one, other in zip(shown, kept, strict=True))
        return self._with_albedo(lost_detail(grey, colour, weight, _DETAIL_PX, hair))

    def _corrected(self, source: SourceLight) -> "PortraitView":
        """The view in the units of the photo's light, corrected to give the photo back under it."""
        used = source.light.weights.sum(1) > 0
        directions, weights = source.light.directions[used], source.light.weights[used]
        shade, glow, _ = self._shaded(directions, self.person.shadows.along(directions))
        olats = self.maps.albedo * shade[:, None] + glow[:, None]
        skin = self.person.classes[_SKIN]
        explained = torch.einsum("lc,lcij->cij", weights, olats)
        shown, found = ((image * skin).sum((1, 2), True) for image in (self.person.image, explained))
        exposure = shown / found.clamp_min(1e-6)  # white, as the photo's light leaves it
        plain = replace(self, exposure=exposure)._without_baked_in(shade[0], share_of_lamp(source.light))
        olats = plain.maps.albedo * shade[:, None] + glow[:, None]
        correction = Correction.of(self.person.image / exposure, olats, weights, 1 - self.person.classes[0])
        return replace(plain, correction=correction)

    def balanced(self, balance: Balance | None) -> "PortraitView":
        """The view whose albedo has the white of a balance."""
        if balance is None:
            return self
        rig, person = rig_directions(_EVEN_LIGHTS), self.person
        even = self.relit(self.lit(rig, torch.full((1, len(rig), 3), 1 / len(rig))))[0]
        return self._with_albedo(balance.gains(even, person.image, person.classes))

    def _shaded(self, lights: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Shading, highlights and the share that arrives [l, S, S] of single lights, given their visibility.

        Lights [l, 3], or [l, S, S, 3] by pixel, are of rgb 1.
        """
        size = self.person.image.shape[1:]
        wide = F.interpolate(visible[None], size=size, mode="bilinear", align_corners=False)
        shade, glow, arrives = self.maps.shaded(lights[None], wide)
        return shade[0], glow[0], arrives[0]

    def _far(self, directions: Tensor, weights: Tensor) -> Iterator[_Some]:
        """Batches of far lights [L, 3] with rgb weights [M, L, 3]; those of weight 0 are left out."""
        used = shining(weights)
        if used.any():
            for lights, some in zip(
                torch.split(directions[used], _LIGHTS_AT_ONCE),
                torch.split(weights[:, used], _LIGHTS_AT_ONCE, 1),
                strict=True,
            ):
                maps = self._shaded(lights, self.person.shadows.along(lights.detach()))
                sent = torch.ones(len(lights), 1, 1)
                yield _Some(*maps, sent, some, from_behind(lights), lights[..., None, None])

    def _near(self, points: PointLights, weights: Tensor) -> Iterator[_Some]:
        """Batches of the points of a near light with rgb weights [M, 3]."""
        toward, irradiance = points.arriving(self.person.maps.positions_m)
        behind = from_behind(-points.toward)
        for first in range(0, len(toward), _LIGHTS_AT_ONCE):
            batch = slice(first, first + _LIGHTS_AT_ONCE)
            sent = irradiance[batch]
            visible = self.person.shadows.toward(points.places_m[batch])
            shade, glow, arrives = self._shaded(toward[batch], visible)
            some = weights[:, None].expand(-1, len(sent), -1)
            share, along = behind.expand(len(sent)), toward[batch].permute(0, 3, 1, 2)
            yield _Some(sent * shade, sent * glow, sent * arrives, sent, some, share, along)

    def lit(
        self, directions: Tensor, weights: Tensor, near: Sequence[tuple[PointLights, Tensor]] = ()
    ) -> PortraitLight:
        """The person under M sums, rgb weights [M, L, 3], of lights [L, 3].

        `near` are further lights, each with its rgb weights [M, 3].
        """
        size = self.person.image.shape
        shading, highlights, reached, sent = torch.zeros(4, len(weights), *size).unbind(0)
        batches = (self._far(directions, weights), *(self._near(*light) for light in near))
        albedo = self.maps.albedo[0].mean(0)
        behind = torch.zeros(len(weights), 6, *size[1:])
        slopes = None if self.person.normals is None else torch.zeros(len(weights), 9, *size[1:])
        for shade, glow, arrives, whole, some, share, toward in itertools.chain(*batches):
            shades, glows = (x.expand(3, *x.shape) for x in (shade, glow))
            factor = torch.ones(3, 1, 1, 1)
            if self.correction is not None:
                factor, added = self.correction.terms(albedo * shade + glow)
                shades, glows = shade * factor, torch.addcmul(added, glow, factor)
            rear = some * share[:, None]
            front = some - rear
            shading = shading + torch.einsum("mlc,clij->mcij", front, shades)
            highlights = highlights + torch.einsum("mlc,clij->mcij", front, glows)
            if slopes is not None:
                lit = (toward * self.maps.normals).sum(1) > 0
                change = torch.einsum("mlc,clij,lkij->mckij", front, factor * arrives * lit, toward)
                slopes = slopes + change.flatten(1, 2)
            if share.any():
                both = [torch.einsum("mlc,clij->mcij", rear, part) for part in (shades, glows)]
                behind = behind + torch.cat(both, 1)
            reached = reached + torch.einsum("mlc,lij->mcij", some, arrives)
            sent = sent + torch.einsum("mlc,lij->mcij", some, whole)
        return PortraitLight(shading, highlights, reached / sent.clamp_min(1e-6), behind, slopes)

    def mirrored(self, lights: Light, centre_m: Tensor) -> Tensor:
        """Radiance [M, N, 3, s, s] that N irises mirror under M sums of lights that reach them.

        The face's centre [3] is what near lights are about.
        """
        found = []
        for number in range(len(self.person.eyes.irises_px)):
            shadows, places = self.person.around_iris(number)
            maps = PortraitMaps(
                *(
                    F.grid_sample(part, places[None], "bilinear", "border", align_corners=False)
                    for part in self.maps
                )
            )
            toward, weights = lights.arriving(torch.from_numpy(shadows.origins.mean(0)), centre_m)
            *_, arrives = maps.shaded(toward[None], shadows.along(toward)[None])
            found.append(mirrored_in_cornea(toward, weights, arrives[0].mean((1, 2))))
        return torch.stack(found, 1) if found else torch.zeros(len(lights.weights), 0, 3, 1, 1)

    def relit(self, lit: PortraitLight) -> Tensor:
        """Radiance [M, 3, S, S] of the person in the square, at the resolution of the maps."""
        lit = lit.whole
        return (self.maps.albedo * lit.shading + lit.highlights) * self.exposure


@dataclass(frozen=True, eq=False)
class PortraitField:
    """The light transport of a person; a `Reflectance`, whose textures are those of the face.

    The first view is of head and shoulders; a second one, of all of the person, is there where it shows more.
    """

    views: tuple[PortraitView, ...]
    field: Field
    texels: Tensor  # [T, T, 2] of the face's texture, in the first view's square, for grid_sample

    @staticmethod
    @torch.no_grad()
    def of(
        model: MorphableModel,
        head: Head,
        field: Field,
        source: SourceLight | None,
        seen: Sequence[tuple[SeenPerson, PortraitMaps]],
    ) -> "PortraitField":
        """The field of a person `seen` in squares, with the maps of each; `source` is the photo's light.

        The balance of the face's field is that of the whole person.
        """
        views = tuple(PortraitView.of(*one, source).balanced(field.balance) for one in seen)
        return PortraitField(views, field, _texels_in_square(model, head, seen[0][0]))

    @property
    def person(self) -> SeenPerson:
        """The person in the square around head and shoulders."""
        return self.views[0].person

    def lit(
        self, directions: Tensor, weights: Tensor, near: Sequence[tuple[PointLights, Tensor]] = ()
    ) -> list[PortraitLight]:
        """The person in each view under sums of lights; see `PortraitView.lit`."""
        return [view.lit(directions, weights, near) for view in self.views]

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Textures [M, 3, T, T] of the face; of a turned head the neural field's alone."""
        textures = self.field.relit(directions, weights, turn)
        return (
            textures
            if turn is not None
            else self.blended(textures, self.views[0].lit(directions, weights).whole)
        )

    def blended(self, textures: Tensor, lit: PortraitLight) -> Tensor:
        """Textures [M, 3, T, T] of the neural field, mixed with the portrait's, lit in the first view.

        `lit.behind` is not in it.
        """
        grid = self.texels[None]

        def sampled(maps: Tensor) -> Tensor:
            return F.grid_sample(
                maps, grid.expand(len(maps), -1, -1, -1), padding_mode="border", align_corners=False
            )

        view = self.views[0]
        texture, source = self.field.face.texture, sampled(view.person.image[None])[0]
        typical = view.typical_skin * view.person.exposure
        detail = finer_detail(texture.movedim(0, -1), source.movedim(0, -1), torch.ones(1), typical)
        albedo = sampled(view.maps.albedo) * detail.movedim(-1, 0)
        own = (albedo * sampled(lit.shading) + sampled(lit.highlights)) * view.exposure
        return torch.lerp(textures, own, _SHARE)


def from_behind(directions: Tensor) -> Tensor:
    """Share [...] of lights from unit directions [..., 3] that comes from behind."""
    return smoothstep((-directions[..., 2] - _BEHIND[0]) / (_BEHIND[1] - _BEHIND[0]))


def maps_of(network: PortraitNetwork, person: SeenPerson) -> PortraitMaps:
    """The light transport of a person, as the Portrait Network sees it.

    It is the mean of the network's maps and of those that it sees in a mirror, whose errors differ.
    """
    rig = rig_directions(_SUMMARY_LIGHTS)
    inputs = person.inputs(rig)
    even = even_shade_of(inputs.image[0], inputs.classes[0])
    inputs = replace(inputs, image=inputs.image * even)
    device = next(network.parameters()).device
    on_device = inputs.to(device)
    seen, mirrored = in_threads(network, (on_device, on_device.mirrored()))
    maps = PortraitMaps(*(part.cpu() for part in seen.averaged(mirrored.mirrored())))
    maps = _with_own_colours(maps, inputs)
    maps = maps._replace(gain=maps.gain * even)  # of the photo, which has the colour
    return maps.without_colours() if is_grey(inputs.image[0]) else maps


def _with_own_colours(maps: PortraitMaps, inputs: PortraitInputs) -> PortraitMaps:
    """Give the bias the colours that the photo shows, and limit it on cloth to what the photo shows there.

    A bias of its own colour bleaches lips. What is nearly black in the photo, whose colours are noise, has
    that of its class; neck, ears and hands have the skin's, or a neck in deep shadow glows orange. Cloth in
    deep shadow needs more bias, and the network allows for it: dark cloth would lie in haze.
    """
    own = (inputs.image * maps.gain).clamp_min(0)
    shown, light = (image.mean(1, keepdim=True) for image in (own, inputs.image))
    person = 1 - inputs.classes[:, :1]
    dark = (
        _DARK
        * (light * person).mean((2, 3), keepdim=True)
        / person.mean((2, 3), keepdim=True).clamp_min(1e-6)
    )
    of_classes = torch.einsum("bkij,bcij->bkc", inputs.classes, own)
    of_classes[:, BARE] = of_classes[:, BARE].sum(1, keepdim=True)
    of_classes = of_classes / of_classes.mean(2, keepdim=True).clamp_min(1e-9)
    typical = torch.einsum("bkij,bkc->bcij", inputs.classes, of_classes)
    colour = torch.lerp(
        typical, own / shown.clamp_min(1e-9), light**2 / (light**2 + dark**2).clamp_min(1e-12)
    )
    amount = maps.bias.mean(1, keepdim=True)
    cloth = inputs.classes[:, [class_index(name) for name in _CLOTH]].sum(1, keepdim=True)
    bias = colour * torch.lerp(amount, torch.minimum(amount, shown), cloth)
    return maps._replace(bias=bias, albedo=inputs.image * maps.gain + bias)


def _texels_in_square(model: MorphableModel, head: Head, person: SeenPerson) -> Tensor:
    """Place [T, T, 2] of each texel of the face in the square, in -1..1."""
    camera = square_camera(head.fit, person.square)
    places = project(head.fit.vertices_camera(model), camera) / person.square.size_px * 2 - 1
    side = head.face.texture.shape[-1]
    grid = round(len(grid_uv()) ** 0.5)
    return bake_attributes(places, grid, side).permute(1, 2, 0)
