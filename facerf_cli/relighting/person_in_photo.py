"""The whole person of a portrait field, relit in its photo at the photo's own resolution.

Of the field's views the narrower lies over the wider one, and fades toward its border. In the face the neural
field's texture is blended in. Both have the photo's detail (`detail.py`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, rows_of_camera, view_face
from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Window, enlarged
from facerf_cli.light.light import Light
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.portrait.parse import class_index, covering, uncovered_fraction
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.raster.rasterize import front_facing, rasterize
from facerf_cli.raster.texture import blurred, inpaint, smoothstep
from facerf_cli.relighting.cast_shadows import CastShadow, cast_shadow
from facerf_cli.relighting.detail import FaceDetail
from facerf_cli.relighting.enlarged import VIEW_LAYERS, Enlarged, Maps, Rims
from facerf_cli.relighting.eyes import Eyes
from facerf_cli.relighting.face_alone import FACE_LAYERS, face_layer
from facerf_cli.relighting.field import near_texture
from facerf_cli.relighting.portrait_field import PortraitField, from_behind
from facerf_cli.relighting.relightable import Relit
from facerf_cli.run.threads import both

_BODY = [class_index(name) for name in ("neck", "garment", "hand")]
_STEADY_PX = 1.5  # blur of their shares, pixels of the classes
_OTHERS = 1e-6  # weight of head for body, and of body for head: counts where nothing else is near
PERSON_LAYERS = ("albedo", "normal", "position", "depth", "shadow", "specular", "classes")
COLOURS = ("albedo", "specular")  # layers that are radiance
_LIPS = 0.7  # cosine to the face's front from which on lips keep no light from the teeth
_LEAST = 0.02  # share of the person in a pixel that has layers: the matte's tail is noise


class Surface:
    """Depth of a person at the resolution of its photo.

    Where the proxy covers a pixel, it is the proxy's: it jumps at chin and nose, and lies between no two
    surfaces. Hair, hats and cloth beyond the proxy continue it, head and body apart: hair next to the neck is
    as far away as the head, a sleeve as the bust. The background gives nothing.
    """

    def __init__(self, person: SeenPerson, size_px: tuple[int, int]) -> None:
        self._proxy, self._size_px = person.proxy, size_px
        self._camera = photo_camera(person.fit.crop, *size_px)
        outside = front_facing(person.proxy.vertices, person.proxy.triangles)
        self._outside = person.proxy.triangles[outside]
        self._beyond = self._continued(person.segmentation.classes)

    def depth_m(self, rows: slice) -> np.ndarray:
        """Distance [h, W, 1] along the camera's axis in some rows of the photo."""
        seen = self._seen(rows_of_camera(self._camera, rows))
        head, body, lead = enlarged(self._beyond.numpy(), self._size_px, rows)
        return np.where(seen.isfinite(), seen, np.where(lead > 0, head, body))[..., None]

    def position_m(self, rows: slice) -> np.ndarray:
        """Places [h, W, 3] in camera space in some rows of the photo."""
        return self.depth_m(rows) * rays_of_rows(self._camera, self._size_px, rows).numpy()

    def _seen(self, camera: Camera) -> Tensor:
        """Depth of the proxy's outer side [h, w]; infinite where nothing of it is seen."""
        return rasterize(self._proxy.vertices, self._outside, camera).depth_m

    def _continued(self, classes: Tensor) -> Tensor:
        """Depth of head and of body, continued, and the lead of the head in the classes [3, h, w]."""
        height, width = classes.shape[1:]
        scale = width / self._size_px[1], height / self._size_px[0]
        whole = self._camera
        seen = self._seen(
            Camera(whole.focal_px * scale[0], width, height, whole.cx_px * scale[0], whole.cy_px * scale[1])
        )
        body = classes[_BODY].sum(0)
        head = 1 - classes[0] - body
        weights = torch.stack([head + _OTHERS * body, body + _OTHERS * head]).clamp(0, 1) * seen.isfinite()
        depth = seen.nan_to_num(posinf=0).expand(2, 1, -1, -1)
        return torch.cat([inpaint(depth, weights)[:, 0], blurred((head - body)[None], _STEADY_PX)])


@dataclass(frozen=True, eq=False)
class PersonLight:
    """A person under one sum of lights, ready to be rendered by rows."""

    views: list[Maps]
    face: Tensor
    mirrored: list[np.ndarray]
    layers: Sequence[str]
    keys: list[tuple["PersonLight | None", CastShadow]]  # each light alone; None: it is all of this light


