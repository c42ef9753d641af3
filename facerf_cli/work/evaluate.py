"""One run of `facerf evaluate` from items to tables: measure, keep figures and images, sum up."""

import io
import json
import logging
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from facerf_cli._version import __version__
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import DigestOf, FolderIndex, Recipe, recipe_of
from facerf_cli.batch.run import Outcome, run_items, sums_up
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Comparison, Row, measure, perceptual_metric
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.evaluation.pairs import read_predictions
from facerf_cli.evaluation.report import (
    FORMAT,
    About,
    ItemFigures,
    Strip,
    cases_to_keep,
    choose,
    draw_strip,
    images_csv,
    page,
    read_figures,
    write_figures,
)
from facerf_cli.evaluation.summary import Layout, print_tables, summarise
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import json_text
from facerf_cli.files.image_metadata import embed_xmp
from facerf_cli.files.write import write_exr
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import described_file
from facerf_cli.run.logs import LOGGER_NAME, Provenance, json_line
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import face_model

CASES, SUMMARY, IMAGES, PAGE = "cases", "summary.json", "images.csv", "report.html"
KEPT, STRIPS = "pictures", "strips"
_STRIP_QUALITY = 88
_MEASURING = 8  # raised where the same recipe gives other figures
log = logging.getLogger(LOGGER_NAME)

CompareItem = Callable[[Item], Iterable[Comparison]]


