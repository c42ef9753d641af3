"""The contact sheet of `facerf envmap`: each map, and a white diffuse ball under it, over the map's name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from facerf_cli import __version__
from facerf_cli.colour import auto_exposure_ev
from facerf_cli.files.drawings import contact_sheet, labels
from facerf_cli.files.images import write_display
from facerf_cli.files.light_files import read_map_file
from facerf_cli.light.envmap import ball, mean_radiance

MOST_MAPS = 300  # on a sheet; more would be too many to look at
_MAP_PX = 96  # height of a map
_LABEL_PX = 16


def write_sheet(maps: Sequence[Path], sheet: Path) -> None:
    """Read maps, the first `MOST_MAPS` at most, and write their contact sheet as an image for display."""
    tiles = np.stack([_tile(path) for path in maps[:MOST_MAPS]])
    write_display(sheet, contact_sheet(tiles), metadata={"Software": f"facerf {__version__}"})


def _tile(path: Path) -> np.ndarray:
    """A map and its ball side by side, each exposed well, over the name [h, 3 maps' heights, 3], linear."""
    envmap = mean_radiance(read_map_file(path), _MAP_PX, 0)
    pixels = torch.nn.functional.interpolate(envmap.permute(2, 0, 1)[None], (_MAP_PX, 2 * _MAP_PX))[0]
    shaded = ball(envmap, _MAP_PX, "diffuse").numpy()
    shown = [_exposed(pixels.permute(1, 2, 0).numpy(), None), _exposed(shaded, shaded.max(-1) > 0)]
    picture = np.concatenate(shown, 1)
    return np.concatenate([picture, labels([path.stem], picture.shape[1], _LABEL_PX)])


def _exposed(linear: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    gain = np.float32(2 ** auto_exposure_ev(linear, mask))
    return np.asarray((linear * gain).clip(0, 1))
