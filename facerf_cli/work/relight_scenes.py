"""The scenes of `facerf relight`: people of a photo, or an OLAT stack, and what is behind them."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.face.descriptor import face_descriptor
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.landmarks import display_ev
from facerf_cli.face.view import photo_camera
from facerf_cli.files.image_metadata import plate_metadata
from facerf_cli.files.olat_stack import StackHeader, is_olat_stack, read_olat_header
from facerf_cli.files.read import LinearImage, read_image
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.image.strips import Rows, Scaled, covering
from facerf_cli.light.envmap import Backdrop
from facerf_cli.light.studio_points import Lights, intensity_of
from facerf_cli.person import Person, Target, person_of
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.relighting.face_alone import FaceAlone
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.relightable import Relightable
from facerf_cli.run.logs import LOGGER_NAME, attributes_of_sum
from facerf_cli.work.light_setups import LightSetup
from facerf_cli.work.lights import (
    as_in_photo,
    each_alone,
    lights_over_rig,
    lights_over_stack,
    off_rig_deg,
    on_face,
    read_map,
    with_room,
)
from facerf_cli.work.photos import (
    FittedFace,
    companion,
    face_model,
    fit_each,
    fit_facts,
    load_models_once,
    naming,
    provenance,
    read_matte,
    read_photo,
    rotation_of,
)
from facerf_cli.work.plan import (
    KEPT_PX,
    beside_person,
    beside_stack,
    prediction_bytes,
    require_face,
)
from facerf_cli.work.relight_options import BackgroundChoice, Relight
from facerf_cli.work.sequence import open_at
from facerf_cli.work.stack_composers import (
    StackImages,
    StackTextures,
    face_in_stack,
    head_in_stack,
)

log = logging.getLogger(LOGGER_NAME)
_OFF_RIG_DEG = 1.0  # from which on a light that a stack lacks is named

Behind = Callable[[LightSetup, float], Rows | None]  # the image behind a person, for a setup and an exposure


def _backdrop(work: Relight, camera: Camera) -> Behind:
    """Images [H, W, 3] behind a person, scene-linear; None for the photo's own, or for nothing.

    A file and a colour look as they are at the exposure, in EV. A map is as bright as its light; single
    lights have a black surrounding.
    """
    fixed, size_px = _fixed(work.background, camera), (camera.height_px, camera.width_px)

    def behind(setup: LightSetup, ev: float) -> Rows | None:
        if work.background.kind != "envmap":
            return None if fixed is None else Scaled(fixed, np.float32(2.0**-ev))
        if (light := setup.envmap) is None or light.envmap is None:
            return np.broadcast_to(np.float32(0), (*size_px, 3))
        with beside_person(size_px):
            envmap = read_map(light.envmap)
        rays, colour = partial(rays_of_rows, camera), intensity_of(light).numpy()
        around = Backdrop(envmap, size_px, rays, light.rotate_deg, work.background_blur)
        return Scaled(around, colour)

    return behind


def _fixed(choice: BackgroundChoice, camera: Camera) -> np.ndarray | None:
    height, width = camera.height_px, camera.width_px
    if choice.colour is not None:
        return np.broadcast_to(np.array(choice.colour, np.float32), (height, width, 3))
    if choice.path is None:
        return None
    with beside_person((height, width), images=1):
        return covering(read_image(choice.path, with_alpha=False).pixels, height, width)


@dataclass(frozen=True, eq=False)
class LitScene:
    """People of a photo in one image, a face alone, or a stack; the lights of setups, and what is behind.

    Attributes:
        subject: What is relit.
        setups: The lights of each image.
        lights_of: Gives setups as sums of far and near lights.
        metadata: Of all images.
        people: Of a photo, from left to right.
        faces: Their numbers, from the left, the nearest first.
        evens: Brightness of even light on each.
        tag: What follows the photo's name in those of its images.
        alpha: The photo's [H, W].
        behind: Gives the image behind the person.
        plate: Metadata of the photo that results keep.
        identity: Distance of an exposed image to the photo.
        facts: Of a stack's fit, for the report.
    """

    subject: Relightable
    setups: tuple[LightSetup, ...]
    lights_of: Callable[[tuple[LightSetup, ...]], Lights]
    metadata: Mapping[str, Any]
    people: Sequence[FittedFace] = ()
    faces: tuple[int, ...] = (0,)
    evens: tuple[float, ...] = (1.0,)
    tag: str = ""
    alpha: np.ndarray | None = None
    behind: Behind | None = None
    plate: Mapping[str, Any] = field(default_factory=dict)
    identity: Callable[[np.ndarray], float] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def lights(self) -> list[Lights]:
        """The lights of all setups on each of the people."""
        return [self.lights_of(one) for one in self._as_lit(self.setups)]

    def relit(self, part: slice) -> list[Any]:
        """The people under some of the setups."""
        return list(self._relit([lights[part] for lights in self.lights]))

    def relit_by_each(self, setup: LightSetup, part: slice) -> Iterator[Any]:
        """The people under some of the lights of a setup, each alone."""
        lit = self._as_lit((setup,))
        return self._relit([self.lights_of(each_alone(one)[part]) for (one,) in lit])

    def _as_lit(self, setups: tuple[LightSetup, ...]) -> list[tuple[LightSetup, ...]]:
        """Setups as they shine on each of the people."""
        return [_as_lit(setups, *one) for one in zip(self.faces, self.evens, strict=True)]

    def _relit(self, lights: Sequence[Lights]) -> Iterator[Any]:
        return self.subject.relit(lights if isinstance(self.subject, PeopleInPhoto) else lights[0])


def _as_lit(setups: Sequence[LightSetup], face: int, even: float = 1.0) -> tuple[LightSetup, ...]:
    """Setups as they shine on one of the people, with the light of their rooms."""
    return tuple(with_room(as_in_photo(on_face(setup, face), even)) for setup in setups)


def scenes_of(item: Item, work: Relight, together: bool) -> Iterator[LitScene]:
    """All chosen people of a photo in one image, or each face alone, the last first; or a stack."""
    if is_olat_stack(item.input_path):
        yield _scene_of_stack(item, work)
        return
    lights_of = partial(lights_over_rig, rig=work.rig, sampling=work.sampling)
    lights_of(_as_lit(work.setups, 0))  # maps are read before the photo, not beside it
    image, faces = _image_and_faces(item, work)
    for number, people in enumerate([list(faces)[::-1]] if together else ([face] for face in faces)):
        if not number:
            _check_faces(item, people[-1].number, work)
        by_size = sorted(people, key=lambda face: -face.fit.crop.side_px)
        targets = [_target(item, face, image, work) for face in by_size]
        fitted = [_fitted(item, image, face, work) for face in by_size]
        scene = LitScene(
            setups=work.setups,
            lights_of=lights_of,
            metadata=_metadata(item, work),
            people=people,
            faces=tuple(face.number for face in by_size),
            evens=tuple(person.even_brightness for person in fitted),
            plate=plate_metadata(image.metadata),
            subject=_subject(fitted, targets),
        )
        if work.composite == "face":
            yield replace(scene, tag=people[0].tag)
            continue
        yield replace(
            scene,
            alpha=image.alpha if work.background.kind == "photo" else None,
            behind=_backdrop(work, photo_camera(by_size[0].fit.crop, *image.pixels.shape[:2])),
            identity=_identity_of(image.pixels, by_size[0]) if work.identity else None,
        )


def _subject(people: Sequence[Person], targets: Sequence[Target]) -> Relightable:
    """People in their photo, or the face of the first alone."""
    if targets[0].composite == "face":
        return people[0].composed(targets[0])
    each = [person.in_photo(target) for person, target in zip(people, targets, strict=True)]
    return PeopleInPhoto(each, targets[0].background)


def _image_and_faces(item: Item, work: Relight) -> tuple[LinearImage, Iterator[FittedFace]]:
    """The image of an item and its faces, the last first, as they are fitted.

    Those of a frame of a shot are steadied by the frames around it.
    """
    if place := open_at(work.shots, item, work.photo, work.white):
        shot, number = place
        image, face = shot.fitted(number, work.reflectance == "portrait")
        return image, iter([face])
    image = read_photo(item, work.photo)
    return image, fit_each(item, image, work.photo, together=work.composite == "photo")


def _check_faces(item: Item, last: int, work: Relight) -> None:
    """Raise InputError where a light is for a face whose number is beyond the last one's."""
    most = max((light.face or 0 for setup in work.setups for light in setup.lights), default=0)
    if most > last:
        raise InputError(
            f"{item.input_path}: a light is for face {most}, and the last is {last}; add --face all"
        )


