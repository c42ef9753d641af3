"""Python API: `fit` the people in a photo once, then relight them under any light (docs/python.md).

Images are scene-linear Rec.709, float32 [H, W, 3], as numpy arrays or torch tensors. Camera space has x to
the image's right, y up and z toward the camera. Angles are in degrees, lengths in metres. A light of rgb 1
gives a white Lambertian surface that faces it radiance 1 (docs/design.md).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import RelightKind
from facerf_cli.baselines.base import Reflectance
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import check_landmarks
from facerf_cli.face.fit import FaceFit, Geometry
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.face.view import photo_camera
from facerf_cli.image.colour import to_display
from facerf_cli.image.strips import covering, in_strips
from facerf_cli.light.envmap import Backdrop, check_envmap
from facerf_cli.light.light import (
    Array,
    Light,
    as_light,
    as_tensor,
    directions_of,
    linear_pixels,
    one_of,
    stacked,
    uncopied_pixels,
)
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.portrait import find
from facerf_cli.portrait.find import Face, face_with
from facerf_cli.portrait.parse import CLASSES
from facerf_cli.portrait.person import unit_normals
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.raster.camera import Camera, pose_to_rotation, rays_of_rows
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.face_alone import FACE_LAYERS, FaceAlone, FaceInPhoto
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.fitting import head_of, reflectance_of
from facerf_cli.relighting.models import LARGEST_TEXTURE, Models
from facerf_cli.relighting.people_in_photo import PERSON_LAYERS, PeopleInPhoto, PersonInPhoto
from facerf_cli.relighting.people_in_photo import Background as Behind
from facerf_cli.relighting.photo_light import estimate_light
from facerf_cli.relighting.portrait_field import PortraitField, SmoothedFrame
from facerf_cli.relighting.relightable import Relightable, RenderRequest
from facerf_cli.relighting.white import WhiteBalance

if TYPE_CHECKING:
    import trimesh

Pose = tuple[float, float, float] | Tensor  # yaw, pitch and roll in degrees (docs/design.md)
Background = Literal["photo", "none"] | Array | tuple[float, float, float]
_LIGHTS_AT_ONCE, _PIXELS_AT_ONCE = 8, 1 << 23  # upper limits for a batch of OLAT images


def find_faces(models: Models, photo: Array, which: str = "all", name: str = "photo") -> list[Face]:
    """Find the faces in a photo, sorted from left to right.

    Args:
        models: Networks and face model, from `load_models`.
        photo: Scene-linear [H, W, 3].
        which: "all", "largest", or the index of a face, counted from the left.
        name: Name of the photo in messages.

    Raises:
        InputError: The photo has no such face.
    """
    return find.find_faces(models.networks.people, uncopied_pixels(name, photo), name, which)


@torch.no_grad()
def fit(
    models: Models,
    photo: Array,
    landmarks_px: Any = None,
    geometry: Geometry | None = None,
    reflectance: RelightKind = "portrait",
    network_alone: bool = False,
    matte: Any = None,
    texture_side: int | None = None,
    white_balance: BalanceMode | None = "keep",
    face: Face | None = None,
    head: Head | None = None,
    steady: SmoothedFrame | None = None,
    normals: Any = None,
) -> "Person":
    """Fit one person in a photo, by default the one with the largest face.

    This runs the networks. Relighting the returned `Person` then costs only what the lights cost.

    Args:
        models: Networks and face model, from `load_models`.
        photo: Scene-linear [H, W, 3]. It is not copied.
        landmarks_px: The face's 68 landmarks [68, 2] in pixels of the photo. No detector runs.
        geometry: "landmarks" fits the face model to landmarks; "network" regresses the head with the Geometry
            Network, without landmarks. Default: the geometry that the networks were trained with.
        reflectance: "portrait" relights the whole person, "field" only the face. "diffuse-sh", "specular-sh"
            and "prt" are the models that the paper compares with; they also relight only the face.
        network_alone: Omit the ratio image, which makes the photo's original light reproduce the photo.
        matte: Your own alpha [H, W] of the person, 0 to 1, instead of the networks' matte.
        texture_side: Side of the face's texture in texels. Default: the side used in training.
        white_balance: Skin under white light: "keep" keeps the photo's colours, "neutral" removes the colour
            of strongly coloured light, None keeps the networks' colours.
        face: One of `find_faces`, instead of the largest face.
        head: A head that was fitted before; nothing is fitted.
        steady: Temporally smoothed inputs for a frame of a video (`relighting/shot.py`).
        normals: Normals [h, w, 3] of the photo from another method, which replace the networks' normals in
            the portrait field. Camera space with y up and z toward the camera, or with y down and z away from
            it; 0 marks pixels without a normal.

    Raises:
        InputError: No face was found, the landmarks clearly miss the face, the fit failed, or the normals do
            not match the face.
        UsageError: Two arguments exclude each other.
    """
    one_of(RelightKind, "reflectance", reflectance)
    if white_balance is not None:
        one_of(BalanceMode, "white_balance", white_balance)
    if geometry is not None:
        one_of(Geometry, "geometry", geometry)
    if texture_side is not None and not 16 <= texture_side <= LARGEST_TEXTURE:
        raise ValueError(f"texture_side is {texture_side}, not 16 to {LARGEST_TEXTURE}")
    if network_alone and reflectance not in ("field", "portrait"):
        raise UsageError("network_alone: only applies to the fields; remove it, or use reflectance='field'")
    if landmarks_px is not None and geometry == "network":
        raise UsageError("geometry: 'network' uses no landmarks; remove geometry or landmarks_px")
    pixels = uncopied_pixels("photo", photo)
    if matte is not None:
        matte = linear_pixels("matte", matte, "[H, W]").detach().numpy().clip(0, 1)
        if matte.shape != pixels.shape[:2]:
            raise ValueError(f"matte has shape {list(matte.shape)}, but the photo is {pixels.shape[:2]}")
    if normals is not None:
        if reflectance != "portrait" or steady is not None:
            raise UsageError("normals: only apply to reflectance='portrait' on a single photo; remove them")
        normals = unit_normals(linear_pixels("normals", normals).detach().numpy(), pixels.shape[:2])
    if head is None:
        if landmarks_px is not None:
            face = face_with(models.networks.people, to_display(pixels), check_landmarks(landmarks_px))
        elif face is None:
            (face,) = find_faces(models, pixels, "largest")
        head = head_of(models, pixels, face, geometry, models.sides(texture_side), matte)
    eyes = face.eyes if face else None
    field = reflectance_of(
        models, head, reflectance, network_alone, pixels, steady, matte, white_balance, normals, eyes
    )
    return Person(models, pixels, head, field, matte, reflectance, isinstance(photo, Tensor))


class PhotoCamera(NamedTuple):
    """Camera of a photo: K [3, 3] in pixels, and head_to_camera [4, 4] in metres.

    A point (x, y, z) in camera space projects to the pixel (K @ (x, -y, -z)) / -z.
    """

    K: Array
    head_to_camera: Array


@dataclass(frozen=True, eq=False)
class Target:
    """Pose and surroundings of a rendered person; in another pose, only the face is rendered."""

    fit: FaceFit | None = None  # pose and shape of the head; None: as in the photo
    matte: np.ndarray | None = None  # alpha [H, W] in 0..1 of the part that is relit; None: all of the person
    alpha: np.ndarray | None = None  # alpha [H, W] of the photo itself, which multiplies the matte
    background: Behind = "photo"


AS_IN_PHOTO = Target()


@dataclass(frozen=True, eq=False)
class Person:
    """One person in a photo, as returned by `fit`.

    Everything that does not depend on the light is computed once and kept. Attributes and results are numpy
    arrays. They are tensors on the models' device if the photo, or an array passed to the method, is a
    tensor.
    """

    models: Models
    photo: np.ndarray | None  # scene-linear [H, W, 3]; None: there is only the face, in the frame of its crop
    head: Head  # fitted face model and the texture of the face
    reflectance: Reflectance  # renders the person under any lights
    user_matte: np.ndarray | None = None  # alpha [H, W] of the person, if the user supplied one
    kind: RelightKind = "portrait"
    tensors: bool = False  # whether the photo was passed as a tensor

    def __repr__(self) -> str:
        size = "" if self.photo is None else " in {1} x {0} pixels".format(*self.photo.shape)
        return f"<facerf.Person{size}, {self.kind}>"

    def relight(
        self,
        light: Light | Array | Sequence[Light | Array],
        pose: Pose | None = None,
        background: Background = "photo",
        layers: Sequence[str] = (),
        ambient: float = 0.0,
        alone: bool = False,
    ) -> Any:
        """Relight the person and return the image [H, W, 3] in the frame of the photo.

        Args:
            light: A `Light`, a lat-long map [h, 2 h, 3], or a list of them, which returns a list of images.
            pose: Yaw, pitch and roll in degrees. Renders only the face, in this pose, as [H, W, 4].
            background: "photo"; "none" for an image with straight alpha [H, W, 4]; an image [h, w, 3], which
                is scaled to cover the frame; or a colour (r, g, b).
            layers: Names of layers, as for `facerf relight --aov`. The result is then a dict of "image" and
                the layers [H, W] or [H, W, C].
            ambient: Uniform ambient fill: a fraction, 0 to 1, of all lights except maps.
            alone: Render only the face, in the pose of the photo, as [H, W, 4].

        Gradients flow to the lights, the pose and the texture if only the face is rendered (docs/python.md).

        Raises:
            UsageError: A gradient through an image in the photo was requested, or the photo's original light
                with `pose` or `alone`.
        """
        if not alone and pose is None:
            return self._group.relight(light, background, layers, ambient)
        lights = _lights_of(light, ambient)
        if any(one.original_rgb is not None for one in lights):
            raise UsageError("Light.original(): lights the whole photo; remove pose and alone")
        _check_layers(layers, FACE_LAYERS)
        images = self._images_of_face(lights, pose, layers)
        return self._images_for_caller(light, lights, [pose, self._texture_requiring_grad], images, layers)

    def olat(self, lights: int | Array = 150) -> Array:
        """Return the person over black under one light at a time, [L, H, W, 3].

        The image under any weighted sum of the lights is the same weighted sum of these images.

        Args:
            lights: Unit directions [L, 3] in camera space, or the size of a uniform rig (`facerf.rig`).
        """
        with torch.no_grad():
            images = list(olat_images(self._group.prepared, directions_of(lights)))
        return self._to_caller_type(np.concatenate(images), lights)

    def uv_olat(self, lights: int | Array = 150, pose: Pose | None = None) -> Array:
        """Return the UV texture of the face under one light at a time, [L, T, T, 3], by the face field.

        Args:
            lights: Unit directions [L, 3] in camera space, or the size of a uniform rig (`facerf.rig`).
            pose: Yaw, pitch and roll of the head in degrees. The lights stay fixed to the camera.
        """
        directions = directions_of(lights)
        turn = None if pose is None else self.head.fit.turn_to(_rotation(pose))
        field = self.field
        inputs = lights, pose, self._texture_requiring_grad
        with _grad_for_tensors(*inputs):
            if isinstance(field, Field):
                textures = torch.cat(list(field.olats(directions, turn)))
            else:
                each = Light.each(directions)
                textures = field.relit(each.directions, each.weights, turn)
        return self._to_caller_type(textures.permute(0, 2, 3, 1).contiguous(), *inputs)

    def estimate_light(self, lights: int = 150) -> Light:
        """Estimate the photo's light as weights of a uniform rig; the comparison models use their own lights.

        Raises:
            InputError: Too little of the face is visible.
        """
        kind = "field" if self.kind == "portrait" else self.kind
        with torch.no_grad():
            rig = rig_directions(lights)
            light = estimate_light(self.models, self.head, kind, rig, white_balance="neutral").light
        return Light(light.directions.numpy(), light.weights.numpy())

    def backdrop(self, envmap: Array, rotate_deg: float = 0.0, blur: float = 0.0) -> Array:
        """Render a lat-long map [h, 2 h, 3] as the background [H, W, 3] that the photo's camera sees.

        Args:
            envmap: The map, scene-linear.
            rotate_deg: Angle added to every azimuth of the map.
            blur: Lens blur: standard deviation as a fraction of the photo's longer side.
        """
        linear, camera = linear_pixels("map", envmap).detach(), self.photo_camera
        check_envmap(linear)
        size = camera.height_px, camera.width_px
        behind = Backdrop(linear, size, partial(rays_of_rows, camera), rotate_deg, blur)
        return self._to_caller_type(behind[0 : size[0]], envmap)

    @property
    def delight(self) -> Light:
        """Uniform light that reproduces the brightness of the skin in the photo."""
        return self.uniform_intensity * Light.uniform()

    @cached_property
    def light(self) -> Light:
        """Light of the photo, estimated over a rig of 150 lights."""
        return self.estimate_light()

    @property
    def matte(self) -> Array:
        """Alpha [H, W] of the person."""
        return self._to_caller_type(self.matte_array)

    @cached_property
    def classes(self) -> dict[str, Array]:
        """Coverage [H, W] of each class of the person (hair, skin, ...); the classes sum to the matte."""
        layers = in_strips(self.segmentation.layers, *self.matte_array.shape)
        return {name: self._to_caller_type(layers[f"class.{name}"]) for name in CLASSES[1:]}

    @cached_property
    def albedo(self) -> Array:
        """Radiance [H, W, 3] of the person under unshadowed light of rgb 1, over black."""
        return self._layer("albedo")

    @cached_property
    def normals(self) -> Array:
        """Unit normals [H, W, 3] in camera space; 0 off the person."""
        return self._layer("normal")

    @cached_property
    def depth(self) -> Array:
        """Distance [H, W] along the viewing axis in metres; 0 off the person."""
        return self._layer("depth")[..., 0]

    @property
    def landmarks(self) -> Array:
        """Landmarks [68, 2] in pixels of the photo, with pixel centres at index + 0.5."""
        return self._to_caller_type(self.head.fit.crop.to_photo(self.head.landmarks_px))

    @property
    def camera(self) -> PhotoCamera:
        """Camera of the photo and pose of the head."""
        camera = self.photo_camera
        focal = camera.focal_px
        matrix = np.array([[focal, 0, camera.cx_px], [0, focal, camera.cy_px], [0, 0, 1]])
        return PhotoCamera(self._to_caller_type(matrix), self._to_caller_type(self.head.fit.head_to_camera))

    @property
    def mesh(self) -> "trimesh.Trimesh":
        """Fitted, textured face in the head's frame, in metres: `.vertices` [V, 3], `.export(path)`."""
        import trimesh  # takes as long as all other imports of a relight together
        from PIL import Image

        fit, (u, v) = self.head.fit, grid_uv().numpy().T
        texture = Image.fromarray(to_display(self.face.texture.permute(1, 2, 0).detach().numpy()))
        vertices = self.models.face.vertices(fit.alpha[None], fit.beta[None])[0].numpy()
        visual = trimesh.visual.TextureVisuals(np.stack([u, 1 - v], -1), image=texture)
        return trimesh.Trimesh(vertices, grid_triangles().numpy(), visual=visual, process=False)

    @property
    def uv(self) -> Array:
        """Texture coordinates (u, v) [V, 2] of the mesh's vertices, with v pointing down."""
        return self._to_caller_type(grid_uv())

    @property
    def texture(self) -> Array:
        """Scene-linear texture [T, T, 3] of the face: the unwrapped photo, with hidden texels filled in."""
        return self._to_caller_type(self.face.texture.permute(1, 2, 0).contiguous())

    def with_texture(self, texture: Array) -> "Person":
        """Return the person with another texture [T, T, 3] of the face, which may require gradients.

        Raises:
            UsageError: The reflectance is a comparison model, which has no such texture.
        """
        planes, field, reflectance = as_tensor(texture).permute(2, 0, 1), self.field, self.reflectance
        if planes.shape != self.face.texture.shape:
            raise ValueError(f"texture has shape {list(texture.shape)}, not {list(self.texture.shape)}")
        if not isinstance(field, Field):
            raise UsageError(f"with_texture: not supported by {self.kind}; use reflectance='field'")
        field = replace(field, face=replace(field.face, texture=planes), known=None)
        whole = replace(reflectance, field=field) if isinstance(reflectance, PortraitField) else field
        return replace(self, reflectance=whole)

    @cached_property
    def segmentation(self) -> Segmentation:
        """Classes and matte of the person."""
        assert self.photo is not None
        if isinstance(self.reflectance, PortraitField):
            return self.reflectance.person.segmentation
        landmarks_px = self.head.fit.crop.to_photo(self.head.landmarks_px)
        people, others = self.models.networks.people, self.head.others
        return segment(people, to_display(self.photo), landmarks_px, self.user_matte, others)

    @property
    def matte_array(self) -> np.ndarray:
        """Alpha [H, W] of the person as a numpy array."""
        return self.segmentation.matte if self.user_matte is None else self.user_matte

    @property
    def field(self) -> Reflectance:
        """Reflectance of the face."""
        return self.reflectance.field if isinstance(self.reflectance, PortraitField) else self.reflectance

    @property
    def face(self) -> FaceTexture:
        """Texture of the face as it is relit: the photo's, or the one passed to `with_texture`."""
        return self.field.face if isinstance(self.field, Field) else self.head.face

    @property
    def photo_camera(self) -> Camera:
        """Camera of the photo."""
        assert self.photo is not None
        return photo_camera(self.head.fit.crop, self.photo.shape[0], self.photo.shape[1])

    @property
    def balance(self) -> WhiteBalance | None:
        """White balance of the person; None for the comparison models."""
        return self.field.balance if isinstance(self.field, Field) else None

    @property
    def uniform_intensity(self) -> float:
        """Intensity of uniform light that reproduces the brightness of the skin in the photo."""
        return 1.0 if self.balance is None else self.balance.uniform_scale

    def prepare(self, target: Target = AS_IN_PHOTO) -> Relightable:
        """Return the person in a pose and over a background, ready to be relit by any number of lights."""
        if self.photo is None or target.fit is not None:
            return self.face_alone(target.fit)
        return PeopleInPhoto([self.in_photo(target)], target.background)

    def face_alone(self, fit: FaceFit | None = None) -> FaceAlone:
        """Return only the face, in the pose of a fit, by default that of the photo, ready to be relit."""
        photo_px = None if self.photo is None else (self.photo.shape[0], self.photo.shape[1])
        return FaceAlone(self.models.face, self.head, self.reflectance, fit, photo_px)

    def in_photo(self, target: Target = AS_IN_PHOTO) -> PersonInPhoto | FaceInPhoto:
        """Return the person in the photo, ready to be relit; the target's matte limits what changes."""
        assert self.photo is not None
        matte = self.matte_array
        for part in (target.matte, target.alpha):
            matte = matte if part is None else (matte * part).astype(np.float32, copy=False)
        if isinstance(self.reflectance, PortraitField):
            return PersonInPhoto(self.models.face, self.photo, self.head, self.reflectance, matte)
        return FaceInPhoto(self.face_alone(), self.photo, matte)

    def image(self, light: RigLight, target: Target = AS_IN_PHOTO) -> np.ndarray:
        """Return the person [H, W, 3] under one light, not premultiplied (paper, 'Relighting')."""
        subject = self.prepare(target)
        return subject.image(next(subject.relit(Light(light.directions, light.weights[None]))))

    def _images_of_face(
        self, lights: Sequence[Light], pose: Pose | None, layers: Sequence[str]
    ) -> Iterator[dict[str, Any]]:
        face = self.face_alone(None if pose is None else replace(self.head.fit, rotation=_rotation(pose)))
        view = face.view
        for (relit,) in face.relit_images(lambda part: stacked(lights[part]), [1] * len(lights)):
            image = torch.zeros(*face.size_px, 4)
            image[view.window] = torch.cat([view.render(relit.texture), view.mask[..., None]], -1)
            arrays = face.rendered(RenderRequest(relit, layers=layers))
            del arrays["rgb"]
            yield {"image": image, **arrays}

    def _images_for_caller(
        self,
        light: Any,
        lights: Sequence[Light],
        inputs: Sequence[Any],
        images: Iterator[dict[str, Any]],
        layers: Sequence[str],
    ) -> Any:
        """Return the result for a light, or a list for a list; `inputs` are what else gradients may reach."""
        inputs = [*inputs, *_arrays_of(lights)]
        with _grad_for_tensors(*inputs):
            each = [
                {name: self._to_caller_type(values, *inputs) for name, values in image.items()}
                for image in images
            ]
        results = each if layers else [image["image"] for image in each]
        return results if isinstance(light, Sequence) else results[0]

    def _to_caller_type(self, values: Array, *inputs: Any) -> Any:
        """Return a numpy array, or a tensor on the models' device if the photo or an input is a tensor."""
        if self.tensors or any(isinstance(one, Tensor) for one in inputs):
            return torch.as_tensor(values).to(self.models.device)
        return values.detach().numpy() if isinstance(values, Tensor) else values

    @property
    def _texture_requiring_grad(self) -> Tensor | None:
        texture = self.face.texture
        return texture if texture.requires_grad else None

    @cached_property
    def _group(self) -> "Group":
        return Group([self])

    def _layer(self, name: str) -> Any:
        if name == "albedo" and self.kind != "portrait":
            raise UsageError("albedo: requires the portrait field; fit with reflectance='portrait'")
        people = self._group.prepared
        with torch.no_grad():
            relit = next(people.relit(Light.each(torch.tensor([[0.0, 0.0, 1.0]]))))
            return self._to_caller_type(people.rendered(RenderRequest(relit, layers=[name]))[name])


