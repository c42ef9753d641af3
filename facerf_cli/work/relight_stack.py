"""OLAT stacks as inputs of `facerf relight`: weighted sums of a stack's lights, at its size, in its frame."""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.files.olat_stack import StackHeader, read_olat_header, stream_olats
from facerf_cli.image.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.light.light import Light
from facerf_cli.relighting.field import weighted_sum
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, attributes_of_sum
from facerf_cli.work.lights import LightsOf, lights_over_stack, off_rig_deg
from facerf_cli.work.photos import face_model, fit_facts
from facerf_cli.work.relight_options import RelightPlan

log = logging.getLogger(LOGGER_NAME)
_OFF_RIG_DEG = 1.0  # from which on a light that a stack lacks is named


@dataclass(frozen=True, eq=False)
class StackImages(Relightable):
    """The images of a stack, over black: of a face and its coverage, or of a photo's person.

    `face` [H, W] is the coverage of a person's face, by which the exposure is chosen.
    """

    header: StackHeader
    path: Path
    face: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of one sum."""
        return 12 * self.header.seen.size

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""
        height, width = self.header.seen.shape
        return height, width

    @property
    def matte(self) -> np.ndarray:
        """Coverage [H, W] of what the stack shows."""
        return self.header.seen

    @property
    def person_matte(self) -> np.ndarray | None:
        return None if self.face is None else self.matte

    def relit(self, lights: Light) -> Iterator[Relit]:
        """Sums of the stack's lights."""
        return map(Relit, weighted_sum(stream_olats(self.path), lights.weights))

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """What gives rows of the image, of lights over black, and of normals."""
        if other := [name for name in request.layers if name != "normal"]:
            raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
        image = {} if request.image is None else {"rgb": self._lit(request.image)}
        image |= {name: self.header.normals for name in request.layers if image}
        lights = {name: self._lit(one) for name, one in request.lights.items()}

        def rendered(rows: slice) -> dict[str, np.ndarray]:
            matte, found = self.matte[rows][..., None], {name: layer[rows] for name, layer in image.items()}
            return found | {name: light[rows] * matte for name, light in lights.items()}

        return rendered

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule; a face alone is shown well, for it has no photo to compare with."""
        lit, seen = self._lit(relit), self.header.seen
        if rule == "face" or self.face is None:
            return auto_exposure_ev(lit, seen)
        return anchored_exposure_ev(lit, self.header.source, self.face * seen, seen)

    def _lit(self, relit: Relit) -> np.ndarray:
        """Colours [H, W, 3] that are not multiplied by the coverage; 0 where that is."""
        pixels = np.asarray(relit.texture.permute(1, 2, 0).numpy())
        if self.face is None:
            return pixels
        share = self.header.seen[..., None]
        return np.divide(pixels, share, out=np.zeros_like(pixels), where=share > 1e-3)


def face_in_stack(item: Item, header: StackHeader, model: MorphableModel) -> tuple[FaceFit, np.ndarray]:
    """The fit in a stack of a photo's person, and the face's coverage [H, W] of its images.

    Raises InputError for a fit that is damaged.
    """
    try:
        fit = fit_from_arrays(header.fit)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{item.input_path}: the fit in it cannot be used: {error}") from None
    view = view_face(fit.vertices_camera(model), photo_camera(fit.crop, *header.seen.shape), fit.crop.side_px)
    return fit, view.full(view.mask)


class OpenStack(NamedTuple):
    """A stack that can be relit by its own lights, with metadata for its images and facts for the report."""

    subject: Relightable
    lights_of: LightsOf
    metadata: Mapping[str, Any]
    facts: Mapping[str, Any]


def open_stack(item: Item, plan: RelightPlan) -> OpenStack:
    """Open a stack; raises InputError for one of textures, and for options that need a photo."""
    _check_stack(item, plan)
    header = read_olat_header(item.input_path)
    if header.kind == "texture":
        raise InputError(
            f"{item.input_path}: a stack of UV textures; give the photo, or predict it with --frame photo "
            "or face"
        )
    own = torch.from_numpy(header.directions).float()
    if (off_deg := off_rig_deg(plan.setups, own)) > _OFF_RIG_DEG:
        said = (
            "%s: has no light there (the nearest is %.1f degrees away), so those around it are mixed; the "
            "photo itself takes any light"
        )
        log.warning(said, item.input_path, off_deg)
    face, facts = None, dict[str, Any]()
    if header.kind == "photo":
        fit, face = face_in_stack(item, header, face_model(plan.photo))
        facts = fit_facts(fit)
    lights_of = partial(lights_over_stack, directions=own, sampling=plan.sampling)
    metadata = attributes_of_sum(header.metadata, item.input_path.name, item.key)
    return OpenStack(StackImages(header, item.input_path, face), lights_of, metadata, facts)


def _check_stack(item: Item, plan: RelightPlan) -> None:
    """Raise InputError for what only a photo can have."""
    options, lights = plan.options, [light for setup in plan.setups for light in setup.lights]
    of_photo = {
        "--composite photo": plan.keeps_photo,
        "--pose": options.pose is not None,
        "--background": options.background.kind not in ("photo", "none"),
        "--reflectance": options.reflectance not in ("field", "portrait"),
        "--white": options.white != "photo",
        "--network-alone": options.network_alone,
        "--normals-from": options.normals_from is not None,
        "--person": plan.photo.person is not None,
        "--light own": any(light.own for light in lights),
        "--light even": any(light.even for light in lights),
        "--light at=": any(light.at_m is not None for light in lights),
    }
    for option, is_given in of_photo.items():
        if is_given:
            raise InputError(
                f"{item.input_path}: {option} needs the photo, not its stack; give the photo, or leave "
                f"{option} out"
            )
