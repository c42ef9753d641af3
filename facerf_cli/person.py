"""The way of a photo: `fit` a person once, then relight it at what a light costs (docs/python.md)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import RelightKind
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import check_landmarks
from facerf_cli.face.fit import Geometry
from facerf_cli.face.head import Head
from facerf_cli.face.topology import grid_triangles, grid_uv
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
from facerf_cli.light.sphere import rig_directions
from facerf_cli.portrait import find
from facerf_cli.portrait.find import Face, face_with
from facerf_cli.portrait.parse import CLASSES
from facerf_cli.portrait.person import unit_normals
from facerf_cli.raster.camera import pose_to_rotation, rays_of_rows
from facerf_cli.relighting import White
from facerf_cli.relighting.face_alone import FACE_LAYERS
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.fitted import FittedPerson, olat_images
from facerf_cli.relighting.heads import head_of
from facerf_cli.relighting.models import LARGEST_TEXTURE, Models
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.person_in_photo import PERSON_LAYERS
from facerf_cli.relighting.photo_light import estimate_light
from facerf_cli.relighting.portrait_field import PortraitField, SteadyFrame
from facerf_cli.relighting.reflectance import reflectance_of
from facerf_cli.relighting.relightable import RenderRequest

if TYPE_CHECKING:
    import trimesh

Pose = tuple[float, float, float] | Tensor  # yaw, pitch, roll in degrees (docs/design.md)
Background = Literal["photo", "none"] | Array | tuple[float, float, float]


def find_faces(
    models: Models,
    photo: Array,
    which: str = "all",
    name: str = "photo",
) -> list[Face]:
    """Find the faces of a photo, from left to right, for `fit`.

    Args:
        models: The networks and the face model.
        photo: Scene-linear [H, W, 3].
        which: "all", "largest", or a number from the left.
        name: The photo's name, for messages.

    Raises InputError where no face is found.
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
    white: White | None = "photo",
    face: Face | None = None,
    head: Head | None = None,
    steady: SteadyFrame | None = None,
    normals: Any = None,
) -> "Person":
    """Fit a person of a photo, by default that with the largest face, once for all lights.

    Args:
        models: The networks and the face model, from `load_models`.
        photo: Scene-linear [H, W, 3], which is not copied.
        landmarks_px: The face's 68 landmarks [68, 2] in the photo's pixels, in place of the detector's.
        geometry: "landmarks", or "network": the Geometry Network regresses the head, without landmarks; by
            default as the networks were trained.
        reflectance: "portrait" relights the whole person, "field" the face alone; "diffuse-sh",
            "specular-sh", "prt" are the paper's baselines, which relight the face, too.
        network_alone: Leave out the correction by which the photo's own light gives the photo back.
        matte: The person's share [H, W] of the photo, in place of the networks'.
        texture_side: Side of the face's texture in texels; by default that of the networks' training.
        white: Under even white light skin has the colours of the photo; or, of a photo in coloured light, the
            "scene", those without that light; None: those of the networks.
        face: The face, from `find_faces`, in place of the largest one.
        head: The head, where it was fitted before.
        steady: What the frames around it steady, of a frame of a shot (`relighting/shot.py`).
        normals: Normals [h, w, 3] of the photo from another method, in place of the networks' in the portrait
            field: camera space, x to the right, y up and z toward the camera, or y down and z away; 0 where
            there are none.

    Raises InputError where no face is found, landmarks clearly lie off the face, the fit fails, or normals
    are not those of the face.
    """
    one_of(RelightKind, "reflectance", reflectance)
    if white is not None:
        one_of(White, "white", white)
    if geometry is not None:
        one_of(Geometry, "geometry", geometry)
    if texture_side is not None and not 16 <= texture_side <= LARGEST_TEXTURE:
        raise ValueError(f"texture_side is {texture_side}, not 16 to {LARGEST_TEXTURE}")
    if network_alone and reflectance not in ("field", "portrait"):
        raise UsageError("network_alone: is for the fields; leave it out, or use reflectance='field'")
    if landmarks_px is not None and geometry == "network":
        raise UsageError("geometry: 'network' uses no landmarks; leave one out")
    pixels = uncopied_pixels("photo", photo)
    if matte is not None:
        matte = linear_pixels("matte", matte, "[H, W]").detach().numpy().clip(0, 1)
        if matte.shape != pixels.shape[:2]:
            raise ValueError(f"matte has shape {list(matte.shape)}, not that of the photo")
    if normals is not None:
        if reflectance != "portrait" or steady is not None:
            raise UsageError("normals: are for the portrait field of a photo alone; leave them out")
        normals = unit_normals(linear_pixels("normals", normals).detach().numpy(), pixels.shape[:2])
    if head is None:
        if landmarks_px is not None:
            face = face_with(models.networks.people, to_display(pixels), check_landmarks(landmarks_px))
        elif face is None:
            (face,) = find_faces(models, pixels, "largest")
        head = head_of(models, pixels, face, geometry, models.sides(texture_side), matte)
    found = reflectance_of(models, head, reflectance, network_alone, pixels, steady, matte, white, normals)
    tensors = isinstance(photo, Tensor)
    return Person(models, pixels, head, found, matte, reflectance, tensors)


