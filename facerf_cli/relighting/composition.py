"""The relit face back in its photo, at the photo's own resolution, or alone in its frame.

A texture is coarser than the photo, so the photo's detail is added to it. Where the source texture is S and
the relit one R, a photo pixel P becomes

    R (P + e) / (S + e) + k e (P - S) / (S + e)    where P >= S,    k = mean R / mean S,
    R D / S + R (P - D) / (S + e)                  where P < S,

D is P, but in dark pixels has the colour of S, for theirs is noise. For bright sources both are the
quotient P R / S. Where the source is nearly black the quotient would be noise, and e, a small share of the
source's mean, keeps the pixel near R. Under the photo's own light (R = S) the photo comes back, its dark
pixels nearly. What lies around the face follows by `Surround`, or is relit as a whole person. All steps are
linear in light: two lights composed apart add up to both composed at once, but for a slight undershoot of
the surround, which is clipped, and for the photo's background, which no light changes. A light with
negative weights, such as the paper's plain least squares gives, can make pixels negative.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.landmarks import display_ev
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import FaceView, photo_camera, view_face
from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev, luminance
from facerf_cli.image.strips import Band, Layer, by_rows, filled, remembered
from facerf_cli.light.studio_points import Lights
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE, Camera
from facerf_cli.raster.texture import inpaint, smoothstep
from facerf_cli.relighting.cast_shadows import CastShadow, cast_shadow
from facerf_cli.relighting.eyes import Eyes
from facerf_cli.relighting.field import Field, near_texture, weighted_sums
from facerf_cli.relighting.grain import Grain
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.rims import from_behind
from facerf_cli.relighting.whole_person import WholePerson
from facerf_cli.run.threads import both

_DARK = 0.08  # e above, a share of the source's mean
_NOISY = 2.0  # times e: the luminance below which colours of pixels are noise
_OWN_REGIONS = ("eyes", "mouth", "brows")  # keep the photo's own detail, scaled as the skin around them
_OWN_SIDE = 128  # texels of their mask; finer ones take seconds to draw
_LIPS = 0.7  # cosine to the face's front from which on lips keep no light from the teeth
_CAVITY = 0.75  # of the light that they keep from them
_TINY = 1e-8

_SURROUND = 3  # crops along each side of the square in which hair and background follow the face's light
_SURROUND_PX = 64  # pixels along a crop there
_SPREAD = 0.04  # standard deviation of the blur of the change of light, in crop sides
_REACH = 0.22  # of that change to the side, in crop sides; beyond it all follows the mean change
_DARKER, _BRIGHTER = 12.0, 1.6  # that change is at most so far below and above the mean change of a light
_UPRIGHT = 0.4  # of a step up or down, as a share of a step aside: above and below are hair and neck

Pixels = np.ndarray | PersonColours  # [H, W, 3], read by rows
Background = Literal["photo", "none", "given"]
FACE_LAYERS = ("normal", "position", "depth", "uv", "face")
PERSON_LAYERS = ("albedo", "normal", "position", "depth", "shadow", "specular", "classes")


@dataclass(frozen=True, eq=False)
class Target:
    """The pose and the surroundings in which a relit head is shown.

    `fit` is the head's pose and shape as shown; None: as in the photo. `composite` is the photo with its
    person relit, or the rendered face alone. A `matte` [H, W] in 0..1 says what is relit, by default all;
    it is multiplied by the `alpha` [H, W] of the photo itself. Behind it stays the photo, or nothing, or
    what is given with each light.
    """

    fit: FaceFit | None = None
    composite: Literal["photo", "face"] = "photo"
    matte: np.ndarray | None = None
    alpha: np.ndarray | None = None
    background: Background = "photo"


AS_IN_PHOTO = Target()


@dataclass(frozen=True, eq=False)
class Relit:
    """A head under one light: its texture [3, T, T], and the light around it.

    `surround` is [3, s, s] of a `Surround`, [views, 15, S, S] of a `WholePerson`; None of a face alone.
    `mirrored` is what the eyes of a whole person mirror [N, 3, s, s]; `mouth` [3, T, T] the texture in what
    falls into the mouth; `own` [3] the share of the photo's own light; `keys` are
    key lights alone, and the shadow that each casts.
    """

    texture: Tensor
    surround: Tensor | None = None
    mirrored: Tensor | None = None
    mouth: Tensor | None = None
    own: Tensor | None = None
    keys: "tuple[tuple[Relit, CastShadow], ...]" = field(default=(), kw_only=True)

    def plus(self, rgb: Tensor, other: "Relit") -> "Relit":
        """This and another light of rgb 1, made so bright [3]."""

        def both(one: Tensor | None, two: Tensor | None) -> Tensor | None:
            return None if one is None or two is None else one + rgb[:, None, None] * two

        names = ("texture", "surround", "mirrored", "mouth")
        return Relit(*(both(getattr(self, name), getattr(other, name)) for name in names))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class RelitImage:
    """An image [H, W, 3], scene-linear, not multiplied by alpha [H, W], which images without gaps lack."""

    pixels: np.ndarray
    alpha: np.ndarray | None = None


class Composition:
    """Compose relit textures of one head into one frame: the photo's, or without a photo the crop's own.

    What does not depend on the light is computed once. With a portrait field, in a photo, all of its person
    is relit; else what lies around the face follows the face's light.
    """

    def __init__(
        self,
        model: MorphableModel,
        photo: np.ndarray | None,
        head: Head,
        target: Target = AS_IN_PHOTO,
        reflectance: Reflectance | None = None,
    ) -> None:
        fit = head.fit if target.fit is None else target.fit
        self.vertices_m = vertices = fit.vertices_camera(model)  # [V, 3], camera space
        size_px = (fit.crop.size_px, fit.crop.size_px) if photo is None else (photo.shape[0], photo.shape[1])
        crop = Crop(0.0, 0.0, float(fit.crop.size_px), fit.crop.size_px) if photo is None else fit.crop
        self.view = view_face(vertices, photo_camera(crop, *size_px), crop.side_px)
        self._photo = photo if target.composite == "photo" else None
        self._head, self._target, self._reflectance = head, target, reflectance
        self.own: Pixels
        self.surround: Surround | WholePerson | None = None
        self.person: WholePerson | None = None
        if self._photo is None:
            return
        if isinstance(reflectance, PortraitField):
            self.person = WholePerson(self._photo, reflectance)
        matte, self.own = target.matte, self._photo
        if matte is None and self.person:
            matte = self.person.matte
        if matte is not None and target.alpha is not None:
            matte = matte * target.alpha
        self.matte = np.broadcast_to(np.float32(1), size_px)
        if matte is not None:
            self.matte = matte.astype(np.float32, copy=False)
            self.own = PersonColours(self._photo, self.matte)
        shown = self.own.small if isinstance(self.own, PersonColours) else self._photo
        self._display_ev = display_ev(shown)
        self._detail = PhotoDetail(head.face, self.view, self.own)
        self.surround = self.person or Surround(vertices, crop, head.face.texture, size_px[1])

    @cached_property
    def _finish(self) -> tuple[Grain, Eyes] | None:
        return self.person.finish(self.own, self._display_ev, self.matte) if self.person else None

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""
        return self.view.height_px, self.view.width_px

    @property
    def keeps_photo(self) -> bool:
        """True where the photo's own background stays behind the person."""
        return self._photo is not None and self._target.background == "photo"

    @property
    def photo(self) -> np.ndarray:
        """The photo [H, W, 3]."""
        assert self._photo is not None
        return self._photo

    @property
    def even(self) -> float:
        """Brightness of even light, from all around, under which skin is as bright as in the photo."""
        reflectance = self._reflectance
        balance = reflectance.balance if isinstance(reflectance, Field | PortraitField) else None
        return 1.0 if balance is None else balance.even

    @property
    def nbytes(self) -> int:
        """Bytes of the head under one sum of lights."""
        return 2 * self._head.face.texture.nbytes + (self.surround.nbytes if self.surround else 0)

    def relit(self, lights: Lights) -> Iterator[Relit]:
        """Relight the head under each sum of lights, the photo's own light among them; see `_by_lights`."""
        pairs = zip(self._by_lights(lights), lights.owns, strict=True)
        return (replace(one, own=own) for one, own in pairs)

    def _by_lights(self, lights: Lights) -> Iterator[Relit]:
        """Relight the head under each sum of lights (paper, 'Relighting'); one prediction serves all sums.

        Of the field, which is linear in light, the surround is summed over its lights, too; the models that
        the paper compares with are not linear where they are clamped.
        """
        reflectance, count = self._reflectance, len(lights)
        lights, keys = lights.with_keys_alone() if self.person else (lights, [])
        directions, weights, near = lights.directions, lights.weights, lights.around(self.vertices_m.mean(0))
        fit, side = self._target.fit, self._head.face.texture.shape[-1]
        turn = None if fit is None else self._head.fit.turn_to(fit.rotation)
        assert reflectance is not None
        if self.person and isinstance(reflectance, PortraitField):
            lit, _ = both(lambda: reflectance.lit(directions, weights, near), lambda: self._finish)
            forward = self._head.fit.rotation[:, 2]

            def arriving(toward: Tensor, weights: Tensor) -> Tensor:
                """Weights of all light on the face, then of what of it falls into the mouth."""
                front = weights * (1 - from_behind(toward))[..., None]
                return torch.cat([front, front * _into_mouth(toward, forward)[..., None]])

            textures = reflectance.field.relit(directions, arriving(directions, weights))
            for points, rgb in near:
                texture = near_texture(reflectance.field, points, self.vertices_m, side)
                textures = textures + arriving(-points.toward, rgb)[..., None, None] * texture
            textures, mouths = textures.chunk(2)
            stacked = torch.stack([view.stacked for view in lit], 1)
            mirrored = reflectance.views[0].mirrored(lights, self.vertices_m.mean(0))
            every = list(map(Relit, reflectance.blended(textures, lit[0]), stacked, mirrored, mouths))
            cast: list[list[tuple[Relit, CastShadow]]] = [[] for _ in range(count)]
            for key in keys:
                light = near[key.samples.start][0] if key.is_near else directions[key.samples].detach()
                cast[key.number].append((every[key.alone], cast_shadow(reflectance.views[0], light)))
            yield from (replace(one, keys=tuple(some)) for one, some in zip(every, cast, strict=False))
            return
        changes = self.surround.changes if isinstance(self.surround, Surround) else None
        pairs: Iterable[tuple[Tensor, Tensor | None]]
        if changes and isinstance(reflectance, Field):
            olats = reflectance.olats(directions, turn)
            pairs = zip(*weighted_sums(olats, weights, lambda olats: olats, changes), strict=True)
        else:
            textures = reflectance.relit(directions, weights, turn)
            pairs = ((x, changes(x[None])[0] if changes else None) for x in textures)
        extra = [near_texture(reflectance, points, self.vertices_m, side, turn) for points, _ in near]
        for number, pair in enumerate(pairs):
            relit = Relit(*pair)
            for texture, (_, rgb) in zip(extra, near, strict=True):
                around = changes(texture[None])[0] if changes else None
                relit = relit.plus(rgb[number], Relit(texture, around))
            yield relit

    def image(self, relit: Relit, ev: float = 0.0, behind: Band | None = None) -> RelitImage:
        """The head in its frame as relit, scene-linear; see `bands`."""
        arrays = filled(self.bands(relit, ev, behind), *self.size_px)
        return RelitImage(arrays["rgb"], arrays.get("A"))

    def bands(self, relit: Relit, ev: float = 0.0, behind: Band | None = None) -> dict[str, Layer]:
        """The head in its frame as relit, scene-linear, by rows: rgb [H, W, 3], and A [H, W] if it has gaps.

        The photo's background keeps its look at an exposure of `ev`; one that is given is `behind` [H, W, 3].
        """
        person, photo, gain = self._relit_pixels(relit), self._photo, np.float32(2.0**-ev)
        if photo is None or self._target.background == "none":
            return {"rgb": person, "A": self._share}

        def of(rows: slice) -> np.ndarray:
            pixels, matte = person(rows), self.matte[rows][..., None]
            if behind is not None:
                below = behind(rows)
                return below + matte * (pixels - below)
            return (photo[rows] - matte * self.own[rows]) * gain + matte * pixels

        return {"rgb": of}

    @property
    def _mask(self) -> Band:
        return self.view.in_frame(lambda rows: self.view.mask[rows])

    @property
    def _share(self) -> Layer:
        """Share [H, W] of the frame that is relit."""
        return self._mask if self._photo is None else self.matte

    def _relit_pixels(self, relit: Relit) -> Band:
        """Pixels [H, W, 3], by rows, of the person or the face alone, also where its share leaves none."""
        pixels = self._by_light(relit)
        if relit.own is None:
            return pixels
        return in_own_light(pixels, self.own, relit.own)

    def _by_light(self, relit: Relit) -> Band:
        """Pixels as `_relit_pixels`, without the photo's own light."""
        person, coarse = self.person, self._by_maps(relit)
        if person is None or self._finish is None or relit.mirrored is None:
            return coarse
        alone = [
            (None if one.texture is relit.texture else self._by_maps(one), cast) for one, cast in relit.keys
        ]

        def of(rows: slice) -> np.ndarray:
            pixels = coarse(rows)
            changes = [(image, person.change(shadow, rows)) for image, shadow in alone]
            parts = [
                (pixels if image is None else image(rows)) * (change - 1)
                for image, change in changes
                if (change != 1).any()
            ]
            return sum(parts, pixels)

        return self._finish[1].lit(of, relit.mirrored)

    def _by_maps(self, relit: Relit) -> Band:
        """Pixels as `_by_light`, without what only the photo's pixels show: shadows' edges, and eyes."""
        if self._photo is None:
            return self.view.in_frame(lambda rows: self.view.render(relit.texture, rows), 3)
        assert self.surround is not None and relit.surround is not None
        around = self.surround.over_photo(self.own, relit.surround, self._display_ev)
        detail, view = self._detail.relit(relit.texture, relit.mouth), self.view

        def of(rows: slice) -> np.ndarray:
            person, rims = np.split(around(rows), [3], -1)  # the field of the face knows no hair around it
            inside = view.rows_inside(rows)
            if inside.start < inside.stop:
                part = person[view.rows_of(inside, rows), view.window[1]]
                part += self.face_share(inside)[..., None] * (detail(inside) - part)
            return person + rims if rims.size else person

        return of if self._finish is None or relit.mirrored is None else self._finish[0].given(of)

    def face_share(self, inside: slice) -> np.ndarray:
        """Share [h, w] of the face in rows of the view's window, without what is seen before it."""
        mask = self.view.mask[inside].numpy()
        if self.person is None:
            return mask
        return np.asarray(mask * self.person.bare_face(self.view.in_photo(inside))[:, self.view.window[1]])

    def person_and_share(self, relit: Relit) -> tuple[Band, Band]:
        """Pixels [H, W, 3] of the whole person, or of its face, and the share [H, W] of it in the photo."""
        return self._relit_pixels(relit), self.share_in_photo

    def share_in_photo(self, rows: slice) -> np.ndarray:
        """Share [h, W] of the whole person, or of its face, in rows of the photo."""
        own = self._mask(rows) if self.person is None else self.person.matte[rows]
        return np.minimum(self.matte[rows], own)

    def light_layer(self, relit: Relit) -> Band:
        """The person [H, W, 3] under one of several lights, over black: layers of lights add up."""
        pixels, share = self._relit_pixels(relit), by_rows(self._share)
        return lambda rows: pixels(rows) * share(rows)[..., None]

    def cut_out(self, relit: Relit) -> Band:
        """Pixels [H, W, 3] of the person or the face alone, not multiplied by the matte; see `bands`."""
        return self._relit_pixels(relit)

    def own_layer(self, straight: bool) -> Band:
        """The person [H, W, 3] as photographed, over black, or `straight`: not multiplied by its share."""
        photo, share = self.own, by_rows(self._share)
        return lambda rows: photo[rows] if straight else photo[rows] * share(rows)[..., None]

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Layer]:
        """Layers of the image by the names that they have in a file; of a photo always the matte, person.A.

        `names` are of `PERSON_LAYERS` where a whole person is relit; else, and for what only the face has, of
        `FACE_LAYERS`. Raises UsageError for others.
        """
        found: dict[str, Layer] = {}
        if self._photo is not None:
            found["person.A"] = self.matte
        for name in names:
            if self.person is not None and relit.surround is not None and name in PERSON_LAYERS:
                found |= self.person.layer(name, relit.surround, self.own, self.matte)
            elif name in FACE_LAYERS:
                found |= self._face_layer(name)
            else:
                raise UsageError(f"--aov {name}: is of whole people; give --reflectance portrait and a photo")
        return found

    def _face_layer(self, name: str) -> dict[str, Layer]:
        if name == "face":
            return {"face.A": self._mask}
        view = self.view
        of, channels = {
            "normal": (lambda rows: view.surface(rows)[..., :3], 3),
            "position": (lambda rows: view.surface(rows)[..., 3:], 3),
            "depth": (lambda rows: -view.surface(rows)[..., 5:], 1),
            "uv": (lambda rows: view.uv[rows], 2),
        }[name]
        return {name: view.in_frame(of, channels)}

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV of a relit head, by a rule."""
        own = torch.zeros(3) if relit.own is None else relit.own.detach()
        if self.person is not None and relit.surround is not None:
            return self.person.exposure_ev(relit.surround, own, rule)
        source = self._head.face.texture
        textures = relit.texture + own[:, None, None] * source, source
        lit, plate = (texture.permute(1, 2, 0).numpy() for texture in textures)
        seen = self._head.face.visible.numpy()
        return chosen_exposure_ev(rule, lit, plate, seen, seen)


def in_own_light(pixels: Band, photo: Pixels, share: Tensor) -> Band:
    """Pixels [H, W, 3], by rows, to which the photo's own light adds its share [3] of the photo."""
    rgb = share.detach().numpy()
    return lambda rows: pixels(rows) + rgb * photo[rows] if rgb.any() else pixels(rows)


