"""What every page that facerf writes begins and ends with; a page is one file and fetches nothing.

Pictures of results, for people to look at.
"""

import math
from collections.abc import Iterable
from html import escape

import numpy as np


def html_page(title: str, style: str, body: Iterable[str]) -> str:
    """A page of lines that are markup already; `title` is text, `style` CSS."""
    head = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>"
    )
    return "\n".join([head, *body, "</body>\n</html>\n"])


_GAP_PX = 2
_MARK = 0.2  # of a tile's height: the mark of its light


def contact_sheet(tiles: np.ndarray, columns: int | None = None) -> np.ndarray:
    """Tiles [N, h, w, 3] row by row on black [H, W, 3]; `columns` None makes the sheet about 3 : 2."""
    count, height, width, _ = tiles.shape
    columns = min(count, columns or math.ceil(math.sqrt(1.5 * count * height / width)))
    rows = math.ceil(count / columns)
    padded = np.zeros((rows * columns, height + _GAP_PX, width + _GAP_PX, 3), np.float32)
    padded[:count, :height, :width] = tiles
    sheet = padded.reshape(rows, columns, *padded.shape[1:]).transpose(0, 2, 1, 3, 4)
    return sheet.reshape(rows * padded.shape[1], columns * padded.shape[2], 3)[:-_GAP_PX, :-_GAP_PX]


def mark_light(tile: np.ndarray, direction: np.ndarray, brightness: float) -> None:
    """Draw into a tile's [h, w, 3] corner where its light stands: a dot in a disc seen as the camera sees it.

    The dot is full for a light on the camera's side of the face, hollow for one behind.
    """
    side = max(9, round(_MARK * tile.shape[0]))
    corner = tile[-side:, :side]
    axis = (np.arange(side) + 0.5) * (2 / side) - 1
    x, y = axis[None, :], -axis[:, None]
    off = np.hypot(x - 0.7 * direction[0], y - 0.7 * direction[1])
    corner[np.hypot(x, y) < 1] = 0.08 * brightness
    corner[(off < 0.28) & ((direction[2] >= 0) | (off > 0.14))] = brightness