class PhotoCamera(NamedTuple):
    """The photo's camera: K [3, 3] in its pixels, and head_to_camera [4, 4] in metres.

    Camera space has x to the image's right, y up and z toward the camera. A point of it is seen at
    (K @ (x, -y, -z)) / -z.
    """

    K: Array
    head_to_camera: Array


@dataclass(frozen=True, eq=False)
class Person(FittedPerson):
    """One person of a photo, as `fit` gives it; each light then costs what a light costs.

    Its arrays are numpy's, or torch's on the models' device where the photo or what a method is given is one.

    Attributes:
        kind: Which reflectance it is.
        tensors: True of a photo that was given as a tensor.
    """

    kind: RelightKind = "portrait"
    tensors: bool = False

    def __repr__(self) -> str:
        """A line for a notebook."""
        camera = self.photo_camera
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

        A light or pose of tensors gives tensors. Gradients flow through the face alone (docs/python.md);
        UsageError says so where one through an image in the photo is wanted.
        """
        if not alone and pose is None:
            return self._group.relight(light, background, layers, room)
        lights = _lights_of(light, room)
        if any(one.own_rgb is not None for one in lights):
            raise UsageError("Light.own(): is of the whole photo; leave out pose and alone")
        _check_layers(layers, FACE_LAYERS)
        return self._answer(light, lights, [pose, self._wanted], self._faces(lights, pose, layers), layers)

    def olat(self, lights: int | Array = 150) -> Array:
        """The person over black under each light alone [L, H, W, 3]; the images add up by a light's weights.

        `lights` are unit directions [L, 3], or the size of a uniform rig, `facerf.rig(lights)`.
        """
        with torch.no_grad():
            images = list(olat_images(self._group.composed, directions_of(lights)))
        return self._out(np.concatenate(images), lights)

    def uv_olat(self, lights: int | Array = 150, pose: Pose | None = None) -> Array:
        """The face's UV texture under each light alone [L, T, T, 3], by the neural field; see `olat`."""
        directions = directions_of(lights)
        turn = None if pose is None else self.head.fit.turn_to(_rotation(pose))
        field = self.field
        given = lights, pose, self._wanted
        with _gradients(*given):
            if isinstance(field, Field):
                textures = torch.cat(list(field.olats(directions, turn)))
            else:
                each = Light.each(directions)
                textures = field.relit(each.directions, each.weights, turn)
        return self._out(textures.permute(0, 2, 3, 1).contiguous(), *given)

    def estimate_light(self, lights: int = 150) -> Light:
        """Estimate the light of the photo over a rig; the models of the paper's baselines have their own.

        Raises InputError where too little of the face is visible.
        """
        kind = "field" if self.kind == "portrait" else self.kind
        with torch.no_grad():
            found = estimate_light(self.models, self.head, kind, rig_directions(lights), white="scene").light
        return Light(found.directions.numpy(), found.weights.numpy())

    def backdrop(self, envmap: Array, rotate_deg: float = 0.0, blur: float = 0.0) -> Array:
        """The map [H, 2 H, 3] that the photo's camera sees behind the person, [H, W, 3], for `background`.

        `rotate_deg` is added to every azimuth; `blur` is that of a lens, as a share of the longer side.
        """
        linear, camera = linear_pixels("map", envmap).detach(), self.photo_camera
        check_envmap(linear)
        size = camera.height_px, camera.width_px
        seen = Backdrop(linear, size, partial(rays_of_rows, camera), rotate_deg, blur)
        return self._out(seen[0 : size[0]], envmap)

    @property
    def even(self) -> Light:
        """Even light from all around, under which the skin is as bright as in the photo."""
        return self.even_brightness * Light.around()

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
        layers = in_strips(self.segmentation.layers, *self.share.shape)
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
        camera = self.photo_camera
        focal = camera.focal_px
        matrix = np.array([[focal, 0, camera.cx_px], [0, focal, camera.cy_px], [0, 0, 1]])
        return PhotoCamera(self._out(matrix), self._out(self.head.fit.head_to_camera))

    @property
    def mesh(self) -> "trimesh.Trimesh":
        """The fitted face with its texture, head frame, m: `.vertices` [V, 3], `.faces`, `.export(path)`."""
        import trimesh  # takes as long as the rest of a relight's imports
        from PIL import Image

        fit, (u, v) = self.head.fit, grid_uv().numpy().T
        texture = Image.fromarray(to_display(self.face.texture.permute(1, 2, 0).detach().numpy()))
        vertices = self.models.face.vertices(fit.alpha[None], fit.beta[None])[0].numpy()
        visual = trimesh.visual.TextureVisuals(np.stack([u, 1 - v], -1), image=texture)
        return trimesh.Trimesh(vertices, grid_triangles().numpy(), visual=visual, process=False)

    @property
    def uv(self) -> Array:
        """The (u, v) [V, 2] of the mesh's vertices, v down."""
        return self._out(grid_uv())

    @property
    def texture(self) -> Array:
        """The photo's texture [T, T, 3] of the face, scene-linear, or another; hidden texels are filled."""
        return self._out(self.face.texture.permute(1, 2, 0).contiguous())

    def with_texture(self, texture: Array) -> "Person":
        """The person with another texture [T, T, 3] of the face, to which gradients flow; the rest stays."""
        planes, found, field = as_tensor(texture).permute(2, 0, 1), self.reflectance, self.field
        if planes.shape != self.face.texture.shape:
            raise ValueError(f"texture has shape {list(texture.shape)}, not {list(self.texture.shape)}")
        if not isinstance(field, Field):
            raise UsageError(f"with_texture: is for the fields, not for {self.kind}")
        field = replace(field, face=replace(field.face, texture=planes))
        whole = replace(found, field=field) if isinstance(found, PortraitField) else field
        return replace(self, reflectance=whole)

    def _faces(self, lights: Sequence[Light], pose: Pose | None, layers: Sequence[str]) -> Iterator[Any]:
        """The face alone under each light; gradients reach all that it is made of."""
        face = self.face_alone(None if pose is None else replace(self.head.fit, rotation=_rotation(pose)))
        view = face.view
        for (one,) in face.relit_images(lambda part: stacked(lights[part]), [1] * len(lights)):
            image = torch.zeros(*face.size_px, 4)
            image[view.window] = torch.cat([view.render(one.texture), view.mask[..., None]], -1)
            arrays = face.rendered(RenderRequest(one, layers=layers))
            del arrays["rgb"]
            yield {"image": image, **arrays}

    def _answer(
        self,
        light: Any,
        lights: Sequence[Light],
        given: Sequence[Any],
        shown: Iterator[Any],
        layers: Sequence[str],
    ) -> Any:
        """The images that a caller asked for, or dicts with layers; one for a light, a list for a list.

        `given` are what gradients may reach beside the lights.
        """
        given = [*given, *(array for one in lights for array in (one.directions, one.weights, one.own_rgb))]
        with _gradients(*given):
            images = [{name: self._out(values, *given) for name, values in one.items()} for one in shown]
        found = images if layers else [one["image"] for one in images]
        return found if isinstance(light, Sequence) else found[0]

    def _out(self, values: Array, *given: Any) -> Any:
        """Values as arrays, or as tensors where the photo or what was given is one."""
        if self.tensors or any(isinstance(one, Tensor) for one in given):
            return torch.as_tensor(values).to(self.models.device)
        return values.detach().numpy() if isinstance(values, Tensor) else values

    @property
    def _wanted(self) -> Tensor | None:
        """The texture, if its gradient is wanted."""
        texture = self.face.texture
        return texture if texture.requires_grad else None

    @cached_property
    def _group(self) -> "Group":
        return Group([self])

    def _layer(self, name: str) -> Any:
        if name == "albedo" and self.kind != "portrait":
            raise UsageError("albedo: is of the portrait field; fit with reflectance='portrait'")
        people = self._group.composed
        with torch.no_grad():
            relit = next(people.relit(Light.each(torch.tensor([[0.0, 0.0, 1.0]]))))
            return self._out(people.rendered(RenderRequest(relit, layers=[name]))[name])


