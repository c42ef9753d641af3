"""`facerf envmap`: write procedural environment maps."""

from typing import Annotated

import typer

from facerf_cli.batch.run import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.option import Only
from facerf_cli.work.verbs import DrawnMaps


def envmap(
    context: typer.Context,
    maps: DrawnMaps,
    batch: Annotated[BatchOptions, Only("output", "overwrite", "dry_run")],
) -> None:
    """Write environment maps drawn from a seed: suns, overcast skies, rooms, studios, streets and stages.

    Lat-long OpenEXR, scene-linear Rec.709; --size changes the resolution, not the scene. Map number n depends
    only on --seed, n and the kinds, so a larger --count adds maps and changes none. envmaps.png shows all of
    them, each beside a white ball under its light; `relight --envmap DIR` reads the maps alone.
    """
    maps.check()
    from facerf_cli.work.draw_envmaps import write_envmaps

    write_envmaps(batch, maps, settings_of(context).seed)
