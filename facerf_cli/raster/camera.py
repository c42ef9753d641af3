"""Axes, the fixed camera and the head pose; all are defined only here.

Camera space is right-handed, in metres: x to the image's right, y up, z out of the face toward the camera.
The camera is at the origin and looks along -z, so visible points have z < 0; the head pose varies (paper,
'Reflectance Field Representation'). Pixels have their origin at the top-left corner, x to the right, y down,
and their centres at index + `PIXEL_CENTRE`.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

CROP_FOCAL_PER_SIDE = 4.0  # focal length of a face crop, in sides of the crop
PIXEL_CENTRE = 0.5
_SMALL_ANGLE2 = 1e-4  # squared radians below which the series of `so3_exp` is exact to 1e-12
_GIMBAL_LOCK = 1e-6  # cosine of the pitch below which yaw and roll are indistinct


@dataclass(frozen=True)
class Camera:
    """Pinhole camera without distortion; lengths and positions are in pixels of its image."""

    focal_px: float
    width_px: int
    height_px: int
    cx_px: float
    cy_px: float

    def scaled(self, scale: float) -> "Camera":
        """Return the camera of the resized image, whose size is rounded up."""
        width_px, height_px = math.ceil(self.width_px * scale), math.ceil(self.height_px * scale)
        return Camera(self.focal_px * scale, width_px, height_px, self.cx_px * scale, self.cy_px * scale)


PLANE = Camera(1.0, 0, 0, 0.0, 0.0)  # focal length 1, origin on the axis: the same image for every camera


def crop_camera(side_px: int) -> Camera:
    """Return the camera of a face crop: focal length 4 x the side, centred principal point."""
    return Camera(CROP_FOCAL_PER_SIDE * side_px, side_px, side_px, side_px / 2, side_px / 2)


def project(points_camera: Tensor, camera: Camera) -> Tensor:
    """Project camera-space points [..., 3] in metres to pixels [..., 2]; valid only for z < 0."""
    x, y, z = points_camera.unbind(-1)
    scale = camera.focal_px / -z
    return torch.stack([camera.cx_px + scale * x, camera.cy_px - scale * y], -1)


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """Calibrated pinhole camera in the world, which is in metres and right-handed; float64."""

    focal_px: tuple[float, float]  # along x and along y
    centre_px: tuple[float, float]
    width_px: int
    height_px: int
    rotation: Tensor  # [3, 3] world to camera
    translation_m: Tensor  # [3] world to camera

    def project(self, points_world: Tensor) -> Tensor:
        """Project world points [..., 3] to the image's pixels [..., 2], float64."""
        points_camera = points_world.double() @ self.rotation.mT + self.translation_m
        focal, centre = torch.tensor([self.focal_px, self.centre_px], dtype=torch.float64)
        return project(points_camera, PLANE) * focal + centre

    def to_plane(self, px: Tensor) -> Tensor:
        """Convert pixels [..., 2] to the image of `PLANE`."""
        focal, centre = torch.tensor([self.focal_px, self.centre_px], dtype=torch.float64)
        return (px - centre) / focal


def pixel_rays(px: Tensor, camera: Camera) -> Tensor:
    """Return viewing rays [..., 3] through pixels [..., 2], with z = -1: a point at depth d is d * ray."""
    x, y = (px[..., 0] - camera.cx_px) / camera.focal_px, (camera.cy_px - px[..., 1]) / camera.focal_px
    return torch.stack([x, y, -torch.ones_like(x)], -1)


def rays_of_rows(camera: Camera, size: tuple[int, int], rows: slice) -> Tensor:
    """Return viewing rays [n, w, 3] of some rows of the camera's image at another size (h, w)."""
    y = (torch.arange(size[0])[rows] + PIXEL_CENTRE) * (camera.height_px / size[0])
    x = (torch.arange(size[1]) + PIXEL_CENTRE) * (camera.width_px / size[1])
    return pixel_rays(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1), camera)


def pose_to_rotation(yaw_deg: float | Tensor, pitch_deg: float | Tensor, roll_deg: float | Tensor) -> Tensor:
    """Return head_to_camera = Rz(roll) Rx(pitch) Ry(yaw) [3, 3] float32, differentiable in angles of tensors.

    yaw > 0 turns the nose to the image's right, pitch > 0 down, roll > 0 counter-clockwise in the image.
    """
    angles = [torch.as_tensor(angle, dtype=torch.float64) for angle in (yaw_deg, pitch_deg, roll_deg)]
    about = torch.eye(3, dtype=torch.float64)[[1, 0, 2]]
    ry, rx, rz = so3_exp(torch.stack(angles).deg2rad()[:, None] * about)
    return (rz @ rx @ ry).float()


def rotation_to_pose(head_to_camera: Tensor) -> tuple[float, float, float]:
    """Return (yaw, pitch, roll) in degrees of a rotation [3, 3]; at a pitch of +-90 the roll is 0."""
    r = head_to_camera.detach().double().cpu()
    pitch = math.asin(max(-1.0, min(1.0, r[2, 1].item())))
    if math.hypot(r[0, 1].item(), r[1, 1].item()) < _GIMBAL_LOCK:  # only yaw +- roll is defined
        yaw, roll = math.atan2(r[0, 2].item(), r[0, 0].item()), 0.0
    else:
        yaw = math.atan2(-r[2, 0].item(), r[2, 2].item())
        roll = math.atan2(-r[0, 1].item(), r[1, 1].item())
    return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)


def so3_exp(omega: Tensor) -> Tensor:
    """Return rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] in radians; differentiable at 0."""
    angle2 = (omega * omega).sum(-1)[..., None, None]
    small = angle2 < _SMALL_ANGLE2  # sqrt has no gradient at 0
    safe = torch.where(small, torch.ones_like(angle2), angle2)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - angle2 / 6 + angle2**2 / 120, angle.sin() / angle)
    versine = torch.where(small, 0.5 - angle2 / 24 + angle2**2 / 720, (1 - angle.cos()) / safe)
    skew = skew_matrix(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return eye + sine * skew + versine * (skew @ skew)


def skew_matrix(vector: Tensor) -> Tensor:
    """Return [v]x [..., 3, 3] for vectors v [..., 3]: [v]x w is the cross product v x w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)
