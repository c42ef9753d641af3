"""The whole person of a portrait field, relit in its photo at the photo's own resolution.

Of the field's views the narrower lies over the wider one, and fades toward its border. In the face the neural
field's texture is blended in. Both have the photo's detail (`detail.py`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.image.colour import ExposureRule
from facerf_cli.light.studio_points import Lights
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.portrait.parse import UncoveredRows
from facerf_cli.raster.texture import smoothstep
from facerf_cli.relighting.cast_shadows import CastShadow, cast_shadow
from facerf_cli.relighting.detail import DetailRows, FaceDetail
from facerf_cli.relighting.enlarged import Enlarged, ViewLight, ViewRows
from facerf_cli.relighting.eyes import Eyes
from facerf_cli.relighting.face_alone import FACE_LAYERS, face_layer
from facerf_cli.relighting.field import near_texture
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.relightable import Relit
from facerf_cli.relighting.rims import Rims, from_behind
from facerf_cli.relighting.surface import Surface
from facerf_cli.run.threads import both

PERSON_LAYERS = ("albedo", "normal", "position", "depth", "shadow", "specular", "classes")
T = TypeVar("T")
COLOURS = ("albedo", "specular")  # layers that are radiance
_LIPS = 0.7  # cosine to the face's front from which on lips keep no light from the teeth
_LEAST = 0.02  # share of the person in a pixel that has layers: the matte's tail is noise


class _Part(NamedTuple):
    """A view as far as it shows in some rows: its number, columns, and weight [h, w] over wider views."""

    number: int
    columns: slice
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class PersonRows:
    """Values in some rows of the photo that no light changes.

    They are of the columns in which these rows show the person, and of its views there.
    """

    rows: slice
    columns: slice
    parts: list[_Part]
    views: list[ViewRows]
    inside: slice  # of the face's window
    detail: DetailRows | None
    face_share: np.ndarray


@dataclass(frozen=True, eq=False)
class PersonLight:
    """A person under one sum of lights, ready to be rendered by rows."""

    views: list[ViewLight]
    face: Tensor
    from_behind: bool
    mirrored: list[np.ndarray]
    layers: dict[str, list[Tensor]]
    keys: list[tuple["PersonLight | None", CastShadow]]  # each light alone; None: it is all of this light
    own: Tensor | None


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
        self._bare_face = UncoveredRows(field.person.segmentation.classes, self.size_px)
        self._views = [Enlarged(view, self.size_px) for view in field.views]
        self._detail = FaceDetail(head.face, self.view, self.own)

    @property
    def nbytes(self) -> int:
        """Bytes of the person under one sum of lights."""
        return 2 * self._head.face.texture.nbytes + sum(15 * view.own.nbytes for view in self._views)

    def share(self, rows: slice) -> np.ndarray:
        """Share [h, W] of the whole person in rows of the photo."""
        return np.minimum(self.matte[rows], self._field.person.segmentation.matte[rows])

    def relit(self, lights: Lights) -> Iterator[Relit]:
        """Relight the person by each sum of lights (paper, 'Relighting'); one prediction serves all.

        Of light from behind the face's field knows nothing.
        """
        field, owns = self._field, lights.owns
        lights, keys = lights.with_keys_alone()
        directions, weights = lights.directions, lights.weights
        middle_m, side = self.vertices_m.mean(0), self._head.face.texture.shape[-1]
        near = lights.around(middle_m)
        lit, _ = both(lambda: field.lit(directions, weights, near), lambda: self._eyes)
        forward = self._head.fit.rotation[:, 2]

        def arriving(toward: Tensor, weights: Tensor) -> Tensor:
            """Weights of all light on the face, then of what of it falls into the mouth."""
            front = weights * (1 - from_behind(toward))[..., None]
            return torch.cat([front, front * _into_mouth(toward, forward)[..., None]])

        textures = field.field.relit(directions, arriving(directions, weights))
        for points, rgb in near:
            texture = near_texture(field.field, points, self.vertices_m, side)
            textures = textures + arriving(-points.toward, rgb)[..., None, None] * texture
        textures, mouths = textures.chunk(2)
        mirrored = field.views[0].mirrored(lights, middle_m)
        blended = field.blended(textures, lit[0])
        every = [
            Relit(blended[at], None, tuple(view[at] for view in lit), mirrored[at], mouths[at])
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
        maps = {}
        for name in layers:
            if name in ("albedo", "normal", "shadow", "specular"):
                lit = zip(self._views, relit.views, strict=True)
                maps[name] = [view.layer_maps(name, light) for view, light in lit]
            elif name not in (*PERSON_LAYERS, *FACE_LAYERS):
                raise UsageError(f"--aov {name}: is no layer; give {', '.join(PERSON_LAYERS)}")
        return PersonLight(
            views=[view.ready(light) for view, light in zip(self._views, relit.views, strict=True)],
            face=self._detail.ready(relit.texture, relit.mouth),
            mirrored=self._eyes.ready(relit.mirrored),
            from_behind=any(bool(light.behind.any()) for light in relit.views),
            layers=maps,
            keys=[
                (None if one.texture is relit.texture else self.ready(one), shadow)
                for one, shadow in relit.keys
            ],
            own=relit.own,
        )

    def observe(self, rows: slice) -> PersonRows:
        """Read rows of the photo, as far as no light changes them."""
        columns, inside = seen_columns(self.matte[rows]), self.view.rows_inside(rows)
        parts, own = self._parts(rows, columns), self.own[rows]
        views = [
            self._views[part.number].observe(own[:, part.columns].clip(min=0), rows, part.columns)
            for part in parts
        ]
        detail, share = None, np.zeros(0, np.float32)
        if inside.start < inside.stop:
            detail = self._detail.observe(inside)
            bare = self._bare_face[self.view.in_photo(inside)][:, self.view.window[1]]
            share = self.view.mask[inside].numpy() * bare
        return PersonRows(rows, columns, parts, views, inside, detail, share)

    def pixels(self, relit: PersonLight, seen: PersonRows) -> np.ndarray:
        """Pixels [h, W, 3] of observed rows, without the photo's own light; 0 where nobody is."""
        rows, among = seen.rows, seen.columns
        by_maps = self._by_maps(relit, seen)
        pixels = by_maps.copy() if relit.keys else by_maps
        for alone, part, change in self._shadows(relit, rows, among):
            image = by_maps if alone is None else self._by_maps(alone, seen)
            pixels[:, part] += image[:, part] * change
        return self._eyes.lit(self._spread(pixels, among), relit.mirrored, rows)

    def _shadows(
        self, relit: PersonLight, rows: slice, among: slice
    ) -> Iterator[tuple[PersonLight | None, slice, np.ndarray]]:
        """Each key light alone, and columns among those given in which its shadow changes it by [h, w, 1].

        A shadow is that of the narrower view.
        """
        columns, weight = self._views[0].weight(rows, among)
        for alone, shadow in relit.keys if weight.any() else ():
            change = weight * (self._views[0].change(shadow, rows, columns) - 1)
            if change.any():
                yield alone, _within(columns, among), change[..., None]

    def _by_maps(self, relit: PersonLight, seen: PersonRows) -> np.ndarray:
        """Observed pixels [h, w, 3] without what only the photo's pixels show: shadows' edges, and eyes."""
        rims = self._rims if relit.from_behind else None
        used = self._used(relit.views, seen)
        shown = [view.radiance(light, rows, rims) for view, light, rows in used]
        person, behind = np.split(_joined(shown, seen.parts), [3], -1)
        if seen.detail is not None:  # the field of the face knows no hair around it
            among, window = seen.columns, self.view.window[1]
            start = max(window.start, among.start)
            common = slice(start, max(start, min(window.stop, among.stop)))
            at = self.view.rows_of(seen.inside, seen.rows), _within(common, among)
            own = _within(common, window)
            face = self._detail.pixels(relit.face, seen.detail, seen.inside)[:, own].numpy()
            person[at] += seen.face_share[:, own, None] * (face - person[at])
        if self._field.person.normals is not None:
            person = person * self._change_by_normals(relit, seen)
        return person + behind if behind.size else person

    def _change_by_normals(self, relit: PersonLight, seen: PersonRows) -> np.ndarray:
        """Factor [h, w, 3] of observed pixels by given normals."""
        used = self._used(relit.views, seen)
        return _joined([view.change_by_normals(light, one) for view, light, one in used], seen.parts)

    def layer(self, name: str, relit: PersonLight, seen: PersonRows) -> dict[str, np.ndarray]:
        """A layer [h, W, C] of observed rows, by the names that it has in a file.

        albedo: radiance of the person in a light of rgb 1 that reaches all; specular: that of the highlights;
        shadow: the share of the light that arrives; normal and position: camera space, m; depth: m; classes:
        shares. All are 0 off the person, whose share is the matte: colours are multiplied by it, as layers of
        lights are.
        """
        rows = seen.rows
        if name == "classes":
            return self._field.person.segmentation.layers(rows)
        if name not in PERSON_LAYERS:
            return face_layer(self.view, name, rows)
        if name in relit.layers:
            used = self._used(relit.layers[name], seen)
            shown = _joined([view.layer(name, maps, one) for view, maps, one in used], seen.parts)
            values = self._spread(shown, seen.columns)
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

    def _used(self, values: Sequence[T], seen: PersonRows) -> Iterator[tuple[Enlarged, T, ViewRows]]:
        """The views that are seen in rows, each with its value."""
        for part, view in zip(seen.parts, seen.views, strict=True):
            yield self._views[part.number], values[part.number], view

    def _parts(self, rows: slice, columns: slice) -> list[_Part]:
        """The views as far as they show in some rows and columns; the last in all of them."""
        parts = []
        for number, view in enumerate(self._views[:-1]):
            part = _Part(number, *view.weight(rows, columns))
            parts += [part] if part.weight.any() else []
            if part.columns == columns and part.weight.min() == 1:  # it hides wider ones
                return parts
        return [*parts, _Part(len(self._views) - 1, columns, np.ones(0))]

    def _spread(self, values: np.ndarray, columns: slice) -> np.ndarray:
        """Values [h, W, C] of those in some columns [h, w, C], 0 in the others."""
        if values.shape[1] == self.size_px[1]:
            return values
        found = np.zeros((len(values), self.size_px[1], values.shape[2]), np.float32)
        found[:, columns] = values
        return found


def seen_columns(shown: np.ndarray) -> slice:
    """Columns in which a part of an image [h, W] is not 0; at least one."""
    at = np.flatnonzero(shown.any(0))
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 1)


def _into_mouth(directions: Tensor, forward: Tensor) -> Tensor:
    """Share [...] of lights from directions [..., 3] that falls between lips; the face looks `forward`."""
    return smoothstep(directions @ forward / _LIPS)


def _joined(shown: Sequence[np.ndarray], parts: Sequence[_Part]) -> np.ndarray:
    """Values [h, w, C] of what each view shows; the widest, the last, lies below."""
    found = shown[-1]
    for values, one in reversed(list(zip(shown[:-1], parts[:-1], strict=True))):
        part = found[:, _within(one.columns, parts[-1].columns)]
        part += one.weight[..., None] * (values - part)
    return found


def _within(columns: slice, among: slice) -> slice:
    """Columns of an image as counted from the first of those among which they are."""
    return slice(columns.start - among.start, columns.stop - among.start)
