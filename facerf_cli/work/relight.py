"""One item of `facerf relight`: read, find, fit, light, relight, write."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.recipe import recipe_of
from facerf_cli.batch.run import Outcome
from facerf_cli.errors import InputError
from facerf_cli.face.view import photo_camera
from facerf_cli.files.image_metadata import attributes_of_sum, plate_metadata
from facerf_cli.files.outputs import OutputImage, write_output
from facerf_cli.files.read import LinearImage, read_image
from facerf_cli.files.texts import file_sha256
from facerf_cli.image.colour import most_exposure_ev
from facerf_cli.image.strips import Empty, Rows, Scaled, SumOf, covering
from facerf_cli.light.envmap import Backdrop
from facerf_cli.light.light import Light, intensity_of
from facerf_cli.light.over_rig import (
    LightsOf,
    as_lit,
    lights_over_rig,
    lights_over_stack,
    off_rig_deg,
    read_map,
    with_ambient,
)
from facerf_cli.light.setups import LightSetup, image_path
from facerf_cli.person import Person, Target, fit
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.relighting.memory import beside, beside_people, canvas, require_face, require_people
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.relightable import Relightable, RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, json_line, step
from facerf_cli.run.memory import batches
from facerf_cli.work.photos import (
    FittedFace,
    PhotoFace,
    companion,
    face_model,
    facts_of,
    find_people,
    fit_facts,
    fitted_face,
    load_models_once,
    naming,
    person_matte,
    provenance,
    read_matte,
    read_normals,
    read_photo,
    rotation_of,
)
from facerf_cli.work.relight_options import BackgroundChoice, RelightPlan

_OFF_RIG_DEG = 1.0  # angle from a stack's nearest light above which an interpolated light is logged
log = logging.getLogger(LOGGER_NAME)
_digest_once = lru_cache(maxsize=256)(file_sha256)
Behind = Callable[[LightSetup, float], Rows | None]  # the background image, for a setup and an exposure


def relight_item(plan: RelightPlan, item: Item) -> Outcome:
    """Relight a photo or an OLAT stack under every setup, and write the images."""
    written: dict[Path, dict[str, float]] = {}
    people: list[dict[str, Any]] = []
    facts: Mapping[str, Any] = {}
    plan = replace(plan, setups=plan.setups_of(item))
    shared_ev = _shared_exposures(item, plan)
    plan = with_background(plan, item)
    for scene in _scenes_of(item, plan):
        with beside_people(len(scene.faces), scene.subject.size_px):
            written |= _write_images(item, scene, plan, shared_ev)
        people[:0] = [face.described() for face in scene.people]
        facts = facts_of(people, plan.photo) if people else scene.facts
    outputs = [path.with_suffix(suffix) for path in written for suffix in plan.options.output.suffixes]
    names = dict.fromkeys(name for values in written.values() for name in values)
    each = {name: {path.stem: values[name] for path, values in written.items()} for name in names}
    return Outcome(outputs, {**facts, **each})


@dataclass(frozen=True, eq=False)
class Scene:
    """The subject of an image (people in a photo, only a face, or an OLAT stack), its lights and background.

    Attributes:
        people: The people of a photo, from left to right.
        faces: Numbers of their faces, counted from the left, nearest first.
        uniforms: Per face, the intensity of uniform light that makes skin as bright as in the photo.
        tag: Suffix of the photo's name in the images' names.
        plate: Metadata of the photo that images keep.
        identity: Returns the distance of an exposed image from the photo.
        facts: Facts about a stack's fit, for the report.
    """

    subject: Relightable
    setups: tuple[LightSetup, ...]
    lights_of: LightsOf
    metadata: Mapping[str, Any]
    people: Sequence[FittedFace] = ()
    faces: tuple[int, ...] = (0,)
    uniforms: tuple[float, ...] = (1.0,)
    tag: str = ""
    alpha: np.ndarray | None = None
    behind: Behind | None = None
    plate: Mapping[str, Any] = field(default_factory=dict)
    identity: Callable[[np.ndarray], float] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def lights(self) -> list[Light]:
        """The lights of all setups, in the order of `as_lit`, for each person."""
        people = zip(self.faces, self.uniforms, strict=True)
        return [self.lights_of(as_lit(self.setups, *person)) for person in people]

    @property
    def sums(self) -> list[int]:
        """Number of sums of lights per setup: all lights, then each named light."""
        return [1 + (len(with_ambient(setup).names) if setup.names else 0) for setup in self.setups]

    def relit(self) -> Iterable[list[Any]]:
        """Return the subject under each setup, and under each of its named lights.

        If everything fits in memory at once, it is kept; otherwise every call predicts it again.
        """
        return self._kept or self._relit()

    @cached_property
    @step("render")
    def _kept(self) -> list[list[Any]]:
        return list(self._relit()) if len(self.subject.parts(self.sums)) == 1 else []

    def _relit(self) -> Iterator[list[Any]]:
        def lights_of(part: slice) -> Any:
            each = [lights.some(part) for lights in self.lights]
            return each if isinstance(self.subject, PeopleInPhoto) else each[0]

        return self.subject.relit_images(lights_of, self.sums)


def _scenes_of(item: Item, plan: RelightPlan) -> Iterator[Scene]:
    """Yield one scene with all chosen people of a photo, a scene per face, last face first, or a stack."""
    if item.input_path.suffix.lower() == ".exr":
        from facerf_cli.files.olat_stack import is_olat_stack

        if is_olat_stack(item.input_path):
            _check_faces(item, [0], plan)
            yield _scene_of_stack(item, plan)
            return
    _over_rig(plan)(as_lit(plan.setups, 0))  # reads the maps before the photo, to hold one at a time
    read = _read(item, plan)
    _check_faces(item, [face.number for face in read.faces], plan)
    if plan.options.composite == "photo":
        with naming(item.input_path):
            require_people(len(read.faces), read.image.pixels.shape[:2])
        yield _scene_in_photo(item, plan, read)
        return
    for face in reversed(read.faces):
        yield _scene_of_face(item, plan, read, face)


class _Read(NamedTuple):
    """A photo, its faces from left to right, and the user's matte and normals."""

    image: LinearImage
    faces: Sequence[PhotoFace]
    matte: np.ndarray | None
    normals: np.ndarray | None
    in_shot: bool


