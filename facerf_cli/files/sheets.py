"""Contact sheets, labels and HTML pages."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image, ImageDraw

_GAP_PX = 2  # black, between tiles
_MARK_SIDE, _SMALLEST_MARK_PX = 0.2, 9  # side of a light's mark, in heights of a tile


def contact_sheet(tiles: np.ndarray, columns: int | None = None) -> np.ndarray:
    """Arrange tiles [N, h, w, 3] row by row on black [H, W, 3]; without `columns` at about 3 : 2."""
    count, height, width, _ = tiles.shape
    columns = min(count, columns or math.ceil(math.sqrt(1.5 * count * height / width)))
    rows = math.ceil(count / columns)
    padded = np.zeros((rows * columns, height + _GAP_PX, width + _GAP_PX, 3), np.float32)
    padded[:count, :height, :width] = tiles
    sheet = padded.reshape(rows, columns, *padded.shape[1:]).transpose(0, 2, 1, 3, 4)
    return sheet.reshape(rows * padded.shape[1], columns * padded.shape[2], 3)[:-_GAP_PX, :-_GAP_PX]


def labels(words: Sequence[str], tile_px: int, height_px: int) -> np.ndarray:
    """Return a black strip [height, N * tile, 3], linear, with one grey word per tile."""
    strip = Image.new("L", (tile_px * len(words), height_px))
    draw = ImageDraw.Draw(strip)
    for column, word in enumerate(words):
        draw.text((column * tile_px + 6, height_px // 2), word, fill=200, anchor="lm")
    grey = np.asarray(strip, np.float32)[..., None] / 255
    return np.repeat(grey, 3, -1)


def mark_light(tile: np.ndarray, direction: np.ndarray, brightness: float) -> None:
    """Draw a light's direction into the lower left corner of a tile [h, w, 3]: a dot in a disc.

    The disc shows the sphere of directions from the camera. The dot is filled for a light in front of the
    face and hollow for a light behind it.
    """
    side = max(_SMALLEST_MARK_PX, round(_MARK_SIDE * tile.shape[0]))
    corner = tile[-side:, :side]
    axis = (np.arange(side) + 0.5) * (2 / side) - 1
    x, y = axis[None, :], -axis[:, None]
    distance = np.hypot(x - 0.7 * direction[0], y - 0.7 * direction[1])
    corner[np.hypot(x, y) < 1] = 0.08 * brightness
    corner[(distance < 0.28) & ((direction[2] >= 0) | (distance > 0.14))] = brightness


def filled_page(template: Path, **values: Any) -> str:
    """Fill a Jinja template, which may include files of its folder; a missing value is an error."""
    environment = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template.name).render(**values)
