"""The haze of a picture: its darkest and brightest tones, and a person brought between them."""

from dataclasses import dataclass

import numpy as np

from facerf_cli.image.colour import softened
from facerf_cli.image.strips import Rows

_BLACK_PERCENT, _WHITE_PERCENT = 1.0, 99.0  # of a picture's pixels
_MOST_BLACK, _LEAST_WHITE = 0.1, 0.4  # a plain wall is no haze
_SAMPLE_PX = 256  # rows, and columns, that are looked at


@dataclass(frozen=True)
class Haze:
    """A picture's black and white, exposed linear Rec.709."""

    black: float
    white: float

    def over(self, linear: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Exposed colours [h, W, 3] with those of a person, by its share [h, W], within these tones."""
        toned = self.black + (1 - self.black) * linear
        if self.white < 1:
            toned = self.white * softened(toned / self.white)
        return np.asarray(linear + share[..., None] * (toned - linear))


def haze_of(picture: Rows, size_px: tuple[int, int]) -> Haze:
    """The haze of a picture [H, W, 3], exposed linear Rec.709.

    Its black is that of the darkest channel (He et al., CVPR 2009): grass is no haze, since its blue is dark.
    """
    height, width = size_px
    rows = range(0, height, max(1, height // _SAMPLE_PX))
    columns = slice(None, None, max(1, width // _SAMPLE_PX))
    seen = np.concatenate([picture[row : row + 1][0, columns] for row in rows])
    black = float(np.percentile(seen.min(-1), _BLACK_PERCENT))
    white = float(np.percentile(seen.max(-1), _WHITE_PERCENT))
    return Haze(min(max(black, 0), _MOST_BLACK), max(white, _LEAST_WHITE))
