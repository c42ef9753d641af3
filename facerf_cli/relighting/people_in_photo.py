"""Render relit people into their photo, at the photo's resolution.

`PersonInPhoto` renders one person from the views of a portrait field. The narrower view lies over the wider
one and fades toward its border; in the face, the texture of the face field is blended in. Both have the
photo's detail (`detail.py`).

`PeopleInPhoto` composites all people. Over the photo's own background, the image is the photo, minus its
people as photographed, plus the relit people over black. So edges are reproduced exactly, and layers of
lights add up.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, rows_of_camera, view_face
from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.image.strips import Window, enlarged, in_strips
from facerf_cli.light.light import Light
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.portrait.parse import class_index, covering, uncovered_fraction
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.raster.rasterize import front_facing, rasterize
from facerf_cli.raster.texture import blurred, inpaint, smoothstep
from facerf_cli.relighting.cast_shadows import CastShadow, cast_shadow
from facerf_cli.relighting.detail import FaceDetail
from facerf_cli.relighting.eyes import Eyes
from facerf_cli.relighting.face_alone import FACE_LAYERS, FaceInPhoto, face_layer
from facerf_cli.relighting.field import near_texture
from facerf_cli.relighting.portrait_field import PortraitField, rear_fraction
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest
from facerf_cli.relighting.upsampled import VIEW_LAYERS, Maps, Rims, UpsampledView
from facerf_cli.run.threads import both

Background = Literal["photo", "none", "given"]
PERSON_LAYERS = ("albedo", "normal", "position", "depth", "shadow", "specular", "classes")
_RADIANCE = ("albedo", "specular")  # layers that the matte multiplies
_BODY = [class_index(name) for name in ("neck", "garment", "hand")]
_STEADY_PX = 1.5  # blur of head and body, in pixels of the classes
_OTHERS = 1e-6  # weight of the head for the body and vice versa: counts where nothing else is near
_LIPS = 0.7  # cosine to the face's front above which lips do not shade the teeth
_LEAST = 0.02  # alpha below which a pixel has no layers: the matte's tail is noise
_BLACK, _TINY = np.float32(0), 1e-6
_Alphas = Sequence[np.ndarray]  # [h, W, 1] of people, the nearest first


class Surface:
    """Depth of a person at the resolution of the photo.

    Where the proxy covers a pixel, it is the proxy's depth, with steps at chin and nose instead of depths
    between two surfaces. Hair, hats and cloth beyond the proxy continue it, separately for head and body:
    hair next to the neck is as far away as the head, a sleeve as the torso. The background has no influence.
    """

    def __init__(self, person: SeenPerson, size_px: tuple[int, int]) -> None:
        self._proxy, self._size_px = person.proxy, size_px
        self._camera = photo_camera(person.fit.crop, *size_px)
        outside = front_facing(person.proxy.vertices, person.proxy.triangles)
        self._outside = person.proxy.triangles[outside]
        self._beyond = self._continued(person.segmentation.classes)

    def depth_m(self, rows: slice) -> np.ndarray:
        """Return the distance [h, W, 1] along the camera's axis in rows of the photo."""
        of_proxy = self._depth_of_proxy(rows_of_camera(self._camera, rows))
        head, body, lead = enlarged(self._beyond.numpy(), self._size_px, rows)
        return np.where(of_proxy.isfinite(), of_proxy, np.where(lead > 0, head, body))[..., None]

    def position_m(self, rows: slice) -> np.ndarray:
        """Return positions [h, W, 3] in camera space in rows of the photo."""
        return self.depth_m(rows) * rays_of_rows(self._camera, self._size_px, rows).numpy()

    def _depth_of_proxy(self, camera: Camera) -> Tensor:
        """Return the depth [h, w] of the proxy's outer side; infinite elsewhere."""
        return rasterize(self._proxy.vertices, self._outside, camera).depth_m

    def _continued(self, classes: Tensor) -> Tensor:
        """Return continued depths of head and body, and head minus body, at the classes' size [3, h, w]."""
        height, width = classes.shape[1:]
        scale = width / self._size_px[1], height / self._size_px[0]
        whole = self._camera
        of_proxy = self._depth_of_proxy(
            Camera(whole.focal_px * scale[0], width, height, whole.cx_px * scale[0], whole.cy_px * scale[1])
        )
        body = classes[_BODY].sum(0)
        head = 1 - classes[0] - body
        weights = (
            torch.stack([head + _OTHERS * body, body + _OTHERS * head]).clamp(0, 1) * of_proxy.isfinite()
        )
        depth = of_proxy.nan_to_num(posinf=0).expand(2, 1, -1, -1)
        return torch.cat([inpaint(depth, weights)[:, 0], blurred((head - body)[None], _STEADY_PX)])


