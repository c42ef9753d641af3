"""The contact sheets of prepared subjects: a row of tiles a camera."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facerf_cli.colour import auto_exposure_ev
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.overlay import draw_fit
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.report import mark_light

_TILE_PX = 192
_SHOWN_AZEL_DEG = ((0.0, 15.0), (-60.0, 20.0), (60.0, 20.0))  # three lights, to the camera


def lights_shown(directions: np.ndarray) -> list[int]:
    """Three lights of the sheet: those nearest to a lamp in front, on the left and on the right."""
    wanted = np.stack([azel_to_direction(*azel).numpy() for azel in _SHOWN_AZEL_DEG])
    return (wanted @ directions.T).argmax(1).tolist()


def sheet_tiles(
    header: StackHeader, fit: FaceFit, model: MorphableModel, shown: Mapping[int, np.ndarray]
) -> np.ndarray:
    """Fully lit, the fit over it, what the mask leaves of it, three single lights: [6, h, w, 3].

    Linear, exposed for display: each on its own, but the three lights alike.
    """
    side_px = fit.crop.size_px
    lit = header.source * np.float32(2 ** auto_exposure_ev(header.source))
    overlay = draw_fit(header.source, replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px)), model)
    masked = lit * (0.1 + 0.9 * header.seen[..., None])
    single = np.stack([shown[light] for light in lights_shown(header.directions)])
    single *= np.float32(2 ** auto_exposure_ev(single.reshape(-1, side_px, 3)))
    small = Crop(0.0, 0.0, float(side_px), min(side_px, _TILE_PX))
    tiles = np.stack([small.apply(tile.clip(0, 1)) for tile in (lit, overlay, masked, *single)])
    for tile, light in zip(tiles[3:], lights_shown(header.directions), strict=True):
        mark_light(tile, header.directions[light], 1.0)
    return tiles
