"""`facerf convert-light`: a light from one form and other programs' axes to another."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer

from facerf_cli.batch.inputs import Item, collect_items
from facerf_cli.batch.made_from import OneRecipe
from facerf_cli.batch.run import BatchOptions, Outcome, run_items
from facerf_cli.cli.options import (
    LIGHT,
    DryRunOption,
    JobsOption,
    OutputOption,
    OverwriteOption,
    refuse_given,
    settings_of,
)
from facerf_cli.cli.values import parse_lights
from facerf_cli.errors import UsageError

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
_MADE_FOR: dict[str, tuple[Form, ...]] = {  # the forms that an option is for
    "width": _MAPS,
    "order": ("json", "sh"),
    "lights": ("json",),
    "signed": ("json", *_MAPS),
}
_SUFFIXES = frozenset({".exr", ".hdr", ".json", ".txt"})
_MOST_ORDER = 20
_LIMIT_PX = 8192


@dataclass(frozen=True)
class ConvertLight:
    """Writes one light in every form of `--to`; settings only."""

    forms: tuple[Form, ...]
    from_axes: Axes
    width_px: int | None
    order: int | None
    lights: str | None
    signed: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """A file for each form."""
        return [item.output(_ENDINGS[form]) for form in self.forms]

    def __call__(self, item: Item) -> Outcome:
        """Read the light and write it."""
        from facerf_cli.work.convert_lights import write_forms

        return Outcome(self.outputs_of(item), {"light": write_forms(item, self)})


def convert_light(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="LIGHT...",
            help="Lat-long maps (.exr, .hdr), lights of estimate-light (.json), DPR's or SfSNet's numbers "
            "(.txt); folders of them, or - for a list.",
            show_default=False,
        ),
    ],
    output: OutputOption,
    to: Annotated[
        list[str],
        typer.Option(
            metavar="FORM",
            help="Write this form: latlong, json, sh, dpr, sfsnet, blender or mitsuba. Repeatable.",
            show_default=False,
        ),
    ],
    from_axes: Annotated[
        Axes,
        typer.Option(help="Read input maps in the orientation of this program.", rich_help_panel=LIGHT),
    ] = "facerf",
    width: Annotated[
        int | None,
        typer.Option(
            min=16,
            max=_LIMIT_PX,
            metavar="PX",
            help="Write maps of this width; the height is half of it.",
            show_default="the map's own, else 512",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    order: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=_MOST_ORDER,
            help="Write spherical harmonics of this order in json and sh.",
            show_default="the input's own, else 2",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option(
            metavar="N|FILE",
            help="Write json over this rig: a number, 'az,el;az,el;...', or a file of such lines.",
            show_default="the input's own, else 150",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    signed: Annotated[
        bool,
        typer.Option(
            "--signed",
            help="Keep the plain series of spherical harmonics, negative in places (default: the nearest "
            "non-negative light).",
            rich_help_panel=LIGHT,
        ),
    ] = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Convert lights between maps, weights of a rig, spherical harmonics, and the axes of other programs.

    Forms: latlong (EXR); json (weights of a rig, and spherical harmonics); sh (spherical harmonics alone,
    JSON); dpr and sfsnet (text); blender and mitsuba (EXR, oriented as these programs expect for a head that
    faces the viewer). Maps are scene-linear; files name their convention where they can.

    Spherical harmonics lose what is finer than their order; the weights of a rig are integrated from a map as
    `relight` does.
    """
    if unknown := [form for form in to if form not in get_args(Form)]:
        raise UsageError(f"--to {unknown[0]}: no such form; give one of {', '.join(_ENDINGS)}")
    for option, made in _MADE_FOR.items():
        if not set(made) & set(to):
            refuse_given(context, (option,), f"is for --to {', '.join(made)}; leave it out here")
    if width is not None and width % 2:
        raise UsageError(f"--width {width}: an odd width has no half; give an even number")
    if lights is not None:
        parse_lights(lights)  # a wrong one fails the call, not every item
    forms: Any = tuple(dict.fromkeys(to))
    convert = ConvertLight(forms, from_axes, width, order, lights, signed)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    settings = settings_of(context)
    items = collect_items(inputs, output, _SUFFIXES, null_separated=settings.null_separated)
    code = run_items(
        "convert-light", items, convert, convert.outputs_of, options, settings, OneRecipe(convert)
    )
    raise typer.Exit(code)
