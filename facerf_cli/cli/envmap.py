"""`facerf envmap`: write procedural environment maps."""

from dataclasses import dataclass
from typing import Annotated

import typer

from facerf_cli.batch.settings import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.errors import UsageError
from facerf_cli.option import LIGHT, Only, option
from facerf_cli.work.verbs import LARGEST_MAP_PX


@dataclass(frozen=True)
class DrawnMaps:
    """Maps to draw.

    Attributes:
        count: Write so many maps.
        kind: Draw from this kind alone (may be repeated): sun, dusk, overcast, windows, hall, studio, night,
            stage.
        size_px: Write maps of this width; the height is half.
    """

    count: int = option(10, metavar="N", least=1, panel=LIGHT)
    kind: list[str] | None = option(None, metavar="KIND", shown_default="all, sun most often", panel=LIGHT)
    size_px: int = option(512, metavar="PX", least=16, most=LARGEST_MAP_PX, panel=LIGHT)


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
    if maps.size_px % 2:
        raise UsageError(f"--size {maps.size_px}: the height is half of it; give an even number")
    from facerf_cli.synth.sky.maps import write_envmaps

    write_envmaps(batch, maps.count, maps.kind, maps.size_px, settings_of(context).seed)
