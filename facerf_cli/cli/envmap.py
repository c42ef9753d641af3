"""`facerf envmap`: draw procedural environment maps."""

from dataclasses import dataclass
from typing import Annotated

import typer

from facerf_cli.batch.settings import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.option import LIGHT, Only, option
from facerf_cli.work.photo_options import LARGEST_MAP_PX, refuse_odd


@dataclass(frozen=True)
class DrawnMaps:
    """Maps to draw.

    Attributes:
        count: Number of maps.
        kind: Kind of map: sun, dusk, overcast, windows, hall, studio, night, stage. Repeatable.
        size_px: Width of the maps; the height is half of it.
    """

    count: int = option(10, metavar="N", least=1, panel=LIGHT)
    kind: list[str] | None = option(None, metavar="KIND", shown_default="all, sun most often", panel=LIGHT)
    size_px: int = option(512, metavar="PX", least=16, most=LARGEST_MAP_PX, panel=LIGHT)


def envmap(
    context: typer.Context,
    maps: DrawnMaps,
    batch: Annotated[BatchOptions, Only("output", "overwrite", "dry_run")],
) -> None:
    """Generate environment maps from a seed: suns, overcast skies, rooms, studios, streets and stages.

    Maps are lat-long OpenEXR files, scene-linear Rec.709. --size changes the resolution, not the scene. Map
    number n depends only on --seed, n and the kinds, so a larger --count adds maps without changing others.
    envmaps.png shows each map beside a white ball under its light; `relight --envmap DIR` ignores it.
    """
    refuse_odd("--size", maps.size_px)
    from facerf_cli.synth.sky.maps import write_envmaps

    write_envmaps(batch, maps.count, maps.kind, maps.size_px, settings_of(context).seed)
