"""The report of a prepared dataset: a contact sheet a subject, and an HTML page of all subjects.

The page shows every subject's sheet, split, fit and findings; it is plain HTML without scripts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.colour import auto_exposure_ev
from facerf_cli.face.crop import Crop
from facerf_cli.face.drawings import draw_fit
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.drawings import mark_light
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.files.pages import filled_page
from facerf_cli.light.sphere import azel_to_direction

_TILE_PX = 192
_SHEET_AZEL_DEG = ((0.0, 15.0), (-60.0, 20.0), (60.0, 20.0))  # front, left and right, in camera space

FindingRows = Sequence[Mapping[str, Any]]


def index_page(
    dataset: Mapping[str, Any], records: Mapping[str, Mapping[str, Any]], findings: Mapping[str, FindingRows]
) -> str:
    """Make the page from the content of `dataset.json`, the records of finished subjects and the findings."""
    return filled_page(
        Path(__file__).with_name("index.html"),
        dataset=dataset,
        records=records,
        findings=findings,
        split_of={name: split for split, names in dataset["splits"].items() for name in names},
    )


def sheet_lights(directions: np.ndarray) -> list[int]:
    """Indices of the sheet's three lights: those nearest to front, left and right; directions [L, 3]."""
    wanted = np.stack([azel_to_direction(*azel).numpy() for azel in _SHEET_AZEL_DEG])
    return (wanted @ directions.T).argmax(1).tolist()


def sheet_tiles(
    header: StackHeader, fit: FaceFit, model: MorphableModel, shown: Mapping[int, np.ndarray]
) -> np.ndarray:
    """Tiles of one camera [6, h, w, 3]: fully lit, the fit over it, masked, and three single lights.

    Scene-linear, exposed for display; the three lights share one exposure.
    """
    side_px = fit.crop.size_px
    lit = header.source * np.float32(2 ** auto_exposure_ev(header.source))
    overlay = draw_fit(header.source, replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px)), model)
    masked = lit * (0.1 + 0.9 * header.seen[..., None])
    single = np.stack([shown[light] for light in sheet_lights(header.directions)])
    single *= np.float32(2 ** auto_exposure_ev(single.reshape(-1, side_px, 3)))
    small = Crop(0.0, 0.0, float(side_px), _TILE_PX)  # crops of a subject may differ in size
    tiles = np.stack([small.apply(tile.clip(0, 1)) for tile in (lit, overlay, masked, *single)])
    for tile, light in zip(tiles[3:], sheet_lights(header.directions), strict=True):
        mark_light(tile, header.directions[light], 1.0)
    return tiles