def _read(item: Item, plan: RelightPlan) -> _Read:
    """Read a photo and find its faces; the face of a shot's frame is fitted already."""
    faces: Sequence[PhotoFace]
    if place := _in_shot(item, plan):
        shot, frame = place
        image, fitted = shot.fitted(frame, plan.options.reflectance == "portrait")
        faces, matte = [fitted], fitted.matte
    else:
        image = read_photo(item, plan.photo)
        matte = person_matte(item, image.pixels, plan.photo)
        faces = find_people(item, image, plan.photo, matte)
    normals = read_normals(item, plan.options.normals_from, image.pixels.shape[:2])
    return _Read(image, faces, matte, normals, in_shot=place is not None)


def _over_rig(plan: RelightPlan) -> LightsOf:
    return partial(lights_over_rig, rig=plan.options.rig, sampling=plan.sampling)


def _scene_in_photo(item: Item, plan: RelightPlan, read: _Read) -> Scene:
    photo, alpha, options = read.image.pixels, read.image.alpha, plan.options
    keeps_photo, part = options.background.kind == "photo", None
    if options.matte is not None:
        part = read_matte(item, options.matte, photo.shape[:2], in_shot=read.in_shot)
    target = Target(
        matte=part,
        alpha=None if keeps_photo else alpha,
        background=options.background.kind if options.background.kind in ("photo", "none") else "given",
    )
    fitted = [_fitted(plan, read, face) for face in read.faces]
    people = [face for face, _ in fitted]
    fitted.sort(key=lambda pair: -pair[0].fit.crop.side_px)  # nearest first
    with naming(item.input_path):
        for face, person in fitted:
            require_face(person.models.face, face.fit, photo.shape[:2])
    nearest, identity = fitted[0][0], None
    if options.identity:
        from facerf_cli.face.descriptor import distances_from

        identity = distances_from(photo, nearest.fit.crop.to_photo(nearest.head.landmarks_px))
    camera = photo_camera(nearest.fit.crop, *photo.shape[:2])
    return Scene(
        subject=PeopleInPhoto([person.in_photo(target) for _, person in fitted], target.background),
        setups=plan.setups,
        lights_of=_over_rig(plan),
        metadata=_metadata(item, plan),
        people=people,
        faces=tuple(face.number for face, _ in fitted),
        uniforms=tuple(person.uniform_intensity for _, person in fitted),
        alpha=alpha if keeps_photo else None,
        behind=_backdrop(options.background, options.background_blur, camera),
        plate=plate_metadata(read.image.metadata),
        identity=identity,
    )


