"""One item of `facerf relight`: read, find, fit, light, relight, write."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.recipe import recipe_of
from facerf_cli.batch.run import Outcome
from facerf_cli.errors import InputError
from facerf_cli.face.view import photo_camera
from facerf_cli.files.image_metadata import plate_metadata
from facerf_cli.files.read import LinearImage, read_image
from facerf_cli.files.texts import file_sha256
from facerf_cli.image.colour import display_ev, linear_to_srgb, most_exposure_ev
from facerf_cli.image.light_wrap import LightWrap
from facerf_cli.image.strips import Empty, Rows, Scaled, covering, rows_of
from facerf_cli.light.envmap import Backdrop
from facerf_cli.light.light import Light, intensity_of
from facerf_cli.person import Person, Target, fit
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.relightable import Relightable, RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, json_line, step
from facerf_cli.run.memory import batches
from facerf_cli.work.light_setups import LightSetup
from facerf_cli.work.lights import LightsOf, as_lit, lights_over_rig, read_map, with_room
from facerf_cli.work.outputs import OutputImage, write_output
from facerf_cli.work.photos import (
    FittedFace,
    PhotoFace,
    companion,
    facts_of,
    find_people,
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
from facerf_cli.work.plan import beside, beside_people, canvas, require_face, require_people
from facerf_cli.work.relight_options import BackgroundChoice, RelightPlan

log = logging.getLogger(LOGGER_NAME)
_digest_once = lru_cache(maxsize=256)(file_sha256)
Behind = Callable[[LightSetup, float], Rows | None]  # the image behind a person, for a setup and an exposure


def relight_item(plan: RelightPlan, item: Item) -> Outcome:
    """Relight a photo or a stack under every setup."""
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
    names = dict.fromkeys(name for one in written.values() for name in one)
    each = {name: {path.stem: one[name] for path, one in written.items()} for name in names}
    return Outcome(outputs, {**facts, **each})


@dataclass(frozen=True, eq=False)
class Scene:
    """What one image shows: people of a photo, a face alone, or a stack; their lights, and what is behind.

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
    lights_of: LightsOf
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
    def lights(self) -> list[Light]:
        """The lights of all setups, as `as_lit` lists them, on each of the people."""
        people = zip(self.faces, self.evens, strict=True)
        return [self.lights_of(as_lit(self.setups, *one)) for one in people]

    @property
    def sums(self) -> list[int]:
        """How many of the lights each setup needs: all together, then each that has a name."""
        return [1 + (len(with_room(setup).names) if setup.names else 0) for setup in self.setups]

    def relit(self) -> Iterable[list[Any]]:
        """The people under each setup, and under each of its lights that has a name.

        What fits the memory at once is kept; else it is predicted again whenever it is asked for.
        """
        return self._whole or self._relit()

    @cached_property
    @step("render")
    def _whole(self) -> list[list[Any]]:
        return list(self._relit()) if len(self.subject.parts(self.sums)) == 1 else []

    def _relit(self) -> Iterator[list[Any]]:
        def lights_of(part: slice) -> Any:
            each = [of_one.some(part) for of_one in self.lights]
            return each if isinstance(self.subject, PeopleInPhoto) else each[0]

        return self.subject.relit_images(lights_of, self.sums)


def _scenes_of(item: Item, plan: RelightPlan) -> Iterator[Scene]:
    """All chosen people of a photo in one image, or each face alone, the last first; or a stack."""
    if item.input_path.suffix.lower() == ".exr":
        from facerf_cli.files.olat_stack import is_olat_stack

        if is_olat_stack(item.input_path):
            from facerf_cli.work.relight_stack import open_stack

            _check_faces(item, [0], plan)
            setups = plan.setups if plan.has_room else tuple(replace(one, room=0.0) for one in plan.setups)
            yield Scene(setups=setups, **open_stack(item, plan)._asdict())
            return
    _over_rig(plan)(as_lit(plan.setups, 0))  # maps are read before the photo, not beside it
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
    """A photo, the faces found in it from left to right, and what is given for it: matte and normals."""

    image: LinearImage
    faces: Sequence[PhotoFace]
    matte: np.ndarray | None
    normals: np.ndarray | None
    in_shot: bool


