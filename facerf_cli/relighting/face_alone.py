"""Render only the face from its relit texture: over black in any pose, or blended into its photo.

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
    """Only the face over black, in the frame of its photo, or of its crop if there is no `photo_px`.

    `fit` is the pose and shape of the rendered head; by default they are the photo's. `reflectance` renders
    the texture under lights; None if textures are passed instead.
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
        self.vertices_m = (fit or head.fit).vertices_camera(model)  # [V, 3], camera space
        camera = photo_camera(crop, *(photo_px or (crop.size_px, crop.size_px)))
        self.view = view_face(self.vertices_m, camera, crop.side_px)

    @property
    def size_px(self) -> tuple[int, int]:
        return self.view.size_px

    @property
    def matte(self) -> np.ndarray:
        return self.view.full(self.view.mask)

    @property
    def nbytes(self) -> int:
        return self.head.face.texture.nbytes

    def relit(self, lights: Light) -> Iterator[Relit]:
        assert self.reflectance is not None
        turn = None if self.fit is None else self.head.fit.turn_to(self.fit.rotation)
        side, near = self.head.face.texture.shape[-1], lights.near_points(self.vertices_m.mean(0))
        textures = self.reflectance.relit(lights.directions, lights.weights, turn)
        extra = [near_texture(self.reflectance, points, self.vertices_m, side, turn) for points, _ in near]
        for number, (original_rgb, texture) in enumerate(zip(lights.original_rgbs, textures, strict=True)):
            for one, (_, rgb) in zip(extra, near, strict=True):
                texture = texture + rgb[number][:, None, None] * one
            yield Relit(texture, original_rgb=original_rgb)

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        require_face_layers(request.layers)
        return partial(self._render, request)

    def _render(self, request: RenderRequest, rows: slice) -> dict[str, np.ndarray]:
        """Render rows. "rgb" is not multiplied by the mask, lights over black are."""
        view, window = self.view, Window(rows, slice(0, self.view.size_px[1]))
        part = window.common(view.window)
        inside, layers = part.inside(view.window), {}
        if request.image is not None:
            layers["rgb"] = window.framed(view.render(request.image.texture, inside).detach().numpy(), part)
        for name in request.layers:
            layers |= face_layer(view, name, window)
        for name, light in request.lights.items():
            masked = view.render(light.texture, inside) * view.mask[inside][..., None]
            layers[name] = window.framed(masked.detach().numpy(), part)
        return layers

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        original_rgb = torch.zeros(3) if relit.original_rgb is None else relit.original_rgb.detach()
        source = self.head.face.texture
        textures = relit.texture + original_rgb[:, None, None] * source, source
        lit, plate = (texture.permute(1, 2, 0).numpy() for texture in textures)
        visible = self.head.face.visible.numpy()
        return chosen_exposure_ev(rule, lit, plate, visible, visible)


class FaceInPhoto:
    """Face with the photo's detail, blended into its photo [H, W, 3] by the mask of the face.

    Used if the reflectance covers only the face: the paper's field and the comparison models. `matte` [H, W]
    is the person's alpha.
    """

    def __init__(self, face: FaceAlone, photo: np.ndarray, matte: np.ndarray) -> None:
        self.size_px, self.view, self.nbytes = face.size_px, face.view, face.nbytes
        self.relit, self.exposure_ev = face.relit, face.exposure_ev
        self.photo, self.own = photo, PersonColours(photo, matte)
        self.matte = matte * face.matte
        self._detail = FaceDetail(face.head.face, face.view)

    def alpha_rows(self, rows: slice) -> np.ndarray:
        """Return the alpha [h, W] of the face in rows of the photo."""
        return self.matte[rows]

    def precompute(self, relit: Relit, layers: Sequence[str] = ()) -> tuple[Tensor, Sequence[str]]:
        """Compute everything that does not depend on rows."""
        require_face_layers(layers)
        return self._detail.precompute(relit.texture), layers

    def render(
        self, window: Window, own: np.ndarray, lights: Sequence[tuple[Tensor, Sequence[str]]]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield "rgb" [h, W, 3] and layers in a window of the photo under each precomputed light.

        `own` [h, W, 3] are the person's colours in the photo.
        """
        part = window.common(self.view.window)
        lit = self._detail.over(part, own[part.inside(window)])
        for maps, layers in lights:
            image = {"rgb": window.framed(lit(maps), part)}
            for name in layers:
                image |= face_layer(self.view, name, window)
            yield image


def require_face_layers(names: Sequence[str]) -> None:
    for name in names:
        if name not in FACE_LAYERS:
            raise UsageError(
                f"--aov {name}: requires the whole person; use --reflectance portrait and a photo"
            )


def face_layer(view: FaceView, name: str, window: Window) -> dict[str, np.ndarray]:
    """Return one of `FACE_LAYERS` [h, w, C] in a window of the photo, by its name in a file."""
    part = window.common(view.window)
    inside = part.inside(view.window)
    if name == "face":
        return {_FACE_ALPHA: window.framed(view.mask[inside].detach().numpy(), part)}
    if name == "uv":
        return {name: window.framed(view.uv[inside].detach().numpy(), part)}
    surface = view.surface(inside.rows)[:, inside.columns]
    values = {"normal": surface[..., :3], "position": surface[..., 3:], "depth": -surface[..., 5:]}[name]
    return {name: window.framed(values.detach().numpy(), part)}
