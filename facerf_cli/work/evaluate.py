"""One protocol of `facerf evaluate` from items to tables: measure, keep figures and images, sum up."""

import io
import json
import logging
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from facerf_cli._version import __version__
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import DigestOf, FolderIndex, Recipe, recipe_of
from facerf_cli.batch.run import Outcome, run_items, sums_up
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Comparison, Measures, Row, measure
from facerf_cli.evaluation.pairs import read_predictions
from facerf_cli.evaluation.report import (
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
from facerf_cli.files.images import write_exr
from facerf_cli.files.texts import file_sha256
from facerf_cli.network.files import checkpoint_file, serving_files
from facerf_cli.run.logs import LOGGER_NAME, Provenance, json_line
from facerf_cli.work.evaluation_settings import EvaluateOptions
from facerf_cli.work.photo_options import PhotoOptions, networks_of
from facerf_cli.work.photos import face_model

CASES, SUMMARY, IMAGES, PAGE = "cases", "summary.json", "images.csv", "report.html"
KEPT, STRIPS = "pictures", "strips"
_STRIP_QUALITY = 88
_MEASURING = 5  # raised where the same recipe gives other figures
log = logging.getLogger(LOGGER_NAME)

CompareItem = Callable[[Item], Iterable[Comparison]]


def run_protocol(
    protocol: Layout,
    items: Sequence[Item],
    compare: CompareItem,
    options: EvaluateOptions,
    settings: Settings,
    photo: PhotoOptions | None = None,
    prepare: Callable[[], object] | None = None,
) -> int:
    """Measure the items and write their tables; return the exit code, 0 done, 1 some failed.

    An item's rows are DIR/cases/ITEM.json, so finished items are skipped and an interrupted run continues. At
    the end: DIR/summary.json, DIR/images.csv, DIR/report.html, and a table on stdout. If an item failed or a
    prediction is missing, each is named and no summary is written.

    Args:
        protocol: The contents of the tables.
        items: What is measured, one after another.
        compare: Yields the comparisons of an item. A frozen dataclass, since it is sent to other processes;
            its fields are part of the recipe of what is written.
        options: The shared options.
        settings: The global options.
        photo: Has the face model of the images; they and the summary name it.
        prepare: Loads what the items need; it is not called where all are finished.
    """
    if not items:
        raise UsageError(f"evaluate {protocol.name}: nothing to evaluate; give other inputs")
    verb = f"evaluate {protocol.name}"
    work = _Measure(protocol.metrics[0], compare, options, settings, photo)
    batch = replace(options, print_outputs=False)

    def recipes(digest_of: DigestOf) -> list[Recipe]:
        names = {"measuring": _MEASURING, "protocol": protocol.name, "methods": list(options.methods)}
        return [recipe_of(compare, digest_of) | recipe_of(options, digest_of) | names]

    def begin() -> None:
        if prepare:
            prepare()
        if not options.dry_run:
            _measures(options).check()  # fails before anything is measured
            _remove_summary(options.output)

    if options.overwrite == "never" and (other := _made_otherwise(items, work, verb, recipes)):
        raise UsageError(
            f"{options.output}: {len(other)} items ({other[0].name}, ...) were evaluated with other options, "
            "another checkpoint or other inputs; leave out --overwrite never, or give another folder"
        )
    code = run_items(verb, items, work, work.outputs_of, batch, settings, recipes, begin)
    if code:
        log.error("no summary is written while images are missing; finished items are kept, so run it again")
    elif not options.dry_run and sums_up(items, work.outputs_of, options):
        _remove_summary(options.output)
        if options.shard.of > 1 and (other := _made_otherwise(items, work, verb, recipes)):
            log.info("%d items of other shards are of an earlier run, so there is no summary", len(other))
        else:
            _finish(protocol, items, work)
    return code


def _made_otherwise(
    items: Sequence[Item], work: "_Measure", verb: str, recipes: Callable[[DigestOf], list[Recipe]]
) -> list[Item]:
    """The finished items that were made from other inputs or by another recipe: one table has one way."""
    index = FolderIndex(work.options.output, verb, work.options.shard, recipes)
    finished = [item for item in items if work.path_of(item).exists()]
    return [
        item for item in finished if index.why_again(item.input_path, [work.path_of(item)])[0] is not None
    ]


def _remove_summary(folder: Path) -> None:
    """Remove the tables of an earlier run, which are about to be out of date."""
    for name in (SUMMARY, IMAGES, PAGE):
        (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True)
class _Measure:
    """Measures an item; settings only."""

    metric: str  # by which the worst images are found
    compare: CompareItem
    options: EvaluateOptions
    settings: Settings
    photo: PhotoOptions | None

    @property
    def stamp(self) -> dict[str, str]:
        """The stamp of the face model of the images, if there is one."""
        return face_model(self.photo).stamp if self.photo else {}

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
        scaled = self.metric.startswith("si_") and self.options.space == "linear"
        strips: dict[str, tuple[Strip, bytes]] = {}
        measures = _measures(self.options)
        for own in self.compare(item):
            if self.options.pictures:
                images += keep_images(own, self.options.output, self.settings, self.stamp)
            comparison = _with_others(own, self.options.folders, wrong)
            if wrong:
                continue  # to name all that is missing at once
            rows += measure(comparison, measures)
            strip, pixels = draw_strip(comparison, scaled)
            strips[strip.case] = strip, _as_jpeg(pixels)
        _require_whole(item, rows, wrong)
        chosen = [strips[case] for case in cases_to_keep(rows, self.metric)]
        kept = keep_strips(chosen, self.options.output, item.name, self.settings, self.stamp)
        write_figures(self.path_of(item), ItemFigures(tuple(rows), kept, tuple(images)))
        facts = {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)}
        return Outcome(self.outputs_of(item), facts)


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


