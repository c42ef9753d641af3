"""Comparisons of the paper: render faces with each method and pair the images with the ground truth.

- `compare_olats` (Tables 1 and 3): held-out people under single lights. The source of each pair of a dataset
  is treated like a user's photo: its face is detected, fitted or regressed, and relit by one light of the
  target camera's OLAT stack. Only the face is rendered. In the same pose, an additional row contains the
  image of `facerf relight` by the first method.
- `reconstruct` (Table 2; Table 4 with the fitted and the mean face): explain photos by a method's reflectance
  and light, and render the faces.
- `transfer` (Table 2): exchange the reflectances of two images of one person, so that each reflectance is
  measured on an image that it was not estimated from.

Two more comparisons use the frame of a dataset's crops, which depends on no checkpoint (docs/evaluation.md):
`freeze` turns pairs into cases, and `compare_images` compares folders of images and facerf's images on them.
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
from facerf_cli.evaluation.people import Bench, ComparedFace, HeadView, common_mask
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

LAMBERT = "lambert"  # the source's texture times the cosine of the light: the minimum a method must beat
COMPOSITE = "composite"  # the first method's face inside its photo, with the photo's detail
FULL, MEAN = "all components", "mean face"  # the forms of Table 4
SAME, DIFFERENT = "same pose", "different pose"
LIGHTS_DEG = (0, 30, 60, 90, 180)  # classes of the angle between a light and the camera's axis
TURNS_DEG = (0, 30, 60, 180)  # classes of the head's rotation between source and target
_NO_TURN_DEG = 0.5
_MAP_ROWS = 64  # height of a case's lat-long map
_LIGHT = ("azimuth_deg", "elevation_deg")  # columns of cases.csv
_POSE, _POSITION = ("yaw_deg", "pitch_deg", "roll_deg"), ("x_m", "y_m", "z_m")
_NEAR_AXIS_DEG = 25.0  # lights within this angle of the camera's axis show the skin's colour, not its shape


@torch.no_grad()
def compare_olats(faces: Sequence[ComparedFace], bench: Bench) -> Iterator[Comparison]:
    """Compare each method's image of a source under the target's light with the stack's image, unclipped."""
    (face,) = faces
    methods, (target, light, truth) = bench.methods, target_of(face)
    lights, same = Light.each(light[None]), target is face
    predictions, views = {}, []
    for method in methods:
        view = target.pose_of(face.fit_with(method.models), method.models)
        predictions[method.name] = next(method.images(None, view.head, lights, Target(view.fit)))
        views.append(view)
    first = views[0]
    predictions[LAMBERT] = _lambert(methods[0].models, light, first)
    if same:  # the image of `facerf relight`, in the truth's crop
        relit = next(methods[0].images(face.photo.pixels, first.head, lights, Target()))
        predictions[COMPOSITE] = first.fit.crop.apply(relit)
    comparison = Comparison(
        replace(face.case, facts={**olat_facts(light, first, same), **face.case.facts}),
        first.fit.crop.apply(truth),
        common_mask(views),
        predictions,
        source=first.head.cropped,
        landmarks_px=target.fit_with(methods[0].models).head.landmarks_px,
        source_face=face.fit_with(methods[0].models).face,
    )
    assert face.origin is not None
    yield _with_drift(comparison, face.origin[0].albedo, first.region("skin"))


def target_of(face: ComparedFace) -> tuple[ComparedFace, Tensor, np.ndarray]:
    """Return a source's target: the person in its camera, the light [3], and the image under it [S, S, 3]."""
    assert face.origin is not None
    person, pair = face.origin
    light = torch.from_numpy(person.header(pair.target_camera).directions[pair.target_light]).float()
    target = face if pair.source_camera == pair.target_camera else person.under_all_lights(pair.target_camera)
    stack = person.dataset.stack_path(pair.subject, pair.target_camera)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    return target, light, truth.permute(1, 2, 0).numpy()


