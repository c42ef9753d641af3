"""`facerf evaluate yale-b`: real people relit to the real point lights of Extended Yale B."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.evaluation_items import MethodOptions, load_methods, refuse_without_field
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import FaceModelOption, settings_of
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from facerf_cli.capture.yale_b import YaleB
    from facerf_cli.evaluation.case import Comparison

WITHOUT = ("keep_eyes", "preset")  # the mask is one ellipse, and the paper has no such figures


def yale_b(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="The cropped Extended Yale Face Database B: the folder with yaleB01, yaleB02 and so on.",
            show_default=False,
        ),
    ],
    options: EvaluateOptions,
    shifts: Annotated[
        Path | None,
        typer.Option(
            "--shifts",
            metavar="CSV",
            help="Where heads drifted: rows subject,light,dy,dx, pixels down and right that move a picture "
            "onto its subject's frontal one.",
            show_default="pictures as they are",
        ),
    ] = None,
    subjects: Annotated[
        list[str] | None,
        typer.Option(
            "--subjects",
            metavar="NAME,...",
            help="Only these, such as yaleB05,yaleB15; may be given several times.",
            show_default="all",
        ),
    ] = None,
    network_alone: Annotated[
        bool, typer.Option("--network-alone", help="Do not hold the field to the photo, as `relight` does.")
    ] = False,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Relight real people to real point lights and compare with their photos under these.

    Sources are a picture under one flash and four soft lights summed from the subject's own pictures; targets
    are single flashes and four environments. Lights are given, not estimated. Pictures are taken as linear,
    as they measure, and are compared inside one ellipse, open eyes too. Cases are SUBJECT/SOURCE/LIGHT; the
    rows of other methods were published for the same pictures. The sources that --pictures keeps are what a
    method for --compare is run on; its PNGs hold values as given too, without a curve, and its colours are
    averaged. The database is for research and is never trained on.
    """
    from facerf_cli.capture.yale_b import read_shifts, read_yale_b
    from facerf_cli.evaluation.protocols.yale_b import layout

    settings = settings_of(context)
    refuse_without_field(context, options, "network_alone")
    database = read_yale_b(folder, None if shifts is None else read_shifts(shifts))
    chosen = _chosen(database, subjects or [])
    photo = PhotoOptions(settings, face_model=face_model)
    work = _YaleB(MethodOptions.of(photo, options), database, network_alone)
    items = [Item(folder / name, options.output / "cases" / name, name) for name in chosen]
    return run_protocol(layout(database, chosen, network_alone), items, work, options, settings, photo)


def _chosen(database: "YaleB", given: Sequence[str]) -> list[str]:
    """The subjects that are asked for; UsageError for one that is not there."""
    wanted = {name.strip() for entry in given for name in entry.split(",") if name.strip()}
    if strangers := sorted(wanted - set(database.subjects)):
        there = ", ".join(database.subjects)
        raise UsageError(f"--subjects {', '.join(strangers)}: not in {database.folder}; there are {there}")
    return [name for name in database.subjects if not wanted or name in wanted]


@dataclass(frozen=True, eq=False)
class _YaleB:
    """Compares one subject's cases."""

    methods: MethodOptions
    database: "YaleB"
    network_alone: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.protocols.yale_b import compare_sitter

        return compare_sitter(self.database, item.name, load_methods(self.methods), not self.network_alone)
