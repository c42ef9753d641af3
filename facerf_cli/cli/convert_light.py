"""`facerf convert-light`: a light from one form and other programs' axes to another."""

from dataclasses import dataclass
from typing import Annotated

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import Outcome
from facerf_cli.cli.options import refuse_given, settings_of
from facerf_cli.option import Without
from facerf_cli.work.verbs import ConvertLight, FileOrFolder, Form

_MAPS: tuple[Form, ...] = ("latlong", "blender", "mitsuba")
_MADE_FOR: dict[str, tuple[Form, ...]] = {  # the forms that an option is for
    "width_px": _MAPS,
    "order": ("json", "sh"),
    "lights": ("json",),
    "signed": ("json", *_MAPS),
}


@dataclass(frozen=True)
class ConvertLights(ConvertLight):
    """`facerf convert-light`."""

    def __call__(self, item: Item) -> Outcome:
        """Write the light in every form."""
        from facerf_cli.work.convert_lights import write_forms

        return Outcome(self.outputs_of(item), {"light": write_forms(item, self)})


def convert_light(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="LIGHT...",
            help="Lat-long maps (.exr, .hdr), lights of estimate-light (.json); folders of them, or - for a "
            "list.",
            show_default=False,
        ),
    ],
    work: ConvertLights,
    batch: Annotated[FileOrFolder, Without("name")],
) -> None:
    """Convert lights between maps, weights of a rig, spherical harmonics, and the axes of other programs.

    Forms: latlong (EXR); json (weights of a rig, and spherical harmonics); sh (spherical harmonics alone,
    JSON); blender and mitsuba (EXR, oriented as these programs expect for a head that faces the viewer). Maps
    are scene-linear; files name their convention where they can.

    Spherical harmonics lose what is finer than their order; the weights of a rig are integrated from a map as
    `relight` does.
    """
    for option, forms in _MADE_FOR.items():
        if not set(forms) & set(work.forms):
            refuse_given(context, (option,), f"is for --to {', '.join(forms)}; leave it out here")
    raise typer.Exit(work.run(inputs, batch, settings_of(context)))