def keep_images(
    comparison: Comparison, folder: Path, settings: Settings, stamp: Mapping[str, str]
) -> list[str]:
    """Write FOLDER/pictures/{source,truth,mask,METHOD}/CASE.exr, scene-linear; the paths below FOLDER.

    Predictions are marked as synthetic and carry the `stamp` of the face model; sources and truths carry the
    version only.
    """
    name = comparison.case.name
    asked = {"truth": comparison.truth, "mask": comparison.mask, "source": comparison.source}
    given = {kind: image for kind, image in asked.items() if image is not None}
    clash = set(given) & set(comparison.predictions)
    if clash:
        raise InputError(f"the method {clash.pop()!r} has the name of a folder of --pictures; rename it")
    for kind, image in given.items():
        pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
        write_exr(folder / _place(kind, name), pixels, metadata={"Software": f"facerf {__version__}"})
    for method, image in comparison.predictions.items():
        marks = Provenance(name, _checkpoint_of(method, settings), **stamp).attributes()
        write_exr(folder / _place(method, name), image, metadata=marks)
    return [_place(kind, name) for kind in (*given, *comparison.predictions)]


def _checkpoint_of(method: str, settings: Settings) -> str:
    """The checkpoint of a method's images, as far as the method's name shows it."""
    name = {"field": "reflectance", "portrait": "portrait"}.get(method)
    return serving_files(settings.checkpoints)[name].stem if name else method


def _place(kind: str, case: str) -> str:
    """The path of a case's image below the folder; InputError for a name that leads out of it."""
    parts = PurePosixPath(case).parts
    if not parts or ".." in parts or PurePosixPath(case).is_absolute() or "/" in kind:
        raise InputError(f"{kind}/{case}: not a name for an image in a folder; rename the case")
    return f"{KEPT}/{kind}/{case}.exr"


def _as_jpeg(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=_STRIP_QUALITY, subsampling=0)
    return stream.getvalue()


def keep_strips(
    strips: Iterable[tuple[Strip, bytes]],
    folder: Path,
    item: str,
    settings: Settings,
    stamp: Mapping[str, str],
) -> tuple[Strip, ...]:
    """Write an item's strips to FOLDER/strips/ITEM/NUMBER.jpg, in place of older ones."""
    place = folder / STRIPS / item
    for old in place.glob("[0-9][0-9][0-9].jpg"):
        old.unlink()
    kept = []
    for number, (strip, jpeg) in enumerate(strips):
        path = place / f"{number:03d}.jpg"
        made = Provenance(strip.case, _checkpoint_of("field", settings), **stamp)
        with atomic_path(path) as temporary:
            temporary.write_bytes(jpeg)
            embed_xmp(temporary, made.attributes())
        kept.append(replace(strip, file=path.relative_to(folder).as_posix()))
    return tuple(kept)


def _finish(protocol: Layout, items: Sequence[Item], work: _Measure) -> None:
    """Write and print the tables of finished items."""
    figures = [read_figures(work.path_of(item)) for item in items]
    rows = [row for of_item in figures for row in of_item.rows]
    _require_every_method(rows)
    summary = summarise(protocol, rows)
    chosen = choose(summary, rows, [strip for of_item in figures for strip in of_item.strips])
    folder, about = work.options.output, _about(work)
    jpegs = {case.strip.case: (folder / case.strip.file).read_bytes() for case in chosen.all()}
    content = {"facerf": about.version, "command": about.command, **about.facts, **summary.as_dict()}
    texts = {
        IMAGES: images_csv(rows),
        PAGE: page(summary, about, chosen, jpegs),
        SUMMARY: json_text(json.loads(json_line(content)), indent=1) + "\n",
    }
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
    print_tables(summary)
    log.info("%s shows the images, worst cases first; %s has a row for each", folder / PAGE, folder / IMAGES)


def _require_every_method(rows: Sequence[Row]) -> None:
    """Raise InputError where a case lacks a method that others have: a mean would leave it out."""
    methods = list(dict.fromkeys(row.method for row in rows))
    of_case: dict[str, set[str]] = {}
    for row in rows:
        of_case.setdefault(row.case, set()).add(row.method)
    missing = [f"{case} by {name}" for case, have in of_case.items() for name in methods if name not in have]
    for line in missing:
        log.error("%s is missing", line)
    if missing:
        raise InputError(
            f"{len(missing)} predictions are missing, so no summary is written; add them and run again"
        )


def _about(work: _Measure) -> About:
    """The run's command and networks, without the time: equal runs give equal files."""
    facts: dict[str, Any] = {}
    if work.options.kinds:
        for own in serving_files(work.settings.checkpoints, networks_of(work.options.kinds)).values():
            facts[f"checkpoint {own.stem}"] = f"SHA-256 {_sha256(own)}"
        for path in work.options.checkpoints:
            facts[f"checkpoint against {path.stem}"] = f"SHA-256 {_sha256(checkpoint_file(path))}"
    facts["values compared"] = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}[
        work.options.space
    ]
    if work.photo:
        facts["face model"] = face_model(work.photo).credit
    return About(shlex.join(["facerf", *sys.argv[1:]]), __version__, facts)


@cache
def _sha256(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None


def _measures(options: EvaluateOptions) -> Measures:
    return Measures(space=options.space, lpips=options.lpips, vgg_weights=options.vgg_weights)