def _scene_of_face(item: Item, plan: RelightPlan, read: _Read, face: PhotoFace) -> Scene:
    """Return only a face, in the photo's pose or in that of `--pose`."""
    fitted, person = _fitted(plan, read, face)
    rotation = rotation_of(plan.options.pose)
    posed = None if rotation is None else replace(fitted.fit, rotation=rotation)
    with naming(item.input_path):
        require_face(person.models.face, posed or fitted.fit, read.image.pixels.shape[:2])
    return Scene(
        subject=person.face_alone(posed),
        setups=plan.setups,
        lights_of=_over_rig(plan),
        metadata=_metadata(item, plan),
        people=[fitted],
        faces=(fitted.number,),
        uniforms=(person.uniform_intensity,),
        tag=fitted.tag,
        plate=plate_metadata(read.image.metadata),
    )


def _scene_of_stack(item: Item, plan: RelightPlan) -> Scene:
    """Open a stack; raise InputError for options that need the photo, and for a stack of UV textures."""
    from facerf_cli.files.olat_stack import read_olat_header
    from facerf_cli.relighting.stack import StackImages, face_in_stack

    path, options = item.input_path, plan.options
    lights = [light for setup in plan.setups for light in setup.lights]
    needs_photo = {
        "--pose": options.pose is not None,
        "--background": options.background.kind not in ("photo", "none"),
        "--reflectance": options.reflectance not in ("field", "portrait"),
        "--white-balance": options.white_balance != "keep",
        "--network-alone": options.network_alone,
        "--normals-from": options.normals_from is not None,
        "--person": plan.photo.person is not None,
        "--light original": any(light.original for light in lights),
        "--light delight": any(light.delight for light in lights),
        "--light at=": any(light.at_m is not None for light in lights),
    }
    if used := [option for option, is_used in needs_photo.items() if is_used]:
        raise InputError(
            f"{path}: {used[0]} needs the photo, not its stack; pass the photo, or remove {used[0]}"
        )
    header = read_olat_header(path)
    if header.kind == "texture":
        raise InputError(
            f"{path}: a stack of UV textures cannot be relit; pass the photo, or predict with --frame photo"
        )
    directions = torch.from_numpy(header.directions).float()
    if (off_deg := off_rig_deg(plan.setups, directions)) > _OFF_RIG_DEG:
        log.warning(
            "%s: no light there (the nearest is %.1f degrees away); interpolating the three around it. Pass "
            "the photo for other lights",
            path,
            off_deg,
        )
    face, facts = None, dict[str, Any]()
    if header.kind == "photo":
        face_fit, face = face_in_stack(path, header, face_model(plan.photo))
        facts = fit_facts(face_fit)
    return Scene(
        subject=StackImages(header, path, face),
        setups=plan.setups
        if plan.has_ambient
        else tuple(replace(setup, ambient=0.0) for setup in plan.setups),
        lights_of=partial(lights_over_stack, directions=directions, sampling=plan.sampling),
        metadata=attributes_of_sum(header.metadata, path.name, item.key),
        facts=facts,
    )


def _fitted(plan: RelightPlan, read: _Read, face: PhotoFace) -> tuple[FittedFace, Person]:
    options = plan.options
    of_shot = face if isinstance(face, FittedFace) else None
    with naming(face.name):
        person = fit(
            load_models_once(plan.photo),
            read.image.pixels,
            geometry=plan.photo.geometry,
            reflectance=options.reflectance,
            network_alone=options.network_alone,
            matte=read.matte,
            texture_side=plan.photo.texture_side,
            white_balance=options.white_balance,
            face=face.found,
            head=of_shot.head if of_shot else None,
            steady=of_shot.steady if of_shot else None,
            normals=read.normals,
        )
    if of_shot:
        return of_shot, person
    fitted = fitted_face(face, person.head, read.matte)
    if person.balance is not None and person.balance.is_strongly_coloured and options.white_balance == "keep":
        log.info("%s: its light is strongly coloured (--white-balance neutral removes its colour)", face.name)
    fitted.see(person.segmentation)
    return fitted, person


