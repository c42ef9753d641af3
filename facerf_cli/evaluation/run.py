"""Run a protocol of `facerf evaluate`: measure the items, store their results, and write the tables."""

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
from facerf_cli.files.image_metadata import Provenance
from facerf_cli.files.write import write_exr
from facerf_cli.network.files import serving_files
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import face_model, prepare_photos

SUMMARY, IMAGES, PAGE = "summary.json", "images.csv", "report.html"
_STRIPS = 14  # stored per item
_MEASURING = 9  # version of the metrics; raised when equal options give other results
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Evaluation(Job):
    """Run of a protocol; contains only settings, which are sent to worker processes.

    Each item writes DIR/cases/ITEM.json, so an interrupted run continues. At the end, the run writes
    DIR/summary.json, DIR/images.csv and DIR/report.html and prints tables, unless an item failed.
    """

    protocol: Protocol
    chosen: Chosen
    options: EvaluateOptions
    photo: PhotoOptions

    @property
    def verb(self) -> str:
        return f"evaluate {self.protocol.name}"

    @property
    def metrics(self) -> tuple[str, ...]:
        """Metrics of the tables: the protocol's metrics, and Face dis with --face-distance."""
        layout, measures = self.protocol.layout, self.options.measures
        metrics = layout.metrics if layout else ("si_mse",)
        return tuple(dict.fromkeys((*metrics, *(["face_distance"] if measures.face_distance else []))))

    def run(self) -> int:
        """Measure the items and write the tables; return the exit code: 0 done, 1 some items failed."""
        items, options = list(self.chosen.items), self.options
        if not items:
            raise UsageError(f"{self.verb}: nothing to evaluate; use other inputs")
        if options.overwrite == "never" and (stale := self._stale()):
            raise UsageError(
                f"{options.output}: {len(stale)} items ({stale[0].name}, ...) were evaluated with other "
                "options, checkpoints or inputs; remove --overwrite never, or use another folder"
            )
        code = run_items(self, items, replace(options, print_outputs=False), self.photo.settings)
        if code:
            log.error("no summary is written while images are missing; run again to finish the others")
        elif not options.dry_run and sums_up(items, self.outputs_of, options):
            self._remove_summary()
            if options.shard.of > 1 and (stale := self._stale()):
                log.info("no summary is written: %d items of other shards are out of date", len(stale))
            else:
                self._sum_up()
        return code

    def ready(self, dry_run: bool) -> Self:
        """Load networks and metrics, so that errors appear early, and remove outdated tables."""
        measures, uses = self.options.measures, networks_used(self.options)
        if uses:
            prepare_photos(self.photo, uses, with_networks=not dry_run)
        if not dry_run:
            if uses:
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

    def _stale(self) -> list[Item]:
        """Return the finished items whose inputs or options have changed; one table must not mix them."""
        journal = Journal(self.options.output, self.verb, self.options.shard)
        (key,) = map(key_of, self.recipes_of(journal.digest_of))
        return [
            item
            for item in self.chosen.items
            if (path := self.path_of(item)).exists() and journal.why(item, path, key) is not None
        ]

    def path_of(self, item: Item) -> Path:
        return self.options.output / "cases" / f"{item.name}.json"

    def outputs_of(self, item: Item) -> list[Path]:
        """Return the files of a finished item: its results and its stored images."""
        path = self.path_of(item)
        try:
            images = read_figures(path).pictures if path.exists() else ()
        except InputError:  # reported when the results are needed
            images = ()
        return [path, *(self.options.output / file for file in images)]

    def __call__(self, item: Item) -> Outcome:
        rows: list[Row] = []
        images: list[str] = []
        strips: dict[str, Strip] = {}
        metric, measures = self.metrics[0], self.options.measures
        scaled = metric.startswith("si_") and measures.space == "linear"
        bench = bench_of(self.options, self.photo)
        for comparison in self.protocol.compare(self.options, bench, self.chosen.items[item]):
            case = comparison.case
            if self.image_folder is not None:
                images += self._write_images(comparison, self.image_folder)
            if not comparison.predictions:
                rows.append(Row(case.name, case.person, "", case.facts, {}))
                continue
            faces, device = "face_distance" in self.metrics, torch_device(self.photo.settings)
            rows += measure(comparison, measures, faces, device)
            strips[case.name] = draw_strip(comparison, scaled, self._marks(case.name, "field"))
        if not rows:
            raise InputError(f"{item.input_path}: no image can be measured; check the input")
        stored = tuple(strips[case] for case in sorted(cases_to_show(rows, metric, strips, _STRIPS)))
        write_figures(self.path_of(item), ItemFigures(FORMAT, tuple(rows), stored, tuple(images)))
        facts = {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)}
        return Outcome(self.outputs_of(item), facts)

    @property
    def image_folder(self) -> Path | None:
        """Folder of the stored images below the output folder; None: images are not stored."""
        if self.protocol.layout is None:
            return Path()
        return Path("pictures") if self.options.pictures else None

    def _write_images(self, comparison: Comparison, folder: Path) -> list[str]:
        """Write FOLDER/{source,truth,mask,light,METHOD}/CASE.exr, scene-linear, and return their paths.

        The metadata of predictions declare them synthetic and name the face model.
        """
        case = comparison.case.name
        references = {TRUTH: comparison.truth, MASK: comparison.mask}
        references |= {SOURCE: comparison.source} if comparison.source is not None else {}
        references |= {LIGHT: comparison.light} if comparison.light is not None else {}
        if clash := {SOURCE, TRUTH, MASK, LIGHT} & set(comparison.predictions):
            raise InputError(f"the method {clash.pop()!r} has the name of a folder of --pictures; rename it")
        written = []
        for kind, image in (references | dict(comparison.predictions)).items():
            pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
            version: dict[str, str | int] = {"Software": f"facerf {__version__}"}
            metadata = version if kind in references else self._marks(case, kind)
            written.append((folder / kind / f"{case}.exr").as_posix())
            write_exr(self.options.output / written[-1], pixels, metadata=metadata)
        return written

    def _marks(self, case: str, method: str) -> dict[str, str | int]:
        """Return the metadata of a method's image: checkpoint and face model."""
        network = {"field": "reflectance", "portrait": "portrait"}.get(method)
        checkpoint = serving_files(self.photo.settings.checkpoints)[network].stem if network else method
        stamp = face_model(self.photo).stamp if self.options.renders else {}
        return Provenance(case, checkpoint, **stamp).attributes()

    def _remove_summary(self) -> None:
        for name in (SUMMARY, IMAGES, PAGE):
            (self.options.output / name).unlink(missing_ok=True)

    def _sum_up(self) -> None:
        """Write and print the tables of all items. Files contain no time, so equal runs give equal files."""
        results = [read_figures(self.path_of(item)) for item in self.chosen.items]
        rows = [row for result in results for row in result.rows]
        strips = [strip for result in results for strip in result.strips]
        folder, options, layout = self.options.output, self.options, self.protocol.layout
        if self.image_folder is not None:
            cases = (Case(row.case, row.person, row.facts) for row in rows)
            write_cases(folder / self.image_folder / CASES, cases)
        if layout is None:
            log.info("wrote %d cases to %s; see docs/evaluation.md", len(rows), folder / CASES)
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
        if options.renders:
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
            log.info("no confidence intervals: people are unknown; use --facts with a CSV of name,person")
        log.info("wrote %s and %s", folder / PAGE, folder / IMAGES)
