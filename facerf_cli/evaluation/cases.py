"""Cases in a frame that no checkpoint decides: frozen from a dataset, and compared in folders of images.

The frame of a case is that of the dataset's crops (docs/evaluation.md).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from facerf_cli.errors import InputError
from facerf_cli.evaluation.comparisons import SAME, olat_facts, target_of
from facerf_cli.evaluation.folders import CaseFiles, read_pixels
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.evaluation.people import Bench, Portrait
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.light.forms import rig_to_latlong
from facerf_cli.light.sphere import RigLight, azel_to_direction
from facerf_cli.light.studio_points import Lights
from facerf_cli.person import Target
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import pose_to_rotation, rotation_to_pose

_MAP_ROWS = 64  # of the lat-long map of a light
_LIGHT, _TURN, _PLACE = (
    ("azimuth_deg", "elevation_deg"),
    ("yaw_deg", "pitch_deg", "roll_deg"),
    ("x_m", "y_m", "z_m"),
)


@torch.no_grad()
def freeze(faces: Sequence[Portrait], bench: Bench) -> Iterator[Comparison]:
    """A pair of a dataset as a case that any method can render: no predictions, all in the dataset's frame.

    Raises NoFaceError where no face is found in the source.
    """
    (face,) = faces
    assert face.origin is not None
    person, pair = face.origin
    find_faces(bench.reading.people, face.photo.pixels, face.name)
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
    options: EvaluateOptions, bench: Callable[[], Bench], cases: Iterable[CaseFiles]
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
            people = bench().reading.people
            landmarks_px = find_faces(people, truth.pixels, str(files.truth))[0].landmarks_px
        source = None if files.source is None else read_pixels(files.source).pixels
        predictions = rendered(files.case, source, bench()) if options.ours else {}
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
    lights = Lights.each(azel_to_direction(azimuth_deg, elevation_deg)[None])
    frame = Crop(0.0, 0.0, float(source.shape[1]), source.shape[1])
    face = bench.reading.find(source, case.name)
    images = {}
    for method, head in bench.heads(source, face):
        target = Target()
        if case.facts["pose"] != SAME:
            place = torch.tensor([float(case.facts[name]) for name in _PLACE])
            fit = replace(head.fit, rotation=pose_to_rotation(*turn_deg), translation_m=place, crop=frame)
            target = Target(fit, "face")
        images[method.name] = next(method.images(source, head, lights, target))
    return images
