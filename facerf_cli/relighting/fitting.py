"""Fit a person in a photo: the head, by landmarks or the Geometry Network, and the reflectance."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from facerf_cli.baselines import RelightKind, explain_by_baseline
from facerf_cli.baselines.base import Reflectance
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import Box, from_box, from_landmarks
from facerf_cli.face.fit import Geometry, fit_landmarks, regressed_fit, trust_inside
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.morphable import BUILTIN, MEAN
from facerf_cli.image.colour import without_fireflies
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.portrait.find import Face, SeenEyes
from facerf_cli.portrait.parse import uncovered, uncovered_by
from facerf_cli.portrait.person import (
    SeenPerson,
    look_at_person,
    maps_with_normals,
    wider_square,
    with_normals,
)
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.field import Field, balance_of
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.relighting.photo_light import SourceLight, source_light
from facerf_cli.relighting.portrait_field import PortraitField, SmoothedFrame, maps_of
from facerf_cli.run.logs import step
from facerf_cli.run.threads import both


@step("fit")
def head_of(
    models: Models,
    photo: np.ndarray,
    face: Face,
    geometry: Geometry | None = None,
    sides: Sides | None = None,
    matte: np.ndarray | None = None,
) -> Head:
    """Fit or regress (`geometry`) the head of a face found in a photo [H, W, 3].

    Skin that is covered by hair, glasses or a hand, or lies outside the user's matte [H, W], is left out of
    the texture.
    """
    if (geometry or models.default_geometry) == "network":
        head = regress_photo(models, photo, face.box_px, sides)
    else:
        head = fit_photo(models, photo, face.landmarks_px, sides)
    head = replace(head, others=face.others)
    if face.view is not None:
        with suppress(
            InputError
        ):  # if all of the skin is covered, nothing is left out; its confidence is low
            head = head.without(models.face, uncovered(face.view, head.fit.crop))
    return head if matte is None else head.without(models.face, uncovered_by(matte, head.fit.crop))


def fit_photo(
    models: Models, photo: np.ndarray, landmarks_px: np.ndarray, sides: Sides | None = None
) -> Head:
    """Crop a photo [H, W, 3] around landmarks [68, 2], fit the face model and unwrap the texture.

    Raises InputError if the landmarks are not a face's or the face lies outside the photo.
    """
    sides = sides or models.sides()
    crop = from_landmarks(landmarks_px, sides.crop_px)
    cropped = without_fireflies(crop.apply(photo))
    in_crop = crop.to_crop(landmarks_px)
    trust = trust_inside(in_crop, crop, *photo.shape[:2])
    fit = fit_landmarks(models.face, in_crop, crop, trust=trust)
    return Head(cropped, fit, unwrap_face(models.face, fit, cropped, sides.texture, photo.shape))


@torch.no_grad()
def regress_photo(models: Models, photo: np.ndarray, box_px: Box, sides: Sides | None = None) -> Head:
    """Crop a photo [H, W, 3] around a detector's box, regress the head and unwrap the texture.

    One forward pass of the Geometry Network returns pose and shape (paper, 'Network Architecture'). The mean
    face (`MorphableModel.pose_only`) uses only the pose.

    Raises InputError if the face lies outside the photo, UsageError for any other face model than the
    network's.
    """
    if models.face.name.removesuffix(MEAN) != BUILTIN:
        raise UsageError(
            f"face model {models.face.name!r}: geometry 'network' requires the built-in face model; use "
            "geometry 'landmarks'"
        )
    sides = sides or models.sides()
    crop = from_box(box_px, sides.crop_px)
    cropped = without_fireflies(crop.apply(photo))
    network: Any = models.networks.geometry
    image = torch.from_numpy(cropped).permute(2, 0, 1)[None].to(models.device)
    estimate = GeometryEstimate(*(tensor.cpu() for tensor in network(image)))
    fit = regressed_fit(models.face, estimate, crop)
    return Head(cropped, fit, unwrap_face(models.face, fit, cropped, sides.texture, photo.shape))


@step("reflectance")
def reflectance_of(
    models: Models,
    head: Head,
    kind: RelightKind = "field",
    network_alone: bool = False,
    photo: np.ndarray | None = None,
    steady: SmoothedFrame | None = None,
    matte: np.ndarray | None = None,
    white_balance: BalanceMode | None = None,
    normals: np.ndarray | None = None,
    eyes: SeenEyes | None = None,
) -> Reflectance:
    """Predict the reflectance of a head; see `facerf.fit` for the arguments.

    The comparison models use neither ratio image nor white balance. The portrait field requires the photo [H,
    W, 3]; a smoothed frame that does not show the person gets only the face field. `eyes` are the person's;
    None detects them.
    """
    if kind != "field" and kind != "portrait":
        return explain_by_baseline(models, head, kind).reflectance
    if kind == "portrait" and photo is None:
        raise UsageError("--reflectance portrait: requires the whole photo; use --reflectance field")

    def face_field() -> tuple[SourceLight | None, Field]:
        source = None if network_alone else source_light(models, head.face, steady.light if steady else None)
        if source:
            field = Field(models, head.face, source.quotient, remove_shade_colour=True, known=source.known)
            field = field.with_detail(source.uniform)
        else:
            field = Field(models, head.face)
        if steady or white_balance is None:
            return source, replace(field, balance=steady.balance if steady else None)
        uniform = source.uniform if source else field.small_under_uniform_light()
        return source, replace(field, balance=balance_of(white_balance, [(head.face, uniform)]))

    def views_of_person() -> list[SeenPerson]:
        assert photo is not None
        people, others = models.networks.people, head.others
        person = look_at_person(people, models.face, photo, head.fit, None, matte, others, eyes)
        if normals is not None:
            person = with_normals(person, normals)
        wide = wider_square(person.square, person.segmentation.matte)
        return [person] if wide is None else [person, person.within(wide, photo)]

    if photo is None or kind == "field" or (steady and not steady.portrait):
        return face_field()[1]
    if steady:
        source, field = face_field()
        return PortraitField.of(models.face, head, field, source, steady.portrait)
    (source, field), views = both(face_field, views_of_person)
    maps = [(view, maps_with_normals(maps_of(models.networks.portrait, view), view)) for view in views]
    return PortraitField.of(models.face, head, field, source, maps)