def _identity_of(photo: np.ndarray, face: FittedFace) -> Callable[[np.ndarray], float]:
    """The distance of an image [H, W, 3] from its photo by descriptors, both at the photo's landmarks."""
    landmarks_px = face.fit.crop.to_photo(face.head.landmarks_px)

    def descriptor(shown: np.ndarray) -> np.ndarray:
        return face_descriptor(linear_to_srgb(shown.clip(0, 1)), landmarks_px)

    own = descriptor(photo * np.float32(2.0 ** display_ev(photo)))
    return lambda shown: round(float(np.linalg.norm(descriptor(shown) - own)), 3)


def _fitted(item: Item, image: LinearImage, face: FittedFace, work: Relight) -> Person:
    """A person, fitted and with its reflectance read."""
    models, photo = load_models_once(work.photo), image.pixels
    kind, alone = work.reflectance, work.network_alone
    with naming(item.input_path):
        require_face(models.face, _posed(face, work), photo.shape[:2])
        person = person_of(
            models, photo, face.head, kind, alone, face.matte, work.white, face.steady, prediction_bytes()
        )
        if (
            person.balance is not None
            and person.balance.is_far
            and work.white == "photo"
            and face.steady is None
        ):
            log.info("%s: its light is far from white; --white scene takes the colour out", face.name)
        if work.composite == "photo" and face.matte is None:
            face.see(person.segmentation)
        return person


def _posed(face: FittedFace, work: Relight) -> FaceFit:
    """The head in the pose of `--pose`."""
    rotation = rotation_of(work.pose)
    return face.fit if rotation is None else replace(face.fit, rotation=rotation)