@dataclass(frozen=True, eq=False)
class Group:
    """People of one photo, relit together; those whose faces are larger stand in front.

    Attributes:
        people: As `fit` gives them, all of the same photo.
    """

    people: Sequence[Person]

    def __post_init__(self) -> None:
        photos = [person.photo for person in self.people if person.photo is not None]
        if not photos or len(photos) < len(self.people):
            raise ValueError("people: give one or more, fitted in their photo")
        if any(photo is not photos[0] and not np.array_equal(photo, photos[0]) for photo in photos):
            raise ValueError("people: are of several photos; give those of one")

    def relight(
        self,
        light: Light | Array | Sequence[Light | Array],
        background: Background = "photo",
        layers: Sequence[str] = (),
        room: float = 0.0,
    ) -> Any:
        """Relight all people by the same light, in one image of the photo's frame; see `Person.relight`."""
        lights, kinds = _lights_of(light, room), {person.kind for person in self.people}
        if not kinds <= {"portrait", "field"} and any(one.own_rgb is not None for one in lights):
            raise UsageError("Light.own(): is of the whole photo; leave out baselines")
        _check_layers(layers, [*FACE_LAYERS, *(PERSON_LAYERS if kinds == {"portrait"} else ())])
        _refuse_gradients(lights, self.people)
        with torch.no_grad():
            shown = self._photos(lights, background, layers)
            return self.people[0]._answer(light, lights, [], shown, layers)

    @property
    def matte(self) -> Array:
        """The people's share [H, W] of the photo."""
        return self.people[0]._out(self.composed.matte)

    @cached_property
    def composed(self) -> PeopleInPhoto:
        """The people in their photo, with all that does not depend on the light."""
        nearest_first = sorted(self.people, key=lambda person: -person.head.fit.crop.side_px)
        with torch.no_grad():
            return PeopleInPhoto([person.in_photo() for person in nearest_first])

    def _photos(
        self, lights: Sequence[Light], background: Background, layers: Sequence[str]
    ) -> Iterator[Any]:
        """The photo under each light, as dicts of arrays."""
        people, behind = self.composed, None
        if not isinstance(background, str):
            pixels = np.array(background)[None, None] if isinstance(background, tuple) else background
            behind = covering(linear_pixels("background", pixels).detach().numpy(), *people.size_px)
        else:
            one_of(Literal["photo", "none"], "background", background)
        if straight := isinstance(background, str) and background == "none":
            people = replace(people, background="none")
        for (one,) in people.relit_images(lambda part: stacked(lights[part]), [1] * len(lights)):
            arrays = people.rendered(RenderRequest(one, layers=layers, background=behind))
            image = torch.from_numpy(arrays.pop("rgb"))
            if straight:
                image = torch.cat([image, torch.from_numpy(people.matte)[..., None]], -1)
            found = {"person.A": people.matte, **arrays} if layers else arrays
            yield {"image": image, **found}


