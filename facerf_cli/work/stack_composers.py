"""OLAT stacks as `relight` composes them: sums of their lights, in their frame or on their photo."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.files.olat_stack import StackHeader, stream_olats
from facerf_cli.image.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.image.strips import Band, Layer, resized_rows
from facerf_cli.light.studio_points import Lights
from facerf_cli.relighting.composition import Relit, in_own_light
from facerf_cli.relighting.field import weighted_sum

_DARK = 1e-3  # keeps a change of light finite, as a share of the photo's mean


@dataclass(frozen=True, eq=False)
class StackTextures:
    """The OLAT textures in a stack as a `Reflectance`; the head stays in the pose of the stack."""

    path: Path

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Sums [M, 3, T, T] of the stack's lights by weights [M, L, 3]."""
        return weighted_sum(stream_olats(self.path), weights)


@dataclass(frozen=True, eq=False)
class StackImages:
    """Composes the images of a stack: of a face and its coverage, or of a photo's person over black.

    A person is shown alone, or with `photo` [H, W, 3] in that photo. That may be larger than the stack: then
    the change of light is enlarged, and the photo keeps its detail. `keeps_background` shows the photo's own.
    """

    header: StackHeader
    path: Path
    face: np.ndarray | None = None  # coverage [H, W] of a person's face, by which the exposure is chosen
    photo: np.ndarray | None = None
    keeps_background: bool = True

    @property
    def nbytes(self) -> int:
        """Bytes of one sum."""
        return 12 * self.header.seen.size

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""
        height, width = (self.header.seen if self.photo is None else self.photo).shape[:2]
        return height, width

    def relit(self, lights: Lights) -> Iterator[Relit]:
        """Sums of the stack's lights."""
        textures = weighted_sum(stream_olats(self.path), lights.weights)
        return (Relit(texture, own=own) for texture, own in zip(textures, lights.owns, strict=True))

    def bands(self, relit: Relit, ev: float, behind: Band | None) -> dict[str, Layer]:
        """The person before the photo's background at `ev`, before another, or with alpha."""
        (person, matte), photo, gain = self._person(relit), self.photo, np.float32(2.0**-ev)
        if photo is None or (behind is None and not self.keeps_background):
            return {"rgb": person, "A": matte}

        def of(rows: slice) -> np.ndarray:
            below = behind(rows) if behind else gain * photo[rows]
            return np.asarray(below + matte(rows)[..., None] * (person(rows) - below))

        return {"rgb": of}

    def light_layer(self, relit: Relit) -> Band:
        """The person under one of several lights, over black."""
        person, matte = self._person(relit)
        return lambda rows: person(rows) * matte(rows)[..., None]

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Layer]:
        """The layer of normals, and a person's matte; raises UsageError for others."""
        if other := [name for name in names if name != "normal"]:
            raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
        found: dict[str, Layer] = {} if self.face is None else {"person.A": self._matte()}
        if names:
            normals = self.header.normals
            found["normal"] = normals if self.face is None else resized_rows(normals, self.size_px)
        return found

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule; a face alone is shown well, for it has no photo to compare with."""
        lit, seen = self._lit(relit), self.header.seen
        if relit.own is not None:
            lit = lit + relit.own.numpy() * self.header.source
        if rule == "face" or self.face is None:
            return auto_exposure_ev(lit, seen)
        return anchored_exposure_ev(lit, self.header.source, self.face * seen, seen)

    def _person(self, relit: Relit) -> tuple[Band, Band]:
        """The person's own colours [H, W, 3], and its matte [H, W]."""
        lit, photo, seen = self._lit(relit), self.photo, self.header.seen
        if photo is None or self.size_px == seen.shape:
            person: Band = lit.__getitem__
        else:
            source = self.header.source
            change = resized_rows(lit / (source + _DARK * source.mean()), self.size_px)

            def person(rows: slice) -> np.ndarray:
                return photo[rows] * change(rows)

        if photo is not None and relit.own is not None:
            person = in_own_light(person, photo, relit.own)
        return person, self._matte()

    def _lit(self, relit: Relit) -> np.ndarray:
        """Colours [h, w, 3] that are not multiplied by the coverage; 0 where that is."""
        pixels = np.asarray(relit.texture.permute(1, 2, 0).numpy())
        if self.face is None:
            return pixels
        share = self.header.seen[..., None]
        return np.divide(pixels, share, out=np.zeros_like(pixels), where=share > 1e-3)

    def _matte(self) -> Band:
        return resized_rows(self.header.seen, self.size_px)


def face_in_stack(item: Item, header: StackHeader, model: MorphableModel) -> tuple[FaceFit, np.ndarray]:
    """The fit in a stack of a photo's person, and the face's coverage [H, W] of its images."""
    with _fit_of(item):
        fit = fit_from_arrays(header.fit)
    view = view_face(fit.vertices_camera(model), photo_camera(fit.crop, *header.seen.shape), fit.crop.side_px)
    return fit, view.full(view.mask)


def head_in_stack(item: Item, header: StackHeader) -> Head:
    """The head of a stack of textures, in the pose of the stack."""
    with _fit_of(item):
        if header.layout_version != LAYOUT_VERSION:
            raise ValueError("it has another UV layout")
        posed = replace(fit_from_arrays(header.fit), rotation=torch.from_numpy(header.rotation).float())
        texture, normals = (torch.from_numpy(x).permute(2, 0, 1) for x in (header.source, header.normals))
        return Head(header.source, posed, FaceTexture(texture, torch.from_numpy(header.seen), normals))


@contextmanager
def _fit_of(item: Item) -> Iterator[None]:
    """Raise InputError for a fit in a stack that is damaged."""
    try:
        yield
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{item.input_path}: the fit in it cannot be used: {error}") from None
