"""Faces that protocols measure: people of a prepared dataset, and users' photos, fitted as the verbs do."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from facerf_cli.face.fit import FaceFit, Geometry, fit_from_arrays
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.landmarks import FaceBox
from facerf_cli.files.images import LinearImage, read_image
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.logs import LOGGER_NAME
from facerf_cli.metrics import tone_of
from facerf_cli.models import Models, Sides
from facerf_cli.pipeline import find_for, head_of
from facerf_cli.portrait.find import LandmarksFrom
from facerf_cli.synth.appearance.people import skin_albedo

T = TypeVar("T")
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Sitting:
    """A portrait as one method's models see it: the head, and the view in which it is compared."""

    head: Head
    view: CropView


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo; every method's own models fit or regress its head, in one crop.

    `face` is the face as it was found, or a fit that was made beforehand. The photo's alpha tells what is
    neither compared nor used.
    """

    photo: LinearImage
    face: FaceBox | FaceFit
    sides: Sides
    keep_eyes: bool = False
    _sittings: dict[int, tuple[Models, Sitting]] = field(default_factory=dict)

    def by(self, models: Models) -> Sitting:
        """The portrait by a method's models; InputError where nothing of the face is visible."""
        if id(models) not in self._sittings:
            head = self._head(models)
            shown = _shown(head.fit.crop, self.photo)
            view = CropView.of(models.face, head.fit, shown, self.keep_eyes)
            self._sittings[id(models)] = models, Sitting(head.without(models.face, shown), view)
        return self._sittings[id(models)][1]

    def posed_as(self, fit: FaceFit, models: Models) -> CropView:
        """The view in which another fit's shape has this portrait's pose."""
        own = self.by(models).view.fit
        posed = replace(own, alpha=fit.alpha, beta=fit.beta)
        return CropView.of(models.face, posed, _shown(posed.crop, self.photo), self.keep_eyes)

    def _head(self, models: Models) -> Head:
        if not isinstance(self.face, FaceFit):
            return head_of(models, self.photo.pixels, self.face, self.sides)
        image = self.photo.pixels
        face = unwrap_face(models.face, self.face, image, self.sides.texture, image.shape)
        return Head(image, self.face, face)


def common_mask(views: Iterable[CropView]) -> np.ndarray:
    """The mask [S, S] inside those of all views."""
    return np.minimum.reduce([view.mask for view in views])


@dataclass(frozen=True, eq=False)
class Person:
    """A subject of a prepared dataset.

    Each source is a separate photo: the face is found in it, and fitted or regressed as `geometry` says.
    With `geometry` None the head is that which was fitted to all calibrated cameras of the person at once.
    """

    dataset: Dataset
    name: str
    geometry: Geometry | None
    sides: Sides
    keep_eyes: bool = False
    landmarks_from: LandmarksFrom = "facerf"
    _lit: dict[str, Portrait] = field(default_factory=dict)
    _headers: dict[str, StackHeader] = field(default_factory=dict)

    def portraits(self, pairs: Iterable[Pair]) -> Iterator[tuple[Pair, Portrait]]:
        """Yield the pairs with their sources; those in which no face is found are named and left out."""
        for pair in pairs:
            try:
                portrait = self.portrait(pair)
            except InputError as error:
                log.warning("%s; left out", error)
            else:
                yield pair, portrait

    def portrait(self, pair: Pair) -> Portrait:
        """The source of a pair; InputError where no face is found in it."""
        name = f"{pair.subject}/{pair.index:05d}"
        return self._portrait(self.source(pair), pair.source_camera, name)

    def lit(self, camera: str) -> Portrait:
        """The person in a camera under all lights: under one light no detector finds a face."""
        if camera not in self._lit:
            image = self.header(camera).source
            self._lit[camera] = self._portrait(image, camera, f"{self.name}/{camera}")
        return self._lit[camera]

    def header(self, camera: str) -> StackHeader:
        """The header of a camera's stack, read once."""
        if camera not in self._headers:
            self._headers[camera] = read_olat_header(self.dataset.stack_path(self.name, camera))
        return self._headers[camera]

    def _portrait(self, image: np.ndarray, camera: str, name: str) -> Portrait:
        header = self.header(camera)
        if self.geometry is None:
            face: FaceBox | FaceFit = _in_own_frame(fit_from_arrays(header.fit))
        else:
            face = find_for(self.geometry, image, name, landmarks_from=self.landmarks_from)[0]
        return Portrait(LinearImage(image, header.seen), face, self.sides, self.keep_eyes)

    def source(self, pair: Pair) -> np.ndarray:
        """The source image [S, S, 3] of a pair, read or rendered from its recipe."""
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return read_image(path).pixels
        return render_source(self.dataset, pair).permute(1, 2, 0).float().numpy()

    def light(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """The true light of a pair's source: camera-space directions [L, 3], rgb weights [L, 3]."""
        directions = self.header(pair.source_camera).directions
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


def _shown(crop: Crop, photo: LinearImage) -> np.ndarray:
    """The share of the photo in each pixel of its crop [S, S], in 0..1."""
    inside = crop.valid(*photo.pixels.shape[:2]).astype(np.float32)
    return inside if photo.alpha is None else inside * crop.apply(photo.alpha[..., None])[..., 0]
