"""The shadows of lids and lashes on open eyes, which the chart, one smooth sheet over both, does not cast."""

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.regions import CHART_MM
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.stage.appearance.window import CHART_SPAN, Window, mask

_LIDS_MM, _LASHES_MM = 3.0, 7.0  # how far they stand off the eye
_LASHES_PASS = 0.6  # the share of the light between them
_GRAZING = 0.15  # light less steep than this does not get further under


def lid_shadows(directions: Tensor, side: int) -> Tensor:
    """What lids and lashes let through [L, T, T] of lights in the head frame [L, 3]; 1 off the eyes.

    A point of the eye is lit where the opening, seen from it along the light, is still the opening.
    """
    opening = mask(Window(side, CHART_SPAN), "eyes", 1.5)  # [1, 1, T, T]
    rows = opening[0, 0].amax(1).nonzero()[:, 0]
    band = slice(int(rows[0]), int(rows[-1]) + 1)  # the eyes' rows
    slope = directions[:, :2] / directions[:, 2:].clamp_min(_GRAZING)  # millimetres aside for one of height
    aside_uv = slope * torch.tensor([1.0, -1.0]) / torch.as_tensor(CHART_MM, dtype=torch.float32)
    lids, lashes = (_moved(opening, reach_mm * aside_uv, band) for reach_mm in (_LIDS_MM, _LASHES_MM))
    passed = lids * (_LASHES_PASS + (1 - _LASHES_PASS) * lashes)
    through = torch.ones(len(directions), side, side)
    through[:, band] -= opening[0, :, band] * (1 - passed)
    return through


def _moved(field: Tensor, by_uv: Tensor, rows: slice) -> Tensor:
    """Rows of a field [1, 1, T, T] as they are at places moved by [L, 2]: [L, R, T]."""
    places = texel_centres_uv(field.shape[-1])[rows] + by_uv[:, None, None]
    return F.grid_sample(field.expand(len(by_uv), -1, -1, -1), 2 * places - 1, align_corners=False)[:, 0]
