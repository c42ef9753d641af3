"""ComfyUI nodes that relight portraits: images are display sRGB [B, H, W, 3] in 0..1, masks [B, H, W]."""

from functools import cache
from typing import Any, ClassVar

import numpy as np
import torch

import facerf_cli as facerf
from facerf_cli.image.colour import SOFT_VIEW, encode_display, srgb_to_linear
from facerf_cli.relighting.models import Models


@cache
def _models() -> Models:
    return facerf.load_models()


def _shown(linear: np.ndarray, ev: float) -> torch.Tensor:
    """A scene-linear image as the PNG of facerf has it."""
    return torch.from_numpy(encode_display(linear * np.float32(2.0**ev), SOFT_VIEW).astype(np.float32))


class FacerfLight:
    """A single light: azimuth (right > 0) and elevation (above > 0) in degrees, and its linear colour."""

    CATEGORY, FUNCTION = "facerf", "make"
    RETURN_TYPES: ClassVar = ("FACERF_LIGHT",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """Name the widgets, as ComfyUI asks for them."""

        def number(default: float, low: float, high: float, step: float) -> tuple[str, dict[str, float]]:
            return "FLOAT", {"default": default, "min": low, "max": high, "step": step}

        colour = {name: number(1.0, 0.0, 100.0, 0.05) for name in ("red", "green", "blue")}
        place = {
            "azimuth": number(40.0, -180.0, 180.0, 1.0),
            "elevation": number(25.0, -90.0, 90.0, 1.0),
        }
        return {"required": place | colour, "optional": {"add_to": ("FACERF_LIGHT",)}}

    def make(
        self,
        azimuth: float,
        elevation: float,
        red: float,
        green: float,
        blue: float,
        add_to: facerf.Light | None = None,
    ) -> tuple[facerf.Light]:
        """Make a light, added to another if there is one."""
        light = facerf.Light.single(azimuth, elevation, (red, green, blue))
        return (light if add_to is None else add_to + light,)


class FacerfEnvironment:
    """A lat-long map file (.exr, .hdr), turned by degrees."""

    CATEGORY, FUNCTION = "facerf", "read"
    RETURN_TYPES: ClassVar = ("FACERF_LIGHT",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """Name the widgets, as ComfyUI asks for them."""
        turn = ("FLOAT", {"default": 0.0, "min": -360.0, "max": 360.0, "step": 1.0})
        return {"required": {"path": ("STRING", {"default": "sky.exr"}), "rotate": turn}}

    def read(self, path: str, rotate: float) -> tuple[facerf.Light]:
        """Read a map as a rig of lights."""
        return (facerf.Light.from_envmap(facerf.read_image(path), rotate_deg=rotate),)


class FacerfRelight:
    """Relight the largest person of each image; the second output is the person's matte."""

    CATEGORY, FUNCTION = "facerf", "relight"
    RETURN_TYPES: ClassVar = ("IMAGE", "MASK")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """Name the widgets, as ComfyUI asks for them."""
        exposure = ("FLOAT", {"default": 0.0, "min": -10.0, "max": 10.0, "step": 0.1})
        return {"required": {"image": ("IMAGE",), "light": ("FACERF_LIGHT",), "exposure_ev": exposure}}

    def relight(
        self, image: torch.Tensor, light: facerf.Light, exposure_ev: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Relight images [B, H, W, 3] over black; put them on any background by the mask [B, H, W]."""
        images, mattes = [], []
        for one in image.cpu().numpy()[..., :3]:
            photo = srgb_to_linear(np.ascontiguousarray(one, np.float32))
            relit = facerf.fit(_models(), photo).relight(light, background="none")
            images.append(_shown(relit[..., :3], exposure_ev))
            mattes.append(torch.from_numpy(np.ascontiguousarray(relit[..., 3], np.float32)))
        return torch.stack(images), torch.stack(mattes)


NODE_CLASS_MAPPINGS = {
    "FacerfLight": FacerfLight,
    "FacerfEnvironment": FacerfEnvironment,
    "FacerfRelight": FacerfRelight,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "FacerfLight": "facerf light",
    "FacerfEnvironment": "facerf environment map",
    "FacerfRelight": "facerf relight",
}
