"""One run of `facerf evaluate` from items to tables: measure, keep figures and images, sum up."""

import io
import json
import logging
import shlex
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from facerf_cli._version import __version__
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import DigestOf, FolderIndex, Recipe, keyed, recipe_of
from facerf_cli.batch.run import Job, Outcome, run_items, sums_up
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Comparison, Row, measure, perceptual_metric
from facerf_cli.evaluation.options import Chosen, EvaluateOptions, folder_name
from facerf_cli.evaluation.pairs import read_predictions
from facerf_cli.evaluation.people import Bench
from facerf_cli.evaluation.protocols import Protocol
from facerf_cli.evaluation.report import (
    FORMAT,
    ItemFigures,
    Strip,
    choose_cases,
    draw_strip,
    images_csv,
    page,
    read_figures,
    write_figures,
)
from facerf_cli.evaluation.summary import print_tables, published, summarise
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import json_text
from facerf_cli.files.image_metadata import embed_xmp
from facerf_cli.files.write import write_exr
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import described_file
from facerf_cli.run.logs import LOGGER_NAME, Provenance, json_line

SUMMARY, IMAGES, PAGE = "summary.json", "images.csv", "report.html"
_KEPT, _KEPT_FEW = 10, 2  # strips of an item: of the worst cases, of typical and of the best ones
_STRIP_QUALITY = 88
_MEASURING = 9  # raised where the same recipe gives other figures
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Evaluation(Job):
    """A run of a protocol; settings only, sent to the processes that take the items.

    An item's rows are DIR/cases/ITEM.json, so finished items are skipped and an interrupted run continues. At
    the end: DIR/summary.json, DIR/images.csv, DIR/report.html, and a table on stdout. If an item failed or a
    prediction is missing, each is named and no summary is written.
    """

    protocol: Protocol
    chosen: Chosen
    options: EvaluateOptions
    settings: Settings
    bench: Callable[[], Bench]
    reading: Any = None  # a dataclass of further options that shape the figures
    networks: tuple[tuple[str, Path], ...] = ()  # title and file of each that takes part
    face_model: Callable[[], MorphableModel] | None = None  # images and the summary name it
    prepare: Callable[[], object] | None = None  # loads what the items need

    @property
    def verb(self) -> str:
        """The verb as it is typed."""
        return f"evaluate {self.protocol.name}"

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics of the tables: the protocol's, and Face dis if it is asked for."""
        more = ("face_distance",) if self.options.measures.face_distance else ()
        return tuple(dict.fromkeys((*self.protocol.layout.metrics, *more)))

    def run(self) -> int:
        """Measure the items and write their tables; return the exit code, 0 done, 1 some failed."""
        items, options = list(self.chosen.items), self.options
        if not items:
            raise UsageError(f"{self.verb}: nothing to evaluate; give other inputs")

        if options.overwrite == "never" and (other := self._made_otherwise()):
            raise UsageError(
                f"{options.output}: {len(other)} items ({other[0].name}, ...) were evaluated with other "
                "options, another checkpoint or other inputs; leave out --overwrite never, or give another "
                "folder"
            )
        code = run_items(self, items, replace(options, print_outputs=False), self.settings)
        if code:
            log.error(
                "no summary is written while images are missing; finished items are kept, so run it again"
            )
        elif not options.dry_run and sums_up(items, self.outputs_of, options):
            self._remove_summary()
            if options.shard.of > 1 and (other := self._made_otherwise()):
                log.info("%d items of other shards are of an earlier run, so there is no summary", len(other))
            else:
                self._sum_up()
        return code

    def ready(self, dry_run: bool) -> Self:
        """Load what all items need, and remove the tables of an earlier run."""
        measures = self.options.measures
        if self.prepare:
            self.prepare()
        if not dry_run:
            if measures.vgg_weights is not None:  # fails before anything is measured
                perceptual_metric(measures.lpips, measures.vgg_weights)
            self._remove_summary()
        return self

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all items."""
        recipe: Recipe = {"measuring": _MEASURING, "protocol": self.protocol.name}
        for part in filter(None, (self.reading, self.chosen, self.settings, self.options)):
            recipe |= recipe_of(part, digest_of)
        return [recipe | {"methods": list(self.options.methods)}]

    def _made_otherwise(self) -> list[Item]:
        """The finished items that were made from other inputs or by another recipe: one table has one way."""
        index = FolderIndex(self.options.output, self.verb, self.options.shard)
        recipes = keyed(self.recipes_of(index.digest_of))
        return [
            item
            for item in self.chosen.items
            if (path := self.path_of(item)).exists() and index.why_again(item.input_path, [path], recipes)
        ]

    def path_of(self, item: Item) -> Path:
        """The item's figures."""
        return self.options.output / "cases" / f"{item.name}.json"

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
        metric, measures = self.metrics[0], self.options.measures
        scaled = metric.startswith("si_") and measures.space == "linear"
        for own in self.protocol.compare(self.options, self.bench, self.chosen.items[item]):
            if self.options.pictures:
                images += self._keep_images(own)
            case, shape = own.case.name, own.truth.shape
            try:
                others = read_predictions(self.options.compare, case, shape, own.grey_as_given)
            except InputError as error:
                wrong.append(str(error))
            if wrong:  # all that is missing is named at once
                continue
            comparison = replace(own, predictions={**own.predictions, **others})
            rows += measure(comparison, measures, "face_distance" in self.metrics)
            strip, image = draw_strip(comparison, scaled)
            jpeg = io.BytesIO()
            image.save(jpeg, "JPEG", quality=_STRIP_QUALITY, subsampling=0)
            strips[case] = strip, jpeg.getvalue()
        for line in wrong[1:]:
            log.error("%s", line)
        if wrong:
            more = f" (and {len(wrong) - 1} more of {item.name}, above)" if len(wrong) > 1 else ""
            raise InputError(f"{wrong[0]}{more}")
        if not rows:
            raise InputError(f"{item.input_path}: no image can be measured; check the input")
        chosen = sorted(choose_cases(rows, metric, strips, _KEPT, _KEPT_FEW).all())
        kept = self._keep_strips(item.name, [strips[case] for case in chosen])
        write_figures(self.path_of(item), ItemFigures(FORMAT, tuple(rows), kept, tuple(images)))
        facts = {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)}
        return Outcome(self.outputs_of(item), facts)

    def _keep_images(self, comparison: Comparison) -> list[str]:
        """Write DIR/pictures/{source,truth,mask,METHOD}/CASE.exr, scene-linear; return the paths below DIR.

        Predictions are marked as synthetic and name the face model; other images carry the version only.
        """
        case, folder = comparison.case.name, self.options.output
        given = {"truth": comparison.truth, "mask": comparison.mask}
        if comparison.source is not None:
            given["source"] = comparison.source
        if clash := set(given) & set(comparison.predictions):
            raise InputError(f"the method {clash.pop()!r} has the name of a folder of --pictures; rename it")
        places = {kind: f"pictures/{kind}/{case}.exr" for kind in (*given, *comparison.predictions)}
        for kind, image in given.items():
            pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
            write_exr(folder / places[kind], pixels, metadata={"Software": f"facerf {__version__}"})
        for method, image in comparison.predictions.items():
            write_exr(folder / places[method], image, metadata=self._marks(case, method))
        return list(places.values())

    def _keep_strips(self, item: str, strips: Iterable[tuple[Strip, bytes]]) -> tuple[Strip, ...]:
        """Write an item's strips to DIR/strips/ITEM/NUMBER.jpg, in place of older ones."""
        folder = self.options.output
        for old in (folder / "strips" / item).glob("[0-9][0-9][0-9].jpg"):
            old.unlink()
        kept = []
        for number, (strip, jpeg) in enumerate(strips):
            file = f"strips/{item}/{number:03d}.jpg"
            with atomic_path(folder / file) as temporary:
                temporary.write_bytes(jpeg)
                embed_xmp(temporary, self._marks(strip.case, "field"))
            kept.append(replace(strip, file=file))
        return tuple(kept)

    def _marks(self, case: str, method: str) -> dict[str, str | int]:
        """Metadata of a method's image: its checkpoint, as far as its name shows it, and the face model."""
        network = {"field": "reflectance", "portrait": "portrait"}.get(method)
        made_by = serving_files(self.settings.checkpoints)[network].stem if network else method
        stamp = self.face_model().stamp if self.face_model else {}
        return Provenance(case, made_by, **stamp).attributes()

    def _remove_summary(self) -> None:
        """Remove the tables of an earlier run, which are about to be out of date."""
        for name in (SUMMARY, IMAGES, PAGE):
            (self.options.output / name).unlink(missing_ok=True)

    def _sum_up(self) -> None:
        """Write and print the tables of finished items. Equal runs give equal files, without the time."""
        figures = [read_figures(self.path_of(item)) for item in self.chosen.items]
        rows = [row for of_item in figures for row in of_item.rows]
        strips = [strip for of_item in figures for strip in of_item.strips]
        folder, options, layout = self.options.output, self.options, self.protocol.layout
        ablation = (f"{self.protocol.name} --against",) if options.against else ()
        layout = replace(
            layout,
            title=layout.title.format(truth=folder_name(options.truth) if options.truth else ""),
            metrics=self.metrics,
            published=published(self.protocol.name, *ablation),
            notes=tuple(self.protocol.notes(options, self.chosen)),
        )
        summary = summarise(layout, rows)
        spaces = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}
        run: dict[str, Any] = {
            "facerf": __version__,
            "command": shlex.join(["facerf", *sys.argv[1:]]),
            "networks": {title: described_file(path) for title, path in self.networks},
            "values compared": spaces[options.measures.space],
        }
        if self.face_model:
            run["face model"] = self.face_model().credit
        content = {**run, "protocol": self.protocol.name, **summary.as_dict()}
        texts = {
            IMAGES: images_csv(rows),
            PAGE: page(summary, run, rows, strips, folder),
            SUMMARY: json_text(json.loads(json_line(content)), indent=1) + "\n",
        }
        for name, text in texts.items():
            with atomic_path(folder / name) as temporary:
                temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
        print_tables(summary, run["networks"])
        if not all(row.person for row in rows):
            log.info("who is in which image is not known: no intervals; give --facts, a CSV with name,person")
        log.info(
            "%s shows the images, worst cases first; %s has a row for each", folder / PAGE, folder / IMAGES
        )
