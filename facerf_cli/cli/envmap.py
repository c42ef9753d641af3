"""`facerf envmap`: write procedural environment maps."""

import logging
from typing import Annotated

import typer

from facerf_cli.cli.options import DryRunOption, OutputOption, OverwriteOption, settings_of
from facerf_cli.errors import UsageError
from facerf_cli.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)


def envmap(
    context: typer.Context,
    output: OutputOption,
    count: Annotated[int, typer.Option(min=1, help="Maps to write.")] = 10,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Draw from this kind alone (may be repeated): sun, dusk, overcast, windows, hall, studio, "
            "night, stage.",
            show_default="all, sun most often",
        ),
    ] = None,
    size: Annotated[int, typer.Option(min=16, max=8192, help="Width in pixels; the height is half.")] = 512,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Write environment maps drawn from a seed: suns, overcast skies, rooms, studios, streets and stages.

    Lat-long OpenEXR, scene-linear Rec.709; --size changes the resolution, not the scene. Map number n depends
    only on --seed, n and the kinds, so a larger --count adds maps and changes none.
    """
    from facerf_cli import __version__
    from facerf_cli.files.images import write_exr
    from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky, kind_of

    kinds = tuple(dict.fromkeys(kind)) if kind else MIX
    if unknown := [name for name in kinds if name not in KINDS]:
        raise UsageError(f"--kind {unknown[0]}: no such kind; there are {', '.join(KINDS)}")
    if size % 2:
        raise UsageError(f"--size {size}: the height is half of it, so give an even number")
    seed = settings_of(context).seed
    for index in range(count):
        name = kind_of(index, seed, kinds)
        path = output / f"{index:05d}_{name}.exr"
        if path.exists() and not overwrite:
            log.info("%s: already there (--overwrite makes it anew)", path)
        elif dry_run:
            print(path)
        else:
            pixels, _ = draw_sky(index, seed, size, kinds)
            facts: dict[str, str | int | float] = {"facerf:kind": name, "facerf:seed": seed}
            facts |= {"facerf:index": index, "Software": f"facerf {__version__}"}
            write_exr(path, pixels, metadata=facts)
            print(path, flush=True)