class PersonInPhoto:
    """A person in its photo [H, W, 3]; `matte` [H, W] is the share that is relit."""

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
        self._views = [Enlarged(view) for view in field.views]
        self._detail = FaceDetail(head.face, self.view)

    @property
    def nbytes(self) -> int:
        """Bytes of the person under one sum of lights."""
        return 2 * self._head.face.texture.nbytes + sum(15 * view.own.nbytes for view in self._views)

    def share(self, rows: slice) -> np.ndarray:
        """Share [h, W] of the whole person in rows of the photo."""
        return np.minimum(self.matte[rows], self._field.person.segmentation.matte[rows])

    def relit(self, lights: Light) -> Iterator[Relit]:
        """Relight the person by each sum of lights (paper, 'Relighting'); one prediction serves all.

        Of light from behind the face's field knows nothing.
        """
        field, owns = self._field, lights.owns
        lights, keys = lights.with_keys_alone()
        directions, weights = lights.directions, lights.weights
        middle_m, side = self.vertices_m.mean(0), self._head.face.texture.shape[-1]
        near = lights.near_points(middle_m)
        lit, _ = both(lambda: field.lit(directions, weights, near), lambda: self._eyes)
        forward = self._head.fit.rotation[:, 2]

        def arriving(toward: Tensor, weights: Tensor) -> Tensor:
            """Weights of all light on the face, then of what of it falls into the mouth."""
            front = weights * (1 - from_behind(toward))[..., None]
            into_mouth = smoothstep(toward @ forward / _LIPS)  # between the lips of a face that looks forward
            return torch.cat([front, front * into_mouth[..., None]])

        textures = field.field.relit(directions, arriving(directions, weights))
        for points, rgb in near:
            texture = near_texture(field.field, points, self.vertices_m, side)
            textures = textures + arriving(-points.toward, rgb)[..., None, None] * texture
        textures, mouths = textures.chunk(2)
        mirrored = field.views[0].mirrored(lights, middle_m)
        blended = field.blended(textures, lit[0])
        every = [
            Relit(blended[at], tuple(view[at] for view in lit), mirrored[at], mouths[at])
            for at in range(len(blended))
        ]
        shadows: dict[tuple[bool, int], CastShadow] = {}
        for number, own in enumerate(owns):
            cast = []
            for key in (one for one in keys if one.number == number):
                at = key.is_near, key.samples.start
                if at not in shadows:
                    light = near[at[1]][0] if key.is_near else directions[key.samples].detach()
                    shadows[at] = cast_shadow(field.views[0], light)
                cast.append((every[key.alone], shadows[at]))
            yield replace(every[number], own=own, keys=tuple(cast))

    @cached_property
    def _eyes(self) -> Eyes:
        return Eyes(self.own, self._field.person.eyes, self.size_px)

    @cached_property
    def _rims(self) -> Rims:
        person = self._field.person
        return Rims(person.segmentation.matte, person.square.side_px / person.sides)

    def ready(self, relit: Relit, layers: Sequence[str] = ()) -> PersonLight:
        """Compute all that does not depend on rows; raises UsageError for an unknown layer."""
        assert relit.mirrored is not None
        for name in layers:
            if name not in (*PERSON_LAYERS, *FACE_LAYERS):
                raise UsageError(f"--aov {name}: is no layer; give {', '.join(PERSON_LAYERS)}")
        of_views = [name for name in layers if name in VIEW_LAYERS]
        behind = any(bool(light.behind.any()) for light in relit.views)
        return PersonLight(
            [view.ready(one, of_views, behind) for view, one in zip(self._views, relit.views, strict=True)],
            self._detail.ready(relit.texture, relit.mouth),
            self._eyes.ready(relit.mirrored),
            layers,
            [(None if key.texture is relit.texture else self.ready(key), cast) for key, cast in relit.keys],
        )

    def render(
        self, window: Window, own: np.ndarray, lights: Sequence[PersonLight]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield rows of the photo, whose person has its `own` colours [h, W, 3], under each light.

        "rgb" [h, W, 3] is the image, 0 where nobody is; others are the light's layers.
        """
        among = Window(window.rows, seen_columns(self.matte[window.rows]))
        rims = self._rims if any("behind" in maps for light in lights for maps in light.views) else None
        by_maps = self._by_maps(among, own[:, among.columns], rims)
        for light in lights:
            found = by_maps(light)
            whole = found["rgb"]
            pixels = whole.copy() if light.keys else whole
            for key, part, change in self._shadows(light, among):
                alone = whole if key is None else by_maps(key)["rgb"]
                pixels[part] += alone[part] * change
            pixels = self._eyes.lit(window.framed(pixels, among), light.mirrored, window)
            shown = {name: window.framed(found[name], among) for name in VIEW_LAYERS if name in found}
            image = {"rgb": pixels}
            for name in light.layers:
                image |= self._layer(name, window, shown)
            yield image

    def _shadows(
        self, light: PersonLight, among: Window
    ) -> Iterator[tuple[PersonLight | None, Window, np.ndarray]]:
        """Each key light alone, and the part of a window that its shadow changes, by [h, w, 1].

        A shadow is that of the narrower view.
        """
        view = self._views[0]
        part, weight = view.weight(among)
        for key, shadow in light.keys if weight.any() else ():
            change = weight * (view.change(shadow, part) - 1)
            if change.any():
                yield key, part.inside(among), change[..., None]

    def _by_maps(
        self, among: Window, own: np.ndarray, rims: Rims | None
    ) -> Callable[[PersonLight], dict[str, np.ndarray]]:
        """What gives a window under a light, as the maps show it: without edges of shadows, and eyes.

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
            face, share = self._detail.over(part, own[at]), self._face_share(part)[..., None]

        def lit(light: PersonLight) -> dict[str, np.ndarray]:
            found: dict[str, np.ndarray] = {}
            for view, (number, place, weight) in zip(views[::-1], parts[::-1], strict=True):
                for name, values in view(light.views[number]).items():
                    if name in found:
                        below = found[name][place.inside(among)]
                        below += weight[..., None] * (values - below)
                    else:  # the widest
                        found[name] = values
            person = found["rgb"]
            if on_face:  # the field of the face knows no hair around it
                person[at] += share * (face(light.face) - person[at])
            if "change" in found:
                person = person * found["change"]
            return found | {"rgb": person + found["behind"] if "behind" in found else person}

        return lit

    def _face_share(self, part: Window) -> np.ndarray:
        """Share [h, w] that the field of the face has in a part of its window."""
        bare = uncovered_fraction(enlarged(self._covered, self.size_px, part.rows)[0])[:, part.columns]
        return np.asarray(self.view.mask[part.inside(self.view.window)].numpy() * bare)

    def _layer(self, name: str, window: Window, shown: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """A layer [h, W, C] of some rows, by the names that it has in a file; `shown` are those of the views.

        albedo: radiance of the person in a light of rgb 1 that reaches all; specular: that of the highlights;
        shadow: the share of the light that arrives; normal and position: camera space, m; depth: m; classes:
        shares. All are 0 off the person, whose share is the matte: colours are multiplied by it, as layers of
        lights are.
        """
        rows = window.rows
        if name == "classes":
            return self._field.person.segmentation.layers(rows)
        if name not in PERSON_LAYERS:
            return face_layer(self.view, name, window)
        if name in shown:
            values = shown[name]
        else:
            values = {"depth": self._surface.depth_m, "position": self._surface.position_m}[name](rows)
        share = self.matte[rows][..., None]
        values = values * (share if name in COLOURS else share > _LEAST)
        if name == "normal":
            values = values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-6)
        return {name: values}

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV of the relit person, by a rule."""
        own = torch.zeros(3) if relit.own is None else relit.own.detach()
        return self._views[0].exposure_ev(relit.views[0], own, rule)

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self._field.person, self.size_px)

    def _parts(self, among: Window) -> list[tuple[int, Window, np.ndarray]]:
        """The views in a window: number, part, and weight [h, w] over the next view; the last has none."""
        parts = []
        for number, view in enumerate(self._views[:-1]):
            part, weight = view.weight(among)
            parts += [(number, part, weight)] if weight.any() else []
            if part == among and weight.min() == 1:  # it hides wider ones
                return parts
        return [*parts, (len(self._views) - 1, among, np.ones(0))]


def seen_columns(shown: np.ndarray) -> slice:
    """Columns in which a part of an image [h, W] is not 0; at least one."""
    at = np.flatnonzero(shown.any(0))
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 1)