def _lambert(models: Models, light: Tensor, view: HeadView) -> np.ndarray:
    """Render the source's texture times the cosine of a light [3], in the target's crop."""
    head = view.head
    turn = head.fit.turn_to(view.fit.rotation)
    cosine = torch.einsum("c,cd,dij->ij", light, turn, head.face.normals).clamp_min(0)
    face = FaceAlone(models.face, head, fit=view.fit)
    return face.image(Relit(head.face.texture * cosine))


def olat_facts(light: Tensor, view: HeadView, same: bool) -> dict[str, str | float]:
    """Describe the light's direction and the head's rotation from the source's pose."""
    turn_deg = angle_of(view.head.fit.turn_to(view.fit.rotation))
    angle_deg = float(torch.rad2deg(light[2].clamp(-1, 1).acos()))
    azimuth_deg, elevation_deg = direction_to_azel(light)
    return {
        "pose": SAME if same else DIFFERENT,
        "angle": angle_class(angle_deg, LIGHTS_DEG),
        "turn": turn_class(turn_deg),
        "turn_deg": turn_deg,
        "angle_deg": angle_deg,
        "azimuth_deg": float(azimuth_deg),
        "elevation_deg": float(elevation_deg),
    }


def _with_drift(comparison: Comparison, albedo: np.ndarray | None, skin: np.ndarray) -> Comparison:
    """Add the drift of the skin tone if the true albedo is known and the light is near the camera's axis."""
    if albedo is None or float(comparison.case.facts["angle_deg"]) > _NEAR_AXIS_DEG:
        return comparison
    extra = {}
    for name, image in comparison.predictions.items():
        drift = tone_drift_deg(image, comparison.truth, skin * comparison.mask, albedo)
        if drift is not None:
            extra[name] = {"tone_drift_deg": abs(drift), "tone_shift_deg": drift}
    return replace(comparison, extra=extra)


@torch.no_grad()
def reconstruct(faces: Sequence[ComparedFace], bench: Bench, with_light: bool = True) -> Iterator[Comparison]:
    """Compare a portrait's crop with each method's reconstruction, where all of them show the face.

    If `with_light` and the true light is known, also measure the error of the brightest direction.
    """
    (face,) = faces
    truth = face.origin[0].light(face.origin[1]) if face.origin and with_light else None
    predictions, views, extra = {}, [], {}
    for method in bench.methods:
        view = face.fit_with(method.models)
        explained = method.explain(view.head)
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
    """Return the direction [3] with the largest luminance among directions [L, 3] of weights [L, 3]."""
    return np.asarray(directions[luminance(weights).argmax()])


def reconstruct_with_mean(faces: Sequence[ComparedFace], bench: Bench) -> Iterator[Comparison]:
    """Reconstruct with the fitted face and with the mean face of each method, without the light (Table 4).

    Both faces are fitted to the same landmarks, or regressed from the same crop. Predictions are named by the
    form, and with several methods also by the method.
    """
    forms = [(FULL, method, method.models) for method in bench.methods]
    for method in bench.methods:
        models = bench.mean if bench.mean and method.kind == "field" else method.models
        forms.append((MEAN, method, replace(models, face=models.face.pose_only())))
    several = len(bench.methods) > 1
    methods = [
        replace(method, name=f"{form}, {method.name}" if several else form, models=models)
        for form, method, models in forms
    ]
    return reconstruct(faces, replace(bench, methods=methods), with_light=False)


