"""One light read from any file that can hold one, and written in other forms."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from facerf_cli._version import __version__
from facerf_cli.files.light_files import Harmonics, LightRecord, read_light_file, read_map_file, write_light
from facerf_cli.files.write import write_exr
from facerf_cli.light.forms import LightForms, MapAxes, from_map_axes, to_map_axes
from facerf_cli.light.sh import CONVENTION
from facerf_cli.light.studio_points import rig_by_text
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)


def convert(
    path: Path,
    forms: Mapping[Any, Path],
    order: int | None = None,
    rig: str | None = None,
    signed: bool = False,
    from_axes: MapAxes = "facerf",
    width_px: int | None = None,
) -> str:
    """Read a light and write it in other forms; return a description of it.

    Args:
        path: A lat-long map, or a light of estimate-light (.json).
        forms: Files to write: latlong, blender and mitsuba (maps), json (weights of a rig, and spherical
            harmonics), sh (spherical harmonics).
        order: Order of the spherical harmonics; by default the input's own, else 2.
        rig: `--lights` of json; by default the input's own, else 150.
        signed: Keep the plain series of spherical harmonics, negative in places.
        from_axes: Orientation of an input map.
        width_px: Width of maps; by default the map's own, else 512.
    """
    attributes: dict[str, str | int | float] = {
        "Software": f"facerf {__version__}",
        "facerf:input": path.name,
    }
    if path.suffix.lower() == ".json":
        light, known = read_light_file(path)
        attributes = {**known, **attributes}
    else:
        light = LightForms(envmap=from_map_axes(read_map_file(path), from_axes))
    light = replace(light, signed=signed)
    for form, target in forms.items():
        if form in ("json", "sh"):
            harmonics = Harmonics(light.harmonics(order), CONVENTION)
            record = LightRecord(torch.zeros(0, 3), torch.zeros(0, 3), "", harmonics, attributes)
            if form == "json":
                over = light.on_rig(None if rig is None else rig_by_text(rig))
                words = f"--lights {rig}" if rig else f"{len(over.weights)} lights"
                record = LightRecord(over.directions, over.weights, words, harmonics, attributes)
            write_light(target, record)
            continue
        axes: MapAxes = "facerf" if form == "latlong" else form
        envmap = light.latlong(None if width_px is None else width_px // 2)
        below = float((envmap < 0).any(-1).float().mean())
        if below:
            reason = (
                "as in the input" if light.envmap is not None else "since spherical harmonics are cut off"
            )
            log.warning("%s: %.0f %% of the map is negative, %s", target, 100 * below, reason)
        metadata = attributes | {"facerf:map_axes": axes}
        write_exr(target, to_map_axes(envmap, axes).numpy(), metadata=metadata)
    return str(light)
