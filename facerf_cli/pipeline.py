"""The method, one function an arrow: from one photo to the face under any light, from any head pose.

    photo -> fit_photo or regress_photo -> head -> reflectance_of -> Person (person.py) -> images
                                            head -> estimate_light -> light
                                            head -> predict_olat -> a texture for each light

The verbs on photos, the protocols of `evaluate` and most benchmarks call these functions. Images are
scene-linear [H, W, 3], textures [3, T, T]; directions are toward the light, in camera space (docs/design.md).
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.baselines.base import Explained, Reflectance
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import Box, from_box, from_landmarks
from facerf_cli.face.fit import Geometry, fit_landmarks, regressed_fit, trust_inside
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.image.colour import without_fireflies
from facerf_cli.light.estimate import LightEvidence, RefinedLight, joined, refine_light
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.network.inputs import exposure_of, resize
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.correction import Quotient
from facerf_cli.portrait.find import Face, FaceBox, find_faces
from facerf_cli.portrait.given_normals import maps_with_normals, with_normals
from facerf_cli.portrait.parse import uncovered, uncovered_by
from facerf_cli.portrait.person import SeenPerson, look_at_person, wider_square
from facerf_cli.relighting import White
from facerf_cli.relighting.field import (
    Field,
    balance_of,
    photo_evidence,
    shrunk,
)
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.relighting.portrait_field import PortraitField, SteadyFrame, maps_of
from facerf_cli.relighting.source_light import (
    SourceLight,
    light_of_frames,
    over_rig,
    share_of_lamp,
    source_light,
)
from facerf_cli.run.logs import step
from facerf_cli.run.threads import both


def fit_photo(
    models: Models, photo: np.ndarray, landmarks_px: np.ndarray, sides: Sides | None = None
) -> Head:
    """Crop a photo [H, W, 3] around landmarks [68, 2] in its pixels, fit the face model, unwrap the face.

    `sides` are those that the networks were trained on, unless others are given.
    Raises InputError where the landmarks are no face's or the face lies outside the photo.
    """
    sides = sides or models.sides()
    crop = from_landmarks(landmarks_px, sides.crop_px)
    cropped = without_fireflies(crop.apply(photo))
    in_crop = crop.to_crop(landmarks_px)
    trust = trust_inside(in_crop, crop, *photo.shape[:2])
    fit = fit_landmarks(models.face, in_crop, crop, trust=trust)
    return Head(cropped, fit, unwrap_face(models.face, fit, cropped, sides.texture, photo.shape))


def regress_photo(models: Models, photo: np.ndarray, box_px: Box, sides: Sides | None = None) -> Head:
    """Crop a photo [H, W, 3] around a detector's box, regress the head, unwrap the face.

    One forward pass of the Geometry Network gives pose and shape (paper, 'Network Architecture'); there are
    no landmarks. Raises InputError where the face lies outside the photo, UsageError for a face model that is
    not the network's.
    """
    sides = sides or models.sides()
    crop = from_box(box_px, sides.crop_px)
    cropped = without_fireflies(crop.apply(photo))
    fit = regressed_fit(models.face, regress_head(models, cropped), crop)
    return Head(cropped, fit, unwrap_face(models.face, fit, cropped, sides.texture, photo.shape))


@step("find")
def find_for(
    people: PeopleNetworks,
    geometry: Geometry,
    photo: np.ndarray,
    name: str,
    which: str = "largest",
) -> Sequence[FaceBox]:
    """Find faces in a photo [H, W, 3] with what a geometry needs: landmarks, or boxes alone.

    `which` is largest, all or an index. Raises InputError, with the photo's name, where no face is found.
    """
    faces = find_faces(people, photo, name, which)
    return [face.box for face in faces] if geometry == "network" else faces


@step("fit")
def head_of(
    models: Models,
    photo: np.ndarray,
    face: FaceBox,
    sides: Sides | None = None,
    matte: np.ndarray | None = None,
) -> Head:
    """The head of a face found in a photo: fitted to its landmarks, or regressed where it has none.

    What covers the skin in the photo (hair, glasses, a hand, what is off a given matte) is not taken as skin.
    """
    if isinstance(face, Face):
        head = fit_photo(models, photo, face.landmarks_px, sides)
    else:
        head = regress_photo(models, photo, face.box_px, sides)
    head = replace(head, others=face.others)
    if face.view is not None:
        with suppress(InputError):  # all of it is covered: then nothing is left out, and its rating is low
            head = head.without(models.face, uncovered(face.view, head.fit.crop))
    return head if matte is None else head.without(models.face, uncovered_by(matte, head.fit.crop))


@torch.no_grad()
def regress_head(models: Models, cropped: np.ndarray) -> GeometryEstimate:
    """Regress pose and coefficients from a crop [S, S, 3] by the Geometry Network.

    Raises UsageError for a face model that is not the network's.
    """
    network: Any = models.networks.geometry
    if models.face.name != BUILTIN:
        raise UsageError(
            f"face model {models.face.name!r}: geometry 'network' regresses heads of the built-in one; "
            "use that, or geometry 'landmarks'"
        )
    image = torch.from_numpy(cropped).permute(2, 0, 1)[None].to(models.device)
    return GeometryEstimate(*(tensor.cpu() for tensor in network(image)))


@step("reflectance")
def reflectance_of(
    models: Models,
    head: Head,
    kind: RelightKind = "field",
    network_alone: bool = False,
    photo: np.ndarray | None = None,
    steady: SteadyFrame | None = None,
    matte: np.ndarray | None = None,
    white: White | None = None,
    normals: np.ndarray | None = None,
) -> Reflectance:
    """Read the reflectance of a head from its photo.

    Args:
        models: The networks and the face model.
        head: The head in the photo.
        kind: The portrait field, the face's, or a baseline of the paper, which has neither quotient nor
            white.
        network_alone: Leave out the correction by the photo's quotient image, by which the photo comes back
            under its own light.
        photo: Scene-linear [H, W, 3], which the portrait field needs itself.
        steady: What the frames around it steady, of a frame of a shot, which has the face's field alone where
            it shows nobody.
        matte: The person's share [H, W] of the photo, if it is given.
        white: Under even white light skin has the photo's colours, or those of skin (`white.py`); None leaves
            the network's.
        normals: Unit normals [H, W, 3] of the photo, which the portrait field takes for the networks'.
    """
    if kind != "field" and kind != "portrait":
        return explain(models, head, kind).reflectance
    if kind == "portrait" and photo is None:
        raise UsageError("--reflectance portrait: needs the whole photo; give --reflectance field")

    def of_face() -> tuple[SourceLight | None, Field]:
        found = None if network_alone else source_light(models, head.face, steady.light if steady else None)
        quotient = found.quotient if found else None
        field = Field(models, head.face, quotient, even_shade=found is not None)
        field = field.with_detail(found.even) if found else field
        if steady or white is None:
            return found, replace(field, balance=steady.balance if steady else None)
        even = found.even if found else field.small_under_even_light()
        return found, replace(field, balance=balance_of(white, [(head.face, even)]))

    def of_person() -> list[SeenPerson]:
        assert photo is not None
        people, others = models.networks.people, head.others
        person = look_at_person(people, models.face, photo, head.fit, matte=matte, others=others)
        if normals is not None:
            person = with_normals(person, normals)
        wide = wider_square(person.square, person.segmentation.matte)
        return [person] if wide is None else [person, person.within(wide, photo)]

    if photo is None or kind == "field" or (steady and not steady.portrait):
        return of_face()[1]
    if steady:
        source, field = of_face()
        return PortraitField.of(models.face, head, field, source, steady.portrait)
    (source, field), views = both(of_face, of_person)
    seen = [(one, maps_with_normals(maps_of(models.networks.portrait, one), one)) for one in views]
    return PortraitField.of(models.face, head, field, source, seen)


@dataclass(frozen=True, eq=False)
class Estimator:
    """Settings of estimating the light of a photo over a rig.

    Without `non_negative` by the paper's least squares, whose weights may be negative. `features` (V_f or
    S_f) refines the weights (paper, 'Light Estimation').
    """

    non_negative: bool = True
    features: FeatureNetwork | None = None


DEFAULT_ESTIMATOR = Estimator()
_ONE_LAMP = 0.8  # share of the lamp in a photo's light from which it may be the light
_AS_WELL = 1.1  # times the error of the rig's lights: one lamp then explains the photo as well


def explain(
    models: Models,
    head: Head,
    kind: Kind = "field",
    network_alone: bool = True,
    estimator: Estimator = DEFAULT_ESTIMATOR,
) -> Explained:
    """Read both reflectance and light of a head's photo, as far as the model can separate them."""
    if kind == "field":
        light = estimate_light(models, head, estimator=estimator).light
        return Explained(reflectance_of(models, head, kind, network_alone), light)
    if kind == "diffuse-sh":  # relighting by the fields loads none of these
        from facerf_cli.baselines.diffuse_sh import explain_by_diffuse_sh as explained
    elif kind == "specular-sh":
        from facerf_cli.baselines.specular_sh import explain_by_specular_sh as explained
    else:
        from facerf_cli.baselines.prt import explain_by_prt as explained
    return explained(models, head.fit, head.face)