class Group:
    """People in one photo, who are relit together.

    Args:
        people: Results of `fit`, all for the same photo.
    """

    def __init__(self, people: Sequence[Person]) -> None:
        photos = [person.photo for person in people if person.photo is not None]
        if not photos or len(photos) < len(people):
            raise ValueError("people: pass at least one person, each fitted in a photo")
        if any(photo is not photos[0] and not np.array_equal(photo, photos[0]) for photo in photos):
            raise ValueError("people: come from different photos; pass people of one photo")
        self.people, nearest_first = people, sorted(people, key=lambda person: -person.head.fit.crop.side_px)
        with torch.no_grad():
            self.prepared = PeopleInPhoto([person.in_photo() for person in nearest_first])

    def relight(
        self,
        light: Light | Array | Sequence[Light | Array],
        background: Background = "photo",
        layers: Sequence[str] = (),
        ambient: float = 0.0,
    ) -> Any:
        """Relight all people with the same light and return one image; see `Person.relight`."""
        lights, kinds = _lights_of(light, ambient), {person.kind for person in self.people}
        if not kinds <= {"portrait", "field"} and any(one.original_rgb is not None for one in lights):
            raise UsageError("Light.original(): unsupported by comparison models; use reflectance='field'")
        _check_layers(layers, [*FACE_LAYERS, *(PERSON_LAYERS if kinds == {"portrait"} else ())])
        _refuse_gradients(lights, self.people)
        with torch.no_grad():
            images = self._images(lights, background, layers)
            return self.people[0]._images_for_caller(light, lights, [], images, layers)

    @property
    def matte(self) -> Array:
        """Alpha [H, W] of all people."""
        return self.people[0]._to_caller_type(self.prepared.matte)

    def _images(
        self, lights: Sequence[Light], background: Background, layers: Sequence[str]
    ) -> Iterator[dict[str, Any]]:
        people, behind = self.prepared, None
        if not isinstance(background, str):
            pixels = np.array(background)[None, None] if isinstance(background, tuple) else background
            behind = covering(linear_pixels("background", pixels).detach().numpy(), *people.size_px)
        else:
            one_of(Literal["photo", "none"], "background", background)
        if cut_out := isinstance(background, str) and background == "none":
            people = replace(people, background="none")
        for (relit,) in people.relit_images(lambda part: stacked(lights[part]), [1] * len(lights)):
            arrays = people.rendered(RenderRequest(relit, layers=layers, background=behind))
            image = torch.from_numpy(arrays.pop("rgb"))
            if cut_out:
                image = torch.cat([image, torch.from_numpy(people.matte)[..., None]], -1)
            yield {"image": image} | ({"person.A": people.matte, **arrays} if layers else arrays)


