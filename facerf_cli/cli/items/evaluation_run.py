"""One protocol of `facerf evaluate` from items to tables: measure, keep figures and images, sum up."""

import json
import logging
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from facerf_cli import __version__
from facerf_cli.cli.batch import BatchOptions, run_items, sums_up
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.evaluation_key import evaluation_key, item_key, networks_of
from facerf_cli.cli.items.photos import face_model
from facerf_cli.cli.options import Settings
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.cli.report import Outcome
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.case import Comparison, Others
from facerf_cli.evaluation.case_files import (
    ItemFigures,
    KeptStrip,
    images_csv,
    read_figures,
    write_figures,
)
from facerf_cli.evaluation.measure import Measures, Row, measure
from facerf_cli.evaluation.report_html import About, choose, page
from facerf_cli.evaluation.strips import Strip, StripKeeper, strip_of
from facerf_cli.evaluation.summary import Layout, Summary, print_tables, summarise
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import json_text
from facerf_cli.files.image_metadata import embed_xmp
from facerf_cli.files.images import write_exr
from facerf_cli.logs import LOGGER_NAME, Provenance, json_line
from facerf_cli.models import DEFAULT_CHECKPOINT

CASES, SUMMARY, IMAGES, PAGE = "cases", "summary.json", "images.csv", "report.html"
KEPT, STRIPS = "pictures", "strips"
_STRIP_QUALITY = 88
log = logging.getLogger(LOGGER_NAME)


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
        write_exr(folder / _place(kind, name), pixels, metadata={"Software": _software()})
    for method, image in comparison.predictions.items():
        marks = Provenance(name, _checkpoint_of(method, settings), **stamp).attributes()
        write_exr(folder / _place(method, name), image, metadata=marks)
    return [_place(kind, name) for kind in (*given, *comparison.predictions)]


def _software() -> str:
    return f"facerf {__version__}"


def _checkpoint_of(method: str, settings: Settings) -> str:
    """The checkpoint of a method's images, as far as the method's name shows it."""
    return (settings.checkpoint or DEFAULT_CHECKPOINT).stem if method in ("field", "portrait") else method


def _place(kind: str, case: str) -> str:
    """The path of a case's image below the folder; InputError for a name that leads out of it."""
    parts = PurePosixPath(case).parts
    if not parts or ".." in parts or PurePosixPath(case).is_absolute() or "/" in kind:
        raise InputError(f"{kind}/{case}: not a name for an image in a folder; rename the case")
    return f"{KEPT}/{kind}/{case}.exr"


def keep_strips(
    strips: Mapping[str, Strip], folder: Path, item: str, settings: Settings, stamp: Mapping[str, str]
) -> tuple[KeptStrip, ...]:
    """Write an item's strips to FOLDER/strips/ITEM/NUMBER.jpg, in place of older ones."""
    place = folder / STRIPS / item
    for old in place.glob("[0-9][0-9][0-9].jpg"):
        old.unlink()
    kept = []
    for number, (case, strip) in enumerate(strips.items()):
        path = place / f"{number:03d}.jpg"
        _write_strip(path, strip, Provenance(case, _checkpoint_of("field", settings), **stamp))
        size = (strip.pixels.shape[1], strip.pixels.shape[0])
        relative = path.relative_to(folder).as_posix()
        kept.append(KeptStrip(case, relative, strip.methods, strip.ev, strip.scales, strip.has_source, size))
    return tuple(kept)


def _write_strip(path: Path, strip: Strip, made: Provenance) -> None:
    with atomic_path(path) as temporary:
        Image.fromarray(strip.pixels).save(temporary, quality=_STRIP_QUALITY, subsampling=0)
        embed_xmp(temporary, made.attributes())


def run_protocol(
    protocol: Layout,
    items: Sequence[Item],
    compare: Callable[[Item], Iterable[Comparison]],
    options: EvaluateOptions,
    settings: Settings,
    photo: PhotoOptions | None = None,
    prepare: Callable[[], object] | None = None,
) -> int:
    """Measure the items and write their tables; return the exit code, 0 done, 1 some failed.

    `compare` (a frozen dataclass, since it is sent to other processes) yields the comparisons of an item. An
    item's rows are DIR/cases/ITEM.json, so finished items are skipped and an interrupted run continues; an
    item is unfinished if a strip or image that it kept is gone. At the end: DIR/summary.json, DIR/images.csv,
    DIR/report.html, and a table on stdout. If an item failed or a prediction is missing, each is named and no
    summary is written. `photo` has the face model of the images; they and the summary name it. `prepare`
    loads what the items need; it is not called where all are finished.
    """
    if not items:
        raise UsageError(f"evaluate {protocol.name}: nothing to evaluate; give other inputs")
    key = evaluation_key(protocol.name, compare, options, settings)
    work = _Measure(protocol.metrics[0], compare, options, settings, photo, key)
    _check_earlier(items, work)
    batch = BatchOptions(options.output, options.overwrite, options.dry_run, options.jobs)

    def begin() -> None:
        if prepare:
            prepare()
        if not options.dry_run:
            _measures(options).check()  # fails before anything is measured
            _remove_summary(options.output)

    code = run_items(f"evaluate {protocol.name}", items, work, work.outputs_of, batch, settings, begin)
    if code:
        log.error("no summary is written while images are missing; finished items are kept, so run it again")
    elif not options.dry_run and sums_up(items, work.outputs_of, batch, settings):
        _remove_summary(options.output)
        _finish(protocol, items, work)
    return code