def predict_olat(
    models: Models,
    head: Head,
    lights: Tensor,
    rotation: Tensor | None = None,
    network_alone: bool = False,
    bf16: bool = False,
    white: White | None = None,
) -> Iterator[Tensor]:
    """Yield OLAT textures of a head, in batches [l, 3, T, T] that fit the memory.

    Args:
        models: The networks and the face model.
        head: The head in its photo.
        lights: Unit directions [L, 3], camera space.
        rotation: The target's head pose, head_to_camera [3, 3]; None keeps the photo's.
        network_alone: As in `reflectance_of`.
        bf16: Compute in half precision.
        white: As in `reflectance_of`.
    """
    field = reflectance_of(models, head, "field", network_alone, white=white)
    assert isinstance(field, Field)
    turn = None if rotation is None else head.fit.turn_to(rotation)
    return replace(field, bf16=bf16).olats(lights, turn)


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """The light of a photo, the evidence for it, and the texture [3, t, t] of the face under it.

    If features refined the weights, `refined` holds the refinement, and `least_squares` [L, 3] are those
    before. `key_share` is the share of the key light, where that was asked.
    """

    light: RigLight
    evidence: LightEvidence
    explained: Tensor
    refined: RefinedLight | None = None
    least_squares: Tensor | None = None
    key_share: float | None = None