def _metadata(item: Item, plan: RelightPlan) -> dict[str, str | int]:
    network = "diffuse_sh" if plan.options.reflectance == "diffuse-sh" else "reflectance"
    metadata = provenance(item, plan.photo, load_models_once(plan.photo).checkpoint_name(network))
    if plan.options.reflectance != "portrait":
        metadata["facerf:reflectance"] = plan.options.reflectance
    if plan.options.network_alone:
        metadata["facerf:network_alone"] = 1
    return metadata


def _shared_exposures(item: Item, plan: RelightPlan) -> dict[str, float] | None:
    """Return the exposures of the middle frame of an item's take; None for a photo, and for that frame."""
    if not (place := _in_shot(item, plan)):
        return None
    shot, number = place
    leader = shot.shot.frames[shot.take_of(number).middle]
    if leader == item:
        return None
    known = plan.exposures.setdefault(leader.output_base, {})
    if not {setup.name for setup in plan.setups} <= set(known):
        if isinstance(rule := plan.exposure_rule, float):
            return dict.fromkeys((setup.name for setup in plan.setups), rule)
        scene = next(_scenes_of(leader, with_background(plan, leader)))
        known |= _exposures_ev(scene, plan)
    return known


def _in_shot(item: Item, plan: RelightPlan) -> Any:
    """Return the open shot of an item and its frame number; None for a photo."""
    if not plan.shots.all:
        return None
    from facerf_cli.work.sequence import open_at

    return open_at(plan.shots, item, plan.photo, plan.options.white_balance)


def _write_images(
    item: Item, scene: Scene, plan: RelightPlan, shared_ev: Mapping[str, float] | None
) -> dict[Path, dict[str, float]]:
    """Write the image of every setup; one prediction serves as many images as fit in memory.

    If not all fit, finding the exposures needs a second prediction. Returns the EXR's path of each image, and
    its exposure and identity distance for the report.
    """
    exposures_ev = shared_ev or _exposures_ev(scene, plan)
    written: dict[Path, dict[str, float]] = {}
    images = iter(scene.relit())  # `zip` would hold one image's maps while the next are made
    for setup in scene.setups:
        relit, *each = next(images)
        _require_finite(item, setup, relit)
        path, ev = image_path(setup, item, scene.tag, ".exr", plan.options.name), exposures_ev[setup.name]
        with canvas(path, scene.subject.size_px, len(plan.options.output.formats)) as empty:
            image = _rendered(scene, setup, relit, each, ev, plan, empty)
            image = replace(image, header={**scene.plate, **_made_by(setup, plan)})
            metadata = {**scene.metadata, "facerf:exposure_ev": ev}
            write_output(path, image, ev, plan.options.output, metadata)
            written[path] = {"exposure_ev": ev}
            if scene.identity is not None:
                written[path]["identity_distance"] = scene.identity(image.pixels * np.float32(2.0**ev))
            del image
        ambient = f", with {100 * setup.ambient:g} % ambient fill (--ambient)" if setup.ambient else ""
        if not shared_ev:
            name = setup.name + setup.frame
            log.info("%s under %s: exposure %+.2f EV%s", item.input_path, name, ev, ambient)
        del relit, each  # frees the maps before the next are made
    return written


def _made_by(setup: LightSetup, plan: RelightPlan) -> dict[str, str]:
    """Return an image's lights, options and networks as JSON for its header, with digests of files."""
    served = load_models_once(plan.photo).networks.served()
    networks = {name: {**file, "file": Path(file["file"]).name} for name, file in served.items()}
    lights = json_line(recipe_of(setup, _digest_once))
    options = json_line(recipe_of(plan, _digest_once))
    return {"facerf:lights": lights, "facerf:options": options, "facerf:networks": json_line(networks)}


