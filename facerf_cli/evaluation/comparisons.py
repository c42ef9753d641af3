"""The comparisons of the paper's tables: images that methods predict of faces, and the truths.

- `compare_olats` (Tables 1 and 3): single lights of held-out people. The source of each pair of a dataset is
  a user's photo: the face is found in it, fitted or regressed, and relit by one light of the target camera's
  stack. The image is the rendered face alone; in the same pose the photo with its face relit by the first
  method, the image of `facerf relight`, has a row of its own.
- `reconstruct` (Table 2, and 4 with the fitted and the mean face): photos explained by a method's reflectance
  and light, and rendered again, the face alone.
- `transfer` (Table 2): two images of one person with their reflectances exchanged, so that a reflectance is
  measured where it was not read.

Two more are in the frame of a dataset's crops, which no checkpoint decides (docs/evaluation.md): `freeze`
makes cases of pairs, and `compare_images` compares folders of images and facerf's own on them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import PurePosixPath

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.evaluation.folders import CaseFiles, read_pixels
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.metrics import light_error_deg, tone_drift_deg
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.evaluation.people import Bench, HeadView, Portrait, common_mask
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.image.colour import luminance
from facerf_cli.light.envmap import rig_to_latlong
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight, azel_to_direction, direction_to_azel
from facerf_cli.person import Target
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import pose_to_rotation, rotation_to_pose
from facerf_cli.relighting.face_alone import FaceAlone
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.relightable import Relit

LAMBERT = "lambert"  # the source's texture under the cosine of the light: the least a method must beat
COMPOSITE = "composite"  # the first method's face back in its photo, with its detail
FULL, MEAN = "all components", "mean face"  # the forms of Table 4
SAME, DIFFERENT = "same pose", "different pose"
LIGHTS_DEG = (0, 30, 60, 90, 180)  # between a light and the camera's axis
TURNS_DEG = (0, 30, 60, 180)  # of the head, from the source's pose to the target's
_NO_TURN_DEG = 0.5
_MAP_ROWS = 64  # of the lat-long map of a light
_LIGHT, _TURN, _PLACE = (
    ("azimuth_deg", "elevation_deg"),
    ("yaw_deg", "pitch_deg", "roll_deg"),
    ("x_m", "y_m", "z_m"),
)
_NEAR_AXIS_DEG = 25.0  # lights that show the skin's colour rather than its shape


@torch.no_grad()
def compare_olats(faces: Sequence[Portrait], bench: Bench) -> Iterator[Comparison]:
    """A source: each method's image under the target's light next to the stack's own, unclipped."""
    (face,) = faces
    methods, (target, light, truth) = bench.methods, target_of(face)
    lights, same = Light.each(light[None]), target is face
    predictions, views = {}, []
    for method in methods:
        view = target.pose_of(face.by(method.models), method.models)
        predictions[method.name] = next(method.images(None, view.head, lights, Target(view.fit)))
        views.append(view)
    first = views[0]
    predictions[LAMBERT] = _lambert(methods[0].models, light, first)
    if same:  # the image of `facerf relight`, cropped as the truth is
        whole = next(methods[0].images(face.photo.pixels, first.head, lights, Target()))
        predictions[COMPOSITE] = first.fit.crop.apply(whole)
    comparison = Comparison(
        replace(face.case, facts={**olat_facts(light, first, same), **face.case.facts}),
        first.fit.crop.apply(truth),
        common_mask(views),
        predictions,
        source=first.head.cropped,
        landmarks_px=target.by(methods[0].models).head.landmarks_px,
        source_face=face.by(methods[0].models).face,
    )
    assert face.origin is not None
    yield _with_drift(comparison, face.origin[0].albedo, first.region("skin"))


def target_of(face: Portrait) -> tuple[Portrait, Tensor, np.ndarray]:
    """The target of a source: the person in its camera, the light [3], and the image [S, S, 3] under it."""
    assert face.origin is not None
    person, pair = face.origin
    light = torch.from_numpy(person.header(pair.target_camera).directions[pair.target_light]).float()
    target = face if pair.source_camera == pair.target_camera else person.lit(pair.target_camera)
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    return target, light, truth.permute(1, 2, 0).numpy()


def _lambert(models: Models, light: Tensor, view: HeadView) -> np.ndarray:
    """The source's texture under the cosine of a light [3], rendered in the target's crop."""
    head = view.head
    turn = head.fit.turn_to(view.fit.rotation)
    cosine = torch.einsum("c,cd,dij->ij", light, turn, head.face.normals).clamp_min(0)
    face = FaceAlone(models.face, head, fit=view.fit)
    return face.image(Relit(head.face.texture * cosine))