def estimate_light(
    models: Models,
    head: Head,
    kind: Kind = "field",
    rig: Tensor | None = None,
    estimator: Estimator = DEFAULT_ESTIMATOR,
    keep_eyes: bool = False,
    more: Sequence[Head] = (),
    white: White | None = None,
) -> LightEstimate:
    """Estimate the light of a head's photo over a rig (paper, 'Light Estimation', Eq. leastsq).

    Args:
        models: The networks and the face model.
        head: The head in its photo.
        kind: The field, or a baseline of the paper, which estimates its own light.
        rig: Unit directions [L, 3], camera space; by default 150.
        estimator: How the least squares are solved and refined.
        keep_eyes: Eyes take part, which the paper leaves out.
        more: Heads of other frames of a shot, which take part.
        white: The light is that over the photo's or over skin's own colours (`white.py`).

    Where one lamp and light from around explain the photo as well, they are its light (`source_light.py`).
    Raises InputError where too little of the face is visible.
    """
    evidence = photo_evidence(head.face, keep_eyes)
    if kind != "field":
        explained = explain(models, head, kind)
        texture = explained.reflectance.relit(explained.light.directions, explained.light.weights[None])
        small = resize(texture, evidence.photo.shape[-1])[0]
        return LightEstimate(explained.light, evidence, small)
    rig = rig_directions() if rig is None else rig
    heads = [(head, evidence), *((one, photo_evidence(one.face, keep_eyes)) for one in more)]
    frames = [
        replace(seen, directions=rig, olats=torch.cat(list(Field(models, shrunk(one.face)).olats(rig))))
        for one, seen in heads
    ]
    evidence, features = frames[0], estimator.features
    whole = joined(frames)
    weights, share = whole.least_squares(estimator.non_negative), None
    if estimator.non_negative:
        own = light_of_frames(models, [one.face for one, _ in heads])
        share, one_lamp = share_of_lamp(own), over_rig(own, rig)
        left = [whole.residual(whole.relit(either)) for either in (weights, one_lamp)]
        if share > _ONE_LAMP and left[1] < _AS_WELL * left[0]:
            weights = one_lamp

    def balanced(weights: Tensor) -> RigLight:
        """The light of weights [L, 3] over a face of the white that is wanted."""
        if white is None:
            return RigLight(rig, weights)
        quotient = Quotient.of(evidence.photo, evidence.relit(weights), shrunk(head.face).visible)
        even = quotient.corrected(evidence.olats).mean(0)
        return RigLight(rig, weights / balance_of(white, [(head.face, even)]).gain)

    if features is None:
        return LightEstimate(balanced(weights), evidence, evidence.relit(weights), key_share=share)

    def layers(x: Tensor) -> list[Tensor]:
        return features.layers((x / exposure).to(models.device))

    exposure = exposure_of(evidence.photo[None], evidence.mask[None, None].float())  # as in their training
    refined = refine_light(evidence, weights, layers, estimator.non_negative)
    shown = evidence.relit(refined.weights)
    return LightEstimate(balanced(refined.weights), evidence, shown, refined, weights, share)
