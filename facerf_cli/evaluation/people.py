"""People of a prepared dataset as the protocols see them: crops, fits, source pictures, and what is known.

A user's photo as the protocols see it: its crop, fitted and unwrapped as every verb does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path
from facerf_cli.dataset.relight import render_source
from facerf_cli.dataset.weights import load_pairs, pair_weights, weights_path
from facerf_cli.evaluation.methods import View
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit, fit_from_arrays, fit_landmarks
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.images import LinearImage, read_image
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.metrics import tone_of
from facerf_cli.pipeline import FaceTexture, fit_face
from facerf_cli.synth.appearance.pigments import skin_albedo

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera's crop of a person: the stack's header and the fitted face in it."""

    header: StackHeader
    view: View


@dataclass(frozen=True, eq=False)
class Person:
    """A subject of a prepared dataset; crops are seen when they are first asked for.

    `refit`: each crop is fitted by its own landmarks, as a photo is, not all of them at once.
    """

    model: MorphableModel
    dataset: Dataset
    name: str
    keep_eyes: bool = False
    refit: bool = False
    _shots: dict[str, Shot] = field(default_factory=dict)

    def shot(self, camera: str) -> Shot:
        """What a camera sees of the person."""
        if camera not in self._shots:
            header = read_olat_header(self.dataset.stack_path(self.name, camera))
            fit = fit_from_arrays(header.fit)
            if self.refit:
                fit = refitted(self.model, fit)
            self._shots[camera] = Shot(header, View.of(self.model, fit, header.seen, self.keep_eyes))
        return self._shots[camera]

    def posed_as(self, fit: FaceFit, camera: str) -> Shot:
        """A camera's crop with another fit's shape in its pose; the crop's own where they agree."""
        shot = self.shot(camera)
        own = shot.view.fit
        if torch.equal(own.alpha, fit.alpha) and torch.equal(own.beta, fit.beta):
            return shot
        posed = replace(own, alpha=fit.alpha, beta=fit.beta)
        return Shot(shot.header, View.of(self.model, posed, shot.header.seen, self.keep_eyes))

    def source(self, pair: Pair) -> tuple[np.ndarray, FaceTexture]:
        """The source picture [S, S, 3] of a pair, written or made from its recipe, and its texture."""
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            image = read_image(path).pixels
        else:
            image = render_source(self.dataset, pair).permute(1, 2, 0).float().numpy()
        return image, self.shot(pair.source_camera).view.texture_of(image)

    def light(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """The true light of a pair's source: camera-space directions [L, 3] and rgb weights [L, 3]."""
        directions = self.shot(pair.source_camera).header.directions
        if not weights_path(self.dataset).is_file():  # nothing is written into a dataset that is measured on
            return directions, pair_weights(self.dataset, pair).numpy()
        pairs, weights = load_pairs(self.dataset)[self.name]
        return directions, np.array(weights[pairs.index(pair)])

    @property
    def facts(self) -> dict[str, str | float]:
        """The class of their skin, where the capture says it."""
        ita = self._skin("ita_deg")
        return {"tone": "unknown"} if ita is None else {"tone": tone_of(ita), "ita_deg": ita}

    @property
    def albedo(self) -> np.ndarray | None:
        """The true mean albedo [3] of their bare skin, linear Rec.709; None where it is not known."""
        melanin, blood = self._skin("melanin"), self._skin("haemoglobin")
        if melanin is None or blood is None:
            return None
        mixed = skin_albedo(torch.full((1, 1, 1, 1), melanin), torch.full((1, 1, 1, 1), blood))
        return mixed[0, :, 0, 0].numpy()

    def _skin(self, trait: str) -> float | None:
        """A number that the capture knows of their skin; faces of random colours have none."""
        traits = self.dataset.traits.get(self.name, {})
        value = traits.get(trait)
        if not isinstance(value, int | float) or traits.get("random_texture"):
            return None
        return float(value)


def refitted(model: MorphableModel, fit: FaceFit) -> FaceFit:
    """A fit anew, by its own landmarks alone."""
    return fit_landmarks(model, fit.landmarks_px.double().numpy(), fit.crop)


def evenly(groups: Mapping[str, Sequence[T]], most: int) -> dict[str, list[T]]:
    """The first of each group, then the second of each, and so on until there are `most`."""
    rounds = sorted((place, name) for name, members in groups.items() for place in range(len(members)))
    chosen: dict[str, list[T]] = {name: [] for name in groups}
    for place, name in rounds[:most]:
        chosen[name].append(groups[name][place])
    return {name: members for name, members in chosen.items() if members}


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo: its crop, a picture [S, S, 3] linear; view, texture."""

    image: np.ndarray
    photo: LinearImage
    keep_eyes: bool
    view: View
    face: FaceTexture

    @staticmethod
    def of(
        model: MorphableModel,
        fit: FaceFit,
        image: np.ndarray,
        photo: LinearImage,
        keep_eyes: bool,
    ) -> "Portrait":
        """A crop of a photo seen with a fit; nothing is compared beyond the photo and its alpha."""
        view = View.of(model, fit, _shown(fit.crop, photo), keep_eyes)
        return Portrait(image, photo, keep_eyes, view, view.texture_of(image))

    def fitted_with(self, model: MorphableModel) -> "Portrait":
        """The same crop with another face model on the same landmarks."""
        old = self.view.fit
        landmarks_px = old.crop.to_photo(old.landmarks_px.numpy())
        fit = fit_face(model, old.crop, landmarks_px, self.photo.pixels.shape)
        return Portrait.of(model, fit, self.image, self.photo, self.keep_eyes)


def _shown(crop: Crop, photo: LinearImage) -> np.ndarray:
    """How much of the photo each pixel of its crop shows [S, S], in 0..1."""
    inside = crop.valid(*photo.pixels.shape[:2]).astype(np.float32)
    return inside if photo.alpha is None else inside * crop.apply(photo.alpha[..., None])[..., 0]
