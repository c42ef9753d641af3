"""The head in a photo: cropped, fitted to landmarks or regressed by the Geometry Network, and unwrapped."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import Box, from_box, from_landmarks
from facerf_cli.face.fit import Geometry, fit_landmarks, regressed_fit, trust_inside
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.morphable import BUILTIN, MEAN
from facerf_cli.image.colour import without_fireflies
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.portrait.find import Face
from facerf_cli.portrait.parse import uncovered, uncovered_by
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.run.logs import step


@step("fit")
def head_of(
    models: Models,
    photo: np.ndarray,
    face: Face,
    geometry: Geometry | None = None,
    sides: Sides | None = None,
    matte: np.ndarray | None = None,
) -> Head:
    """Fit the head of a face that was found in a photo [H, W, 3], or regress it from the face's box.

    `geometry` chooses between the two; by default it is that of the networks' training. Skin that hair,
    glasses or a hand cover, or that lies off a given matte [H, W], is left out.
    """
    if (geometry or models.default_geometry) == "network":
        head = regress_photo(models, photo, face.box_px, sides)
    else:
        head = fit_photo(models, photo, face.landmarks_px, sides)
    head = replace(head, others=face.others)
    if face.view is not None:
        with suppress(InputError):  # all of it is covered: then nothing is left out, and its rating is low
            head = head.without(models.face, uncovered(face.view, head.fit.crop))
    return head if matte is None else head.without(models.face, uncovered_by(matte, head.fit.crop))


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


@torch.no_grad()
def regress_head(models: Models, cropped: np.ndarray) -> GeometryEstimate:
    """Regress pose and coefficients from a crop [S, S, 3] by the Geometry Network.

    The mean face (`MorphableModel.pose_only`) takes the pose alone.
    Raises UsageError for a face model that is not the network's.
    """
    network: Any = models.networks.geometry
    if models.face.name.removesuffix(MEAN) != BUILTIN:
        raise UsageError(
            f"face model {models.face.name!r}: geometry 'network' regresses heads of the built-in one; "
            "use that, or geometry 'landmarks'"
        )
    image = torch.from_numpy(cropped).permute(2, 0, 1)[None].to(models.device)
    return GeometryEstimate(*(tensor.cpu() for tensor in network(image)))