class PhotoDetail:
    """The photo's own detail, added to relit textures in the window [h, w] of a view (formula above).

    Eyes, brows and teeth stay the photo's: they are scaled as the skin around them, teeth by the light that
    falls into the mouth.
    """

    def __init__(self, face: FaceTexture, view: FaceView, photo: Pixels) -> None:
        self._view, self._texture = view, face.texture
        masks = torch.stack([region_mask(name, _OWN_SIDE) for name in _OWN_REGIONS])[None]
        masks = F.interpolate(masks, face.texture.shape[1:], mode="bilinear", align_corners=False)[0]
        own, self._mouth = masks.amax(0), masks[_OWN_REGIONS.index("mouth")]
        self.trusted = face.visible * (1 - own)
        self.mean_source = _mean(face.texture, self.trusted)
        self.floor = _DARK * float(self.mean_source.mean()) + _TINY
        self._around_source = inpaint(face.texture, self.trusted).clamp(min=self.floor)
        self._source, self._photo = torch.cat([face.texture, own[None]]), photo
        self._seen = remembered(self._of_photo)

    def _of_photo(self, rows: slice) -> tuple[np.ndarray, ...]:
        """Some rows of the window: pixels, what multiplies R and k in them, and share of `_OWN_REGIONS`."""
        floor = self.floor
        pixels = self._photo[self._view.in_photo(rows)][:, self._view.window[1]].clip(min=0)
        source, own = np.split(self._view.render(self._source, rows).numpy(), [3], -1)
        finer = pixels >= source
        steady = _steady_colours(pixels, source, _NOISY * floor)
        darker = steady / source.clip(min=_TINY) + (pixels - steady) / (source + floor)
        gain = np.where(finer, (pixels + floor) / (source + floor), darker)
        bias = np.where(finer, floor * (pixels - source) / (source + floor), 0)
        return pixels, gain, bias, own

    def relit(self, texture: Tensor, mouth: Tensor | None = None) -> Band:
        """The photo's pixels in rows [h, w, 3] of the window under the light of a relit texture [3, T, T].

        `mouth` [3, T, T] is relit by what falls into the mouth.
        """
        mean_change = (_mean(texture, self.trusted) / self.mean_source.clamp(min=_TINY)).numpy()
        around = inpaint(texture, self.trusted)
        if mouth is not None:
            around = torch.lerp(around, inpaint(mouth, self.trusted), _CAVITY * self._mouth)
        textures = torch.cat([texture, around / self._around_source])

        def of(rows: slice) -> np.ndarray:
            pixels, gain, bias, own = self._seen(rows)
            skin, change = np.split(self._view.render(textures, rows).numpy(), 2, -1)
            skin = skin * gain + mean_change * bias
            return np.asarray(skin + own * (change * pixels - skin))

        return of


