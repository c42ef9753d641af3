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
from facerf_cli.api.light import Array, Light, as_light, as_tensor, linear_pixels, rig, sums_of
from facerf_cli.baselines import RelightKind
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import fit_from_arrays, fit_to_arrays
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import read_npz
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.face.view import photo_camera
from facerf_cli.files.atomic import atomic_path
from facerf_cli.image.strips import Band, covering, filled, whole
from facerf_cli.light.envmap import backdrop, check_envmap
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.raster.camera import pose_to_rotation, rays_of_rows
from facerf_cli.relighting.composition import FACE_LAYERS, PERSON_LAYERS, Composition, Relit, Target
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.models import LARGEST_TEXTURE, Models
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.work.plan import batches

Pose = tuple[float, float, float] | Tensor  # yaw, pitch, roll in degrees (docs/design.md)
Background = Literal["photo", "none"] | Array | tuple[float, float, float]
_LIGHTS_AT_ONCE = 8
_FILE = "not a person that facerf wrote"


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
        tensors = self.tensors or isinstance(pose, Tensor) or any(one.tensors for one in lights)
        with torch.set_grad_enabled(tensors and torch.is_grad_enabled()):
            if alone or pose is not None:
                shown = self._faces(lights, pose, layers)
            else:
                shown = self._photos(lights, background, layers)
            images = [self._given(image, tensors, bool(layers)) for image in shown]
        return images if isinstance(light, Sequence) else images[0]

    def olat(self, lights: int | Array = 150) -> Array:
        """The person over black under each light alone [L, H, W, 3]; the images add up by a light's weights.

        `lights` are unit directions [L, 3], or the size of a uniform rig, `facerf.rig(lights)`.
        """
        directions, composition = rig(lights), self._composition("photo")
        with torch.no_grad():
            images = [
                whole(composition.light_layer(relit), *composition.size_px)
                for some in torch.split(directions, _LIGHTS_AT_ONCE)
                for relit in composition.relit(Lights.each(some))
            ]
        return self._out(np.stack(images), isinstance(lights, Tensor))

    def uv_olat(self, lights: int | Array = 150, pose: Pose | None = None) -> Array:
        """The face's UV texture under each light alone [L, T, T, 3], by the neural field; see `olat`."""
        directions, turn = rig(lights), None
        if pose is not None:
            turn = self.head.fit.turn_to(_rotation(pose))
        field = self.reflectance.field if isinstance(self.reflectance, PortraitField) else self.reflectance
        tensors = isinstance(lights, Tensor) or isinstance(pose, Tensor)
        with torch.set_grad_enabled(tensors and torch.is_grad_enabled()):
            if isinstance(field, Field):
                textures = torch.cat(list(field.olats(directions, turn)))
            else:
                each = Lights.each(directions)
                textures = field.relit(each.directions, each.weights, turn)
        return self._out(textures.permute(0, 2, 3, 1).contiguous(), tensors)

    def estimate_light(self, lights: int = 150) -> Light:
        """Estimate the light of the photo over a rig; the models of the paper's baselines have their own.

        Raises InputError where too little of the face is visible.
        """
        kind = "field" if self.kind == "portrait" else self.kind
        with torch.no_grad():
            found = pipeline.estimate_light(self.models, self.head, kind, rig_directions(lights)).light
        return Light(found.directions.numpy(), found.weights.numpy())

    def backdrop(self, envmap: Array, rotate_deg: float = 0.0, blur: float = 0.0) -> np.ndarray:
        """The map [H, 2 H, 3] that the photo's camera sees behind the person, [H, W, 3], for `background`.

        `rotate_deg` is added to every azimuth; `blur` is that of a lens, as a share of the longer side.
        """
        linear, camera = linear_pixels("map", envmap), self._photo_camera
        check_envmap(linear)
        size = camera.height_px, camera.width_px
        return whole(backdrop(linear, size, partial(rays_of_rows, camera), rotate_deg, blur), *size)

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
        """Radiance [H, W, 3] of the person in a light of rgb 1 that reaches all; of the portrait field."""
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
        texture = Image.fromarray(to_display(np.asarray(_by_pixel(self.head.face.texture))))
        return trimesh.Trimesh(
            self.models.face.vertices(fit.alpha[None], fit.beta[None])[0].numpy(),
            grid_triangles().numpy(),
            visual=TextureVisuals(np.stack([u, 1 - v], -1), image=texture),
            process=False,
        )

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
        planes = as_tensor(texture).permute(2, 0, 1)
        if planes.shape != self.head.face.texture.shape:
            raise ValueError(f"texture has shape {list(texture.shape)}, not {list(self.texture.shape)}")
        face = replace(self.head.face, texture=planes)
        reflectance = self.reflectance
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
        arrays |= {name: getattr(self.head.face, name).numpy() for name in FaceTexture.__dataclass_fields__}
        arrays |= {"network_alone": self.network_alone, **fit_to_arrays(self.head.fit)}
        arrays |= {} if self.given_matte is None else {"matte": self.given_matte}
        with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @staticmethod
    def load(models: Models, path: str | Path) -> "Person":
        """Read what `save` wrote; the networks of the models see the photo again, the fit stays.

        Raises InputError for any other file, and for a fit of another face model.
        """
        try:
            arrays = read_npz(Path(path))
            fit = fit_from_arrays(arrays)
            photo, cropped = (linear_pixels(name, arrays[name]).numpy() for name in ("photo", "cropped"))
            face = FaceTexture(**{name: as_tensor(arrays[name]) for name in FaceTexture.__dataclass_fields__})
            matte = linear_pixels("matte", arrays["matte"], "[H, W]").numpy() if "matte" in arrays else None
            _require_shapes(photo, cropped, face, fit.crop.size_px, matte)
            fit.vertices_camera(models.face)
            one_of(RelightKind, "kind", kind := str(arrays["kind"]))
            alone = bool(arrays["network_alone"])
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise InputError(f"{path}: {_FILE} ({error}); fit the photo again") from None
        return read_person(models, photo, Head(cropped, fit, face), kind, alone, matte)  # type: ignore[arg-type]

    def _photos(
        self, lights: Sequence[Light], background: Background, layers: Sequence[str]
    ) -> Iterator[Any]:
        """The photo under each light, as dicts of arrays; gradients reach the weights alone."""
        composition, behind = self._behind(background)
        for part in batches(len(lights), composition.nbytes):
            some = sums_of(lights[part])
            if some.directions.requires_grad:
                raise UsageError("directions: have no gradient in the photo; give alone=True, or detach them")
            with torch.no_grad():
                relit = list(composition.relit(some))
            for number, one in enumerate(relit):
                arrays = self._layers(composition, one, layers, composition.bands(one, behind=behind))
                if some.weights.requires_grad:
                    rgb = torch.from_numpy(arrays["rgb"])
                    arrays["rgb"] = _OfWeights.apply(  # type: ignore[no-untyped-call]
                        some.weights[number], some.directions, composition, rgb
                    )
                yield arrays

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
                yield {"rgb": image, **self._layers(composition, one, layers, {})}

    def _layers(
        self, composition: Composition, relit: Relit, layers: Sequence[str], bands: dict[str, Any]
    ) -> dict[str, Any]:
        if isinstance(layers, str) or not set(layers) <= {*FACE_LAYERS, *PERSON_LAYERS}:
            known = ", ".join(dict.fromkeys((*FACE_LAYERS, *PERSON_LAYERS)))
            raise ValueError(f"layers is {layers!r}, not a list of some of {known}")
        wanted = composition.layers(layers, relit) if layers else {}
        return filled({**bands, **wanted}, *composition.size_px)

    def _behind(self, background: Background) -> tuple[Composition, Band | None]:
        """The composition before a background, and the image that is given as one."""
        if isinstance(background, str):
            one_of(Literal["photo", "none"], "background", background)
            return self._composition(background), None
        composition = self._composition("photo")
        if isinstance(background, tuple):
            colour = np.array(background, np.float32)
            image = np.broadcast_to(
                linear_pixels("background", colour[None, None]), (*composition.size_px, 3)
            )
        else:
            image = covering(linear_pixels("background", background).detach().numpy(), *composition.size_px)
        return composition, image.__getitem__

    def _composition(self, background: str) -> Composition:
        """All that does not depend on the light, made once for each kind of background."""
        kept: dict[str, Composition] = self.__dict__.setdefault("_compositions", {})
        if background not in kept:
            with torch.no_grad():
                kept[background] = self.composed(Target(background=background))  # type: ignore[arg-type]
        return kept[background]

    def _layer(self, name: str) -> Any:
        if name == "albedo" and self.kind != "portrait":
            raise UsageError("albedo: is of the portrait field; fit with reflectance='portrait'")
        composition = self._composition("photo")
        with torch.no_grad():
            relit = next(composition.relit(Lights.each(torch.tensor([[0.0, 0.0, 1.0]]))))
            return self._out(filled(composition.layers([name], relit), *composition.size_px)[name])

    @property
    def _photo_camera(self) -> Any:
        return photo_camera(self.head.fit.crop, *self._size_px)

    @property
    def _size_px(self) -> tuple[int, int]:
        assert self.photo is not None
        return self.photo.shape[0], self.photo.shape[1]

    def _given(self, arrays: dict[str, Any], tensors: bool, layers: bool) -> Any:
        """An image with alpha if it has that, or a dict of it and its layers."""
        image, alpha = arrays.pop("rgb"), arrays.pop("A", None)
        if alpha is not None:
            image = torch.cat([torch.as_tensor(image), torch.from_numpy(alpha)[..., None]], -1)
        found = {name: self._out(values, tensors) for name, values in {"image": image, **arrays}.items()}
        return found if layers else found["image"]

    def _out(self, values: Array, tensors: bool = False) -> Any:
        """Values as tensors on the models' device, if they or the photo's arrays are to be, or as arrays."""
        if self.tensors or tensors:
            return torch.as_tensor(values).to(self.models.device)
        return values.detach().numpy() if isinstance(values, Tensor) else values