def _remove_summary(folder: Path) -> None:
    """Remove the tables of an earlier run, which are about to be out of date."""
    for name in (SUMMARY, IMAGES, PAGE):
        (folder / name).unlink(missing_ok=True)


def _check_earlier(items: Sequence[Item], work: "_Measure") -> None:
    """Raise UsageError where finished items were evaluated in another way: one table has one way."""
    if work.options.overwrite == "always":
        return
    found = {item: path for item in items if (path := work.path_of(item)).exists()}
    other = [path for item, path in found.items() if read_figures(path).key != work.key_of(item)]
    if other:
        raise UsageError(
            f"{work.options.output}: {len(other)} items ({other[0].stem}, ...) were evaluated with other "
            "options, another checkpoint or another version; give --overwrite always, or another folder"
        )


@dataclass(frozen=True)
class _Measure:
    """Measures an item; settings only."""

    metric: str  # by which the worst images are found
    compare: Callable[[Item], Iterable[Comparison]]
    options: EvaluateOptions
    settings: Settings
    photo: PhotoOptions | None
    key: str

    @property
    def stamp(self) -> dict[str, str]:
        """The stamp of the face model of the images, if there is one."""
        return face_model(self.photo).stamp if self.photo else {}

    def path_of(self, item: Item) -> Path:
        """The item's figures."""
        return self.options.output / CASES / f"{item.name}.json"

    def key_of(self, item: Item) -> str:
        """The key of all that its figures depend on."""
        return item_key(self.key, item.input_path)

    def outputs_of(self, item: Item) -> list[Path]:
        """The files of a finished item: its figures, and the images that they name."""
        path = self.path_of(item)
        kept = () if self.options.overwrite == "always" or not path.exists() else read_figures(path).files
        return [path, *(self.options.output / file for file in kept)]

    def __call__(self, item: Item) -> Outcome:
        """Measure an item's comparisons, and write its figures when all are measured."""
        rows: list[Row] = []
        wrong: list[str] = []
        images: list[str] = []
        scaled = self.metric.startswith("si_") and self.options.space == "linear"
        keeper, measures = StripKeeper(self.metric), _measures(self.options)
        for own in self.compare(item):
            if self.options.pictures:
                images += keep_images(own, self.options.output, self.settings, self.stamp)
            comparison = _with_others(own, self.options.compare, wrong)
            if wrong:
                continue  # to name all that is missing at once
            measured = measure(comparison, measures)
            keeper.offer(measured, partial(strip_of, comparison, scaled))
            rows += measured
        _require_whole(item, rows, wrong)
        strips = keep_strips(keeper.kept(), self.options.output, item.name, self.settings, self.stamp)
        figures = ItemFigures(self.key_of(item), tuple(rows), strips, tuple(images))
        write_figures(self.path_of(item), figures)
        return Outcome([], {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)})


def _with_others(own: Comparison, folders: Sequence[Path], wrong: list[str]) -> Comparison:
    """Add other methods' predictions to the comparison; errors go to `wrong`."""
    try:
        others = Others(tuple(folders), own.grey_as_given).predictions(own.case.name, own.truth.shape)
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


def _finish(protocol: Layout, items: Sequence[Item], work: _Measure) -> None:
    """Write and print the tables of finished items."""
    found = {item.name: read_figures(work.path_of(item)) for item in items}
    rows = [row for figures in found.values() for row in figures.rows]
    _require_every_method(found)
    summary = summarise(protocol, rows)
    folder = work.options.output
    with atomic_path(folder / IMAGES) as temporary:
        temporary.write_text(images_csv(rows), encoding="utf-8", errors="backslashreplace")
    _write_documents(summary, rows, found, work)
    print_tables(summary)
    log.info("%s shows the images, worst cases first; %s has a row for each", folder / PAGE, folder / IMAGES)


def _require_every_method(found: Mapping[str, ItemFigures]) -> None:
    """Raise InputError where a case lacks a method that others have: a mean would leave it out."""
    rows = [row for figures in found.values() for row in figures.rows]
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


def _write_documents(
    summary: Summary, rows: Sequence[Row], found: Mapping[str, ItemFigures], work: _Measure
) -> None:
    """Write the summary and the page."""
    folder, about = work.options.output, _about(work)
    chosen = choose(summary, rows, [strip for figures in found.values() for strip in figures.strips])
    jpegs = {case.strip.case: (folder / case.strip.file).read_bytes() for case in chosen.all()}
    content = {"facerf": about.version, "command": about.command, **about.facts, **summary.as_dict()}
    texts = {PAGE: page(summary, about, chosen, jpegs)}
    texts[SUMMARY] = json_text(json.loads(json_line(content)), indent=1) + "\n"
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _about(work: _Measure) -> About:
    """The run's command and networks, without the time: equal runs give equal files."""
    networks = networks_of(work.options, work.settings)
    facts = {f"checkpoint {name}": f"SHA-256 {digest}" for name, digest in networks.items()}
    facts["values compared"] = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}[
        work.options.space
    ]
    if work.photo:
        facts["face model"] = face_model(work.photo).credit
    return About(shlex.join(["facerf", *sys.argv[1:]]), __version__, facts)


def _measures(options: EvaluateOptions) -> Measures:
    return Measures(space=options.space, lpips=options.lpips, vgg_weights=options.vgg_weights)