@dataclass(frozen=True, eq=False)
class PersonLight:
    """Person under one sum of lights, with everything computed that does not depend on rows."""

    views: list[Maps]
    face: Tensor
    eye_reflections: list[np.ndarray]
    layers: Sequence[str]
    keys: list[tuple["PersonLight | None", CastShadow]]  # each light on its own; None: this light is the key


class PersonInPhoto:
    """Person in its photo [H, W, 3]; `matte` [H, W] is the alpha of the part that is relit."""

    def __init__(
        self, model: MorphableModel, photo: np.ndarray, head: Head, field: PortraitField, matte: np.ndarray
    ) -> None:
        self.size_px = photo.shape[0], photo.shape[1]
        self.photo, self._field, self._head = photo, field, head
        self.matte, self.own = matte, PersonColours(photo, matte)
        self.vertices_m = head.fit.vertices_camera(model)
        crop = head.fit.crop
        self.view = view_face(self.vertices_m, photo_camera(crop, *self.size_px), crop.side_px)
        self._covered = covering(field.person.segmentation.classes)[None].numpy()
        self._views = [UpsampledView(view) for view in field.views]
        self._detail = FaceDetail(head.face, self.view)
        self._last: tuple[tuple[Window, bool], Callable[[PersonLight], dict[str, np.ndarray]]] | None = None

    @property
    def nbytes(self) -> int:
        return 2 * self._head.face.texture.nbytes + sum(15 * view.own.nbytes for view in self._views)

    def alpha_rows(self, rows: slice) -> np.ndarray:
        """Return the alpha [h, W] of the whole person in rows of the photo."""
        return np.minimum(self.matte[rows], self._field.person.segmentation.matte[rows])

    def relit(self, lights: Light) -> Iterator[Relit]:
        """Yield the person under each sum of lights; the face field ignores light from behind."""
        field, original_rgbs = self._field, lights.original_rgbs
        lights, keys = lights.with_keys_alone()
        directions, weights = lights.directions, lights.weights
        middle_m, side = self.vertices_m.mean(0), self._head.face.texture.shape[-1]
        near = lights.near_points(middle_m)
        shadings, _ = both(lambda: field.shade(directions, weights, near), lambda: self._eyes)
        forward = self._head.fit.rotation[:, 2]

        def arriving(toward: Tensor, weights: Tensor) -> Tensor:
            """Return weights of all light on the face, then of the part that enters the mouth."""
            front = weights * (1 - rear_fraction(toward))[..., None]
            into_mouth = smoothstep(toward @ forward / _LIPS)  # between the lips of a face that looks forward
            return torch.cat([front, front * into_mouth[..., None]])

        textures = field.field.relit(directions, arriving(directions, weights))
        for points, rgb in near:
            texture = near_texture(field.field, points, self.vertices_m, side)
            textures = textures + arriving(-points.toward, rgb)[..., None, None] * texture
        textures, mouths = textures.chunk(2)
        reflections = field.views[0].eye_reflections(lights, middle_m)
        blended = field.blended(textures, shadings[0])
        every = [
            Relit(blended[at], tuple(view[at] for view in shadings), reflections[at], mouths[at])
            for at in range(len(blended))
        ]
        shadows: dict[tuple[bool, int], CastShadow] = {}
        for number, original_rgb in enumerate(original_rgbs):
            cast = []
            for key in (one for one in keys if one.number == number):
                at = key.is_near, key.samples.start
                if at not in shadows:
                    light = near[at[1]][0] if key.is_near else directions[key.samples].detach()
                    shadows[at] = cast_shadow(field.views[0], light)
                cast.append((every[key.alone], shadows[at]))
            yield replace(every[number], original_rgb=original_rgb, keys=tuple(cast))

    @cached_property
    def _eyes(self) -> Eyes:
        return Eyes(self.own, self._field.person.eyes, self.size_px)

    @cached_property
    def _rims(self) -> Rims:
        person = self._field.person
        return Rims(person.segmentation.matte, person.square.side_px / person.sides)

    def precompute(self, relit: Relit, layers: Sequence[str] = ()) -> PersonLight:
        """Compute everything that does not depend on rows."""
        assert relit.eye_reflections is not None
        for name in layers:
            if name not in (*PERSON_LAYERS, *FACE_LAYERS):
                raise UsageError(f"--aov {name}: not a layer; use some of {', '.join(PERSON_LAYERS)}")
        of_views = [name for name in layers if name in VIEW_LAYERS]
        rear = any(bool(light.rear.any()) for light in relit.views)
        views = zip(self._views, relit.views, strict=True)
        return PersonLight(
            [view.precompute(shading, of_views, rear) for view, shading in views],
            self._detail.precompute(relit.texture, relit.mouth),
            self._eyes.precompute(relit.eye_reflections),
            layers,
            [
                (None if key.texture is relit.texture else self.precompute(key), cast)
                for key, cast in relit.keys
            ],
        )

    def render(
        self, window: Window, own: np.ndarray, lights: Sequence[PersonLight]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield "rgb" [h, W, 3] and layers in a window of the photo under each precomputed light.

        `own` [h, W, 3] are the person's colours in the photo. "rgb" is 0 where there is no person.
        """
        used = np.flatnonzero(self.matte[window.rows].any(0))
        columns = slice(int(used[0]), int(used[-1]) + 1) if len(used) else slice(0, 1)
        among = Window(window.rows, columns)
        rims = self._rims if any("rear" in maps for light in lights for maps in light.views) else None
        place = among, rims is None
        by_maps = self._last[1] if self._last and self._last[0] == place else None
        if by_maps is None:
            by_maps = self._by_maps(among, own[:, among.columns], rims)
        if window.shape == self.size_px:  # the next lights are rendered in the same window
            self._last = place, by_maps
        for light in lights:
            values = by_maps(light)
            whole = values["rgb"]
            pixels = whole.copy() if light.keys else whole
            for key, part, change in self._shadows(light, among):
                of_key = whole if key is None else by_maps(key)["rgb"]
                pixels[part] += of_key[part] * change
            pixels = self._eyes.lit(window.framed(pixels, among), light.eye_reflections, window)
            of_views = {name: window.framed(values[name], among) for name in VIEW_LAYERS if name in values}
            image = {"rgb": pixels}
            for name in light.layers:
                image |= self._layer(name, window, of_views)
            yield image

    def _shadows(
        self, light: PersonLight, among: Window
    ) -> Iterator[tuple[PersonLight | None, Window, np.ndarray]]:
        """Yield each key light on its own, and the part of a window that its shadow changes, by [h, w, 1]."""
        view = self._views[0]
        part, weight = view.weight(among)
        for key, shadow in light.keys if weight.any() else ():
            change = weight * (view.shadow_factor(shadow, part) - 1)
            if change.any():
                yield key, part.inside(among), change[..., None]

    def _by_maps(
        self, among: Window, own: np.ndarray, rims: Rims | None
    ) -> Callable[[PersonLight], dict[str, np.ndarray]]:
        """Return a function that renders a window under a light, without cast shadows and eyes.

        `own` [h, w, 3] are the person's colours in the photo.
        """
        parts = self._parts(among)
        views = [
            self._views[number].over(part, own[:, part.inside(among).columns].clip(min=0), rims)
            for number, part, _ in parts
        ]
        part = among.common(self.view.window)
        at = part.inside(among)
        if on_face := all(part.shape):
            face, face_weight = self._detail.over(part, own[at]), self._face_weight(part)[..., None]

        def lit(light: PersonLight) -> dict[str, np.ndarray]:
            values: dict[str, np.ndarray] = {}
            for view, (number, place, weight) in zip(views[::-1], parts[::-1], strict=True):
                for name, above in view(light.views[number]).items():
                    if name in values:
                        below = values[name][place.inside(among)]
                        below += weight[..., None] * (above - below)
                    else:  # the widest view
                        values[name] = above
            person = values["rgb"]
            if on_face:  # the face field ends at the hair
                person[at] += face_weight * (face(light.face) - person[at])
            if "change" in values:
                person = person * values["change"]
            return values | {"rgb": person + values["rear"] if "rear" in values else person}

        return lit

    def _face_weight(self, part: Window) -> np.ndarray:
        """Return the weight [h, w] of the face field in a part of its window."""
        bare = uncovered_fraction(enlarged(self._covered, self.size_px, part.rows)[0])[:, part.columns]
        return np.asarray(self.view.mask[part.inside(self.view.window)].numpy() * bare)

    def _layer(self, name: str, window: Window, of_views: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return a layer [h, W, C] of rows, by the names that it has in a file.

        albedo: radiance under unshadowed light of rgb 1; specular: radiance of highlights; shadow: fraction
        of the light that is not shadowed; normal and position: camera space, m; depth: m; classes: coverage.
        All are 0 off the person. The matte multiplies radiance, as in layers of lights.
        """
        rows = window.rows
        if name == "classes":
            return self._field.person.segmentation.layers(rows)
        if name not in PERSON_LAYERS:
            return face_layer(self.view, name, window)
        if name in of_views:
            values = of_views[name]
        else:
            values = {"depth": self._surface.depth_m, "position": self._surface.position_m}[name](rows)
        alpha = self.matte[rows][..., None]
        values = values * (alpha if name in _RADIANCE else alpha > _LEAST)
        if name == "normal":
            values = values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-6)
        return {name: values}

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        view = self._field.views[0]
        original_rgb = torch.zeros(3) if relit.original_rgb is None else relit.original_rgb.detach()
        image, skin = view.person.image, view.person.classes[class_index("skin")].numpy()
        (radiance,) = view.render(relit.views[0])
        lit = radiance + original_rgb[:, None, None] * image
        lit, plate = (pixels.permute(1, 2, 0).numpy() for pixels in (lit, image))
        return chosen_exposure_ev(rule, lit, plate, skin, view.person.own_pixels.numpy())

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self._field.person, self.size_px)

    def _parts(self, among: Window) -> list[tuple[int, Window, np.ndarray]]:
        """Return number, part and weight [h, w] of the views in a window; the last view needs no weight."""
        parts = []
        for number, view in enumerate(self._views[:-1]):
            part, weight = view.weight(among)
            parts += [(number, part, weight)] if weight.any() else []
            if part == among and weight.min() == 1:  # hides wider views
                return parts
        return [*parts, (len(self._views) - 1, among, np.ones(0))]


