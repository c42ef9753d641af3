"""`facerf envmap`: write procedural environment maps."""

from typing import Annotated

import typer

from facerf_cli.cli.options import LIGHT, DryRunOption, OutputOption, OverwriteOption, settings_of
from facerf_cli.errors import UsageError


def envmap(
    context: typer.Context,
    output: OutputOption,
    count: Annotated[
        int, typer.Option(min=1, metavar="N", help="Write so many maps.", rich_help_panel=LIGHT)
    ] = 10,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Draw from this kind alone (may be repeated): sun, dusk, overcast, windows, hall, studio, "
            "night, stage.",
            show_default="all, sun most often",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    size: Annotated[
        int,
        typer.Option(
            min=16,
            max=8192,
            metavar="PX",
            help="Write maps of this width; the height is half.",
            rich_help_panel=LIGHT,
        ),
    ] = 512,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
) -> None:
    """Write environment maps drawn from a seed: suns, overcast skies, rooms, studios, streets and stages.

    Lat-long OpenEXR, scene-linear Rec.709; --size changes the resolution, not the scene. Map number n depends
    only on --seed, n and the kinds, so a larger --count adds maps and changes none. envmaps.png shows all of
    them, each beside a white ball under its light; `relight --envmap DIR` reads the maps alone.
    """
    if size % 2:
        raise UsageError(f"--size {size}: the height is half of it; give an even number")
    from facerf_cli.work.draw_envmaps import write_envmaps

    write_envmaps(output, count, kind, size, settings_of(context).seed, overwrite, dry_run)
