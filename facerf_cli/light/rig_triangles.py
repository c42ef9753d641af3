"""The lights of a rig around each direction: a triangle of three, whose shares change smoothly.

A light that moves passes from one cell of the rig to the next in a step; between the lights of a triangle it
is shared by barycentric coordinates, so that an image under it changes without steps.
"""

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

_AT_ONCE = 1 << 12  # directions that are compared with all triangles
_OUTSIDE = -1e-4  # a share below it: the rig does not surround this direction


def lights_around(directions: Tensor, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Three of the lights [L, 3] around each of directions [P, 3]: indices and shares [P, 3], which sum to 1.

    Shares are float64. Where a rig surrounds no such direction, its nearest light has all.
    """
    nearest = (directions.double() @ lights.double().T).argmax(1)
    index = nearest[:, None].expand(-1, 3).clone()
    share = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).repeat(len(directions), 1)
    try:
        hull = ConvexHull(lights.double().numpy())
    except (QhullError, ValueError):  # fewer than four lights, or all in a plane
        return index, share
    corners = torch.from_numpy(hull.simplices).long()  # [F, 3]
    planes = torch.from_numpy(hull.equations)  # [F, 4]: n . x + d = 0, n outward
    around = torch.linalg.pinv(lights.double()[corners].mT)  # [F, 3, 3]: from a direction to its shares
    reciprocal = planes[:, :3] / -planes[:, 3:].clamp(max=-1e-9)  # of the distance along a ray
    for first in range(0, len(directions), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        toward = directions[rows].double()
        triangle = (toward @ reciprocal.T).argmax(1)
        found = torch.einsum("pij,pj->pi", around[triangle], toward)
        inside = (found > _OUTSIDE).all(1) & (planes[triangle, 3] < 0)
        found = found.clamp(min=0)
        index[rows][inside] = corners[triangle][inside]
        share[rows][inside] = (found / found.sum(1, keepdim=True).clamp_min(1e-12))[inside]
    return index, share