@torch.no_grad()
def transfer(faces: Sequence[ComparedFace], bench: Bench) -> Iterator[Comparison]:
    """Render each of two images with its own light and the other's reflectance.

    The same method estimates the light from the image with its own reflectance.
    """
    methods = bench.methods
    views = [[face.fit_with(method.models) for method in methods] for face in faces]
    explained = [
        [method.explain(view.head) for method, view in zip(methods, of_face, strict=True)]
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
def freeze(faces: Sequence[ComparedFace], bench: Bench) -> Iterator[Comparison]:
    """Turn a pair of a dataset into a case that any method can render, in the frame of the dataset's crop.

    Raises NoFaceError if no face is detected in the source.
    """
    (face,) = faces
    assert face.origin is not None
    person, pair = face.origin
    find_faces(bench.models.networks.people, face.photo.pixels, face.name)
    target, light, truth = target_of(face)
    view = target.fit_with(bench.models)
    crop = fit_from_arrays(person.header(pair.target_camera).fit).crop
    pose = (*rotation_to_pose(view.fit.rotation), *view.fit.translation_m.tolist())
    facts = {
        **olat_facts(light, replace(view, head=face.fit_with(bench.models).head), target is face),
        **person.facts,
        **dict(zip(_POSE + _POSITION, pose, strict=True)),
        **{"crop_x0_px": crop.x0_px, "crop_y0_px": crop.y0_px, "crop_side_px": crop.side_px},
    }
    latlong = rig_to_latlong(RigLight(light[None], torch.ones(1, 3)), _MAP_ROWS).numpy()
    case = replace(face.case, facts=facts)
    yield Comparison(case, truth, view.mask, {}, face.photo.pixels, light=latlong)


def compare_images(
    options: EvaluateOptions, bench: Bench, cases: Iterable[CaseFiles]
) -> Iterator[Comparison]:
    """Read the images of each case and render facerf's methods.

    The mask is the mean of the mask image's channels, without decoding. If there is no mask image, it is the
    truth's alpha; without alpha, all pixels.
    """
    for files in cases:
        truth = read_pixels(files.truth)
        mask = truth.alpha
        if files.mask is not None:
            mask = read_pixels(files.mask, "linear").pixels.mean(-1).clip(0, 1)
        if mask is None:
            mask = np.ones(truth.pixels.shape[:2], np.float32)
        landmarks_px = None
        if options.measures.face_distance:
            faces = find_faces(bench.models.networks.people, truth.pixels, str(files.truth))
            landmarks_px = faces[0].landmarks_px
        source = None if files.source is None else read_pixels(files.source).pixels
        side_px = truth.pixels.shape[1]
        predictions = rendered(files.case, source, bench, side_px) if options.renders else {}
        predictions |= {name: read_pixels(path).pixels for name, path in files.predictions.items()}
        yield Comparison(files.case, truth.pixels, mask, predictions, source, landmarks_px)


@torch.no_grad()
def rendered(case: Case, source: np.ndarray | None, bench: Bench, side_px: int) -> dict[str, np.ndarray]:
    """Render a case with each of facerf's methods from its source [S, S, 3].

    In the source's pose, return the image of `facerf relight`; in another pose, only the face, in the
    target's frame, whose side is `side_px`.
    """
    if source is None or not {*_LIGHT, *_POSE, *_POSITION, "pose"} <= case.facts.keys():
        raise InputError(f"{case.name}: has no source, pose and light; use the output of evaluate cases")
    azimuth_deg, elevation_deg, *turn_deg = (float(case.facts[name]) for name in _LIGHT + _POSE)
    lights = Light.each(azel_to_direction(azimuth_deg, elevation_deg)[None])
    frame = Crop(0.0, 0.0, float(side_px), side_px)
    face = bench.find(source, case.name)
    images = {}
    for method, head in bench.heads(source, face):
        target = Target()
        if case.facts["pose"] != SAME:
            shift_m = torch.tensor([float(case.facts[name]) for name in _POSITION])
            fit = replace(head.fit, rotation=pose_to_rotation(*turn_deg), translation_m=shift_m, crop=frame)
            target = Target(fit)
        images[method.name] = next(method.images(source, head, lights, target))
    return images


def angle_of(rotation: Tensor) -> float:
    """Return the angle in degrees of a rotation [3, 3]."""
    return float((((rotation.trace() - 1) / 2).clamp(-1, 1).acos()).rad2deg())


def angle_class(angle_deg: float, edges_deg: tuple[int, ...]) -> str:
    """Return the class that contains an angle, such as '0 to 30 deg'."""
    return next(f"{low} to {high} deg" for low, high in pairwise(edges_deg) if angle_deg <= high)


def turn_class(angle_deg: float) -> str:
    """Return 'none', or the class of a head's rotation in `TURNS_DEG`."""
    return "none" if angle_deg < _NO_TURN_DEG else angle_class(angle_deg, TURNS_DEG)
