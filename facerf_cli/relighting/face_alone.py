"""A face by its relit texture: alone, in the pose of its photo or another, or in its photo.

See the paper, 'Relighting'.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import FaceView, photo_camera, view_face
from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.image.strips import Window
from facerf_cli.light.light import Light
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.relighting.detail import FaceDetail
from facerf_cli.relighting.field import near_texture
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest

FACE_LAYERS = ("normal", "position", "depth", "uv", "face")
_FACE_ALPHA = "face.A"


class FaceAlone(Relightable):
    """A head in a pose, before nothing: in its photo's frame, or without one in its crop's.

    Args:
        model: The face model of the fit.
        head: The head in its photo, which the reflectance is of.
        reflectance: Textures of the face under lights; None where textures are given.
        fit: The head's pose and shape as shown; None: as in the photo.
        photo_px: Height and width of the photo.
    """

    def __init__(
        self,
        model: MorphableModel,
        head: Head,
        reflectance: Reflectance | None = None,
        fit: FaceFit | None = None,
        photo_px: tuple[int, int] | None = None,
    ) -> None:
        self.head, self.reflectance, self.fit = head, reflectance, fit
        crop = (fit or head.fit).crop
        if photo_px is None:
            crop = Crop(0.0, 0.0, float(crop.size_px), crop.size_px)
        self.vertices_m = (fit or head.fit).vertices_camera(model)  # [V, 3] as shown, camera space
        camera = photo_camera(crop, *(photo_px or (crop.size_px, crop.size_px)))
        self.view = view_face(self.vertices_m, camera, crop.side_px)

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""
        return self.view.size_px

    @property
    def matte(self) -> np.ndarray:
        """Share [H, W] of the face, with a soft border."""
        return self.view.full(self.view.mask)

    @property
    def nbytes(self) -> int:
        """Bytes of one texture."""
        return self.head.face.texture.nbytes

    def relit(self, lights: Light) -> Iterator[Relit]:
        """Relight the face by each sum of lights (paper, 'Relighting')."""
        assert self.reflectance is not None
        turn = None if self.fit is None else self.head.fit.turn_to(self.fit.rotation)
        side, near = self.head.face.texture.shape[-1], lights.near_points(self.vertices_m.mean(0))
        textures = self.reflectance.relit(lights.directions, lights.weights, turn)
        extra = [near_texture(self.reflectance, points, self.vertices_m, side, turn) for points, _ in near]
        for number, (own, texture) in enumerate(zip(lights.owns, textures, strict=True)):
            for one, (_, rgb) in zip(extra, near, strict=True):
                texture = texture + rgb[number][:, None, None] * one
            yield Relit(texture, own=own)

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """What gives rows of the image, not multiplied by the mask, of lights over black, and of layers."""
        require_face_layers(request.layers)
        return partial(self._render, request)

    def _render(self, request: RenderRequest, rows: slice) -> dict[str, np.ndarray]:
        view, window = self.view, Window(rows, slice(0, self.view.size_px[1]))
        part = window.common(view.window)
        inside, found = part.inside(view.window), {}
        if request.image is not None:
            found["rgb"] = window.framed(view.render(request.image.texture, inside).detach().numpy(), part)
        for name in request.layers:
            found |= face_layer(view, name, window)
        for name, light in request.lights.items():
            shown = view.render(light.texture, inside) * view.mask[inside][..., None]
            found[name] = window.framed(shown.detach().numpy(), part)
        return found

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the relit texture over that of the photo."""
        own = torch.zeros(3) if relit.own is None else relit.own.detach()
        source = self.head.face.texture
        textures = relit.texture + own[:, None, None] * source, source
        lit, plate = (texture.permute(1, 2, 0).numpy() for texture in textures)
        seen = self.head.face.visible.numpy()
        return chosen_exposure_ev(rule, lit, plate, seen, seen)


class FaceInPhoto:
    """A face in its photo [H, W, 3], with the photo's detail, blended in by its mask.

    So a person is relit whose reflectance is the face's alone: the paper's field, and the models that it is
    compared with. `matte` [H, W] is the person's share.
    """

    def __init__(self, face: FaceAlone, photo: np.ndarray, matte: np.ndarray) -> None:
        self.size_px, self.view, self.nbytes = face.size_px, face.view, face.nbytes
        self.relit, self.exposure_ev = face.relit, face.exposure_ev
        self.photo, self.own = photo, PersonColours(photo, matte)
        self.matte = matte * face.matte
        self._detail = FaceDetail(face.head.face, face.view)

    def share(self, rows: slice) -> np.ndarray:
        """Share [h, W] of the face in rows of the photo."""
        return self.matte[rows]

    def ready(self, relit: Relit, layers: Sequence[str] = ()) -> tuple[Tensor, Sequence[str]]:
        """Compute all that does not depend on rows; raises UsageError for layers of whole people."""
        require_face_layers(layers)
        return self._detail.ready(relit.texture), layers

    def render(
        self, window: Window, own: np.ndarray, lights: Sequence[tuple[Tensor, Sequence[str]]]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield rows of the photo, whose person has its `own` colours [h, W, 3], under each light.

        "rgb" [h, W, 3] is the face; others are the light's layers.
        """
        part = window.common(self.view.window)
        lit = self._detail.over(part, own[part.inside(window)])
        for maps, layers in lights:
            image = {"rgb": window.framed(lit(maps), part)}
            for name in layers:
                image |= face_layer(self.view, name, window)
            yield image


def require_face_layers(names: Sequence[str]) -> None:
    """Raise UsageError for layers of whole people."""
    for name in names:
        if name not in FACE_LAYERS:
            raise UsageError(f"--aov {name}: is of whole people; give --reflectance portrait and a photo")


def face_layer(view: FaceView, name: str, window: Window) -> dict[str, np.ndarray]:
    """A window [h, w, C] of one of `FACE_LAYERS` in the photo's frame, by its name in a file."""
    part = window.common(view.window)
    inside = part.inside(view.window)
    if name == "face":
        return {_FACE_ALPHA: window.framed(view.mask[inside].detach().numpy(), part)}
    if name == "uv":
        return {name: window.framed(view.uv[inside].detach().numpy(), part)}
    surface = view.surface(inside.rows)[:, inside.columns]
    values = {"normal": surface[..., :3], "position": surface[..., 3:], "depth": -surface[..., 5:]}[name]
    return {name: window.framed(values.detach().numpy(), part)}