@dataclass(frozen=True, eq=False)
class PeopleInPhoto(Relightable):
    """People in one photo, the nearest first, over the photo's background, nothing, or another image."""

    people: Sequence[PersonInPhoto | FaceInPhoto]
    background: Background = "photo"

    @property
    def size_px(self) -> tuple[int, int]:
        return self.people[0].size_px

    @property
    def keeps_photo(self) -> bool:  # type: ignore[override]
        return self.background == "photo"

    @property
    def nbytes(self) -> int:
        return sum(person.nbytes for person in self.people)

    @cached_property
    def matte(self) -> np.ndarray:
        if len(self.people) == 1:
            return self.people[0].matte
        return in_strips(self._alpha_rows, *self.size_px)["alpha"]

    @property
    def person_matte(self) -> np.ndarray:
        return self.matte

    def relit(self, lights: Light | Sequence[Light]) -> Iterator[tuple[Relit, ...]]:
        """Yield the people under each sum of lights; a sequence has one `Light` per person."""
        each = [lights] * len(self.people) if isinstance(lights, Light) else lights
        return zip(*(person.relit(own) for person, own in zip(self.people, each, strict=True)), strict=True)

    def exposure_ev(self, relit: Sequence[Relit], rule: ExposureRule) -> float:
        return self.people[0].exposure_ev(relit[0], rule)

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """Return a function that renders rows; positions are in each person's own camera."""
        lights = [] if request.image is None else [(request.image, request.layers)]
        lights += [(relit, ()) for relit in request.lights.values()]
        ready = [
            [person.precompute(relit[number], layers) for relit, layers in lights]
            for number, person in enumerate(self.people)
        ]
        return partial(self._render, request, ready)

    def original_layer(self) -> np.ndarray:
        """Return the people [H, W, 3] as photographed, over black."""
        return in_strips(self._original_rows, *self.size_px)["original"]

    def _alpha_rows(self, rows: slice) -> dict[str, np.ndarray]:
        return {"alpha": _alpha(self._present(rows)[1])[..., 0]}

    def _original_rows(self, rows: slice) -> dict[str, np.ndarray]:
        numbers, alphas = self._present(rows)
        return {"original": _over(alphas, [self.people[number].own[rows] for number in numbers])}

    def _render(
        self, request: RenderRequest, ready: Sequence[Sequence[Any]], rows: slice
    ) -> dict[str, np.ndarray]:
        window, (numbers, alphas) = Window(rows, slice(0, self.size_px[1])), self._present(rows)
        owns = [self.people[number].own[rows] for number in numbers]
        images = [
            self.people[number].render(window, own, ready[number])
            for number, own in zip(numbers, owns, strict=True)
        ]
        under_each, layers = zip(*images, strict=True), dict[str, np.ndarray]()
        if request.image is not None:
            each = next(under_each)
            pixels = _with_original_light(each, [request.image[number] for number in numbers], owns)
            layers["rgb"] = self._image(request, alphas, owns, pixels, rows)
            layers |= _layers(alphas, each)
        for (name, relit), each in zip(request.lights.items(), under_each, strict=True):
            pixels = _with_original_light(each, [relit[number] for number in numbers], owns)
            layers[name] = _over(alphas, pixels)
        if request.wrap is not None and request.image is not None:
            layers["wrap"] = request.wrap[rows]
            layers["rgb"] = layers["rgb"] + layers["wrap"]
        return layers

    def _present(self, rows: slice) -> tuple[list[int], _Alphas]:
        """Return number and alpha [h, W, 1] of the nearest person, and of the few others in rows."""
        numbers, alphas = [0], [self.people[0].matte[rows][..., None]]
        for number, person in enumerate(self.people[1:], 1):
            if (alpha := person.alpha_rows(rows)).any():
                numbers.append(number)
                alphas.append(alpha[..., None])
        return numbers, alphas

    def _image(
        self,
        request: RenderRequest,
        alphas: _Alphas,
        owns: Sequence[np.ndarray],
        pixels: Sequence[np.ndarray],
        rows: slice,
    ) -> np.ndarray:
        """Composite pixels [h, W, 3] of the people over the background."""
        if request.background is not None:
            return _over(alphas, pixels, request.background[rows])
        if self.keeps_photo:
            plate = (self.people[0].photo[rows] - _over(alphas, owns)) * np.float32(2.0**-request.ev)
            image = plate + _over(alphas, pixels)
            return image.clip(min=0) if len(self.people) > 1 else image
        if len(alphas) == 1:
            return pixels[0]
        return _over(alphas, pixels) / np.maximum(_alpha(alphas), _TINY)  # not premultiplied