def olat_images(subject: Relightable, directions: Tensor) -> Iterator[np.ndarray]:
    """Yield batches [l, H, W, 3] of a subject over black, under one of the lights [L, 3] at a time."""
    height, width = subject.size_px
    at_once = max(1, min(_LIGHTS_AT_ONCE, _PIXELS_AT_ONCE // (height * width)))
    return (_under_each(subject, batch) for batch in torch.split(directions, at_once))


def _under_each(subject: Relightable, directions: Tensor) -> np.ndarray:
    images = np.empty((len(directions), *subject.size_px, 3), np.float32)
    lights = {str(number): relit for number, relit in enumerate(subject.relit(Light.each(directions)))}
    subject.rendered(RenderRequest(lights=lights), lambda number, shape: images[int(number)])
    return images


def _lights_of(light: Any, ambient: float) -> list[Light]:
    return [as_light(one, ambient) for one in (light if isinstance(light, Sequence) else [light])]


def _arrays_of(lights: Sequence[Light]) -> list[Any]:
    """Return the arrays of lights through which gradients may flow."""
    return [array for one in lights for array in (one.directions, one.weights, one.original_rgb)]


def _check_layers(layers: Sequence[str], known: Sequence[str]) -> None:
    if isinstance(layers, str) or not set(layers) <= set(known):
        raise ValueError(f"layers is {layers!r}, not a list of some of {', '.join(dict.fromkeys(known))}")


def _refuse_gradients(lights: Sequence[Light], people: Sequence[Person]) -> None:
    """Raise UsageError if a gradient through an image in the photo is requested."""
    inputs = _arrays_of(lights)
    for person in people:
        inputs.append(person.face.texture)
        networks: Any = person.models.networks  # all are loaded by now
        inputs += networks.reflectance.parameters() if isinstance(person.field, Field) else []
        inputs += networks.portrait.parameters() if isinstance(person.reflectance, PortraitField) else []
    if torch.is_grad_enabled() and any(isinstance(one, Tensor) and one.requires_grad for one in inputs):
        raise UsageError(
            "gradients: not supported through images in the photo; pass alone=True, weight the images of "
            "olat, or use torch.no_grad()"
        )


def _grad_for_tensors(*inputs: Any) -> torch.set_grad_enabled:
    """Enable gradients only if an input is a tensor."""
    return torch.set_grad_enabled(torch.is_grad_enabled() and any(isinstance(one, Tensor) for one in inputs))


def _rotation(pose: Pose) -> Tensor:
    """Return the rotation head_to_camera [3, 3] of a pose in degrees, with gradients."""
    each = pose if isinstance(pose, Sequence | Tensor | np.ndarray) else [pose]
    angles = torch.stack([torch.as_tensor(angle, dtype=torch.float64).cpu() for angle in each])
    if angles.shape != (3,) or not angles.isfinite().all():
        raise ValueError(f"pose is {pose}, not yaw, pitch and roll in degrees")
    return pose_to_rotation(*angles)
