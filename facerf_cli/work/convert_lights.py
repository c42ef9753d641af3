"""One light read from any file that can hold one, and written in other forms."""

import logging
from dataclasses import replace
from pathlib import Path

import torch

from facerf_cli._version import __version__
from facerf_cli.batch.inputs import Item
from facerf_cli.files.light_files import (
    Harmonics,
    LightRecord,
    read_light_file,
    read_map_file,
    write_light,
)
from facerf_cli.files.write import write_exr
from facerf_cli.light.forms import (
    LightForms,
    MapAxes,
    from_map_axes,
    to_map_axes,
)
from facerf_cli.light.sh import CONVENTION
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photos import directions_of
from facerf_cli.work.verbs import ConvertLight, Form

Attributes = dict[str, str | int | float]
log = logging.getLogger(LOGGER_NAME)


def write_forms(item: Item, work: ConvertLight) -> str:
    """Read the item's light and write it in every form; a description of the light for the report."""
    light, attributes = _read(item.input_path, work.from_axes)
    light = replace(light, signed=work.signed)
    for form, path in zip(work.forms, work.outputs_of(item), strict=True):
        if form == "json" or form == "sh":
            _write_json(path, light, form, attributes, work)
        else:
            _write_map(path, light, "facerf" if form == "latlong" else form, attributes, work)
    return str(light)


def _write_json(
    path: Path, light: LightForms, form: Form, attributes: Attributes, work: ConvertLight
) -> None:
    harmonics = Harmonics(light.harmonics(work.order), CONVENTION)
    record = LightRecord(torch.zeros(0, 3), torch.zeros(0, 3), "", harmonics, attributes)
    if form == "json":
        rig = light.on_rig(None if work.lights is None else directions_of(work.lights))
        words = f"--lights {work.lights}" if work.lights else f"{len(rig.weights)} lights"
        record = LightRecord(rig.directions, rig.weights, words, harmonics, attributes)
    write_light(path, record)


def _write_map(
    path: Path, light: LightForms, axes: MapAxes, attributes: Attributes, work: ConvertLight
) -> None:
    envmap = light.latlong(None if work.width_px is None else work.width_px // 2)
    below = float((envmap < 0).any(-1).float().mean())
    if below:
        reason = "as in the input" if light.envmap is not None else "since spherical harmonics are cut off"
        log.warning("%s: %.0f %% of the map is negative, %s", path, 100 * below, reason)
    write_exr(path, to_map_axes(envmap, axes).numpy(), metadata=attributes | {"facerf:map_axes": axes})


def _read(path: Path, from_axes: MapAxes) -> tuple[LightForms, Attributes]:
    """The light of any file that can hold one, and metadata of its origin."""
    said: Attributes = {"Software": f"facerf {__version__}", "facerf:input": path.name}
    if path.suffix.lower() == ".json":
        light, known = read_light_file(path)
        return light, {**known, **said}
    return LightForms(envmap=from_map_axes(read_map_file(path), from_axes)), said
