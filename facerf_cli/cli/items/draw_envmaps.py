"""The maps of `facerf envmap`."""

import logging
from pathlib import Path

from facerf_cli import __version__
from facerf_cli.cli.items.envmap_sheet import MOST_MAPS, write_sheet
from facerf_cli.cli.options import Overwrite
from facerf_cli.errors import UsageError
from facerf_cli.files.images import write_exr
from facerf_cli.logs import LOGGER_NAME
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky, kind_of

SHEET = "envmaps.png"
log = logging.getLogger(LOGGER_NAME)


def write_envmaps(
    output: Path,
    count: int,
    kind: list[str] | None,
    width_px: int,
    seed: int,
    overwrite: Overwrite,
    dry_run: bool,
) -> None:
    """Draw and write maps of some kinds (None: the usual mix), and print their paths; skip existing ones.

    At the end the contact sheet of all of them is written, unless no map is new.
    """
    kinds = tuple(dict.fromkeys(kind)) if kind else MIX
    if unknown := [name for name in kinds if name not in KINDS]:
        raise UsageError(f"--kind {unknown[0]}: no such kind; give one of {', '.join(KINDS)}")
    names = [kind_of(index, seed, kinds) for index in range(count)]
    paths = [output / f"{index:05d}_{name}.exr" for index, name in enumerate(names)]
    new = {path for path in paths if overwrite == "always" or not path.exists()}
    for index, (name, path) in enumerate(zip(names, paths, strict=True)):
        if path not in new:
            log.info("%s: already exists (--overwrite always makes it again)", path)
            continue
        if not dry_run:
            pixels, _ = draw_sky(index, seed, width_px, kinds)
            facts: dict[str, str | int | float] = {"facerf:kind": name, "facerf:seed": seed}
            facts |= {"facerf:index": index, "Software": f"facerf {__version__}"}
            write_exr(path, pixels, metadata=facts)
        print(path, flush=True)
    sheet = output / SHEET
    if new or not sheet.exists():
        if not dry_run:
            write_sheet(paths, sheet)
            log.info("%s: shows %d of %d maps", sheet, min(count, MOST_MAPS), count)
        print(sheet, flush=True)
