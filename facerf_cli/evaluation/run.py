"""One run of `facerf evaluate` from items to tables: measure, keep figures and images, sum up."""

import json
import logging
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from facerf_cli._version import __version__
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.recipe import DigestOf, Recipe, key_of, recipe_of
from facerf_cli.batch.run import Job, Outcome, run_items, sums_up
from facerf_cli.batch.settings import torch_device
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.folders import CASES, LIGHT, MASK, SOURCE, TRUTH, write_cases
from facerf_cli.evaluation.measure import Case, Comparison, Row, measure, perceptual_metric
from facerf_cli.evaluation.options import Chosen, EvaluateOptions, name_of
from facerf_cli.evaluation.people import bench_of, networks_used
from facerf_cli.evaluation.protocols import Protocol, notes
from facerf_cli.evaluation.report import (
    FORMAT,
    ItemFigures,
    Strip,
    cases_to_show,
    draw_strip,
    images_csv,
    page,
    read_figures,
    write_figures,
)
from facerf_cli.evaluation.summary import print_tables, summarise
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import json_text
from facerf_cli.files.write import write_exr
from facerf_cli.network.files import serving_files
from facerf_cli.run.logs import LOGGER_NAME, Provenance, json_line
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import face_model, prepare_photos

SUMMARY, IMAGES, PAGE = "summary.json", "images.csv", "report.html"
_KEPT = 14  # strips of an item
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
    photo: PhotoOptions

    @property
    def verb(self) -> str:
        """The verb as it is typed."""
        return f"evaluate {self.protocol.name}"

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics of the tables: the protocol's, and Face dis if it is asked for."""
        own = self.protocol.layout.metrics if self.protocol.layout else ("si_mse",)
        more = ("face_distance",) if self.options.measures.face_distance else ()
        return tuple(dict.fromkeys((*own, *more)))

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
        code = run_items(self, items, replace(options, print_outputs=False), self.photo.settings)
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
        measures, uses = self.options.measures, networks_used(self.options)
        if uses:
            prepare_photos(self.photo, uses, with_networks=not dry_run)
        if not dry_run:
            if uses:  # what would fail each item fails before anything is measured
                bench_of(self.options, self.photo)
            if measures.vgg_weights is not None:
                device = torch_device(self.photo.settings)
                perceptual_metric(measures.lpips, measures.vgg_weights, device)
            self._remove_summary()
        return self

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        recipe: Recipe = {"measuring": _MEASURING, "protocol": self.protocol.name}
        for part in (self.photo, self.chosen, self.options):
            recipe |= recipe_of(part, digest_of)
        return [recipe | {"names": list(self.options.names)}]

    def _made_otherwise(self) -> list[Item]:
        """The finished items that were made from other inputs or by another recipe: one table has one way."""
        journal = Journal(self.options.output, self.verb, self.options.shard)
        (key,) = map(key_of, self.recipes_of(journal.digest_of))
        return [
            item
            for item in self.chosen.items
            if (path := self.path_of(item)).exists() and journal.why(item, path, key) is not None
        ]

    def path_of(self, item: Item) -> Path:
        """The item's figures."""
        return self.options.output / "cases" / f"{item.name}.json"

    def outputs_of(self, item: Item) -> list[Path]:
        """The files of a finished item: its figures, and the images that were kept."""
        path = self.path_of(item)
        try:
            kept = read_figures(path).pictures if path.exists() else ()
        except InputError:  # said when the figures are needed
            kept = ()
        return [path, *(self.options.output / file for file in kept)]

    def __call__(self, item: Item) -> Outcome:
        """Measure an item's comparisons, and write its figures when all are measured."""
        rows: list[Row] = []
        images: list[str] = []
        strips: dict[str, Strip] = {}
        metric, measures = self.metrics[0], self.options.measures
        scaled = metric.startswith("si_") and measures.space == "linear"
        bench = bench_of(self.options, self.photo)
        for own in self.protocol.compare(self.options, bench, self.chosen.items[item]):
            case = own.case
            if self.kept is not None:
                images += self._keep_images(own, self.kept)
            if not own.predictions:
                rows.append(Row(case.name, case.person, "", case.facts, {}))
                continue
            faces, device = "face_distance" in self.metrics, torch_device(self.photo.settings)
            rows += measure(own, measures, faces, device)
            strips[case.name] = draw_strip(own, scaled, self._marks(case.name, "field"))
        if not rows:
            raise InputError(f"{item.input_path}: no image can be measured; check the input")
        chosen = sorted(cases_to_show(rows, metric, strips, _KEPT))
        kept = tuple(strips[case] for case in chosen)
        write_figures(self.path_of(item), ItemFigures(FORMAT, tuple(rows), kept, tuple(images)))
        facts = {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)}
        return Outcome(self.outputs_of(item), facts)

    @property
    def kept(self) -> Path | None:
        """The folder of images that are kept, below the output folder."""
        if self.protocol.layout is None:
            return Path()
        return Path("pictures") if self.options.pictures else None

    def _keep_images(self, comparison: Comparison, folder: Path) -> list[str]:
        """Write FOLDER/{source,truth,mask,light,METHOD}/CASE.exr, scene-linear; return their paths.

        Predictions are marked as synthetic and name the face model; other images carry the version only.
        """
        case = comparison.case.name
        given = {TRUTH: comparison.truth, MASK: comparison.mask}
        given |= {SOURCE: comparison.source} if comparison.source is not None else {}
        given |= {LIGHT: comparison.light} if comparison.light is not None else {}
        if clash := {SOURCE, TRUTH, MASK, LIGHT} & set(comparison.predictions):
            raise InputError(f"the method {clash.pop()!r} has the name of a folder of --pictures; rename it")
        places = {
            kind: (folder / kind / f"{case}.exr").as_posix() for kind in (*given, *comparison.predictions)
        }
        for kind, image in given.items():
            pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
            mark = {"Software": f"facerf {__version__}"}
            write_exr(self.options.output / places[kind], pixels, metadata=mark)
        for method, image in comparison.predictions.items():
            write_exr(self.options.output / places[method], image, metadata=self._marks(case, method))
        return list(places.values())

    def _marks(self, case: str, method: str) -> dict[str, str | int]:
        """Metadata of a method's image: its checkpoint, as far as its name shows it, and the face model."""
        network = {"field": "reflectance", "portrait": "portrait"}.get(method)
        made_by = serving_files(self.photo.settings.checkpoints)[network].stem if network else method
        stamp = face_model(self.photo).stamp if self.options.ours else {}
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
        if self.kept is not None:
            cases = (Case(row.case, row.person, row.facts) for row in rows)
            write_cases(folder / self.kept / CASES, cases)
        if layout is None:
            log.info(
                "%s lists %d cases; docs/evaluation.md says what a method renders", folder / CASES, len(rows)
            )
            return
        layout = replace(
            layout,
            title=layout.title.format(truth=name_of(options.truth)),
            metrics=self.metrics,
            notes=tuple(notes(options, self.chosen)),
        )
        summary = summarise(layout, rows)
        spaces = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}
        run: dict[str, Any] = {
            "facerf": __version__,
            "command": shlex.join(["facerf", *sys.argv[1:]]),
            "values compared": spaces[options.measures.space],
        }
        if options.ours:
            run["face model"] = face_model(self.photo).credit
        content = {**run, "protocol": self.protocol.name, **summary.as_dict()}
        texts = {
            IMAGES: images_csv(rows),
            PAGE: page(summary, run, rows, strips),
            SUMMARY: json_text(json.loads(json_line(content)), indent=1) + "\n",
        }
        for name, text in texts.items():
            with atomic_path(folder / name) as temporary:
                temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
        print_tables(summary)
        if not all(row.person for row in rows):
            log.info("who is in which image is not known: no intervals; give --facts, a CSV with name,person")
        log.info(
            "%s shows the images, worst cases first; %s has a row for each", folder / PAGE, folder / IMAGES
        )