class _OfWeights(torch.autograd.Function):
    """An image [H, W, 3] as a function of the weights [L, 3] of lights [L, 3], in which it is linear."""

    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, directions: Tensor, composition: Composition, image: Tensor
    ) -> Tensor:
        """The image, which is composed already."""
        ctx.directions, ctx.composition = directions, composition
        return image

    @staticmethod
    def backward(ctx: Any, *of_image: Tensor) -> tuple[Tensor, None, None, None]:
        """Sum the gradient [H, W, 3] over the image of each light."""
        composition, slope = ctx.composition, of_image[0].cpu()

        def image(relit: Relit) -> Tensor:
            bands = composition.bands(relit)
            band = bands["rgb"] if "A" in bands else composition.light_layer(relit)
            return torch.from_numpy(whole(band, *composition.size_px))

        found = [
            (slope * image(relit)).sum((0, 1))
            for some in torch.split(ctx.directions, _LIGHTS_AT_ONCE)
            for relit in composition.relit(Lights.each(some))
        ]
        return torch.stack(found), None, None, None


def read_person(
    models: Models,
    photo: np.ndarray,
    head: Head,
    kind: RelightKind,
    network_alone: bool,
    matte: np.ndarray | None,
    tensors: bool = False,
) -> Person:
    """Read the reflectance of a head in its photo [H, W, 3]; the matte [H, W] is the person's, if given."""
    with torch.no_grad():
        reflectance = pipeline.reflectance_of(models, head, kind, network_alone, photo=photo, matte=matte)
    return Person(models, photo, head, reflectance, matte, kind, network_alone, tensors)


