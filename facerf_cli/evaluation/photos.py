"""A user's photo as the protocols see it: its crop, fitted and unwrapped as every verb does."""

from dataclasses import dataclass

import numpy as np

from facerf_cli.evaluation.views import View
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.images import Picture
from facerf_cli.pipeline import FaceTexture, fit_face


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo: its crop, a picture [S, S, 3] linear; view, texture."""

    picture: np.ndarray
    photo: Picture
    keep_eyes: bool
    view: View
    face: FaceTexture

    @staticmethod
    def of(
        model: MorphableModel,
        fit: FaceFit,
        picture: np.ndarray,
        photo: Picture,
        keep_eyes: bool,
    ) -> "Portrait":
        """A crop of a photo seen with a fit; nothing is compared beyond the photo and its alpha."""
        view = View.of(model, fit, _shown(fit.crop, photo), keep_eyes)
        return Portrait(picture, photo, keep_eyes, view, view.texture_of(picture))

    def fitted_with(self, model: MorphableModel) -> "Portrait":
        """The same crop with another face model on the same landmarks."""
        old = self.view.fit
        landmarks_px = old.crop.to_photo(old.landmarks_px.numpy())
        fit = fit_face(model, old.crop, landmarks_px, self.photo.pixels.shape)
        return Portrait.of(model, fit, self.picture, self.photo, self.keep_eyes)


def _shown(crop: Crop, photo: Picture) -> np.ndarray:
    """How much of the photo each pixel of its crop shows [S, S], in 0..1."""
    inside = crop.valid(*photo.pixels.shape[:2]).astype(np.float32)
    return inside if photo.alpha is None else inside * crop.apply(photo.alpha[..., None])[..., 0]
