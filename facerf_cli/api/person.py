"""A person of the Python API: fitted once, then relit at what the light costs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor
from trimesh.visual import TextureVisuals

from facerf_cli import pipeline
from facerf_cli.api.light import Array, Light, as_light, as_tensor, directions_of, linear_pixels, sums_of
from facerf_cli.baselines import RelightKind
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import fit_from_arrays, fit_to_arrays
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import floats, read_npz
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.face.view import photo_camera
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import require_regular
from facerf_cli.image.strips import covering, filled, whole
from facerf_cli.light.envmap import backdrop, check_envmap
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.raster.camera import Camera, pose_to_rotation, rays_of_rows
from facerf_cli.relighting import White
from facerf_cli.relighting.composition import FACE_LAYERS, PERSON_LAYERS, Composition, Relit, Target
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.models import LARGEST_TEXTURE, Models
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.work.plan import batches

Pose = tuple[float, float, float] | Tensor  # yaw, pitch, roll in degrees (docs/design.md)
Background = Literal["photo", "none"] | Array | tuple[float, float, float]
_LIGHTS_AT_ONCE = 8


class PhotoCamera(NamedTuple):
    """The photo's camera: K [3, 3] in its pixels, and head_to_camera [4, 4] in metres.

    Camera space has x to the image's right, y up and z toward the camera. A point of it is seen at
    (K @ (x, -y, -z)) / -z.
    """

    K: Array
    head_to_camera: Array


@dataclass(frozen=True, eq=False)
class Person(pipeline.FittedPerson):
    """One person of a photo, as `facerf.fit` gives it; each light then costs what a light costs.

    Of a photo that was given as a tensor all arrays are tensors on the device of the models.
    """

    kind: RelightKind = "portrait"
    network_alone: bool = False
    tensors: bool = False
    white: White = "photo"

    def __repr__(self) -> str:
        """A line for a notebook."""
        camera = self._photo_camera
        return f"<facerf.Person in {camera.width_px} x {camera.height_px} pixels, {self.kind}>"

    def relight(
        self,
        light: Light | Array | Sequence[Light | Array],
        pose: Pose | None = None,
        background: Background = "photo",
        layers: Sequence[str] = (),
        room: float = 0.0,
        alone: bool = False,
    ) -> Any:
        """Relight the person: an image [H, W, 3] in the photo's frame, scene-linear, or one for each light.

        Args:
            light: A light, a lat-long map [H, 2 H, 3], or a list of them, which gives a list.
            pose: Yaw, pitch and roll in degrees, which turn the head and show the face alone.
            background: "photo"; "none" for alpha [H, W, 4], by which colours are not multiplied; an image
                [h, w, 3], enlarged to cover the frame; or a colour.
            layers: Names of layers (`facerf relight --aov`); then a dict of "image" and layers [H, W] or
                [H, W, C] is returned.
            room: Share of the lights' sum that a white room sends back; of maps none.
            alone: The face alone, with alpha [H, W, 4].

        A light or pose of tensors gives tensors, through which gradients flow (docs/gradients.md).
        """
        lights = [as_light(one, room) for one in (light if isinstance(light, Sequence) else [light])]
        given = [pose, *(array for one in lights for array in (one.directions, one.weights, one.own_rgb))]
        with self._gradients(*given):
            is_whole = not (alone or pose is not None) and self.kind in ("portrait", "field")
            if not is_whole and any(one.own_rgb is not None for one in lights):
                raise UsageError("Light.own(): is of the whole photo; leave out pose, alone and baselines")
            if alone or pose is not None:
                shown = self._faces(lights, pose, layers)
            else:
                shown = self._photos(lights, background, layers)
            images = [{name: self._out(values, *given) for name, values in one.items()} for one in shown]
        found = images if layers else [one["image"] for one in images]
        return found if isinstance(light, Sequence) else found[0]

    def olat(self, lights: int | Array = 150) -> Array:
        """The person over black under each light alone [L, H, W, 3]; the images add up by a light's weights.

        `lights` are unit directions [L, 3], or the size of a uniform rig, `facerf.rig(lights)`.
        """
        layer, size = self._composition.light_layer, self._composition.size_px
        found = [
            whole(layer(relit), *size)
            for relit in _one_by_one(self._composition, Lights.each(directions_of(lights)))
        ]
        return self._out(np.stack(found), lights)

    def uv_olat(self, lights: int | Array = 150, pose: Pose | None = None) -> Array:
        """The face's UV texture under each light alone [L, T, T, 3], by the neural field; see `olat`."""
        directions = directions_of(lights)
        turn = None if pose is None else self.head.fit.turn_to(_rotation(pose))
        field = self.reflectance.field if isinstance(self.reflectance, PortraitField) else self.reflectance
        with self._gradients(lights, pose):
            if isinstance(field, Field):
                textures = torch.cat(list(field.olats(directions, turn)))
            else:
                each = Lights.each(directions)
                textures = field.relit(each.directions, each.weights, turn)
        return self._out(textures.permute(0, 2, 3, 1).contiguous(), lights, pose)

    def estimate_light(self, lights: int = 150) -> Light:
        """Estimate the light of the photo over a rig; the models of the paper's baselines have their own.

        Raises InputError where too little of the face is visible.
        """
        kind = "field" if self.kind == "portrait" else self.kind
        with torch.no_grad():
            found = pipeline.estimate_light(
                self.models, self.head, kind, rig_directions(lights), white="scene"
            ).light
        return Light(found.directions.numpy(), found.weights.numpy())

    def backdrop(self, envmap: Array, rotate_deg: float = 0.0, blur: float = 0.0) -> Array:
        """The map [H, 2 H, 3] that the photo's camera sees behind the person, [H, W, 3], for `background`.

        `rotate_deg` is added to every azimuth; `blur` is that of a lens, as a share of the longer side.
        """
        linear, camera = linear_pixels("map", envmap).detach(), self._photo_camera
        check_envmap(linear)
        size = camera.height_px, camera.width_px
        seen = backdrop(linear, size, partial(rays_of_rows, camera), rotate_deg, blur)
        return self._out(whole(seen, *size), envmap)

    @property
    def even(self) -> Light:
        """Even light from all around, under which the skin is as bright as in the photo."""
        return self._composition.even * Light.around()

    @cached_property
    def light(self) -> Light:
        """The light of the photo, estimated over a rig of 150 lights."""
        return self.estimate_light()

    @property
    def matte(self) -> Array:
        """The person's share [H, W] of the photo."""
        return self._out(self.share)

    @cached_property
    def classes(self) -> dict[str, Array]:
        """Share [H, W] of each class of the person (hair, skin, ...), which sum to the matte."""
        layers = filled(self.segmentation.layers(), *self.share.shape)
        return {name: self._out(layers[f"class.{name}"]) for name in CLASSES[1:]}

    @cached_property
    def albedo(self) -> Array:
        """Radiance [H, W, 3] of the portrait, over black, in a light of rgb 1 that reaches all."""
        return self._layer("albedo")

    @cached_property
    def normals(self) -> Array:
        """Unit normals [H, W, 3] of the person, camera space; 0 off it."""
        return self._layer("normal")

    @cached_property
    def depth(self) -> Array:
        """Distance [H, W] of the person along the viewing axis, m; 0 off it."""
        return self._layer("depth")[..., 0]

    @property
    def landmarks(self) -> Array:
        """The 68 landmarks [68, 2] in the photo's pixels, centres at index + 0.5."""
        return self._out(self.head.fit.crop.to_photo(self.head.landmarks_px))

    @property
    def camera(self) -> PhotoCamera:
        """The photo's camera and the pose of the head."""
        camera = self._photo_camera
        focal = camera.focal_px
        matrix = np.array([[focal, 0, camera.cx_px], [0, focal, camera.cy_px], [0, 0, 1]])
        return PhotoCamera(self._out(matrix), self._out(self.head.fit.head_to_camera))

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The fitted face with its texture, head frame, m: `.vertices` [V, 3], `.faces`, `.export(path)`."""
        fit, (u, v) = self.head.fit, grid_uv().numpy().T
        texture = Image.fromarray(to_display(_by_pixel(self.head.face.texture).detach().numpy()))
        vertices = self.models.face.vertices(fit.alpha[None], fit.beta[None])[0].numpy()
        visual = TextureVisuals(np.stack([u, 1 - v], -1), image=texture)
        return trimesh.Trimesh(vertices, grid_triangles().numpy(), visual=visual, process=False)

    @property
    def uv(self) -> Array:
        """The (u, v) [V, 2] of the mesh's vertices, v down."""
        return self._out(grid_uv())

    @property
    def texture(self) -> Array:
        """The photo's texture [T, T, 3] of the face, scene-linear; hidden texels are filled."""
        return self._out(_by_pixel(self.head.face.texture))

    def with_texture(self, texture: Array) -> "Person":
        """The person with another texture [T, T, 3] of the face, to which gradients flow; the rest stays."""
        planes, reflectance = as_tensor(texture).permute(2, 0, 1), self.reflectance
        if planes.shape != self.head.face.texture.shape:
            raise ValueError(f"texture has shape {list(texture.shape)}, not {list(self.texture.shape)}")
        face = replace(self.head.face, texture=planes)
        if isinstance(reflectance, PortraitField):
            reflectance = replace(reflectance, field=replace(reflectance.field, face=face))
        elif isinstance(reflectance, Field):
            reflectance = replace(reflectance, face=face)
        else:
            raise UsageError(f"with_texture: is for the fields, not for {self.kind}")
        return replace(self, head=replace(self.head, face=face), reflectance=reflectance)

    def save(self, path: str | Path) -> None:
        """Write photo, fit and texture as .npz; `Person.load` reads the rest from the photo."""
        arrays: dict[str, Any] = {"photo": self.photo, "cropped": self.head.cropped, "kind": self.kind}
        maps = {name: getattr(self.head.face, name) for name in FaceTexture.__dataclass_fields__}
        arrays |= {name: tensor.detach().numpy() for name, tensor in maps.items()}
        arrays |= {"network_alone": self.network_alone, "white": self.white, **fit_to_arrays(self.head.fit)}
        arrays |= {} if self.given_matte is None else {"matte": self.given_matte}
        with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @staticmethod
    def load(models: Models, path: str | Path) -> "Person":
        """Read what `save` wrote; the networks of the models see the photo again, the fit stays.

        Raises InputError for any other file, and for a fit of another face model.
        """
        require_regular(Path(path), "give one that Person.save wrote")
        try:
            arrays = read_npz(Path(path))
            fit, side = fit_from_arrays(arrays), min(arrays["visible"].shape[-1], LARGEST_TEXTURE)
            maps = {"texture": (3, side, side), "visible": (side, side), "normals": (3, side, side)}
            face = FaceTexture(**{name: floats(arrays, name, shape) for name, shape in maps.items()})
            photo = linear_pixels("photo", arrays["photo"]).numpy()
            cropped = floats(arrays, "cropped", (fit.crop.size_px, fit.crop.size_px, 3)).numpy()
            matte = floats(arrays, "matte", photo.shape[:2]).numpy() if "matte" in arrays else None
            fit.vertices_camera(models.face)
            one_of(RelightKind, "kind", kind := str(arrays["kind"]))
            alone = bool(arrays["network_alone"])
            one_of(White, "white", white := str(arrays.get("white", "photo")))
        except (ValueError, TypeError, LookupError, OverflowError) as error:
            said = f"{path}: not a person that facerf wrote ({error}); fit the photo again"
            raise InputError(said) from None
        head = Head(cropped, fit, face)
        return read_person(models, photo, head, kind, alone, matte, white=white)  # type: ignore[arg-type]

    def _photos(
        self, lights: Sequence[Light], background: Background, layers: Sequence[str]
    ) -> Iterator[Any]:
        """The photo under each light, as dicts of arrays; gradients reach the weights alone."""
        composition, behind = self._composition, None
        if not isinstance(background, str):
            pixels = np.array(background)[None, None] if isinstance(background, tuple) else background
            linear = linear_pixels("background", pixels).detach().numpy()
            behind = covering(linear, *composition.size_px).__getitem__
        else:
            one_of(Literal["photo", "none"], "background", background)
        cut_out = isinstance(background, str) and background == "none"
        layer_of = composition.cut_out if cut_out else composition.light_layer
        for part in batches(len(lights), composition.nbytes):
            some = sums_of(lights[part])
            if some.directions.requires_grad:
                raise UsageError("directions: have no gradient in the photo; give alone=True, or detach them")
            with torch.no_grad():
                relit = list(composition.relit(some))
            each = Lights.each(some.directions, some.keys)
            for weights, own, one in zip(some.weights, some.owns, relit, strict=True):
                bands = {"rgb": layer_of(one)} if cut_out else composition.bands(one, behind=behind)
                arrays = self._with_layers(composition, one, layers, bands)
                image = torch.from_numpy(arrays.pop("rgb"))
                if weights.requires_grad:
                    image = _OfWeights.apply(weights, each, composition, layer_of, image)  # type: ignore[no-untyped-call]
                if own is not None and own.requires_grad:
                    layer = torch.from_numpy(whole(composition.own_layer(cut_out), *composition.size_px))
                    image = image + (own - own.detach()) * layer
                if cut_out:
                    image = torch.cat([image, torch.from_numpy(composition.matte)[..., None]], -1)
                yield {"image": image, **arrays}

    def _faces(self, lights: Sequence[Light], pose: Pose | None, layers: Sequence[str]) -> Iterator[Any]:
        """The face alone under each light; gradients reach all that it is made of."""
        fit = self.head.fit
        posed = None if pose is None else replace(fit, rotation=_rotation(pose))
        composition = self.composed(Target(posed, "face"))
        view = composition.view
        for part in batches(len(lights), composition.nbytes):
            for one in composition.relit(sums_of(lights[part])):
                image = torch.zeros(view.height_px, view.width_px, 4)
                image[view.window] = torch.cat([view.render(one.texture), view.mask[..., None]], -1)
                yield {"image": image, **self._with_layers(composition, one, layers, {})}

    @staticmethod
    def _with_layers(
        composition: Composition, relit: Relit, layers: Sequence[str], bands: dict[str, Any]
    ) -> dict[str, Any]:
        known = dict.fromkeys([*FACE_LAYERS, *(PERSON_LAYERS if composition.person else ())])
        if isinstance(layers, str) or not set(layers) <= set(known):
            raise ValueError(f"layers is {layers!r}, not a list of some of {', '.join(known)}")
        wanted = composition.layers(layers, relit) if layers else {}
        return filled({**bands, **wanted}, *composition.size_px)

    @cached_property
    def _composition(self) -> Composition:
        """The person in the photo, with all that does not depend on the light."""
        with torch.no_grad():
            return self.composed()

    def _layer(self, name: str) -> Any:
        if name == "albedo" and self.kind != "portrait":
            raise UsageError("albedo: is of the portrait field; fit with reflectance='portrait'")
        relit = next(_one_by_one(self._composition, Lights.each(torch.tensor([[0.0, 0.0, 1.0]]))))
        return self._out(self._with_layers(self._composition, relit, [name], {})[name])

    @property
    def _photo_camera(self) -> Camera:
        assert self.photo is not None
        return photo_camera(self.head.fit.crop, self.photo.shape[0], self.photo.shape[1])

    def _gradients(self, *given: Any) -> torch.set_grad_enabled:
        """Gradients where tensors are given."""
        return torch.set_grad_enabled(
            torch.is_grad_enabled() and any(isinstance(one, Tensor) for one in given)
        )

    def _out(self, values: Array, *given: Any) -> Any:
        """Values as arrays, or as tensors on the models' device where the photo or what was given is one."""
        if self.tensors or any(isinstance(one, Tensor) for one in given):
            return torch.as_tensor(values).to(self.models.device)
        return values.detach().numpy() if isinstance(values, Tensor) else values


