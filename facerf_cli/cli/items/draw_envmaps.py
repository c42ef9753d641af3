"""The maps of `facerf envmap`."""

import logging
from pathlib import Path

from facerf_cli import __version__
from facerf_cli.cli.options import Overwrite
from facerf_cli.errors import UsageError
from facerf_cli.files.images import write_exr
from facerf_cli.logs import LOGGER_NAME
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky, kind_of

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
    """Draw and write maps of some kinds (None: the usual mix), and print their paths; skip existing ones."""
    kinds = tuple(dict.fromkeys(kind)) if kind else MIX
    if unknown := [name for name in kinds if name not in KINDS]:
        raise UsageError(f"--kind {unknown[0]}: no such kind; give one of {', '.join(KINDS)}")
    for index in range(count):
        name = kind_of(index, seed, kinds)
        path = output / f"{index:05d}_{name}.exr"
        if path.exists() and overwrite != "always":
            log.info("%s: already exists (--overwrite always makes it again)", path)
        elif dry_run:
            print(path)
        else:
            pixels, _ = draw_sky(index, seed, width_px, kinds)
            facts: dict[str, str | int | float] = {"facerf:kind": name, "facerf:seed": seed}
            facts |= {"facerf:index": index, "Software": f"facerf {__version__}"}
            write_exr(path, pixels, metadata=facts)
            print(path, flush=True)