def _lights_of(light: Any, room: float) -> list[Light]:
    return [as_light(one, room) for one in (light if isinstance(light, Sequence) else [light])]


def _check_layers(layers: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError for what is no list of known layers."""
    if isinstance(layers, str) or not set(layers) <= set(known):
        raise ValueError(f"layers is {layers!r}, not a list of some of {', '.join(dict.fromkeys(known))}")


def _refuse_gradients(lights: Sequence[Light], people: Sequence[Person]) -> None:
    """Raise UsageError where a gradient through an image in the photo is wanted."""
    taken = [array for one in lights for array in (one.directions, one.weights, one.own_rgb)]
    for person in people:
        taken.append(person.face.texture)
        networks: Any = person.models.networks  # each is loaded already
        taken += networks.reflectance.parameters() if isinstance(person.field, Field) else []
        taken += networks.portrait.parameters() if isinstance(person.reflectance, PortraitField) else []
    if torch.is_grad_enabled() and any(isinstance(one, Tensor) and one.requires_grad for one in taken):
        raise UsageError(
            "gradients: do not go through images in the photo; give alone=True, weigh the images of olat, or "
            "use torch.no_grad()"
        )


def _gradients(*given: Any) -> torch.set_grad_enabled:
    """Gradients where tensors are given."""
    return torch.set_grad_enabled(torch.is_grad_enabled() and any(isinstance(one, Tensor) for one in given))


def _rotation(pose: Pose) -> Tensor:
    """The head_to_camera rotation [3, 3] of a pose in degrees, to which gradients flow."""
    each = pose if isinstance(pose, Sequence | Tensor | np.ndarray) else [pose]
    angles = torch.stack([torch.as_tensor(angle, dtype=torch.float64).cpu() for angle in each])
    if angles.shape != (3,) or not angles.isfinite().all():
        raise ValueError(f"pose is {pose}, not yaw, pitch and roll in degrees")
    return pose_to_rotation(*angles)
