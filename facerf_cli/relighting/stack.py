"""OLAT stacks as subjects: weighted sums of a stack's images, at its size and in its frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import photo_camera, view_face
from facerf_cli.files.olat_stack import StackHeader, stream_olats
from facerf_cli.image.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.light.light import Light
from facerf_cli.relighting.field import weighted_sum
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest


@dataclass(frozen=True, eq=False)
class StackImages(Relightable):
    """The images of a stack, over black: a face, or the person of a photo.

    Attributes:
        header: The stack's header.
        path: Its file.
        face: Coverage [H, W] of the face of a photo's person, which decides the exposure.
    """

    header: StackHeader
    path: Path
    face: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        return 12 * self.header.seen.size

    @property
    def size_px(self) -> tuple[int, int]:
        height, width = self.header.seen.shape
        return height, width

    @property
    def matte(self) -> np.ndarray:
        return self.header.seen

    @property
    def person_matte(self) -> np.ndarray | None:
        return None if self.face is None else self.matte

    def relit(self, lights: Light) -> Iterator[Relit]:
        return map(Relit, weighted_sum(stream_olats(self.path), lights.weights))

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        if other := [name for name in request.layers if name != "normal"]:
            raise UsageError(f"--aov {other[0]}: a stack contains only normals; use --aov normal")
        image = {} if request.image is None else {"rgb": self._straight(request.image)}
        image |= {name: self.header.normals for name in request.layers if image}
        lights = {name: self._straight(relit) for name, relit in request.lights.items()}

        def rendered(rows: slice) -> dict[str, np.ndarray]:
            matte, layers = self.matte[rows][..., None], {name: layer[rows] for name, layer in image.items()}
            return layers | {name: light[rows] * matte for name, light in lights.items()}

        return rendered

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        pixels, seen = self._straight(relit), self.header.seen
        if rule == "face" or self.face is None:  # there is no photo to compare a face with
            return auto_exposure_ev(pixels, seen)
        return anchored_exposure_ev(pixels, self.header.source, self.face * seen, seen)

    def _straight(self, relit: Relit) -> np.ndarray:
        """Return colours [H, W, 3] that are not multiplied by the coverage; 0 where the coverage is 0."""
        pixels = np.asarray(relit.texture.permute(1, 2, 0).numpy())
        if self.face is None:
            return pixels
        share = self.header.seen[..., None]
        return np.divide(pixels, share, out=np.zeros_like(pixels), where=share > 1e-3)


def face_in_stack(path: Path, header: StackHeader, model: MorphableModel) -> tuple[FaceFit, np.ndarray]:
    """Return the face fit of a stack's person, and the face's coverage [H, W] of its images.

    Raises InputError if the fit is damaged.
    """
    try:
        fit = fit_from_arrays(header.fit)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: its face fit cannot be read ({error}); predict the stack again") from None
    view = view_face(fit.vertices_camera(model), photo_camera(fit.crop, *header.seen.shape), fit.crop.side_px)
    return fit, view.full(view.mask)