def _steady_colours(pixels: np.ndarray, around: np.ndarray, dark: float) -> np.ndarray:
    """Pixels [h, w, 3], which where they are darker than `dark` take on the colour of what is around them."""
    light, mean = (luminance(image)[..., None] for image in (pixels, around))
    share = (1 - light / dark).clip(min=0)
    return pixels + share * (around * light / mean.clip(min=_TINY) - pixels)


def _into_mouth(directions: Tensor, forward: Tensor) -> Tensor:
    """Share [...] of lights from directions [..., 3] that falls between lips; the face looks `forward`."""
    return smoothstep(directions @ forward / _LIPS)


def _mean(texture: Tensor, weight: Tensor) -> Tensor:
    """Mean colour [3] of a texture [3, T, T] under weights [T, T]."""
    return (texture * weight).sum((1, 2)) / weight.sum().clamp(min=_TINY)


class Surround:
    """The change of light on the face, spread outward and blurred: hair, neck and background follow it.

    With distance it becomes the mean change. Next to the face it stays near the mean, since a bright rim
    there looks like a glow. The bounds apply to each light, so sums over lights stay linear.
    """

    def __init__(self, vertices_camera: Tensor, crop: Crop, source: Tensor, width_px: int) -> None:
        side = _SURROUND * _SURROUND_PX
        camera = Camera(CROP_FOCAL_PER_SIDE * _SURROUND_PX, side, side, side / 2, side / 2)
        self._view = view_face(vertices_camera, camera, _SURROUND_PX)
        self._mask = torch.from_numpy(self._view.full(self._view.mask))
        outside = (self._mask < 0.5).numpy()
        away_px = torch.from_numpy(distance_transform_edt(outside, sampling=(_UPRIGHT, 1.0))).float()
        self._near = 1 - smoothstep(away_px / (_REACH * _SURROUND_PX))
        self._crop, self._width_px = crop, width_px
        self._mean_source, self._around_source = self._mean_and_blur(source[None])

    def changes(self, olats: Tensor) -> Tensor:
        """The change of light [L, 3, s, s] from the source to each of OLAT textures [L, 3, T, T]."""
        mean, around = self._mean_and_blur(olats)
        floor = _DARK * self._mean_source
        change = mean / self._mean_source.clamp(min=_TINY)
        local = (around + floor * change) / (self._around_source + floor).clamp(min=_TINY)
        local = local.minimum(change * _BRIGHTER).maximum(change / _DARKER)
        return torch.lerp(change.expand_as(local), local, self._near)

    @property
    def nbytes(self) -> int:
        """Size of one change of light."""
        return 3 * self._mask.nbytes

    def over_photo(self, photo: Pixels, change: Tensor, display_ev: float) -> Band:
        """The photo [H, W, 3], by rows, under a change of light [3, s, s]."""

        def of(rows: slice) -> np.ndarray:
            grid = _photo_grid(self._crop, rows, self._width_px)
            over = F.grid_sample(
                change[None], grid, mode="bicubic", padding_mode="border", align_corners=False
            )
            # bicubic weights undershoot a little
            return np.asarray(photo[rows] * over[0].permute(1, 2, 0).clamp(min=0).numpy())

        return of

    def _mean_and_blur(self, textures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean colours [N, 3, 1, 1] of textures [N, 3, T, T] on the face, and their blur [N, 3, s, s]."""
        rendered = self._view.full(self._view.render(textures.flatten(0, 1)))
        planes = torch.from_numpy(rendered).permute(2, 0, 1)
        mean = (planes * self._mask).sum((1, 2)) / self._mask.sum().clamp(min=_TINY)
        sigma = _SPREAD * _SURROUND_PX
        blurred = gaussian_filter(inpaint(planes, self._mask).numpy(), (0, sigma, sigma), mode="nearest")
        shape = (len(textures), 3)
        return mean.view(*shape, 1, 1), torch.from_numpy(blurred).view(*shape, *self._mask.shape)


def _photo_grid(crop: Crop, rows: slice, width_px: int) -> Tensor:
    """The place of pixels of the photo's rows in the surround's square, for grid_sample [1, h, W, 2]."""
    x = ((torch.arange(width_px) + PIXEL_CENTRE - crop.x0_px) / crop.side_px - 0.5) * (2 / _SURROUND)
    y = ((torch.arange(rows.start, rows.stop) + PIXEL_CENTRE - crop.y0_px) / crop.side_px - 0.5) * (
        2 / _SURROUND
    )
    return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, width_px)], -1)[None].float()