def _with_original_light(
    images: Sequence[dict[str, np.ndarray]], relit: Sequence[Relit], owns: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Add the photo's original light to pixels [h, W, 3] of people; `owns` are their colours under it."""
    return [
        image["rgb"]
        if one.original_rgb is None or not one.original_rgb.any()
        else image["rgb"] + one.original_rgb.detach().numpy() * own
        for image, one, own in zip(images, relit, owns, strict=True)
    ]


def _over(alphas: _Alphas, pixels: Sequence[np.ndarray], below: Any = _BLACK) -> np.ndarray:
    """Composite pixels [h, W, 3] of people, one after the other, over what is below, by default black."""
    for alpha, own in zip(alphas, pixels, strict=True):
        image = own - below
        image *= alpha
        image += below
        below = image
    return np.asarray(below)


def _alpha(alphas: _Alphas) -> np.ndarray:
    """Return the alpha [h, W, 1] of all people."""
    total: Any = _BLACK
    for alpha in alphas:
        total = total + alpha * (1 - total)
    return np.asarray(total)


def _layers(alphas: _Alphas, each: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Merge layers of all people: composite alphas and radiance; take others from the most visible person."""
    merged: dict[str, np.ndarray] = {}
    below: Any = _BLACK
    for alpha, layers in zip(alphas, each, strict=True):
        for name, top in layers.items():
            if name == "rgb":
                continue
            if name not in merged:
                merged[name] = top
            elif name in _RADIANCE or name.endswith(".A") or name.startswith("class."):
                merged[name] = top + (1 - (alpha if top.ndim == 3 else alpha[..., 0])) * merged[name]
            else:
                merged[name] = np.where(alpha > (1 - alpha) * below, top, merged[name])
        below = below + alpha * (1 - below)
    return merged
