"""Classes of the angles that break the protocols' tables down."""

from itertools import pairwise

from torch import Tensor

LIGHTS_DEG = (0, 30, 60, 90, 180)  # between a light and the camera's axis
TURNS_DEG = (0, 30, 60, 180)  # of the head, from the source's pose to the target's
_NO_TURN_DEG = 0.5


def angle_of(rotation: Tensor) -> float:
    """The angle in degrees of a rotation [3, 3]."""
    return float((((rotation.trace() - 1) / 2).clamp(-1, 1).acos()).rad2deg())


def angle_class(angle_deg: float) -> str:
    """'0 to 30 deg' and so on, of the angle between a light and the camera's axis."""
    return _class(angle_deg, LIGHTS_DEG)


def turn_class(angle_deg: float) -> str:
    """'none', '0 to 30 deg' and so on, of the angle by which a head is turned."""
    return "none" if angle_deg < _NO_TURN_DEG else _class(angle_deg, TURNS_DEG)


def _class(angle_deg: float, edges_deg: tuple[int, ...]) -> str:
    return next(f"{low} to {high} deg" for low, high in pairwise(edges_deg) if angle_deg <= high)
