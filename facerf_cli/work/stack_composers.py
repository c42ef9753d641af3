"""OLAT stacks that are relit: sums of their lights, in their frame or on their photo."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
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
from facerf_cli.image.strips import Resized, Rows, Scaled
from facerf_cli.light.studio_points import Lights
from facerf_cli.relighting.field import weighted_sum
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest

_DARK = 1e-3  # keeps a change of light finite, as a share of the photo's mean


@dataclass(frozen=True, eq=False)
class StackTextures:
    """The OLAT textures in a stack as a `Reflectance`; the head stays in the pose of the stack."""

    path: Path

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Sums [M, 3, T, T] of the stack's lights by weights [M, L, 3]."""
        return weighted_sum(stream_olats(self.path), weights)


@dataclass(frozen=True, eq=False)
class StackLight:
    """Sums [h, w, 3] of the lights; of a larger photo the change of its light [H, W, 3]."""

    lit: Rows
    is_change: bool
    own: np.ndarray | None


@dataclass(frozen=True, eq=False)
class StackImages(Relightable):
    """The images of a stack: of a face and its coverage, or of a photo's person over black.

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

    @property
    def keeps_photo(self) -> bool:  # type: ignore[override]
        """True where the photo's own background stays behind the person."""
        return self.photo is not None and self.keeps_background

    @cached_property
    def matte(self) -> np.ndarray:
        """Coverage [H, W] of what the stack shows."""
        return Resized(self.header.seen, self.size_px)[0 : self.size_px[0]]

    @property
    def person_matte(self) -> np.ndarray | None:
        """The matte of a person."""
        return None if self.face is None else self.matte

    def relit(self, lights: Lights) -> Iterator[Relit]:
        """Sums of the stack's lights."""
        textures = weighted_sum(stream_olats(self.path), lights.weights)
        return (Relit(texture, own=own) for texture, own in zip(textures, lights.owns, strict=True))

    def ready(self, relit: Relit, layers: Sequence[str] = ()) -> StackLight:
        """A sum in its frame; raises UsageError for layers other than normals."""
        if other := [name for name in layers if name != "normal"]:
            raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
        lit, source = self._lit(relit), self.header.source
        own = None if relit.own is None or self.photo is None else relit.own.numpy()
        if self.photo is None or self.size_px == self.header.seen.shape:
            return StackLight(lit, False, own)
        return StackLight(Resized(lit / (source + _DARK * source.mean()), self.size_px), True, own)

    def render(self, request: RenderRequest, rows: slice) -> dict[str, np.ndarray]:
        """Some rows of the image, of lights over black, and of normals."""
        matte, found = self.matte[rows][..., None], {}
        if request.image is not None:
            found["rgb"] = self._pixels(request.image, rows)
            below = request.background
            if below is None and self.keeps_photo:
                assert self.photo is not None
                below = Scaled(self.photo, np.float32(2.0**-request.ev))
            if self.photo is not None and below is not None:
                under = below[rows]
                found["rgb"] = under + matte * (found["rgb"] - under)
            for name in request.layers:
                found[name] = self._normals[rows]
        return found | {name: self._pixels(one, rows) * matte for name, one in request.lights.items()}

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule; a face alone is shown well, for it has no photo to compare with."""
        lit, seen = self._lit(relit), self.header.seen
        if relit.own is not None:
            lit = lit + relit.own.numpy() * self.header.source
        if rule == "face" or self.face is None:
            return auto_exposure_ev(lit, seen)
        return anchored_exposure_ev(lit, self.header.source, self.face * seen, seen)

    def _pixels(self, relit: StackLight, rows: slice) -> np.ndarray:
        """The person's own colours [h, W, 3]."""
        pixels, photo = relit.lit[rows], self.photo
        if photo is not None:
            pixels = photo[rows] * pixels if relit.is_change else pixels
            pixels = pixels if relit.own is None else pixels + relit.own * photo[rows]
        return pixels

    @cached_property
    def _normals(self) -> Rows:
        normals = self.header.normals
        return normals if self.face is None else Resized(normals, self.size_px)

    def _lit(self, relit: Relit) -> np.ndarray:
        """Colours [h, w, 3] that are not multiplied by the coverage; 0 where that is."""
        pixels = np.asarray(relit.texture.permute(1, 2, 0).numpy())
        if self.face is None:
            return pixels
        share = self.header.seen[..., None]
        return np.divide(pixels, share, out=np.zeros_like(pixels), where=share > 1e-3)


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
