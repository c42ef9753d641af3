"""Where relit textures become files: the photo with its face relit, or the face alone."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerf_cli.errors import InputError
from facerf_cli.logs import LOGGER_NAME

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from facerf_cli.face.crop import Crop
    from facerf_cli.files.images import LinearImage
    from facerf_cli.pipeline import FaceTexture

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Backdrop:
    """The photo [H, W, 3] that a face goes back into, and how."""

    image: "LinearImage"
    surround: bool  # hair and background follow the light
    matte: "np.ndarray | None"  # [H, W], what the light may change

    @property
    def kept(self) -> bool:
        """Some of the photo stays as it was, so a PNG exposes the new light and not the whole picture."""
        return not self.surround or self.matte is not None


class Canvas:
    """One face seen by one camera; writes a picture a relit texture.

    With a `backdrop` the picture is the photo with its face relit, else the rendered face with its alpha.
    """

    def __init__(
        self,
        vertices_camera: "Tensor",
        crop: "Crop",
        size_px: tuple[int, int],
        face: "FaceTexture",
        backdrop: Backdrop | None,
    ) -> None:
        from facerf_cli.composite import Surround
        from facerf_cli.face.view import photo_camera, view_face

        self._face, self._backdrop = face, backdrop
        self._view = view_face(vertices_camera, photo_camera(crop, *size_px), crop.side_px)
        follow = backdrop is not None and backdrop.surround
        self._surround = Surround(vertices_camera, crop, *size_px) if follow else None
        view = self._view
        self.seen = face.visible
        self._mask = view.full(view.mask)
        places = {"normal": view.normal, "position": view.position_m, "uv": view.uv}
        self._layers: dict[str, np.ndarray] = {name: view.full(values) for name, values in places.items()}

    def write(self, path: Path, relit: "Tensor", exposure_ev: float, metadata: Mapping[str, Any]) -> None:
        """Write a relit texture [3, T, T] as an EXR of absolute light and a PNG at an exposure beside it."""
        pixels, alpha = self._image(relit)
        shown = self._image(relit * 2**exposure_ev)[0] if self.kept else pixels * 2**exposure_ev
        layers = self._layers if self._backdrop is None else {"face.A": self._mask, **self._layers}
        _write(path, pixels, shown, alpha, layers, exposure_ev, metadata)

    @property
    def kept(self) -> bool:
        """The photo's own light stays in part of the picture."""
        return self._backdrop is not None and self._backdrop.kept

    def auto_exposure_ev(self, relit: "Tensor") -> float:
        """The PNG's exposure: the lit face well exposed; beside a kept background as bright as it was."""
        chosen_ev = _auto_exposure_ev(relit, self.seen)
        return chosen_ev - _auto_exposure_ev(self._face.texture, self.seen) if self.kept else chosen_ev

    def _image(self, relit: "Tensor") -> "tuple[np.ndarray, np.ndarray | None]":
        """Colour [H, W, 3], not multiplied by the alpha [H, W] beside it."""
        from facerf_cli.composite import composite

        if self._backdrop is None:
            return self._view.full(self._view.render(relit)), self._mask
        image, face = self._backdrop.image, self._face
        pixels = composite(
            image.pixels,
            face.texture,
            relit,
            face.visible,
            self._view,
            self._surround,
            self._backdrop.matte,
        )
        return pixels, image.alpha


@dataclass(frozen=True, eq=False)
class ImageCanvas:
    """For stacks of pictures that are rendered already; seen [H, W] is the face's coverage."""

    seen: "Tensor"
    normals: "np.ndarray"  # [H, W, 3]

    def write(self, path: Path, relit: "Tensor", exposure_ev: float, metadata: Mapping[str, Any]) -> None:
        """Write a relit picture [3, H, W] as an EXR and a PNG."""
        pixels, alpha = relit.permute(1, 2, 0).numpy(), self.seen.numpy()
        _write(path, pixels, pixels * 2**exposure_ev, alpha, {"normal": self.normals}, exposure_ev, metadata)

    def auto_exposure_ev(self, relit: "Tensor") -> float:
        """The PNG's exposure: the lit face well exposed."""
        return _auto_exposure_ev(relit, self.seen)


def _auto_exposure_ev(relit: "Tensor", seen: "Tensor") -> float:
    from facerf_cli.colour import auto_exposure_ev

    return auto_exposure_ev(relit.permute(1, 2, 0).numpy(), seen.numpy())


def _write(
    path: Path,
    pixels: "np.ndarray",
    shown: "np.ndarray",
    alpha: "np.ndarray | None",
    layers: "Mapping[str, np.ndarray]",
    exposure_ev: float,
    metadata: Mapping[str, Any],
) -> None:
    from facerf_cli.files.images import write_display, write_exr

    metadata = {**metadata, "facerf:exposure_ev": exposure_ev}  # of the PNG, in both
    write_display(path.with_suffix(".png"), shown, 0.0, alpha, metadata)
    write_exr(path, pixels, alpha, layers, metadata)
    log.info("%s: exposure %+.2f EV", path.with_suffix(".png"), exposure_ev)


def read_matte(path: Path, size_px: tuple[int, int]) -> "np.ndarray":
    """A matte [H, W] in 0..1 of a photo of that size: the file's alpha, or its values as they stand."""
    from facerf_cli.files.images import read_image

    image = read_image(path, "linear")
    matte = image.pixels.mean(-1) if image.alpha is None else image.alpha
    if matte.shape != size_px:
        height, width = matte.shape
        raise InputError(
            f"{path}: the matte is {width} x {height}, the photo {size_px[1]} x {size_px[0]} pixels"
        )
    return matte.clip(0, 1)