def _read(item: Item, plan: RelightPlan) -> _Read:
    """Read a photo and find its faces; a frame of a shot has one, which is fitted already."""
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
    """The people of a photo in one image."""
    photo, alpha, options = read.image.pixels, read.image.alpha, plan.options
    keeps_photo, shown = options.background.kind == "photo", None
    if options.matte is not None:
        shown = read_matte(item, options.matte, photo.shape[:2], in_shot=read.in_shot)
    target = Target(
        matte=shown,
        alpha=None if keeps_photo else alpha,
        background=options.background.kind if options.background.kind in ("photo", "none") else "given",
    )
    fitted = [_fitted(plan, read, face) for face in read.faces]
    people = [face for face, _ in fitted]
    fitted.sort(key=lambda one: -one[0].fit.crop.side_px)  # the nearest first
    with naming(item.input_path):
        for face, person in fitted:
            require_face(person.models.face, face.fit, photo.shape[:2])
    nearest = fitted[0][0]
    camera = photo_camera(nearest.fit.crop, *photo.shape[:2])
    return Scene(
        subject=PeopleInPhoto([person.in_photo(target) for _, person in fitted], target.background),
        setups=plan.setups,
        lights_of=_over_rig(plan),
        metadata=_metadata(item, plan),
        people=people,
        faces=tuple(face.number for face, _ in fitted),
        evens=tuple(person.uniform_intensity for _, person in fitted),
        alpha=alpha if keeps_photo else None,
        behind=_backdrop(options.background, options.background_blur, camera),
        plate=plate_metadata(read.image.metadata),
        identity=_identity_of(photo, nearest) if options.identity else None,
    )


def _scene_of_face(item: Item, plan: RelightPlan, read: _Read, face: PhotoFace) -> Scene:
    """One face alone, in the photo's pose or in that of `--pose`."""
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
        evens=(person.uniform_intensity,),
        tag=fitted.tag,
        plate=plate_metadata(read.image.metadata),
    )


def _fitted(plan: RelightPlan, read: _Read, face: PhotoFace) -> tuple[FittedFace, Person]:
    """The person of a face, with what is known of its fit and its matte."""
    options = plan.options
    known = face if isinstance(face, FittedFace) else None  # of a frame of a shot
    with naming(face.name):
        person = fit(
            load_models_once(plan.photo),
            read.image.pixels,
            geometry=plan.photo.geometry,
            reflectance=options.reflectance,
            network_alone=options.network_alone,
            matte=read.matte,
            texture_side=plan.photo.texture_side,
            white=options.white,
            face=face.found,
            head=known.head if known else None,
            steady=known.steady if known else None,
            normals=read.normals,
        )
    if known:
        return known, person
    found = fitted_face(face, person.head, read.matte)
    if person.balance is not None and person.balance.is_strongly_coloured and options.white == "photo":
        log.info("%s: its light has a strong colour (--white scene takes it out)", face.name)
    found.see(person.segmentation)
    return found, person


def _identity_of(photo: np.ndarray, face: FittedFace) -> Callable[[np.ndarray], float]:
    """The distance of an image [H, W, 3] from its photo by descriptors, both at the photo's landmarks."""
    from facerf_cli.face.descriptor import face_descriptor

    landmarks_px = face.fit.crop.to_photo(face.head.landmarks_px)

    def descriptor(shown: np.ndarray) -> np.ndarray:
        return face_descriptor(linear_to_srgb(shown.clip(0, 1)), landmarks_px)

    own = descriptor(photo * np.float32(2.0 ** display_ev(photo)))
    return lambda shown: round(float(np.linalg.norm(descriptor(shown) - own)), 3)


def _metadata(item: Item, plan: RelightPlan) -> dict[str, str | int]:
    network = "diffuse_sh" if plan.options.reflectance == "diffuse-sh" else "reflectance"
    metadata = provenance(item, plan.photo, load_models_once(plan.photo).checkpoint_name(network))
    if plan.options.reflectance != "portrait":
        metadata["facerf:reflectance"] = plan.options.reflectance
    if plan.options.network_alone:
        metadata["facerf:network_alone"] = 1
    return metadata


def _shared_exposures(item: Item, plan: RelightPlan) -> dict[str, float] | None:
    """Return the exposures of the middle frame of an item's take; None for a photo and that frame itself."""
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
    """The open shot of an item and its number there; None for a photo alone."""
    if not plan.shots.all:
        return None
    from facerf_cli.work.sequence import open_at

    return open_at(plan.shots, item, plan.photo, plan.options.white)


def _write_images(
    item: Item,
    scene: Scene,
    plan: RelightPlan,
    shared_ev: Mapping[str, float] | None,
) -> dict[Path, dict[str, float]]:
    """Write the image of every setup, as many at a time as fit the memory; one prediction serves those.

    Where they do not fit at once, an exposure that is to be found needs a second prediction. Returns the EXR
    of each image, and facts of it for the report: the exposure of the PNG in its place, the identity.
    """
    exposures_ev = shared_ev or _exposures_ev(scene, plan)
    written: dict[Path, dict[str, float]] = {}
    images = iter(scene.relit())  # `zip` would hold one image's beside the next
    for setup in scene.setups:
        relit, *each = next(images)
        _require_finite(item, setup, relit)
        path, ev = setup.output(item, scene.tag, ".exr", plan.options.name), exposures_ev[setup.name]
        with canvas(path, scene.subject.size_px, len(plan.options.output.formats)) as empty:
            image = _rendered(scene, setup, relit, each, ev, plan, empty)
            image = replace(image, header={**scene.plate, **_made_by(setup, plan)})
            metadata = {**scene.metadata, "facerf:exposure_ev": ev}
            write_output(path, image, ev, plan.options.output, metadata)
            written[path] = {"exposure_ev": ev}
            if scene.identity is not None:
                written[path]["identity_distance"] = scene.identity(image.pixels * np.float32(2.0**ev))
            del image
        said = [f"exposed by {ev:+.2f} EV"]
        if setup.room:
            said.append(f"with {100 * setup.room:g} % of the light bounced by the room (--room)")
        if not shared_ev:
            log.info("%s under %s: %s", item.input_path, setup.name + setup.frame, ", ".join(said))
        del relit, each  # of all of its part, beside the next
    return written


