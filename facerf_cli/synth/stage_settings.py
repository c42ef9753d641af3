"""Settings of a synthetic capture, which `facerf synth-stage` offers as options."""

from dataclasses import dataclass
from typing import Literal

from facerf_cli.option import option

Frame = Literal["head", "bust"]
_STAGE, _IMAGE = "People and stage", "Image"


@dataclass(frozen=True)
class StageSettings:
    """Settings of a capture; `size_px` is the side of an image.

    Attributes:
        size_px: Write square images of this side.
        face_model: Draw people from this face model: builtin, or a .npz of `face-model import`.
        lights: Number of lights, uniform on the sphere.
        cameras: Number of cameras, from the front first, then more and more from the sides.
        frame: Show the head down to the collar, or a bust down to the chest.
    """

    size_px: int = option(
        256, metavar="PX", panel=_IMAGE, flags=("--size",), least=64, most=1024, everyday=True
    )
    face_model: str = option("builtin", metavar="NAME|PATH", panel=_STAGE)
    lights: int = option(150, metavar="N", panel=_STAGE, least=4, most=1000)
    cameras: int = option(8, metavar="N", panel=_STAGE, least=1, most=8, everyday=True)
    seed: int = 0
    frame: Frame = option("head", panel=_IMAGE)
