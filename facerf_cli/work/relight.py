"""One item of `facerf relight`: read, its people fitted, relit by every setup, exposed, written."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import recipe_of
from facerf_cli.batch.run import Outcome
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import display_ev
from facerf_cli.face.view import photo_camera
from facerf_cli.files.image_metadata import plate_metadata
from facerf_cli.files.texts import file_sha256
from facerf_cli.image.colour import linear_to_srgb, most_exposure_ev
from facerf_cli.image.light_wrap import LightWrap
from facerf_cli.image.strips import Empty, rows_of
from facerf_cli.person import Group, Person, Target, fit
from facerf_cli.relighting.people_in_photo import Background
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, json_line, step
from facerf_cli.run.memory import batches
from facerf_cli.work.light_setups import LightSetup
from facerf_cli.work.lights import lights_over_rig, with_room
from facerf_cli.work.outputs import OutputImage, write_output
from facerf_cli.work.photos import (
    FittedFace,
    PhotoFace,
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
from facerf_cli.work.plan import beside_people, canvas, require_face, require_people
from facerf_cli.work.relight_options import RelightOptions, RelightPlan
from facerf_cli.work.relight_scenes import LitScene, as_lit, backdrop, check_faces, with_background

log = logging.getLogger(LOGGER_NAME)
_digest_once = lru_cache(maxsize=256)(file_sha256)


def relight_item(plan: RelightPlan, item: Item) -> Outcome:
    """Relight a photo or a stack under every setup."""
    written: dict[Path, dict[str, float]] = {}
    people: list[dict[str, Any]] = []
    facts: Mapping[str, Any] = {}
    plan = replace(plan, setups=plan.setups_of(item))
    shared_ev = _shared_exposures(item, plan)
    plan = with_background(plan, item)
    for scene in scenes_of(item, plan, together=plan.options.composite == "photo"):
        with beside_people(len(scene.faces), scene.subject.size_px):
            written |= _write_setups(item, scene, plan, shared_ev)
        people[:0] = [face.described() for face in scene.people]
        facts = facts_of(people, plan.photo) if people else scene.facts
    outputs = [path.with_suffix(suffix) for path in written for suffix in plan.options.output.suffixes]
    names = dict.fromkeys(name for one in written.values() for name in one)
    each = {name: {path.stem: one[name] for path, one in written.items()} for name in names}
    return Outcome(outputs, {**facts, **each})


def scenes_of(item: Item, plan: RelightPlan, together: bool) -> Iterator[LitScene]:
    """All chosen people of a photo in one image, or each face alone, the last first; or a stack."""
    if item.input_path.suffix.lower() == ".exr":
        from facerf_cli.files.olat_stack import is_olat_stack

        if is_olat_stack(item.input_path):
            from facerf_cli.work.stack_composers import scene_of_stack

            yield scene_of_stack(item, plan)
            return
    options, rotation = plan.options, rotation_of(plan.options.pose)
    lights_of = partial(lights_over_rig, rig=options.rig, sampling=plan.sampling)
    lights_of(as_lit(plan.setups, 0))  # maps are read before the photo, not beside it
    in_photo = options.composite == "photo"
    faces: Sequence[PhotoFace]
    if place := _in_shot(item, plan):
        shot, frame = place
        image, face = shot.fitted(frame, options.reflectance == "portrait")
        faces, matte = [face], face.matte
    else:
        image = read_photo(item, plan.photo)
        matte = person_matte(item, image.pixels, plan.photo)
        faces = find_people(item, image, plan.photo, matte)
    photo, background = image.pixels, options.background.kind
    normals = read_normals(item, options.normals_from, photo.shape[:2])
    check_faces(item, [face.number for face in faces], plan)
    target = Target(composite="face")
    if in_photo:
        shown = None
        if options.matte is not None:
            shown = read_matte(item, options.matte, photo.shape[:2], in_shot=place is not None)
        behind: Background = background if background in ("photo", "none") else "given"
        target = Target(matte=shown, alpha=None if behind == "photo" else image.alpha, background=behind)
        with naming(item.input_path):
            require_people(len(faces), photo.shape[:2])
    for some in [faces] if together else ([face] for face in reversed(faces)):
        fitted: list[tuple[FittedFace, Person]] = []
        for face in some:
            known = face if isinstance(face, FittedFace) else None  # of a frame of a shot
            with naming(face.name):
                person = fit(
                    load_models_once(plan.photo),
                    photo,
                    geometry=plan.photo.geometry,
                    reflectance=options.reflectance,
                    network_alone=options.network_alone,
                    matte=matte,
                    texture_side=plan.photo.texture_side,
                    white=options.white,
                    face=face.found,
                    head=known.head if known else None,
                    steady=known.steady if known else None,
                    normals=normals,
                )
            fitted.append((_described(face, person, matte, options), person))
        people = [face for face, _ in fitted]
        fitted.sort(key=lambda one: -one[0].fit.crop.side_px)  # the nearest first
        persons = [person for _, person in fitted]
        subject = persons[0] if len(persons) == 1 else Group(persons)
        if rotation is not None:
            target = replace(target, fit=replace(people[0].fit, rotation=rotation))
        with naming(item.input_path):
            for face, person in fitted:
                require_face(person.models.face, target.fit or face.fit, photo.shape[:2])
        scene = LitScene(
            setups=plan.setups,
            lights_of=lights_of,
            metadata=_metadata(item, plan),
            people=people,
            faces=tuple(face.number for face, _ in fitted),
            evens=tuple(person.even_brightness for person in persons),
            plate=plate_metadata(image.metadata),
            subject=subject.composed(target),
        )
        if not in_photo:
            yield replace(scene, tag=people[0].tag)
            continue
        nearest = fitted[0][0]
        camera = photo_camera(nearest.fit.crop, *photo.shape[:2])
        yield replace(
            scene,
            alpha=image.alpha if background == "photo" else None,
            behind=backdrop(options.background, options.background_blur, camera),
            identity=_identity_of(photo, nearest) if options.identity else None,
        )


def _described(
    face: PhotoFace, person: Person, matte: np.ndarray | None, options: RelightOptions
) -> FittedFace:
    """The face of a person, with what is known of its fit and its matte."""
    if isinstance(face, FittedFace):
        return face
    found = fitted_face(face, person.head, matte)
    if person.balance is not None and person.balance.is_far and options.white == "photo":
        log.info("%s: its light has a strong colour (--white scene takes it out)", face.name)
    found.see(person.segmentation)
    return found


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
        scene = next(scenes_of(leader, with_background(plan, leader), together=True))
        known |= _exposures_ev(scene, scene.relit, plan)
    return known


def _in_shot(item: Item, plan: RelightPlan) -> Any:
    """The open shot of an item and its number there; None for a photo alone."""
    if not plan.shots.all:
        return None
    from facerf_cli.work.sequence import open_at

    return open_at(plan.shots, item, plan.photo, plan.options.white)


def _write_setups(
    item: Item,
    scene: LitScene,
    plan: RelightPlan,
    shared_ev: Mapping[str, float] | None,
) -> dict[Path, dict[str, float]]:
    """Write the image of every setup, as many at a time as fit the memory; one prediction serves those.

    Where they do not fit at once, an exposure that is to be found needs a second prediction. Returns the EXR
    of each image, and facts of it for the report: the exposure of the PNG in its place, the identity.
    """
    parts = scene.parts
    whole = scene.relit(parts[0]) if len(parts) == 1 else None

    def relit_by(part: slice) -> list[list[Any]]:
        return scene.relit(part) if whole is None else whole

    exposures_ev = shared_ev or _exposures_ev(scene, relit_by, plan)
    written: dict[Path, dict[str, float]] = {}
    for part in parts:
        for setup, (relit, *each) in zip(scene.setups[part], relit_by(part), strict=True):
            _require_finite(item, setup, relit)
            path, ev = setup.output(item, scene.tag, ".exr", plan.options.name), exposures_ev[setup.name]
            with canvas(path, scene.subject.size_px, len(plan.options.output.formats)) as empty:
                image = _rendered(scene, setup, relit, each, ev, plan, empty)
                image = replace(image, header={**scene.plate, **_made_by(setup, plan)})
                write_output(
                    path, image, ev, plan.options.output, {**scene.metadata, "facerf:exposure_ev": ev}
                )
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
    scene: LitScene,
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


def _exposures_ev(
    scene: LitScene, relit_by: Callable[[slice], list[list[Any]]], plan: RelightPlan
) -> dict[str, float]:
    """Exposure by the name of the setup: one for all frames of a map, so that a rotation does not flicker."""
    if isinstance(rule := plan.exposure_rule, float):
        return dict.fromkeys((setup.name for setup in plan.setups), rule)
    found: dict[str, float] = {}
    strengths = scene.lights[0].strengths()
    for part in scene.parts:
        at = scene.ends[:-1][part]
        for setup, first, (relit, *_) in zip(scene.setups[part], at, relit_by(part), strict=True):
            chosen_ev = setup.exposure_ev
            if chosen_ev is None:
                most_ev = most_exposure_ev(rule, strengths[first])
                chosen_ev = round(min(scene.subject.exposure_ev(relit, rule), most_ev), 2)
            found[setup.name] = min(chosen_ev, found.get(setup.name, chosen_ev))
            del relit  # a view of one holds all of its part, beside the next
    return found