@step("render")
def _rendered(
    scene: Scene,
    setup: LightSetup,
    relit: Any,
    each: Sequence[Any],
    ev: float,
    plan: RelightPlan,
    empty: Empty,
) -> OutputImage:
    """Render the image of a setup, its layers and those of its named lights, into arrays from `empty`.

    The soft view keeps the look of photographed pixels and of the user's background. If the photo's original
    light is used, the view bends only what other lights add.
    """
    subject, lit = scene.subject, with_ambient(setup)
    behind, wrap = scene.behind(setup, ev) if scene.behind else None, None
    if behind is not None and plan.options.light_wrap:
        from facerf_cli.image.light_wrap import LightWrap

        wrap = LightWrap(behind, subject.matte, plan.options.light_wrap)
    parts = batches(len(lit.names), subject.nbytes)
    arrays: dict[str, np.ndarray] = {}
    for part in parts or [slice(0)]:
        lights = dict(zip(lit.names[part], each[part], strict=True))
        request = RenderRequest(None if arrays else relit, lights, plan.options.aov, ev, behind, wrap)
        arrays |= subject.rendered(request, empty)
    pixels, alpha = arrays.pop("rgb"), subject.alpha(behind)
    matte = subject.person_matte
    layers = arrays if matte is None else {"person.A": matte, **arrays}
    keeps = alpha is None and plan.options.background.kind != "envmap"
    added = None
    if setup.has_original:
        lights_by_name = zip(lit.names, lit.lights, strict=True)
        others = [layers[name] for name, light in lights_by_name if not light.original]
        others += [layers["wrap"]] if wrap is not None else []
        added = SumOf(others, subject.size_px[1], alpha)
    return OutputImage(
        pixels, scene.alpha if alpha is None else alpha, layers, matte if keeps else None, added
    )


def _require_finite(item: Item, setup: LightSetup, relit: Any) -> None:
    for person in relit if isinstance(relit, Sequence) else [relit]:
        if not all(tensor.isfinite().all() for tensor in person.tensors):
            raise InputError(
                f"{item.input_path}: NaN or infinite values under {setup.name}; check the photo, its "
                "landmarks and the light"
            )


def _exposures_ev(scene: Scene, plan: RelightPlan) -> dict[str, float]:
    """Return exposures by the name of the setup; frames of a rotated map share one, to avoid flicker."""
    if isinstance(rule := plan.exposure_rule, float):
        return dict.fromkeys((setup.name for setup in plan.setups), rule)
    exposures: dict[str, float] = {}
    strengths, first = scene.lights[0].strengths(), 0
    images = iter(scene.relit())
    for setup in scene.setups:
        relit, *each = next(images)
        ev = setup.exposure_ev
        if ev is None:
            most_ev = most_exposure_ev(rule, strengths[first])
            ev = round(min(scene.subject.exposure_ev(relit, rule), most_ev), 2)
        exposures[setup.name] = min(ev, exposures.get(setup.name, ev))
        first += 1 + len(each)
        del relit, each  # frees the maps before the next are made
    return exposures


def with_background(plan: RelightPlan, item: Item) -> RelightPlan:
    """Choose an item's image of `--background`, by its frame number in its shot or by its name."""
    choice = plan.options.background
    path = choice.path and companion(item, choice.path, "--background")
    if choice.frames:
        path = choice.frames[plan.shots.places[item.output_base][1]]
    return replace(plan, options=replace(plan.options, background=replace(choice, path=path, frames=())))


def _backdrop(choice: BackgroundChoice, blur: float, camera: Camera) -> Behind:
    """Return a function: the background image [H, W, 3], scene-linear, or None for the photo or nothing.

    A file or a colour keeps its look at the exposure, in EV. A map is as bright as its light. Single lights
    have a black background.
    """
    fixed, size_px = None, (camera.height_px, camera.width_px)
    if choice.colour is not None:
        fixed = np.broadcast_to(np.array(choice.colour, np.float32), (*size_px, 3))
    elif choice.path is not None:
        with beside(size_px, images=3):
            fixed = covering(read_image(choice.path, with_alpha=False).pixels, *size_px)

    def behind(setup: LightSetup, ev: float) -> Rows | None:
        if choice.kind != "envmap":
            return None if fixed is None else Scaled(fixed, np.float32(2.0**-ev))
        if (light := setup.envmap) is None or light.envmap is None:
            return np.broadcast_to(np.float32(0), (*size_px, 3))
        with beside(size_px, images=2):
            envmap = read_map(light.envmap)
        rays, colour = partial(rays_of_rows, camera), intensity_of(light).numpy()
        return Scaled(Backdrop(envmap, size_px, rays, light.rotate_deg, blur), colour)

    return behind


def _check_faces(item: Item, relit: Sequence[int], plan: RelightPlan) -> None:
    """Raise InputError if a light is for a face that is not relit."""
    if others := plan.lit_faces.difference(relit):
        numbers = ", ".join(map(str, relit))
        raise InputError(
            f"{item.input_path}: a light is for face {min(others)}, but only face {numbers} is relit; "
            "add --face all, or remove that light"
        )
