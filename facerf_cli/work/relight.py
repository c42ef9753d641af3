"""One photo, or one OLAT stack, under every light setup: relit, exposed, before a background, and written."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item
from facerf_cli.cli.backgrounds import BackgroundChoice
from facerf_cli.cli.lights import LightSetup
from facerf_cli.cli.relight_work import Relight
from facerf_cli.cli.shots import shot_of
from facerf_cli.errors import InputError
from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.files.images import LinearImage, read_image
from facerf_cli.files.olat_stack import StackHeader, is_olat_stack, read_olat_header, stream_olats
from facerf_cli.image.colour import ExposureRule, most_exposure_ev
from facerf_cli.image.strips import Band, Layer, filled
from facerf_cli.light.envmap import backdrop
from facerf_cli.pipeline import composition_of, reflectance_of, relit_by
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.relighting.composition import Composition, GroupComposition, Relit, Target
from facerf_cli.relighting.field import weighted_sum
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, attributes_of_sum
from facerf_cli.work.lights import (
    near_lights_of,
    read_map,
    strengths,
    weights_of_far_lights,
    weights_over_rig,
    weights_over_stack,
)
from facerf_cli.work.outputs import OutputImage, canvas, write_output
from facerf_cli.work.photos import (
    FittedFace,
    companion,
    face_model,
    facts_of,
    fit_faces,
    fit_facts,
    load_models_once,
    provenance,
    read_matte,
    read_photo,
    rotation_of,
)
from facerf_cli.work.sequence import seen_frame, view_of
from facerf_cli.work.stacks import PersonStack, RenderedStack

_IMAGE_PX = 12  # bytes of a pixel of an image
_HELD = 4  # relit textures are held this many times while lights are added to them
_STACK_BYTES = 130  # of a pixel of a stack, beside its photo
_KEPT_PX = 12  # bytes of a pixel beside that photo: an image computed once for several formats
log = logging.getLogger(LOGGER_NAME)
_of_leaders: dict[tuple[Item, Relight], dict[str, float]] = {}  # found in this process, by setup

Written = dict[Path, float]  # the EXR of each image, and the exposure of the PNG in its place


class Backdrops:
    """Draws the chosen background for a photo's camera; what setups share is drawn once."""

    def __init__(self, choice: BackgroundChoice, blur: float, camera: Camera) -> None:
        self._choice, self._blur, self._camera = choice, blur, camera
        self._fixed = _fixed(choice, camera)

    def behind(self, setup: LightSetup, ev: float) -> Band | None:
        """The image behind a person under a setup, scene-linear; None for the photo's own, or for nothing.

        A file and a colour look as they are at an exposure of `ev`. A map is as bright as its light; single
        lights have a black surrounding.
        """
        fixed, gain = self._fixed, np.float32(2.0**-ev)
        if self._choice.kind != "envmap":
            return None if fixed is None else lambda rows: fixed[rows] * gain
        if setup.envmap is None:
            width_px = self._camera.width_px
            return lambda rows: np.zeros((rows.stop - rows.start, width_px, 3), np.float32)
        with memory.beside(_photo_bytes(self._camera)):
            envmap = read_map(setup.envmap)
        size = self._camera.height_px, self._camera.width_px
        return backdrop(envmap, size, partial(rays_of_rows, self._camera), setup.rotate_deg, self._blur)


def _photo_bytes(camera: Camera) -> int:
    """Memory of the photo that is held while a background is read."""
    return _HELD_BYTES * camera.height_px * camera.width_px


def _fixed(choice: BackgroundChoice, camera: Camera) -> np.ndarray | None:
    height, width = camera.height_px, camera.width_px
    if choice.colour is not None:
        return np.broadcast_to(np.array(choice.colour, np.float32), (height, width, 3))
    if choice.path is None:
        return None
    with memory.beside(_photo_bytes(camera) + _COVER_BYTES * height * width):
        return _covering(read_image(choice.path, None).pixels, height, width)


