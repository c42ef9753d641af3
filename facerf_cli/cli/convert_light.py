"""`facerf convert-light`: a light from one form and other programs' axes to another."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from facerf_cli.cli.batch import BatchOptions, Item, Outcome, run_batch
from facerf_cli.cli.options import (
    DryRunOption,
    JobsOption,
    OutputOption,
    OverwriteOption,
    refuse_given,
    settings_of,
)
from facerf_cli.cli.values import parse_directions
from facerf_cli.errors import UsageError
from facerf_cli.logs import LOGGER_NAME

if TYPE_CHECKING:
    from torch import Tensor

    from facerf_cli.light.forms import LightForms

Form = Literal["latlong", "json", "sh", "dpr", "sfsnet", "blender", "mitsuba"]
Axes = Literal["facerf", "blender", "mitsuba"]
_ENDINGS: dict[Form, str] = {
    "latlong": "_latlong.exr",
    "json": "_light.json",
    "sh": "_sh.json",
    "dpr": "_dpr.txt",
    "sfsnet": "_sfsnet.txt",
    "blender": "_blender.exr",
    "mitsuba": "_mitsuba.exr",
}
_MAPS: tuple[Form, ...] = ("latlong", "blender", "mitsuba")
_MADE_FOR: dict[str, tuple[Form, ...]] = {  # what an option says something of
    "width": _MAPS,
    "order": ("json", "sh"),
    "lights": ("json",),
    "signed": ("json", *_MAPS),
}
_SUFFIXES = frozenset({".exr", ".hdr", ".json", ".txt"})
_MOST_ORDER = 20
_LIMIT_PX = 8192
Attributes = dict[str, str | int | float]
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class _ConvertLight:
    """Writes one light in every form that was asked for; settings only."""

    forms: tuple[Form, ...]
    from_axes: Axes
    width_px: int | None
    order: int | None
    lights: str | None
    signed: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """A file a form."""
        return [item.output(_ENDINGS[form]) for form in self.forms]

    def __call__(self, item: Item) -> Outcome:
        """Read the light and write it."""
        light, attributes = _read(item.input_path, self.from_axes)
        light = replace(light, signed=self.signed)
        for form in self.forms:
            self._write(item.output(_ENDINGS[form]), light, form, attributes)
        return Outcome(self.outputs_of(item), {"light": str(light)})

    def _write(self, path: Path, light: "LightForms", form: Form, attributes: Attributes) -> None:
        from facerf_cli.files.light_files import write_numbers
        from facerf_cli.light.forms import to_dpr, to_sfsnet

        if form == "json" or form == "sh":
            self._write_json(path, light, form, attributes)
        elif form == "dpr" or form == "sfsnet":
            numbers = to_dpr if form == "dpr" else to_sfsnet
            write_numbers(path, numbers(light.harmonics(2)))
        else:
            self._write_map(path, light, "facerf" if form == "latlong" else form, attributes)

    def _write_json(self, path: Path, light: "LightForms", form: Form, attributes: Attributes) -> None:
        import torch

        from facerf_cli.files.light_files import Harmonics, LightRecord, write_light
        from facerf_cli.light.sh import CONVENTION

        harmonics = Harmonics(light.harmonics(self.order), CONVENTION)
        record = LightRecord(torch.zeros(0, 3), torch.zeros(0, 3), "", harmonics, attributes)
        if form == "json":
            rig = light.on_rig(None if self.lights is None else parse_directions(self.lights))
            words = f"--lights {self.lights}" if self.lights else f"{len(rig.weights)} lights"
            record = LightRecord(rig.directions, rig.weights, words, harmonics, attributes)
        write_light(path, record)

    def _write_map(self, path: Path, light: "LightForms", axes: Axes, attributes: Attributes) -> None:
        from facerf_cli.files.images import write_exr
        from facerf_cli.light.forms import to_map_axes

        envmap = light.latlong(None if self.width_px is None else self.width_px // 2)
        below = float((envmap < 0).any(-1).float().mean())
        if below:
            what = "as a cut series of spherical harmonics is" if light.envmap is None else "as it came"
            log.warning("%s: %.0f %% of the map is negative, %s", path, 100 * below, what)
        write_exr(path, to_map_axes(envmap, axes).numpy(), metadata=attributes | {"facerf:map_axes": axes})


def _read(path: Path, from_axes: Axes) -> "tuple[LightForms, Attributes]":
    """The light of any file that can hold one, and what is to be said of its origin."""
    from facerf_cli import __version__
    from facerf_cli.files.light_files import read_light_file, read_map_file
    from facerf_cli.light.forms import LightForms, from_map_axes

    said: Attributes = {"Software": f"facerf {__version__}", "facerf:input": path.name}
    if path.suffix.lower() == ".json":
        light, known = read_light_file(path)
        return light, {**known, **said}
    if path.suffix.lower() == ".txt":
        return LightForms(coefficients=_read_text(path)), said
    return LightForms(envmap=from_map_axes(read_map_file(path), from_axes)), said


def _read_text(path: Path) -> "Tensor":
    """Coefficients [9, 3] of DPR's 9 or SfSNet's 27 numbers."""
    from facerf_cli.files.light_files import read_numbers
    from facerf_cli.light.forms import from_dpr, from_sfsnet

    numbers = read_numbers(path, (9, 27))
    return from_dpr(numbers) if len(numbers) == 9 else from_sfsnet(numbers)


def convert_light(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="LIGHT...",
            help="Lat-long maps (.exr, .hdr), lights of estimate-light (.json), DPR's 9 or SfSNet's 27 "
            "numbers (.txt); folders of them, or - for a list of paths on standard input.",
            show_default=False,
        ),
    ],
    output: OutputOption,
    to: Annotated[
        list[str],
        typer.Option(
            metavar="FORM",
            help="What to write (may be repeated): latlong (EXR), json (a rig's weights with spherical "
            "harmonics), sh (spherical harmonics alone, JSON), dpr, sfsnet (text), blender, mitsuba (EXR, "
            "turned as these want it for a head that faces the viewer).",
            show_default=False,
        ),
    ],
    from_axes: Annotated[
        Axes, typer.Option(help="The program whose orientation an input map has.")
    ] = "facerf",
    width: Annotated[
        int | None,
        typer.Option(
            min=16,
            max=_LIMIT_PX,
            help="Of maps in pixels; the height is half.",
            show_default="the map's own, else 512",
        ),
    ] = None,
    order: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=_MOST_ORDER,
            help="Of the spherical harmonics in json and sh.",
            show_default="the input's own, else 2",
        ),
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option(
            metavar="N|FILE",
            help="The rig of json: a number, 'az,el;az,el;...', or a file of such lines.",
            show_default="the input's own, else 150",
        ),
    ] = None,
    signed: Annotated[
        bool,
        typer.Option(
            "--signed",
            help="Keep the plain series of spherical harmonics, which is negative in places (default: a "
            "light that can shine, with the same coefficients as nearly as can be).",
        ),
    ] = False,
    jobs: JobsOption = 1,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Convert lights: maps, rigs' weights, spherical harmonics; in the axes of other programs.

    Maps are OpenEXR lat-long, scene-linear; every file that can says which convention it is in. From a map
    or a rig to spherical harmonics what is finer than their order is lost; the weights of a rig are taken
    from a map as `relight` takes them.
    """
    if unknown := [form for form in to if form not in get_args(Form)]:
        raise UsageError(f"--to {unknown[0]}: no such form; there are {', '.join(_ENDINGS)}")
    for option, made in _MADE_FOR.items():
        if not set(made) & set(to):
            refuse_given(context, (option,), f"is for --to {', '.join(made)}; leave it out here")
    if width is not None and width % 2:
        raise UsageError(f"--width {width}: the height is half of it, so give an even number")
    if lights is not None:
        parse_directions(lights)  # a wrong one fails the call, not every item
    forms: Any = tuple(dict.fromkeys(to))
    convert = _ConvertLight(forms, from_axes, width, order, lights, signed)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    settings = settings_of(context)
    code = run_batch("convert-light", inputs, convert, convert.outputs_of, options, settings, _SUFFIXES)
    raise typer.Exit(code)
