"""Maps of `facerf envmap`, and their contact sheet: each map beside a white ball under it."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from facerf_cli._version import __version__
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.settings import BatchOptions, Overwrite
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import sweep_leftovers
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.light_files import read_map_file
from facerf_cli.files.sheets import contact_sheet, labels
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import auto_exposure_ev
from facerf_cli.light.envmap import ball, mean_radiance
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky, kind_of

SHEET = "envmaps.png"
Facts = dict[str, str | int | float]
log = logging.getLogger(LOGGER_NAME)
MOST_MAPS = 300  # on a sheet; more would be too many to look at
_MAP_PX = 96  # height of a map
_LABEL_PX = 16


def write_envmaps(
    batch: BatchOptions, count: int, kind: Sequence[str] | None, size_px: int, seed: int
) -> None:
    """Draw and write maps, and print their paths; skip finished ones.

    A map is finished if it was drawn from the same seed at the same width. At the end the contact sheet of
    all of them is written, unless there is one since the last map.
    """
    kinds = tuple(dict.fromkeys(kind)) if kind else MIX
    if unknown := [name for name in kinds if name not in KINDS]:
        raise UsageError(f"--kind {unknown[0]}: no such kind; use one of {', '.join(KINDS)}")
    maps: dict[Path, Facts] = {}
    for index in range(count):
        name = kind_of(index, seed, kinds)
        path = batch.output / f"{index:05d}_{name}.exr"
        maps[path] = {"facerf:kind": name, "facerf:seed": seed, "facerf:index": index}
    if not batch.dry_run:
        sweep_leftovers(batch.output)
    new = {path for path in maps if _is_to_be_made(path, maps[path], size_px, batch.overwrite)}
    sheet, journal = batch.output / SHEET, Journal(batch.output, "envmap")
    stays = batch.overwrite == "never" and sheet.exists()
    is_old = not sheet.exists() or any(path.stat().st_mtime > sheet.stat().st_mtime for path in maps)
    is_shown_anew = not stays and (bool(new) or is_old)
    if batch.overwrite == "changed":
        for path in [*sorted(new), *([sheet] if is_shown_anew else [])]:
            if refusal := journal.refusal(path):
                raise InputError(refusal)
    for index, (path, facts) in enumerate(maps.items()):
        if path not in new:
            log.info("%s: already exists (--overwrite always redraws it)", path)
            continue
        if not batch.dry_run:
            pixels, _ = draw_sky(index, seed, size_px, kinds)
            write_exr(path, pixels, metadata={**facts, "Software": f"facerf {__version__}"})
            journal.add_file(path)
        print(path, flush=True)
    if is_shown_anew:
        if not batch.dry_run:
            write_sheet(list(maps), sheet)
            journal.add_file(sheet)
            log.info("%s: shows %d of %d maps", sheet, min(count, MOST_MAPS), count)
        print(sheet, flush=True)


def _is_to_be_made(path: Path, facts: Facts, width_px: int, overwrite: Overwrite) -> bool:
    """Tell if a map is missing or damaged, or was drawn from another seed or at another width."""
    if overwrite != "changed":
        return overwrite == "always" or not path.exists()
    header = read_header(path)
    return not (header and header.width_px == width_px and facts.items() <= header.metadata.items())


def write_sheet(maps: Sequence[Path], sheet: Path) -> None:
    """Read maps, the first `MOST_MAPS` at most, and write their contact sheet as an image for display."""
    tiles = np.stack([_tile(path) for path in maps[:MOST_MAPS]])
    write_display(sheet, contact_sheet(tiles), metadata={"Software": f"facerf {__version__}"})


def _tile(path: Path) -> np.ndarray:
    """Return a map and its ball side by side, each exposed well, above the name; linear, 3 heights wide."""
    envmap = mean_radiance(read_map_file(path), _MAP_PX, 0)
    pixels = torch.nn.functional.interpolate(envmap.permute(2, 0, 1)[None], (_MAP_PX, 2 * _MAP_PX))[0]
    shaded = ball(envmap, _MAP_PX, "diffuse").numpy()
    shown = [_exposed(pixels.permute(1, 2, 0).numpy(), None), _exposed(shaded, shaded.max(-1) > 0)]
    tile = np.concatenate(shown, 1)
    return np.concatenate([tile, labels([path.stem], tile.shape[1], _LABEL_PX)])


def _exposed(linear: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    gain = np.float32(2 ** auto_exposure_ev(linear, mask))
    return np.asarray((linear * gain).clip(0, 1))