def olat_facts(light: Tensor, view: HeadView, same: bool) -> dict[str, str | float]:
    """Facts on the direction of the light and the turn of the head from the source's pose."""
    turn_deg = angle_of(view.head.fit.turn_to(view.fit.rotation))
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "pose": SAME if same else DIFFERENT,
        "angle": angle_class(angle_deg),
        "turn": turn_class(turn_deg),
        "turn_deg": turn_deg,
        "angle_deg": angle_deg,
        "azimuth_deg": float(azimuth_deg),
        "elevation_deg": float(elevation_deg),
    }


def _with_drift(comparison: Comparison, albedo: np.ndarray | None, skin: np.ndarray) -> Comparison:
    """Add the drift of the skin tone (ITA on true albedo) if the light is near the camera's axis."""
    near = float(comparison.case.facts["angle_deg"]) <= _NEAR_AXIS_DEG
    if albedo is None or not near:
        return comparison
    extra = {}
    for name, image in comparison.predictions.items():
        drift = tone_drift_deg(image, comparison.truth, skin * comparison.mask, albedo)
        if drift is not None:
            extra[name] = {"tone_drift_deg": abs(drift), "tone_shift_deg": drift}
    return replace(comparison, extra=extra)


@torch.no_grad()
def reconstruct(faces: Sequence[Portrait], bench: Bench, with_light: bool = True) -> Iterator[Comparison]:
    """A portrait's crop next to each method's reconstruction, where all of them show the face.

    Where the true light is known, each has the error of its brightest direction, `with_light`.
    """
    (face,) = faces
    truth = face.origin[0].light(face.origin[1]) if face.origin and with_light else None
    predictions, views, extra = {}, [], {}
    for method in bench.methods:
        view = face.by(method.models)
        explained = method.explained(view.head)
        light = explained.light
        predictions[method.name] = method.image(view.head, explained.reflectance, light)
        views.append(view)
        if truth is not None:
            estimated = brightest(light.directions.numpy(), light.weights.numpy())
            extra[method.name] = {"light_error_deg": light_error_deg(estimated, brightest(*truth))}
    head = views[0].head
    yield Comparison(
        face.case, head.cropped, common_mask(views), predictions, head.cropped, head.landmarks_px, extra=extra
    )


