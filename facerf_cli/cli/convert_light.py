"""`facerf convert-light`: a light from one form and other programs' axes to another."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.inputs import Item, collect_items, only_item
from facerf_cli.batch.made_from import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.cli.options import refuse_given, settings_of
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import parse_lights
from facerf_cli.option import LIGHT, Without, option
from facerf_cli.work.verbs import LARGEST_MAP_PX, MOST_ORDER, FileOrFolder, end_of_file, refuse_odd

Form = Literal["latlong", "json", "sh", "blender", "mitsuba"]
_ENDINGS: dict[Form, str] = {
    "latlong": "_latlong.exr",
    "json": "_rig.json",
    "sh": "_sh.json",
    "blender": "_blender.exr",
    "mitsuba": "_mitsuba.exr",
}
_LIGHT_SUFFIXES = frozenset({".exr", ".hdr", ".json"})
_MAPS: tuple[Form, ...] = ("latlong", "blender", "mitsuba")
_MADE_FOR: dict[str, tuple[Form, ...]] = {  # the forms that an option is for
    "width_px": _MAPS,
    "order": ("json", "sh"),
    "lights": ("json",),
    "signed": ("json", *_MAPS),
}


def parse_forms(names: Sequence[str]) -> tuple[Form, ...]:
    """The forms of `--to`, each once; raises UsageError for a name of none."""
    if unknown := [name for name in names if name not in _ENDINGS]:
        raise UsageError(f"--to {unknown[0]}: no such form; give one of {', '.join(_ENDINGS)}")
    return tuple(form for form in dict.fromkeys(names) if form in _ENDINGS)


@dataclass(frozen=True)
class ConvertLight(Job):
    """`facerf convert-light`.

    Attributes:
        forms: Write this form: latlong, json, sh, blender or mitsuba. Repeatable.
        from_axes: Read input maps in the orientation of this program.
        width_px: Write maps of this width; the height is half of it.
        order: Write spherical harmonics of this order in json and sh.
        lights: Write json over this rig: a number, 'az,el;az,el;...', or a file of such lines or vectors
            (.lp).
        signed: Keep the plain series of spherical harmonics, negative in places (default: the nearest
            non-negative light).
    """

    forms: tuple[Form, ...] = option(
        ..., metavar="FORM", flags=("--to",), shown_default=False, typed=list[str], parse=parse_forms
    )
    from_axes: Literal["facerf", "blender", "mitsuba"] = option("facerf", panel=LIGHT)
    width_px: int | None = option(
        None,
        metavar="PX",
        shown_default="the map's own, else 512",
        least=16,
        most=LARGEST_MAP_PX,
        panel=LIGHT,
    )
    order: int | None = option(
        None, shown_default="the input's own, else 2", least=0, most=MOST_ORDER, panel=LIGHT
    )
    lights: str | None = option(
        None, metavar="N|FILE", shown_default="the input's own, else 150", panel=LIGHT
    )
    signed: bool = option(False, panel=LIGHT)
    alone: str = field(default="", metadata=NOT_IN_RECIPE)  # the suffix of the one file that -o names
    verb = "convert-light"

    def outputs_of(self, item: Item) -> list[Path]:
        """A file for each form."""
        return [item.output(self.alone or _ENDINGS[form]) for form in self.forms]

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all forms."""
        return [recipe_of(self, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Write the light in every form."""
        from facerf_cli.light.convert import convert

        paths = dict(zip(self.forms, self.outputs_of(item), strict=True))
        how = self.order, self.lights, self.signed, self.from_axes, self.width_px
        light = convert(item.input_path, paths, *how)
        return Outcome(list(paths.values()), {"light": light})


def convert_light(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="LIGHT...",
            help="Lat-long maps (.exr, .hdr), lights of estimate-light (.json); folders of them, or - to "
            "read a map, or a list of paths.",
            show_default=False,
        ),
    ],
    work: ConvertLight,
    batch: Annotated[FileOrFolder, Without("name")],
) -> None:
    """Convert lights between maps, weights of a rig, spherical harmonics, and the axes of other programs.

    Forms: latlong (EXR); json (weights of a rig, and spherical harmonics); sh (spherical harmonics alone,
    JSON); blender and mitsuba (EXR, oriented as these programs expect for a head that faces the viewer). Maps
    are scene-linear; files name their convention where they can.

    Spherical harmonics lose what is finer than their order; the weights of a rig are integrated from a map as
    `relight` does.
    """
    for name, forms in _MADE_FOR.items():
        if not set(forms) & set(work.forms):
            refuse_given(context, (name,), f"is for --to {', '.join(forms)}; leave it out here")
    if work.width_px is not None:
        refuse_odd("--width", work.width_px)
    if work.lights is not None:
        parse_lights(work.lights)  # a wrong one fails the call, not every item
    settings, ends = settings_of(context), [_ENDINGS[form] for form in work.forms]
    items = collect_items(inputs, batch.output, _LIGHT_SUFFIXES, null_separated=settings.null_separated)
    if end_of_file(batch.output, ends):
        items = [only_item(items, batch.output, several=len(ends) > 1)]
        work = replace(work, alone=batch.output.suffix)
        batch = batch.of_file()
    raise typer.Exit(run_items(work, items, batch, settings))
