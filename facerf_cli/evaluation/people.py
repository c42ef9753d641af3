"""Faces that protocols measure: people of a prepared dataset, and users' photos, fitted as the verbs do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path
from facerf_cli.dataset.relight import render_source
from facerf_cli.dataset.weights import load_pairs, pair_weights, weights_path
from facerf_cli.errors import InputError
from facerf_cli.evaluation.crop_view import CropView
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit, fit_from_arrays, fit_landmarks
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.images import LinearImage, read_image
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.metrics import tone_of
from facerf_cli.models import Models
from facerf_cli.pipeline import TEXTURE_SIDE, fit_photo
from facerf_cli.synth.appearance.pigments import skin_albedo

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class CameraCrop:
    """A camera's crop of a person: the stack's header and the view of the face fitted in it."""

    header: StackHeader
    view: CropView


@dataclass(frozen=True, eq=False)
class Person:
    """A subject of a prepared dataset; crops are viewed when they are first needed.

    With `refit` each crop is fitted to its own landmarks, as a photo is, not all of them at once.
    """

    model: MorphableModel
    dataset: Dataset
    name: str
    keep_eyes: bool = False
    refit: bool = False
    _crops: dict[str, CameraCrop] = field(default_factory=dict)

    def crop(self, camera: str) -> CameraCrop:
        """A camera's crop of the person."""
        if camera not in self._crops:
            header = read_olat_header(self.dataset.stack_path(self.name, camera))
            fit = _in_own_frame(fit_from_arrays(header.fit))
            if self.refit:
                fit = refitted(self.model, fit)
            try:
                view = CropView.of(self.model, fit, header.seen, self.keep_eyes)
            except InputError as error:
                raise InputError(f"{self.name}/{camera}: {error}") from None
            self._crops[camera] = CameraCrop(header, view)
        return self._crops[camera]

    def posed_as(self, fit: FaceFit, camera: str) -> CameraCrop:
        """A camera's crop with another fit's shape in its pose; the crop's own where the shapes agree."""
        crop = self.crop(camera)
        own = crop.view.fit
        if torch.equal(own.alpha, fit.alpha) and torch.equal(own.beta, fit.beta):
            return crop
        posed = replace(own, alpha=fit.alpha, beta=fit.beta)
        return CameraCrop(crop.header, CropView.of(self.model, posed, crop.header.seen, self.keep_eyes))

    def source(self, pair: Pair) -> np.ndarray:
        """The source image [S, S, 3] of a pair, read or rendered from its recipe."""
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return read_image(path).pixels
        return render_source(self.dataset, pair).permute(1, 2, 0).float().numpy()

    def head(self, pair: Pair, image: np.ndarray) -> Head:
        """The head of a pair's source image [S, S, 3], by the fit of its crop."""
        crop = self.crop(pair.source_camera)
        face = unwrap_face(self.model, crop.view.fit, image, TEXTURE_SIDE, image.shape)
        return Head(image, crop.view.fit, face).without(self.model, crop.header.seen)

    def light(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """The true light of a pair's source: camera-space directions [L, 3], rgb weights [L, 3]."""
        directions = self.crop(pair.source_camera).header.directions
        if not weights_path(self.dataset).is_file():  # nothing is written into a dataset that is measured on
            return directions, pair_weights(self.dataset, pair).numpy()
        pairs, weights = load_pairs(self.dataset)[self.name]
        return directions, np.array(weights[pairs.index(pair)])

    @property
    def facts(self) -> dict[str, str | float]:
        """The class of their skin tone, if the capture holds it."""
        ita = self._skin("ita_deg")
        return {"tone": "unknown"} if ita is None else {"tone": tone_of(ita), "ita_deg": ita}

    @property
    def albedo(self) -> np.ndarray | None:
        """The true mean albedo [3] of their bare skin, linear Rec.709; None if it is not known."""
        melanin, blood = self._skin("melanin"), self._skin("haemoglobin")
        if melanin is None or blood is None:
            return None
        mixed = skin_albedo(torch.full((1, 1, 1, 1), melanin), torch.full((1, 1, 1, 1), blood))
        return mixed[0, :, 0, 0].numpy()

    def _skin(self, trait: str) -> float | None:
        """A number of their skin in the capture; faces of random colours have none."""
        traits = self.dataset.traits.get(self.name, {})
        value = traits.get(trait)
        if not isinstance(value, int | float) or traits.get("random_texture"):
            return None
        return float(value)


def refitted(model: MorphableModel, fit: FaceFit) -> FaceFit:
    """The fit of the same crop to its own landmarks alone."""
    return fit_landmarks(model, fit.landmarks_px.double().numpy(), fit.crop)


def _in_own_frame(fit: FaceFit) -> FaceFit:
    """The fit with its crop as a separate image: the crop's pixels are the photo's."""
    side_px = fit.crop.size_px
    return replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px))


def evenly(groups: Mapping[str, Sequence[T]], most: int) -> dict[str, list[T]]:
    """Choose the first of each group, then the second of each, and so on, up to `most` in all."""
    rounds = sorted((place, name) for name, members in groups.items() for place in range(len(members)))
    chosen: dict[str, list[T]] = {name: [] for name in groups}
    for place, name in rounds[:most]:
        chosen[name].append(groups[name][place])
    return {name: members for name, members in chosen.items() if members}


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo: its head, and its view, which leaves out what the photo's alpha leaves out."""

    photo: LinearImage
    landmarks_px: np.ndarray  # [68, 2] in the photo's pixels
    head: Head
    view: CropView
    keep_eyes: bool

    @staticmethod
    def of(
        model: MorphableModel, photo: LinearImage, landmarks_px: np.ndarray, head: Head, keep_eyes: bool
    ) -> "Portrait":
        """The face of a photo that was fitted with `model`."""
        shown = _shown(head.fit.crop, photo)
        view = CropView.of(model, head.fit, shown, keep_eyes)
        return Portrait(photo, landmarks_px, head.without(model, shown), view, keep_eyes)

    def fitted_by(self, models: Models) -> "Portrait":
        """The same face fitted to the same landmarks with another face model."""
        head = fit_photo(models, self.photo.pixels, self.landmarks_px)
        return Portrait.of(models.face, self.photo, self.landmarks_px, head, self.keep_eyes)


def _shown(crop: Crop, photo: LinearImage) -> np.ndarray:
    """The share of the photo in each pixel of its crop [S, S], in 0..1."""
    inside = crop.valid(*photo.pixels.shape[:2]).astype(np.float32)
    return inside if photo.alpha is None else inside * crop.apply(photo.alpha[..., None])[..., 0]
