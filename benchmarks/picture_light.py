"""Light guessed from a picture without a person, next to the panorama that the picture was cut from.

    python benchmarks/picture_light.py [MAP|DIR ...]

Each map is seen at four headings by a camera of 60 degrees, in 8 bits, clipped as cameras clip. Printed are
means over the cases, for the light on a matte white ball that the camera sees:

    error    squared relative error under one scale for all channels
    colour   difference of the logarithms of r/g and b/g
    level    size of the error in EV, at the picture's scale

Twins: the picture's mean colour from all around; and the same brighter from above, times 1 + 1.5 y.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from _common import MAPS, arguments, print_header, print_row, skip
from torch import Tensor

from facerf_cli.files.light_files import read_map_file
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.light.envmap import look_up, resampled
from facerf_cli.light.picture import light_of_picture
from facerf_cli.light.sphere import LUMINANCE, latlong_directions, latlong_solid_angles
from tools.picture_network import ball_error, ball_normals, colour_error

ROWS, COLUMNS, FOV_DEG, TURNS = 160, 240, 60.0, 4
MEAN = 0.25  # luminance of a picture
TRUTH_ROWS = 128
DIRECTIONS = latlong_directions(TRUTH_ROWS, 2 * TRUTH_ROWS)
SOLID_ANGLES = latlong_solid_angles(TRUTH_ROWS, 2 * TRUTH_ROWS)
NORMALS = ball_normals()
WEIGHTS = torch.tensor(LUMINANCE)


def main() -> None:
    """Print a row for each way to guess."""
    parser = arguments(__doc__)
    parser.add_argument("maps", type=Path, nargs="*", help="lat-long maps, or folders of them")
    paths = [one for path in parser.parse_args().maps or [MAPS] for one in _maps_in(path)]
    if not paths:
        skip("lat-long maps", "MAP ...")
    cases = [case for path in paths for case in cases_of(read_map_file(path))]
    print_header("guess", "cases", "error", "median", "colour", "level")
    for name, guess in WAYS.items():
        rows = torch.stack([figures(guess(picture), truth) for picture, truth in cases])
        error, colour, level = rows.mean(0).tolist()
        print_row(
            name, len(rows), f"{error:.3f}", f"{rows[:, 0].median():.3f}", f"{colour:.3f}", f"{level:.2f}"
        )


def _maps_in(path: Path) -> list[Path]:
    return (
        [path] if path.is_file() else sorted(one for one in path.glob("*") if one.suffix in (".hdr", ".exr"))
    )


def cases_of(envmap: Tensor) -> list[tuple[Tensor, Tensor]]:
    """A picture [160, 240, 3] decoded from 8 bits, and the map on its scale [128, 256, 3], a heading."""
    half = math.tan(math.radians(FOV_DEG / 2))
    x = ((torch.arange(COLUMNS) + 0.5) / COLUMNS * 2 - 1).expand(ROWS, COLUMNS) * half
    y = (1 - (torch.arange(ROWS) + 0.5) / ROWS * 2)[:, None].expand(ROWS, COLUMNS) * half * ROWS / COLUMNS
    directions = torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)
    cases = []
    for turn in range(TURNS):
        turned = torch.roll(envmap, turn * envmap.shape[1] // TURNS, 1)
        view = look_up(turned, directions).reshape(ROWS, COLUMNS, 3)
        gain = MEAN / (view @ WEIGHTS).mean()
        stored = np.round(linear_to_srgb((view * gain).clamp(0, 1).numpy()) * 255) / 255
        picture = torch.from_numpy(srgb_to_linear(stored.astype(np.float32)))
        cases.append((picture, resampled(turned, TRUTH_ROWS) * gain))
    return cases


def figures(guess: Tensor, truth: Tensor) -> Tensor:
    """Error, colour and level [3] of a guessed map, against the truth, both [128, 256, 3]."""
    lit, truly = (on_ball(envmap)[None] for envmap in (guess, truth))
    level = torch.log2((lit @ WEIGHTS).mean() / (truly @ WEIGHTS).mean()).abs()
    return torch.stack([ball_error(lit, truly)[0], colour_error(lit, truly)[0], level])


def on_ball(envmap: Tensor) -> Tensor:
    """Radiance [N, 3] of a white ball under a map."""
    cosines = (NORMALS @ DIRECTIONS.reshape(-1, 3).T).clamp_min(0) * SOLID_ANGLES.reshape(-1) / math.pi
    return cosines @ envmap.reshape(-1, 3)


def mean_around(picture: Tensor) -> Tensor:
    """The mean colour from everywhere."""
    return picture.mean((0, 1)).expand(TRUTH_ROWS, 2 * TRUTH_ROWS, 3)


def from_above(picture: Tensor) -> Tensor:
    """The mean colour, brighter from above."""
    return mean_around(picture) * (1 + 1.5 * DIRECTIONS[..., 1:2]).clamp_min(0)


WAYS: dict[str, Callable[[Tensor], Tensor]] = {
    "mean colour": mean_around,
    "from above": from_above,
    "facerf": lambda picture: light_of_picture(picture, FOV_DEG).envmap,
}


if __name__ == "__main__":
    main()