def _made_by(setup: LightSetup, plan: RelightPlan) -> dict[str, str]:
    """The lights, the options and the networks of an image, as JSON for its header; files by digests."""
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
    """The image of a setup, with its layers and those of its named lights, as arrays that `empty` makes.

    A soft view leaves what was photographed, and a given background, as it looks; in the photo's own light it
    bends what other lights add.
    """
    subject, lit = scene.subject, with_room(setup)
    behind, wrap = scene.behind(setup, ev) if scene.behind else None, None
    if behind is not None and plan.options.light_wrap:
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
    if setup.has_own:
        others = [layers[name] for name, light in zip(lit.names, lit.lights, strict=True) if not light.own]
        others += [layers["wrap"]] if wrap is not None else []
        added = SumOf(others, subject.size_px[1], alpha)
    shown_alpha = scene.alpha if alpha is None else alpha
    return OutputImage(pixels, shown_alpha, layers, matte if keeps else None, added)


@dataclass(frozen=True, eq=False)
class SumOf:
    """The sum [H, W, 3] of layers over black, by rows, not multiplied by alpha [H, W]."""

    layers: Sequence[np.ndarray]
    width_px: int
    alpha: np.ndarray | None

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Some rows [h, W, 3]."""
        total = np.zeros((rows.stop - rows.start, self.width_px, 3), np.float32)
        for layer in self.layers:
            total += rows_of(layer, rows)
        return total if self.alpha is None else total / np.maximum(self.alpha[rows], 1e-3)[..., None]


def _require_finite(item: Item, setup: LightSetup, relit: Any) -> None:
    """Raise InputError, before anything is written, where a light gives values that are no numbers."""
    for one in relit if isinstance(relit, Sequence) else [relit]:
        if not all(tensor.isfinite().all() for tensor in one.tensors):
            raise InputError(
                f"{item.input_path}: relit by {setup.name} it has values that are NaN or infinite; check the "
                "photo, its landmarks and the light"
            )


def _exposures_ev(scene: Scene, plan: RelightPlan) -> dict[str, float]:
    """Exposure by the name of the setup: one for all frames of a map, so that a rotation does not flicker."""
    if isinstance(rule := plan.exposure_rule, float):
        return dict.fromkeys((setup.name for setup in plan.setups), rule)
    found: dict[str, float] = {}
    strengths, first = scene.lights[0].strengths(), 0
    images = iter(scene.relit())
    for setup in scene.setups:
        relit, *each = next(images)
        chosen_ev = setup.exposure_ev
        if chosen_ev is None:
            most_ev = most_exposure_ev(rule, strengths[first])
            chosen_ev = round(min(scene.subject.exposure_ev(relit, rule), most_ev), 2)
        found[setup.name] = min(chosen_ev, found.get(setup.name, chosen_ev))
        first += 1 + len(each)
        del relit, each  # of all of its part, beside the next
    return found


def with_background(plan: RelightPlan, item: Item) -> RelightPlan:
    """Choose the image of `--background` that goes with an item: by its place in its shot, or by its name."""
    choice = plan.options.background
    path = choice.path and companion(item, choice.path, "--background")
    if choice.frames:
        path = choice.frames[plan.shots.places[item.output_base][1]]
    return replace(plan, options=replace(plan.options, background=replace(choice, path=path, frames=())))


def _backdrop(choice: BackgroundChoice, blur: float, camera: Camera) -> Behind:
    """Images [H, W, 3] behind a person, scene-linear; None for the photo's own, or for nothing.

    A file and a colour look as they are at the exposure, in EV. A map is as bright as its light; single
    lights have a black surrounding.
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
        around = Backdrop(envmap, size_px, rays, light.rotate_deg, blur)
        return Scaled(around, colour)

    return behind


def _check_faces(item: Item, relit: Sequence[int], plan: RelightPlan) -> None:
    """Raise InputError if a light is for a face that is not among the relit ones, given by their numbers."""
    if others := plan.lit_faces.difference(relit):
        numbers = ", ".join(map(str, relit))
        raise InputError(
            f"{item.input_path}: a light is for face {min(others)}, but only face {numbers} is relit; "
            "add --face all, or remove that light"
        )
