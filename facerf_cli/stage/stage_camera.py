"""A camera of the synthetic stage."""

from dataclasses import dataclass

from torch import Tensor

from facerf_cli.raster.camera import Camera


@dataclass(frozen=True, eq=False)
class StageCamera:
    """A camera and where it stands: p_camera = head_to_camera [3, 3] @ p_head + translation_m [3]."""

    camera: Camera
    head_to_camera: Tensor
    translation_m: Tensor
