"""A user's photo as the protocols see it: its crop, fitted and unwrapped as every verb does."""

from dataclasses import dataclass

import numpy as np

from facerf_cli.evaluation.views import View
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.pipeline import FaceTexture, fit_face


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo [H, W, ...]: crop [S, S, 3] linear, view, texture."""

    picture: np.ndarray
    photo_shape: tuple[int, ...]
    keep_eyes: bool
    view: View
    face: FaceTexture

    @staticmethod
    def of(
        model: MorphableModel,
        fit: FaceFit,
        picture: np.ndarray,
        photo_shape: tuple[int, ...],
        keep_eyes: bool,
    ) -> "Portrait":
        """A crop of a photo seen with a fit; beyond the photo nothing is compared."""
        view = View.of(model, fit, fit.crop.valid(*photo_shape[:2]).astype(np.float32), keep_eyes)
        return Portrait(picture, photo_shape, keep_eyes, view, view.texture_of(picture))

    def fitted_with(self, model: MorphableModel) -> "Portrait":
        """The same crop with another face model on the same landmarks."""
        old = self.view.fit
        landmarks_px = old.crop.to_photo(old.landmarks_px.numpy())
        fit = fit_face(model, old.crop, landmarks_px, self.photo_shape)
        return Portrait.of(model, fit, self.picture, self.photo_shape, self.keep_eyes)