def one_of(choices: Any, name: str, value: str) -> None:
    """Raise ValueError for a word that is not one of a Literal's."""
    if value not in get_args(choices):
        raise ValueError(f"{name} is {value!r}, not one of {', '.join(get_args(choices))}")


def _rotation(pose: Pose) -> Tensor:
    """The head_to_camera rotation [3, 3] of a pose in degrees, to which gradients flow."""
    if len(pose) != 3:
        raise ValueError(f"pose is {pose}, not yaw, pitch and roll in degrees")
    yaw, pitch, roll = pose
    return pose_to_rotation(yaw, pitch, roll)


def _by_pixel(texture: Tensor) -> Tensor:
    return texture.permute(1, 2, 0).contiguous()


def _require_shapes(
    photo: np.ndarray, cropped: np.ndarray, face: FaceTexture, crop_px: int, matte: np.ndarray | None
) -> None:
    side = face.visible.shape[-1]
    shapes = [face.texture.shape, face.visible.shape, face.normals.shape, cropped.shape]
    if shapes != [(3, side, side), (side, side), (3, side, side), (crop_px, crop_px, 3)]:
        raise ValueError("its texture has another shape")
    if side > LARGEST_TEXTURE or not all(
        x.isfinite().all() for x in (face.texture, face.visible, face.normals)
    ):
        raise ValueError("its texture is too large, or holds values that are not finite")
    if matte is not None and matte.shape != photo.shape[:2]:
        raise ValueError("its matte has another shape than its photo")