def _target(item: Item, face: FittedFace, image: LinearImage, work: Relight) -> Target:
    """The pose and surroundings that the options choose."""
    if work.composite != "photo":
        return Target(None if work.pose is None else _posed(face, work), "face")
    size_px, in_shot = image.pixels.shape[:2], face.steady is not None
    matte = None if work.matte is None else read_matte(item, work.matte, size_px, in_shot)
    kind = work.background.kind
    alpha = None if kind == "photo" else image.alpha
    return Target(None, "photo", matte, alpha, kind if kind in ("photo", "none") else "given")


def _metadata(item: Item, work: Relight) -> dict[str, str | int]:
    network = "diffuse_sh" if work.reflectance == "diffuse-sh" else "reflectance"
    metadata = provenance(item, work.photo, load_models_once(work.photo).checkpoint_name(network))
    if work.reflectance != "portrait":
        metadata["facerf:reflectance"] = work.reflectance
    if work.network_alone:
        metadata["facerf:network_alone"] = 1
    return metadata


def _scene_of_stack(item: Item, work: Relight) -> LitScene:
    """A stack under its own lights."""
    _check_stack(item, work)
    _check_faces(item, 0, work)
    header = read_olat_header(item.input_path)
    own = torch.from_numpy(header.directions).float()
    if (off_deg := off_rig_deg(work.setups, own)) > _OFF_RIG_DEG:
        said = (
            "%s: lacks a light (its nearest is %.1f degrees off): mixed of those around it; or give the photo"
        )
        log.warning(said, item.input_path, off_deg)
    lights_of = partial(lights_over_stack, directions=own, sampling=work.sampling)
    subject: Relightable
    behind = None
    if header.kind == "photo":
        subject, behind, facts = _person_of_stack(item, header, work)
    elif work.photo_of_stack is not None:
        raise InputError(f"{item.input_path}: not in its photo's frame; predict it with --frame photo")
    elif header.kind == "image":
        subject, facts = StackImages(header, item.input_path), {}
    else:
        subject, facts = _face_of_stack(item, header, work)
    lit = work.setups if work.asked_for_room else tuple(replace(setup, room=0.0) for setup in work.setups)
    metadata = attributes_of_sum(header.metadata, item.input_path.name)
    return LitScene(subject, lit, lights_of, metadata, behind=behind, facts=facts)


def _check_stack(item: Item, work: Relight) -> None:
    """Raise InputError for what only a photo can have."""
    wrong = ""
    if work.pose is not None or work.asked_for_photo:
        wrong = "a stack holds one pose of a face without its photo; give the photo"
    elif work.reflectance not in ("field", "portrait"):
        wrong = f"a stack holds the field; for {work.reflectance} give its photo"
    elif work.white != "photo":
        wrong = "a stack holds the white with which it was predicted; give its photo"
    elif work.network_alone:
        wrong = "a stack holds the field as predicted; give its photo"
    elif work.photo.has_given_person:
        wrong = "a stack holds its person's matte; give its photo"
    elif work.photo_of_stack is None and any(setup.has_own for setup in work.setups):
        wrong = "the photo's own light (own) needs its photo; give that with --photo"
    elif any(light.even for setup in work.setups for light in setup.by_photo):
        wrong = "even light (even) has the brightness of a photo; give that, or from=around"
    elif any(light.at_m is not None for setup in work.setups for light in setup.lights):
        wrong = "a stack holds far lights; for near ones (at=) give its photo"
    if wrong:
        raise InputError(f"{item.input_path}: {wrong}")


def _person_of_stack(
    item: Item, header: StackHeader, work: Relight
) -> tuple[StackImages, Behind | None, dict[str, Any]]:
    """The images of a stack of a photo's person, on its photo if that is given, and facts of its fit."""
    fit, face = face_in_stack(item, header, face_model(work.photo))
    size_px, stack = header.seen.shape, StackImages(header, item.input_path, face)
    if work.photo_of_stack is None:
        return stack, None, fit_facts(fit)
    path = companion(item, work.photo_of_stack, "--photo")
    with beside_stack(size_px):
        photo = read_image(path, work.photo.colourspace, kept_px=KEPT_PX, layer=work.photo.layer).pixels
    scale = photo.shape[0] / size_px[0]
    if abs(photo.shape[1] - scale * size_px[1]) > max(2.0, scale):
        raise InputError(f"{path}: not the photo of {item.input_path}, whose sides have another ratio")
    camera = photo_camera(fit.crop.of_scaled(scale), *photo.shape[:2])
    on_photo = replace(stack, photo=photo, keeps_background=work.background.kind == "photo")
    return on_photo, _backdrop(work, camera), fit_facts(fit)


def _face_of_stack(item: Item, header: StackHeader, work: Relight) -> tuple[FaceAlone, dict[str, Any]]:
    """The face of a stack of textures in the frame of its crop, and facts of its fit."""
    head = head_in_stack(item, header)
    model, textures = face_model(work.photo), StackTextures(item.input_path)
    return FaceAlone(model, head, textures), fit_facts(head.fit)