def brightest(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The direction [3] of the light of the largest luminance, of directions [L, 3] and weights [L, 3]."""
    return np.asarray(directions[luminance(weights).argmax()])


def reconstruct_with_mean(faces: Sequence[Portrait], bench: Bench) -> Iterator[Comparison]:
    """Table 4: each method over the fitted face, then over the mean face; the light has no part in it.

    Both are fitted to the same landmarks, or regressed from the same crop. A row has the name of the form,
    and its method's if there are many.
    """
    forms = [(FULL, method, method.models) for method in bench.methods]
    for method in bench.methods:
        own = bench.mean if bench.mean and method.kind == "field" else method.models
        forms.append((MEAN, method, replace(own, face=own.face.pose_only())))
    several = len(bench.methods) > 1
    methods = [
        replace(method, name=f"{form}, {method.name}" if several else form, models=models)
        for form, method, models in forms
    ]
    return reconstruct(faces, replace(bench, methods=methods), with_light=False)


@torch.no_grad()
def transfer(faces: Sequence[Portrait], bench: Bench) -> Iterator[Comparison]:
    """Both images, each rendered from its own light and the other's reflectance.

    The same method estimates that light with the image's own reflectance.
    """
    methods = bench.methods
    views = [[face.by(method.models) for method in methods] for face in faces]
    explained = [
        [method.explained(view.head) for method, view in zip(methods, of_face, strict=True)]
        for of_face in views
    ]
    for own, other in ((0, 1), (1, 0)):
        predictions = {}
        for number, method in enumerate(methods):
            head, reflectance = views[other][number].head, explained[other][number].reflectance
            light, fit = explained[own][number].light, views[own][number].fit
            predictions[method.name] = method.image(head, reflectance, light, fit)
        first, source = views[own][0].head, views[other][0].head
        turn_deg = angle_of(source.fit.turn_to(first.fit.rotation))
        case = faces[own].case
        name = f"{case.name}_by_{PurePosixPath(faces[other].case.name).name}"
        facts = {**case.facts, "turn": turn_class(turn_deg), "turn_deg": turn_deg}
        yield Comparison(
            replace(case, name=name, facts=facts),
            first.cropped,
            common_mask(views[own]),
            predictions,
            source.cropped,
            first.landmarks_px,
            views[other][0].face,
        )


@torch.no_grad()
def freeze(faces: Sequence[Portrait], bench: Bench) -> Iterator[Comparison]:
    """A pair of a dataset as a case that any method can render: no predictions, all in the dataset's frame.

    Raises NoFaceError where no face is found in the source.
    """
    (face,) = faces
    assert face.origin is not None
    person, pair = face.origin
    find_faces(bench.models.networks.people, face.photo.pixels, face.name)
    target, light, truth = target_of(face)
    view = target.by(bench.models)
    crop = fit_from_arrays(person.header(pair.target_camera).fit).crop
    place = (*rotation_to_pose(view.fit.rotation), *view.fit.translation_m.tolist())
    facts = {
        **olat_facts(light, replace(view, head=face.by(bench.models).head), target is face),
        **person.facts,
        **dict(zip(_TURN + _PLACE, place, strict=True)),
        **{"crop_x0_px": crop.x0_px, "crop_y0_px": crop.y0_px, "crop_side_px": crop.side_px},
    }
    latlong = rig_to_latlong(RigLight(light[None], torch.ones(1, 3)), _MAP_ROWS).numpy()
    case = replace(face.case, facts=facts)
    yield Comparison(case, truth, view.mask, {}, face.photo.pixels, light=latlong)


def compare_images(
    options: EvaluateOptions, bench: Bench, cases: Iterable[CaseFiles]
) -> Iterator[Comparison]:
    """Read the images of each case, and render those of our own methods.

    The mask is the mask's image (its values as they are, the mean of its channels), else the truth's alpha,
    else everything.
    """
    for files in cases:
        truth = read_pixels(files.truth)
        mask = truth.alpha
        if files.mask is not None:
            mask = read_pixels(files.mask, "linear").pixels.mean(-1).clip(0, 1)
        if mask is None:
            mask = np.ones(truth.pixels.shape[:2], np.float32)
        landmarks_px = None
        if options.measures.face_distance:  # InputError where no face is found
            faces = find_faces(bench.models.networks.people, truth.pixels, str(files.truth))
            landmarks_px = faces[0].landmarks_px
        source = None if files.source is None else read_pixels(files.source).pixels
        predictions = rendered(files.case, source, bench) if options.ours else {}
        predictions |= {name: read_pixels(path).pixels for name, path in files.predictions.items()}
        yield Comparison(files.case, truth.pixels, mask, predictions, source, landmarks_px)


@torch.no_grad()
def rendered(case: Case, source: np.ndarray | None, bench: Bench) -> dict[str, np.ndarray]:
    """The image of a case by each of our methods, from its source [S, S, 3].

    In the source's pose it is that of `facerf relight`; in another the face alone, in that pose.
    """
    if source is None or not {*_LIGHT, *_TURN, *_PLACE, "pose"} <= case.facts.keys():
        raise InputError(
            f"{case.name}: has no source, pose and light; give a folder of `facerf evaluate cases`"
        )
    azimuth_deg, elevation_deg, *turn_deg = (float(case.facts[name]) for name in _LIGHT + _TURN)
    lights = Light.each(azel_to_direction(azimuth_deg, elevation_deg)[None])
    frame = Crop(0.0, 0.0, float(source.shape[1]), source.shape[1])
    face = bench.find(source, case.name)
    images = {}
    for method, head in bench.heads(source, face):
        target = Target()
        if case.facts["pose"] != SAME:
            place = torch.tensor([float(case.facts[name]) for name in _PLACE])
            fit = replace(head.fit, rotation=pose_to_rotation(*turn_deg), translation_m=place, crop=frame)
            target = Target(fit)
        images[method.name] = next(method.images(source, head, lights, target))
    return images


def angle_of(rotation: Tensor) -> float:
    """The angle in degrees of a rotation [3, 3]."""
    return float((((rotation.trace() - 1) / 2).clamp(-1, 1).acos()).rad2deg())


def angle_class(angle_deg: float) -> str:
    """'0 to 30 deg' and so on, of the angle between a light and the camera's axis."""
    return _class(angle_deg, LIGHTS_DEG)


def turn_class(angle_deg: float) -> str:
    """'none', '0 to 30 deg' and so on, of the angle by which a head is turned."""
    return "none" if angle_deg < _NO_TURN_DEG else _class(angle_deg, TURNS_DEG)


def _class(angle_deg: float, edges_deg: tuple[int, ...]) -> str:
    return next(f"{low} to {high} deg" for low, high in pairwise(edges_deg) if angle_deg <= high)