def _covering(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The middle of an image, scaled to cover a frame."""
    scale = max(height / image.shape[0], width / image.shape[1])
    rows, columns = (
        min(side, round(wanted / scale)) for side, wanted in zip(image.shape, (height, width), strict=False)
    )
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    part = torch.from_numpy(image[top : top + rows, left : left + columns]).permute(2, 0, 1)[None]
    shrinks = scale < 1
    sized = F.interpolate(part, (height, width), mode="bilinear", align_corners=False, antialias=shrinks)
    covered: np.ndarray = sized[0].permute(1, 2, 0).numpy()
    return covered


class Composer(Protocol):
    """A composer of images: `Composition`, `GroupComposition`; of stacks `PersonStack`, `RenderedStack`."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the images."""

    def bands(self, relit: Any, ev: float, behind: Band | None) -> dict[str, Layer]:
        """rgb and A of a head as relit, before a background or, where it is kept, the photo's at `ev`."""

    def layers(self, names: Sequence[str], relit: Any) -> dict[str, Layer]:
        """Layers of the image by the names that they have in a file."""

    def light_layer(self, relit: Any) -> Band:
        """The person under one of several lights, over black."""

    def exposure_ev(self, relit: Any, rule: ExposureRule) -> float:
        """The exposure in EV of the person, by a rule."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """A head relit by setups, and its composer."""

    composer: Composer
    relit: Callable[[slice], list[Any]]  # by some of the setups, as the composer takes it
    apart: Callable[[LightSetup], list[Any]]  # by each light of a setup
    bytes_each: int
    alpha: np.ndarray | None = None  # of the photo
    backdrops: Backdrops | None = None


def relight_item(item: Item, work: Relight) -> tuple[Written, dict[str, Any]]:
    """Relight a photo or a stack under every setup; the images written, and facts for the report."""
    return _relight_stack(item, work) if is_olat_stack(item.input_path) else _relight_photo(item, work)


def _relight_photo(item: Item, work: Relight) -> tuple[Written, dict[str, Any]]:
    weights_over_rig(work.setups, work.rig, work.sampling)  # maps are read before the photo, not beside it
    image, faces = _seen(item, work)
    metadata = _metadata(item, work)
    chosen_ev = _shared_exposures(item, work)
    written: Written = {}
    if work.composite == "photo":
        shown = _together(item, image, faces, work)
        return dict(_write_setups(item, "", shown, work, metadata, chosen_ev)), facts_of(faces, work.photo)
    for face in reversed(faces):  # the first one's files mark the photo as finished
        shown = _show_face(item, image, face, work)
        written.update(_write_setups(item, face.tag, shown, work, metadata, chosen_ev))
    return written, facts_of(faces, work.photo)


def _seen(item: Item, work: Relight) -> tuple[LinearImage, list[FittedFace]]:
    """The image of an item and its faces; those of a frame of a shot steadied by the frames around it."""
    if place := shot_of(work.shots, item):
        image, face = seen_frame(*place, work.photo, work.reflectance == "portrait")
        return image, [face]
    image = read_photo(item, work.photo)
    return image, fit_faces(item, image, work.photo)


def _leader_of(item: Item, work: Relight) -> Item | None:
    """The photo whose exposure an item shares; of a shot a frame of its middle."""
    place = shot_of(work.shots, item)
    if place is None:
        return work.leader_of(item)
    return place[0].frames[view_of(*place, work.photo).middle_first[0]]


def _shared_exposures(item: Item, work: Relight) -> dict[str, float] | None:
    """The exposures of an item's group; None where it has none, or is the one that it has them of."""
    leader = _leader_of(item, work)
    if leader is None or leader == item:
        return None
    if (leader, work) not in _of_leaders:  # another process has written it, or an earlier run
        _of_leaders[leader, work] = _exposures_of(leader, work)
    return _of_leaders[leader, work]


def _exposures_of(leader: Item, work: Relight) -> dict[str, float]:
    """Exposures of a photo or stack that others share."""
    if isinstance(work.exposure, float):
        return dict.fromkeys((setup.name for setup in work.setups), work.exposure)
    if is_olat_stack(leader.input_path):
        shown = _show_stack(leader, work)[0]
    else:
        shown = _together(leader, *_seen(leader, work), work)
    return _exposures_ev(_parts(shown, work), shown.relit, shown.composer, work)


def _together(item: Item, image: LinearImage, faces: Sequence[FittedFace], work: Relight) -> _Shown:
    """People of one photo in one image; the nearest first."""
    by_size = sorted(faces, key=lambda face: -face.fit.crop.side_px)
    shown = [_show_face(item, image, face, work) for face in by_size]
    first = shown[0]
    if len(shown) == 1:
        return first

    def relit(rows: slice) -> list[Any]:
        return list(zip(*(one.relit(rows) for one in shown), strict=True))

    def apart(setup: LightSetup) -> list[Any]:
        return list(zip(*(one.apart(setup) for one in shown), strict=True))

    bytes_each = sum(one.bytes_each for one in shown)
    return replace(
        first,
        composer=GroupComposition([cast(Composition, one.composer) for one in shown]),
        relit=relit,
        apart=apart,
        bytes_each=bytes_each,
    )


def _metadata(item: Item, work: Relight) -> dict[str, str | int]:
    network = "diffuse_sh" if work.reflectance == "diffuse-sh" else "reflectance"
    metadata = provenance(item, work.photo, load_models_once(work.photo).checkpoint_name(network))
    if work.reflectance != "portrait":
        metadata["facerf:reflectance"] = work.reflectance
    if work.network_alone:
        metadata["facerf:network_alone"] = 1
    return metadata


def _show_face(item: Item, image: LinearImage, face: FittedFace, work: Relight) -> _Shown:
    models, head = load_models_once(work.photo), face.head
    target = _target(item, face, image, work)
    try:
        reflectance = reflectance_of(
            models,
            head,
            work.reflectance,
            work.network_alone,
            memory.limit_bytes(),
            image.pixels,
            face.steady,
        )
        composition = composition_of(models, image.pixels, head, reflectance, target)
    except InputError as error:
        raise InputError(f"{item.input_path}: {error}") from None
    directions, weights = weights_over_rig(work.setups, work.rig, work.sampling)

    def relit(rows: slice) -> list[Relit]:
        near = near_lights_of(work.setups[rows])
        return list(relit_by(composition, head, reflectance, directions, weights[rows], target, near))

    def apart(setup: LightSetup) -> list[Relit]:
        each = _each_light(setup)
        far, near = weights_of_far_lights(each), near_lights_of(each)
        return list(relit_by(composition, head, reflectance, *far, target, near))

    whole = work.composite == "photo"
    alpha = image.alpha if whole and work.background.kind == "photo" else None
    bytes_each = head.face.texture.nbytes + (composition.surround.nbytes if composition.surround else 0)
    camera = photo_camera(head.fit.crop, *image.pixels.shape[:2])
    backdrops = Backdrops(work.background, work.background_blur, camera) if whole else None
    return _Shown(composition, relit, apart, bytes_each, alpha, backdrops)


def _each_light(setup: LightSetup) -> tuple[LightSetup, ...]:
    """A setup for each light of a setup alone."""
    return tuple(replace(setup, lights=(light,)) for light in setup.lights)


def _target(item: Item, face: FittedFace, image: LinearImage, work: Relight) -> Target:
    """The head in the pose of `--pose`, composed as the options choose."""
    rotation = rotation_of(work.pose)
    posed = None if rotation is None else replace(face.fit, rotation=rotation)
    if work.composite != "photo":
        return Target(posed, work.composite)
    matte = None if work.matte is None else read_matte(item, work.matte, image.pixels.shape[:2])
    if matte is None and face.steady is not None:
        matte = face.steady.segmentation.matte
    kind = work.background.kind
    alpha = None if kind == "photo" else image.alpha
    return Target(posed, work.composite, matte, alpha, kind if kind in ("photo", "none") else "given")


def _relight_stack(item: Item, work: Relight) -> tuple[Written, dict[str, Any]]:
    shown, metadata, facts = _show_stack(item, work)
    return dict(_write_setups(item, "", shown, work, metadata, _shared_exposures(item, work))), facts


def _show_stack(item: Item, work: Relight) -> tuple[_Shown, dict[str, Any], dict[str, Any]]:
    """A stack relit by setups, the metadata of its images, and facts for the report."""
    if work.pose is not None or work.asked_for_photo:
        raise InputError(
            f"{item.input_path}: a stack holds one pose of a face without its photo; give the photo"
        )
    if work.reflectance not in ("field", "portrait"):
        raise InputError(f"{item.input_path}: a stack holds the field; for {work.reflectance} give its photo")
    if work.network_alone:
        raise InputError(f"{item.input_path}: a stack holds the field as predicted; give its photo")
    if near_lights_of(work.setups) is not None:
        raise InputError(f"{item.input_path}: a stack holds far lights; for near ones (at=) give its photo")
    header = read_olat_header(item.input_path)
    directions = torch.from_numpy(header.directions).float()
    weights = weights_over_stack(work.setups, directions, work.sampling)
    composer: Composer
    backdrops: Backdrops | None = None
    if header.kind == "photo":
        composer, backdrops, facts = _person_composer(item, header, work)
    elif work.photo_of_stack is not None:
        raise InputError(f"{item.input_path}: not in its photo's frame; predict it with --frame photo")
    else:
        composer, facts = _stack_composer(item, header, work)

    def summed(weights: torch.Tensor) -> list[Relit]:
        return list(map(Relit, weighted_sum(stream_olats(item.input_path), weights)))

    def relit(rows: slice) -> list[Relit]:
        return summed(weights[rows])

    def apart(setup: LightSetup) -> list[Relit]:
        return summed(weights_over_stack(_each_light(setup), directions, work.sampling))

    metadata = attributes_of_sum(header.metadata, item.input_path.name)
    bytes_each = 12 * header.seen.size

    return _Shown(composer, relit, apart, bytes_each, backdrops=backdrops), dict(metadata), facts


def _person_composer(
    item: Item, header: StackHeader, work: Relight
) -> tuple[PersonStack, Backdrops | None, dict[str, Any]]:
    """The composer of a stack of a photo's person, on its photo if that is given, and facts of its fit."""
    try:
        fit = fit_from_arrays(header.fit)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{item.input_path}: the fit in it cannot be used: {error}") from None
    size_px = header.seen.shape
    vertices = fit.vertices_camera(face_model(work.photo))
    view = view_face(vertices, photo_camera(fit.crop, *size_px), fit.crop.side_px)
    face = view.full(view.mask)
    if work.photo_of_stack is None:
        return PersonStack(header, face), None, fit_facts(fit)
    path = companion(item, work.photo_of_stack, sorted(PHOTO_SUFFIXES), "--photo")
    with memory.beside(_STACK_BYTES * header.seen.size):
        photo = read_image(path, work.photo.colourspace, kept_px=_KEPT_PX).pixels
    scale = photo.shape[0] / size_px[0]
    if abs(photo.shape[1] - scale * size_px[1]) > max(2.0, scale):
        raise InputError(f"{path}: not the photo of {item.input_path}, whose sides have another ratio")
    camera = photo_camera(fit.crop.of_scaled(scale), *photo.shape[:2])
    backdrops = Backdrops(work.background, work.background_blur, camera)
    return PersonStack(header, face, photo, work.background.kind == "photo"), backdrops, fit_facts(fit)


def _stack_composer(item: Item, header: StackHeader, work: Relight) -> tuple[Composer, dict[str, Any]]:
    """The composer of a stack's images in the frame of its crop, and facts of its fit."""
    if header.kind == "image":
        return RenderedStack(header.seen, header.normals), {}
    try:
        if header.layout_version != LAYOUT_VERSION:
            raise ValueError("it has another UV layout")
        fit = fit_from_arrays(header.fit)
        posed = replace(fit, rotation=torch.from_numpy(header.rotation).float())
        texture, normals = (torch.from_numpy(x).permute(2, 0, 1) for x in (header.source, header.normals))
        head = Head(header.source, posed, FaceTexture(texture, torch.from_numpy(header.seen), normals))
        composition = Composition(face_model(work.photo), None, head, Target(composite="face"))
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{item.input_path}: the fit in it cannot be used: {error}") from None
    return composition, fit_facts(fit)


def _write_setups(
    item: Item,
    tag: str,
    shown: _Shown,
    work: Relight,
    metadata: Mapping[str, Any],
    chosen_ev: Mapping[str, float] | None = None,
) -> Iterator[tuple[Path, float]]:
    """Write the image of every setup, as many at a time as fit the memory; one prediction serves those.

    Where they do not fit at once, an exposure that is to be found needs a second prediction.
    """
    parts = _parts(shown, work)
    whole = shown.relit(parts[0]) if len(parts) == 1 else None

    def relit_by_part(part: slice) -> list[Any]:
        return shown.relit(part) if whole is None else whole

    exposures_ev = chosen_ev or _exposures_ev(parts, relit_by_part, shown.composer, work)
    if _leader_of(item, work) == item:
        _of_leaders[item, work] = dict(exposures_ev)
    for part in parts:
        for setup, relit in zip(work.setups[part], relit_by_part(part), strict=True):
            _require_finite(item, setup, relit)
            path, ev = setup.output(item, tag, ".exr", work.name), exposures_ev[setup.name]
            behind = shown.backdrops.behind(setup, ev) if shown.backdrops else None
            with canvas(path, _held_bytes(shown.composer, work)) as empty:
                image = _rendered(shown, setup, relit, ev, behind, work, empty)
                write_output(path, image, ev, work.output, {**metadata, "facerf:exposure_ev": ev})
                del image
            if work.output.shown_suffix and not chosen_ev:
                log.info("%s under %s: exposure %+.2f EV", item.input_path, setup.name + setup.frame, ev)
            yield path, ev
            del relit, behind  # a view of one holds all of its part, beside the next


def _held_bytes(composer: Composer, work: Relight) -> int:
    """Bytes beside the layers of an image; a writer of each format may hold as much as an image."""
    return len(work.output.formats) * _IMAGE_PX * math.prod(composer.size_px)


def _rendered(
    shown: _Shown,
    setup: LightSetup,
    relit: Any,
    ev: float,
    behind: Band | None,
    work: Relight,
    empty: Callable[[str, tuple[int, ...]], np.ndarray],
) -> OutputImage:
    """The image of a setup, with its layers, as arrays that `empty` makes.

    A soft view leaves what was photographed, and a given background, as it looks.
    """
    composer = shown.composer
    arrays = filled(composer.bands(relit, ev, behind), *composer.size_px, empty)
    layers = filled(composer.layers(work.aov, relit), *composer.size_px, empty)
    keeps = "A" not in arrays and work.background.kind != "envmap"
    share = layers.get("person.A") if keeps else None
    layers |= _light_layers(shown, setup, empty)
    return OutputImage(arrays["rgb"], arrays.get("A", shown.alpha), layers, share)


def _require_finite(item: Item, setup: LightSetup, relit: Any) -> None:
    """Raise InputError, before anything is written, where a light gives values that are no numbers."""
    for one in relit if isinstance(relit, Sequence) else [relit]:
        tensors = [one.texture] if one.surround is None else [one.texture, one.surround]
        if not all(tensor.isfinite().all() for tensor in tensors):
            raise InputError(
                f"{item.input_path}: relit by {setup.name} it has values that are NaN or infinite; check the "
                "photo, its landmarks and the light"
            )


def _parts(shown: _Shown, work: Relight) -> list[slice]:
    """Setups, as many at a time as fit the memory."""
    at_once = _at_once(shown)
    return [slice(first, first + at_once) for first in range(0, len(work.setups), at_once)]


def _at_once(shown: _Shown) -> int:
    """Sums of lights that fit the memory."""
    return max(1, memory.limit_bytes() // (_HELD * shown.bytes_each))


def _light_layers(
    shown: _Shown, setup: LightSetup, empty: Callable[[str, tuple[int, ...]], np.ndarray]
) -> dict[str, np.ndarray]:
    """The person under each named light of a setup [H, W, 3]; lights are relit as many as fit the memory."""
    layers: dict[str, np.ndarray] = {}
    at_once, composer = _at_once(shown), shown.composer
    for first in range(0, len(setup.names), at_once):
        some = slice(first, first + at_once)
        relit = shown.apart(replace(setup, lights=setup.lights[some]))
        for name, one in zip(setup.names[some], relit, strict=True):
            layers |= filled({name: composer.light_layer(one)}, *composer.size_px, empty)
        del relit, one  # before others are relit
    return layers


def _exposures_ev(
    parts: Iterable[slice], relit_by_part: Callable[[slice], list[Any]], composer: Composer, work: Relight
) -> dict[str, float]:
    """Exposure by the name of the setup: one for all frames of a map, so that a rotation does not flicker."""
    if isinstance(work.exposure, float):
        return dict.fromkeys((setup.name for setup in work.setups), work.exposure)
    found: dict[str, float] = {}
    lights = strengths(work.setups, work.rig, work.sampling)
    for part in parts:
        for setup, light, relit in zip(work.setups[part], lights[part], relit_by_part(part), strict=True):
            most_ev = most_exposure_ev(work.exposure, light)
            chosen_ev = round(min(composer.exposure_ev(relit, work.exposure), most_ev), 2)
            found[setup.name] = min(chosen_ev, found.get(setup.name, chosen_ev))
            del relit  # a view of one holds all of its part, beside the next
    return found


_HELD_BYTES = 24  # of a pixel of the photo: it, its matte and the view of its face
_COVER_BYTES = 12  # of a pixel of the frame, which an image covers