@dataclass(frozen=True)
class Evaluation:
    """A run of a protocol; settings only, sent to the processes that take the items.

    An item's rows are DIR/cases/ITEM.json, so finished items are skipped and an interrupted run continues. At
    the end: DIR/summary.json, DIR/images.csv, DIR/report.html, and a table on stdout. If an item failed or a
    prediction is missing, each is named and no summary is written.
    """

    layout: Layout
    compare: CompareItem
    recipe: tuple[Any, ...]  # dataclasses whose fields shape the figures, besides the options
    options: EvaluateOptions
    settings: Settings
    networks: tuple[tuple[str, Path], ...] = ()  # title and file of each that takes part
    photo: PhotoOptions | None = None  # has the face model of the images; they and the summary name it

    @property
    def verb(self) -> str:
        """The verb as it is typed."""
        return f"evaluate {self.layout.name}"

    def run(self, items: Sequence[Item], prepare: Callable[[], object] | None = None) -> int:
        """Measure the items and write their tables; return the exit code, 0 done, 1 some failed.

        `prepare` loads what the items need; it is not called where all are finished.
        """
        if not items:
            raise UsageError(f"{self.verb}: nothing to evaluate; give other inputs")
        options, measures = self.options, self.options.measures

        def begin() -> None:
            if prepare:
                prepare()
            if not options.dry_run:
                if measures.vgg_weights is not None:  # fails before anything is measured
                    perceptual_metric(measures.lpips, measures.vgg_weights)
                self._remove_summary()

        if options.overwrite == "never" and (other := self._made_otherwise(items)):
            raise UsageError(
                f"{options.output}: {len(other)} items ({other[0].name}, ...) were evaluated with other "
                "options, another checkpoint or other inputs; leave out --overwrite never, or give another "
                "folder"
            )
        batch = replace(options, print_outputs=False)
        code = run_items(
            self.verb, items, self, self.outputs_of, batch, self.settings, self.recipes_of, begin
        )
        if code:
            log.error(
                "no summary is written while images are missing; finished items are kept, so run it again"
            )
        elif not options.dry_run and sums_up(items, self.outputs_of, options):
            self._remove_summary()
            if options.shard.of > 1 and (other := self._made_otherwise(items)):
                log.info("%d items of other shards are of an earlier run, so there is no summary", len(other))
            else:
                self._sum_up(items)
        return code

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all items."""
        recipe: Recipe = {"measuring": _MEASURING, "protocol": self.layout.name}
        for part in (*self.recipe, self.options):
            recipe |= recipe_of(part, digest_of)
        return [recipe | {"methods": list(self.options.methods)}]

    def path_of(self, item: Item) -> Path:
        """The item's figures."""
        return self.options.output / CASES / f"{item.name}.json"

    def outputs_of(self, item: Item) -> list[Path]:
        """The files of a finished item: its figures, and the images that they name."""
        path = self.path_of(item)
        try:
            kept = read_figures(path).files if path.exists() else ()
        except InputError:  # said when the figures are needed
            kept = ()
        return [path, *(self.options.output / file for file in kept)]

    def __call__(self, item: Item) -> Outcome:
        """Measure an item's comparisons, and write its figures when all are measured."""
        rows: list[Row] = []
        wrong: list[str] = []
        images: list[str] = []
        strips: dict[str, tuple[Strip, bytes]] = {}
        metric, measures = self.layout.metrics[0], self.options.measures
        scaled = metric.startswith("si_") and measures.space == "linear"
        for own in self.compare(item):
            if self.options.pictures:
                images += self._keep_images(own)
            comparison = _with_others(own, self.options.compare, wrong)
            if not wrong:  # else all that is missing is named at once
                rows += measure(comparison, measures, "face_distance" in self.layout.metrics)
                strip, pixels = draw_strip(comparison, scaled)
                strips[strip.case] = strip, _as_jpeg(pixels)
        _require_whole(item, rows, wrong)
        chosen = [strips[case] for case in cases_to_keep(rows, metric)]
        kept = self._keep_strips(item.name, chosen)
        write_figures(self.path_of(item), ItemFigures(FORMAT, tuple(rows), kept, tuple(images)))
        facts = {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)}
        return Outcome(self.outputs_of(item), facts)

    def _keep_images(self, comparison: Comparison) -> list[str]:
        """Write DIR/pictures/{source,truth,mask,METHOD}/CASE.exr, scene-linear; return the paths below DIR.

        Predictions are marked as synthetic and name the face model; other images carry the version only.
        """
        case, folder = comparison.case.name, self.options.output
        asked = {"truth": comparison.truth, "mask": comparison.mask, "source": comparison.source}
        given = {kind: image for kind, image in asked.items() if image is not None}
        if clash := set(given) & set(comparison.predictions):
            raise InputError(f"the method {clash.pop()!r} has the name of a folder of --pictures; rename it")
        places = {kind: f"{KEPT}/{kind}/{case}.exr" for kind in (*given, *comparison.predictions)}
        for kind, image in given.items():
            pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
            write_exr(folder / places[kind], pixels, metadata={"Software": f"facerf {__version__}"})
        for method, image in comparison.predictions.items():
            write_exr(folder / places[method], image, metadata=self._marks(case, method))
        return list(places.values())

    def _keep_strips(self, item: str, strips: Iterable[tuple[Strip, bytes]]) -> tuple[Strip, ...]:
        """Write an item's strips to DIR/strips/ITEM/NUMBER.jpg, in place of older ones."""
        folder = self.options.output
        for old in (folder / STRIPS / item).glob("[0-9][0-9][0-9].jpg"):
            old.unlink()
        kept = []
        for number, (strip, jpeg) in enumerate(strips):
            file = f"{STRIPS}/{item}/{number:03d}.jpg"
            with atomic_path(folder / file) as temporary:
                temporary.write_bytes(jpeg)
                embed_xmp(temporary, self._marks(strip.case, "field"))
            kept.append(replace(strip, file=file))
        return tuple(kept)

    def _marks(self, case: str, method: str) -> dict[str, str | int]:
        """Metadata of a method's image: its checkpoint, as far as its name shows it, and the face model."""
        network = {"field": "reflectance", "portrait": "portrait"}.get(method)
        made_by = serving_files(self.settings.checkpoints)[network].stem if network else method
        stamp = face_model(self.photo).stamp if self.photo else {}
        return Provenance(case, made_by, **stamp).attributes()

    def _made_otherwise(self, items: Sequence[Item]) -> list[Item]:
        """The finished items that were made from other inputs or by another recipe: one table has one way."""
        index = FolderIndex(self.options.output, self.verb, self.options.shard, self.recipes_of)
        finished = [item for item in items if self.path_of(item).exists()]
        return [
            item for item in finished if index.why_again(item.input_path, [self.path_of(item)])[0] is not None
        ]

    def _remove_summary(self) -> None:
        """Remove the tables of an earlier run, which are about to be out of date."""
        for name in (SUMMARY, IMAGES, PAGE):
            (self.options.output / name).unlink(missing_ok=True)

    def _sum_up(self, items: Sequence[Item]) -> None:
        """Write and print the tables of finished items."""
        figures = [read_figures(self.path_of(item)) for item in items]
        rows = [row for of_item in figures for row in of_item.rows]
        summary = summarise(self.layout, rows)
        chosen = choose(summary, rows, [strip for of_item in figures for strip in of_item.strips])
        folder, about = self.options.output, self._about()
        jpegs = {case.strip.case: (folder / case.strip.file).read_bytes() for case in chosen.all()}
        run = {"facerf": about.version, "command": about.command, "networks": about.networks}
        content = {**run, **about.facts, **summary.as_dict()}
        texts = {
            IMAGES: images_csv(rows),
            PAGE: page(summary, about, chosen, jpegs),
            SUMMARY: json_text(json.loads(json_line(content)), indent=1) + "\n",
        }
        for name, text in texts.items():
            with atomic_path(folder / name) as temporary:
                temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
        print_tables(summary, about.networks)
        if not all(row.person for row in rows):
            log.info("who is in which image is not known: no intervals; give --facts, a CSV with name,person")
        log.info(
            "%s shows the images, worst cases first; %s has a row for each", folder / PAGE, folder / IMAGES
        )

    def _about(self) -> About:
        """The run's command and networks, without the time: equal runs give equal files."""
        networks = {title: described_file(path) for title, path in self.networks}
        spaces = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}
        facts = {"values compared": spaces[self.options.measures.space]}
        if self.photo:
            facts["face model"] = face_model(self.photo).credit
        return About(shlex.join(["facerf", *sys.argv[1:]]), __version__, networks, facts)


def _with_others(own: Comparison, folders: Sequence[Path], wrong: list[str]) -> Comparison:
    """Add other methods' predictions to the comparison; errors go to `wrong`."""
    try:
        others = read_predictions(folders, own.case.name, own.truth.shape, own.grey_as_given)
    except InputError as error:
        wrong.append(str(error))
        return own
    return replace(own, predictions={**own.predictions, **others})


def _require_whole(item: Item, rows: Sequence[object], wrong: Sequence[str]) -> None:
    """Raise InputError where images are missing; each is logged in a line."""
    for line in wrong[1:]:
        log.error("%s", line)
    if wrong:
        more = f" (and {len(wrong) - 1} more of {item.name}, above)" if len(wrong) > 1 else ""
        raise InputError(f"{wrong[0]}{more}")
    if not rows:
        raise InputError(f"{item.input_path}: no image can be measured; check the input")


def _as_jpeg(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=_STRIP_QUALITY, subsampling=0)
    return stream.getvalue()