def _one_by_one(composition: Composition, each: Lights) -> Iterator[Relit]:
    """The person under each of L lights alone, some at a time."""
    with torch.no_grad():
        for first in range(0, len(each), _LIGHTS_AT_ONCE):
            yield from composition.relit(each[first : first + _LIGHTS_AT_ONCE])


class _OfWeights(torch.autograd.Function):
    """An image [H, W, 3] as a function of the weights [L, 3] of lights [L, 3], in which it is linear."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, each: Lights, composition: Composition, *more: Any) -> Any:
        """The image, which is composed already; `layer_of` gives that of each light."""
        (ctx.layer_of, image), ctx.each, ctx.composition = more, each, composition
        return image

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Sum the gradient [H, W, 3] over the image of each light."""
        images = (
            torch.from_numpy(whole(ctx.layer_of(relit), *ctx.composition.size_px))
            for relit in _one_by_one(ctx.composition, ctx.each)
        )
        return (
            torch.stack([(slopes[0].cpu() * image).sum((0, 1)) for image in images]),
            None,
            None,
            None,
            None,
        )


def read_person(
    models: Models,
    photo: np.ndarray,
    head: Head,
    kind: RelightKind,
    network_alone: bool,
    matte: np.ndarray | None,
    tensors: bool = False,
    white: White = "photo",
) -> Person:
    """Read the reflectance of a head in its photo [H, W, 3]; the matte [H, W] is the person's, if given."""
    with torch.no_grad():
        found = pipeline.reflectance_of(
            models, head, kind, network_alone, photo=photo, matte=matte, white=white
        )
    return Person(models, photo, head, found, matte, kind, network_alone, tensors, white)


def one_of(choices: Any, name: str, value: str) -> None:
    """Raise ValueError for a word that is not one of a Literal's."""
    if value not in get_args(choices):
        raise ValueError(f"{name} is {value!r}, not one of {', '.join(get_args(choices))}")


def _rotation(pose: Pose) -> Tensor:
    """The head_to_camera rotation [3, 3] of a pose in degrees, to which gradients flow."""
    angles = torch.stack([torch.as_tensor(angle, dtype=torch.float64).cpu() for angle in pose])
    if angles.shape != (3,) or not angles.isfinite().all():
        raise ValueError(f"pose is {pose}, not yaw, pitch and roll in degrees")
    return pose_to_rotation(*angles)


def _by_pixel(texture: Tensor) -> Tensor:
    return texture.permute(1, 2, 0).contiguous()
