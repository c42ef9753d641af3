"""OLAT stacks that are relit: sums of their lights, in their frame or on their photo; their scenes."""

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

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
from facerf_cli.files.olat_stack import StackHeader, read_olat_header, stream_olats
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.image.strips import Resized, Rows, Scaled
from facerf_cli.light.light import Light
from facerf_cli.raster.camera import Camera
from facerf_cli.relighting.face_alone import FaceAlone
from facerf_cli.relighting.field import weighted_sum
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, attributes_of_sum
from facerf_cli.work.lights import LightsOf, lights_over_stack, off_rig_deg
from facerf_cli.work.photos import companion, face_model, fit_facts
from facerf_cli.work.plan import KEPT_PX, beside
from facerf_cli.work.relight_options import RelightPlan

log = logging.getLogger(LOGGER_NAME)
_OFF_RIG_DEG = 1.0  # from which on a light that a stack lacks is named
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
        return None if self.face is None else self.matte

    def relit(self, lights: Light) -> Iterator[Relit]:
        """Sums of the stack's lights."""
        textures = weighted_sum(stream_olats(self.path), lights.weights)
        return (Relit(texture, own=own) for texture, own in zip(textures, lights.owns, strict=True))

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """What gives rows of the image, of lights over black, and of normals."""
        if other := [name for name in request.layers if name != "normal"]:
            raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
        image = None if request.image is None else self._ready(request.image)
        return partial(
            self._render, request, image, {name: self._ready(one) for name, one in request.lights.items()}
        )

    def _ready(self, relit: Relit) -> StackLight:
        """A sum in its frame."""
        lit, source = self._lit(relit), self.header.source
        own = None if relit.own is None or self.photo is None else relit.own.numpy()
        if self.photo is None or self.size_px == self.header.seen.shape:
            return StackLight(lit, False, own)
        return StackLight(Resized(lit / (source + _DARK * source.mean()), self.size_px), True, own)

    def _render(
        self,
        request: RenderRequest,
        image: StackLight | None,
        lights: Mapping[str, StackLight],
        rows: slice,
    ) -> dict[str, np.ndarray]:
        matte, found = self.matte[rows][..., None], {}
        if image is not None:
            found["rgb"] = self._pixels(image, rows)
            below = request.background
            if below is None and self.keeps_photo:
                assert self.photo is not None
                below = Scaled(self.photo, np.float32(2.0**-request.ev))
            if self.photo is not None and below is not None:
                under = below[rows]
                found["rgb"] = under + matte * (found["rgb"] - under)
            for name in request.layers:
                found[name] = self._normals[rows]
        found |= {name: self._pixels(one, rows) * matte for name, one in lights.items()}
        return request.wrapped(found, rows)

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


class OpenStack(NamedTuple):
    """A stack that can be relit by its own lights; the photo's camera, if the stack is put back on it."""

    subject: Relightable
    lights_of: LightsOf
    metadata: Mapping[str, Any]
    facts: Mapping[str, Any]
    camera: Camera | None = None


def open_stack(item: Item, plan: RelightPlan) -> OpenStack:
    """Open a stack; raises InputError for options that only a photo can have."""
    _check_stack(item, plan)
    header = read_olat_header(item.input_path)
    own = torch.from_numpy(header.directions).float()
    if (off_deg := off_rig_deg(plan.setups, own)) > _OFF_RIG_DEG:
        said = (
            "%s: has no light there (the nearest is %.1f degrees away), so those around it are mixed; the "
            "photo itself takes any light"
        )
        log.warning(said, item.input_path, off_deg)
    lights_of = partial(lights_over_stack, directions=own, sampling=plan.sampling)
    subject: Relightable
    camera = None
    if header.kind == "photo":
        subject, camera, facts = _person_of_stack(item, header, plan)
    elif plan.options.photo_of_stack is not None:
        raise InputError(f"{item.input_path}: not in its photo's frame; predict it with --frame photo")
    elif header.kind == "image":
        subject, facts = StackImages(header, item.input_path), {}
    else:
        head = head_in_stack(item, header)  # of textures, in the frame of its crop
        subject = FaceAlone(face_model(plan.photo), head, StackTextures(item.input_path))
        facts = fit_facts(head.fit)
    metadata = attributes_of_sum(header.metadata, item.input_path.name, item.key)
    return OpenStack(subject, lights_of, metadata, facts, camera)


def _check_stack(item: Item, plan: RelightPlan) -> None:
    """Raise InputError for what only a photo can have."""
    wrong, options = "", plan.options
    if options.pose is not None or plan.keeps_photo:
        wrong = "a stack holds one pose of a face without its photo; give the photo"
    elif options.reflectance not in ("field", "portrait"):
        wrong = f"a stack holds the field; for {options.reflectance} give its photo"
    elif options.white != "photo":
        wrong = "a stack holds the white with which it was predicted; give its photo"
    elif options.network_alone:
        wrong = "a stack holds the field as predicted; give its photo"
    elif options.normals_from is not None:
        wrong = "a stack holds the normals with which it was predicted; give its photo"
    elif plan.photo.person is not None:
        wrong = "a stack holds its person's matte; give its photo"
    elif options.photo_of_stack is None and any(setup.has_own for setup in plan.setups):
        wrong = "the photo's own light (own) needs its photo; give that with --photo"
    elif options.photo_of_stack is None and options.background.kind not in ("photo", "none"):
        wrong = "a stack shows its person alone; for --background give its photo with --photo"
    elif any(light.even for setup in plan.setups for light in setup.by_photo):
        wrong = "even light (even) has the brightness of a photo; give that, or from=around"
    elif any(light.at_m is not None for setup in plan.setups for light in setup.lights):
        wrong = "a stack holds far lights; for near ones (at=) give its photo"
    if wrong:
        raise InputError(f"{item.input_path}: {wrong}")


def _person_of_stack(
    item: Item, header: StackHeader, plan: RelightPlan
) -> tuple[StackImages, Camera | None, dict[str, Any]]:
    """The images of a stack of a photo's person, on its photo if that is given, and facts of its fit."""
    fit, face = face_in_stack(item, header, face_model(plan.photo))
    size_px, stack = header.seen.shape, StackImages(header, item.input_path, face)
    if plan.options.photo_of_stack is None:
        return stack, None, fit_facts(fit)
    path = companion(item, plan.options.photo_of_stack, "--photo")
    with beside(size_px, images=11):  # of a stack with its writers
        photo = read_image(path, plan.photo.colourspace, kept_px=KEPT_PX, layer=plan.photo.layer).pixels
    scale = photo.shape[0] / size_px[0]
    if abs(photo.shape[1] - scale * size_px[1]) > max(2.0, scale):
        raise InputError(f"{path}: not the photo of {item.input_path}, whose sides have another ratio")
    camera = photo_camera(fit.crop.of_scaled(scale), *photo.shape[:2])
    on_photo = replace(stack, photo=photo, keeps_background=plan.options.background.kind == "photo")
    return on_photo, camera, fit_facts(fit)
