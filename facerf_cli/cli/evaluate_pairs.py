"""`facerf evaluate pairs`: any folders of predictions against a folder of truths."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import settings_of
from facerf_cli.logs import LOGGER_NAME

if TYPE_CHECKING:
    from facerf_cli.evaluation.case import Comparison
    from facerf_cli.evaluation.protocols.pairs import ImagePair

_ITEMS_AT_MOST = 64
WITHOUT = (  # shared options that mean nothing where no model is run
    "reflectance",
    "against",
    "compare",
    "keep_eyes",
    "pictures",
    "preset",
)
log = logging.getLogger(LOGGER_NAME)


def pairs(
    context: typer.Context,
    predictions: Annotated[
        list[Path],
        typer.Argument(
            metavar="PREDICTIONS...",
            help="Folders of pictures named as the truths; a folder is a method. The first is what others "
            "are held against.",
            show_default=False,
        ),
    ],
    truth: Annotated[
        Path,
        typer.Option(
            "--truth",
            metavar="DIR",
            help="Folder of the truths: .exr .hdr .npy (linear), .png .jpg .tif ...",
            show_default=False,
        ),
    ],
    options: EvaluateOptions,
    masks: Annotated[
        Path | None,
        typer.Option(
            "--masks",
            metavar="DIR",
            help="Where to compare: pictures of the truths' names, white inside.",
            show_default="the truths' alpha, else everything",
        ),
    ] = None,
    facts: Annotated[
        Path | None,
        typer.Option(
            "--facts",
            metavar="CSV",
            help="A row a picture: name, person, and columns that break the tables down (text) or go to the "
            "list of pictures (numbers).",
            show_default="a person is a truth's topmost folder",
        ),
    ] = None,
    face_distance: Annotated[
        bool, typer.Option("--face-distance", help="Find the truths' faces and measure Face dis, too.")
    ] = False,
) -> int:
    """Measure folders of predictions against a folder of truths, picture by picture.

    Trees are mirrored and names must match, suffixes may differ. A missing, an additional and a differently
    sized prediction is an error: no table is made of what is left.
    """
    from facerf_cli.evaluation.case import folder_name
    from facerf_cli.evaluation.protocols.pairs import collect_pairs
    from facerf_cli.evaluation.summary import Layout

    options.require_output_apart([*predictions, truth, *([] if masks is None else [masks])])
    found = collect_pairs(predictions, truth, masks, facts)
    by = dict.fromkeys(n for pair in found for n, value in pair.facts.items() if isinstance(value, str))
    asked = {"lpips": options.vgg_weights is not None, "face_distance": face_distance}
    metrics = ("si_mse", "mse", "psnr", "ssim", *(name for name, wanted in asked.items() if wanted))
    layout = Layout("pairs", f"Predictions against {folder_name(truth)}", metrics, tuple(by))
    size = math.ceil(len(found) / _ITEMS_AT_MOST)
    starts = range(0, len(found), size)
    items = [Item(truth, options.output / f"part-{n:02d}", f"part-{n:02d}") for n, _ in enumerate(starts)]
    parts = {item.name: tuple(found[start : start + size]) for item, start in zip(items, starts, strict=True)}
    return run_protocol(layout, items, _Pairs(parts, face_distance), options, settings_of(context))


@dataclass(frozen=True)
class _Pairs:
    """Reads an item's pairs."""

    parts: "dict[str, tuple[ImagePair, ...]]"
    face_distance: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.protocols.pairs import compare_pair

        for pair in self.parts[item.name]:
            yield compare_pair(pair, self.face_distance)
