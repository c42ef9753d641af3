"""What an evaluation depends on, told apart by a key: one table never mixes two ways of measuring.

Pictures that an evaluation keeps: the strips of its report, and with --pictures all of them as EXR.

What all protocols of `facerf evaluate` do alike: walk the items, measure, keep rows, sum them up.
"""

import dataclasses
import hashlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import facerf_cli
from facerf_cli import __version__
from facerf_cli.cli.batch import BatchOptions, Item, Outcome, run_items, sums_up
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.options import Settings
from facerf_cli.cli.photo_options import PhotoOptions, face_model
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME, Provenance, json_line

if TYPE_CHECKING:
    from facerf_cli.evaluation.case import Comparison
    from facerf_cli.evaluation.case_files import ItemFigures, KeptStrip
    from facerf_cli.evaluation.measure import Row
    from facerf_cli.evaluation.report_html import About, Strip
    from facerf_cli.evaluation.summary import Layout, Summary

# Settings that change no figure, wherever they stand; and those that are a name or a file's path.
_WITHOUT_EFFECT = {"output", "jobs", "overwrite", "dry_run", "verbosity", "log_json", "device", "checkpoint"}
_WITHOUT_EFFECT |= {"shard", "ray", "output_base"}
_NAME_OR_PATH = {"face_model", "vgg_weights"}


def evaluation_key(
    protocol: str, compare: Callable[..., Any], options: EvaluateOptions, settings: Settings
) -> str:
    """16 digits that differ where figures may: by version, protocol, its settings, options and networks."""
    facts = {
        "version": __version__,
        "protocol": protocol,
        "compare": _plain(compare),
        "options": _plain(options),
        "networks": networks_of(options, settings),
        "others": [_files_of(folder) for folder in options.compare],
    }
    return hashlib.sha256(json_line(facts).encode("utf-8", "backslashreplace")).hexdigest()[:16]


def item_key(key: str, path: Path) -> str:
    """The key of one item: another file of the same name is another picture."""
    return hashlib.sha256(json_line({"run": key, "item": _plain(path)}).encode()).hexdigest()[:16]


def networks_of(options: EvaluateOptions, settings: Settings) -> dict[str, str]:
    """SHA-256 of the checkpoints by what they are for; none where no reflectance model is asked for."""
    if not options.reflectance:
        return {}
    from facerf_cli.pipeline import DEFAULT_CHECKPOINT

    own = settings.checkpoint or DEFAULT_CHECKPOINT
    against = {f"against {path.stem}": _sha256(path) for path in options.against}
    return {own.stem: _sha256(own), **against}


def _files_of(folder: Path) -> list[Any]:
    """What tells a folder of predictions from the same folder rewritten."""
    return [_plain(path) for path in sorted(folder.rglob("*")) if path.is_file()]


@cache
def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def _plain(value: Any) -> Any:
    """Settings as JSON can have them; what is no setting is told by its type alone.

    A path is told by what it leads to, however it was written; a file by its size and time as well.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name for field in dataclasses.fields(value)} - _WITHOUT_EFFECT
        return {"type": type(value).__name__} | {name: _field(value, name) for name in sorted(fields)}
    if isinstance(value, Mapping):
        return [[_plain(name), _plain(entry)] for name, entry in value.items()]
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, Path):
        facts = value.stat() if value.is_file() else None
        return [value.resolve(), *((facts.st_size, facts.st_mtime_ns) if facts else ())]
    if isinstance(value, (str, int, float, bool)) or value is None:
        return value
    return value.tolist() if hasattr(value, "tolist") else type(value).__name__


def _field(settings: Any, name: str) -> Any:
    value = getattr(settings, name)
    is_file = name in _NAME_OR_PATH and value is not None and Path(value).is_file()
    return _plain(Path(value) if is_file else value)


KEPT, STRIPS = "pictures", "strips"
_STRIP_QUALITY = 88


def keep_images(
    comparison: "Comparison", folder: Path, settings: Settings, stamp: Mapping[str, str]
) -> list[str]:
    """Write FOLDER/pictures/{source,truth,mask,METHOD}/CASE.exr, scene-linear; give the paths from FOLDER on.

    Predictions carry the mark of what facerf makes, and the `stamp` of the face model; sources and truths are
    given and carry its version only.
    """
    import numpy as np

    from facerf_cli.files.images import write_exr

    name = comparison.case.name
    asked = {"truth": comparison.truth, "mask": comparison.mask, "source": comparison.source}
    given = {kind: image for kind, image in asked.items() if image is not None}
    clash = set(given) & set(comparison.predictions)
    if clash:
        raise InputError(f"a method is called {clash.pop()!r}, as a folder of --pictures is; rename it")
    for kind, image in given.items():
        pixels = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
        write_exr(folder / _place(kind, name), pixels, metadata={"Software": _software()})
    for method, image in comparison.predictions.items():
        marks = Provenance(name, _checkpoint_of(method, settings), **stamp).attributes()
        write_exr(folder / _place(method, name), image, metadata=marks)
    return [_place(kind, name) for kind in (*given, *comparison.predictions)]


def _software() -> str:
    return f"facerf {facerf_cli.__version__}"


def _checkpoint_of(method: str, settings: Settings) -> str:
    """The checkpoint that a method's pictures come from, as far as its name tells."""
    from facerf_cli.pipeline import DEFAULT_CHECKPOINT

    return (settings.checkpoint or DEFAULT_CHECKPOINT).stem if method == "field" else method


def _place(kind: str, case: str) -> str:
    """Where in the folder a case's picture is kept; a name that leads out of it is an error."""
    parts = PurePosixPath(case).parts
    if not parts or ".." in parts or PurePosixPath(case).is_absolute() or "/" in kind:
        raise InputError(f"{kind}/{case}: is no name for a picture in a folder")
    return f"{KEPT}/{kind}/{case}.exr"


def keep_strips(
    strips: "Mapping[str, Strip]", folder: Path, item: str, settings: Settings, stamp: Mapping[str, str]
) -> "tuple[KeptStrip, ...]":
    """Write an item's strips to FOLDER/strips/ITEM/NUMBER.jpg in place of those that are there."""
    from facerf_cli.evaluation.case_files import KeptStrip

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


def _write_strip(path: Path, strip: "Strip", made: Provenance) -> None:
    from PIL import Image

    from facerf_cli.files.atomic import atomic_path
    from facerf_cli.files.images import embed_xmp

    with atomic_path(path) as temporary:
        Image.fromarray(strip.pixels).save(temporary, quality=_STRIP_QUALITY, subsampling=0)
        embed_xmp(temporary, made.attributes())


CASES, SUMMARY, IMAGES, PAGE = "cases", "summary.json", "images.csv", "report.html"
log = logging.getLogger(LOGGER_NAME)


def run_protocol(
    protocol: "Layout",
    items: Sequence[Item],
    compare: Callable[[Item], "Iterable[Comparison]"],
    options: EvaluateOptions,
    settings: Settings,
    photo: PhotoOptions | None = None,
) -> int:
    """Measure the items' pictures and write their tables; give the exit code, 0 done, 1 some failed.

    `compare` (a frozen dataclass, for it goes to other processes) yields an item's pictures one after
    another. An item's rows are DIR/cases/ITEM.json, so finished items are skipped and a run that was cut off
    goes on; an item is unfinished where a strip or picture that it kept is gone. When all are there:
    DIR/summary.json, DIR/images.csv, DIR/report.html, and a table on stdout. Where an item failed or a
    prediction is missing, each is named and no summary is written. `photo` has the face model that the
    pictures are made with; they and the summary name it.
    """
    if not items:
        raise UsageError(f"evaluate {protocol.name}: nothing to evaluate")
    key = evaluation_key(protocol.name, compare, options, settings)
    work = _Measure(protocol.metrics[0], compare, options, settings, photo, key)
    _check_earlier(items, work)
    batch = BatchOptions(options.output, options.overwrite, options.dry_run, options.jobs)
    if not options.dry_run:
        options.measures().check()  # names what is wrong with a metric's weights before anything is measured
        for name in (SUMMARY, IMAGES, PAGE):  # they speak of a run that is about to change
            (options.output / name).unlink(missing_ok=True)
    code = run_items(f"evaluate {protocol.name}", items, work, work.outputs_of, batch, settings)
    if code:
        log.error("no summary is written while pictures are missing; finished ones are kept, so run it again")
    elif not options.dry_run and sums_up(items, work.outputs_of, batch, settings):
        _finish(protocol, items, work)
    return code


def _check_earlier(items: Sequence[Item], work: "_Measure") -> None:
    """Raise where finished items were evaluated otherwise: one table is of one kind."""
    from facerf_cli.evaluation.case_files import read_figures

    if work.options.overwrite:
        return
    found = {item: path for item in items if (path := work.path_of(item)).exists()}
    other = [path for item, path in found.items() if read_figures(path).key != work.key_of(item)]
    if other:
        raise UsageError(
            f"{work.options.output}: {len(other)} items ({other[0].stem}, ...) were evaluated with other "
            "options, another checkpoint or another version; give --overwrite, or another folder"
        )


@dataclass(frozen=True)
class _Measure:
    """Measures an item; settings only."""

    metric: str  # by which the worst pictures are found
    compare: Callable[[Item], "Iterable[Comparison]"]
    options: EvaluateOptions
    settings: Settings
    photo: PhotoOptions | None
    key: str

    @property
    def stamp(self) -> dict[str, str]:
        """That of the face model that the pictures are made with, if they are with one."""
        return face_model(self.photo).stamp if self.photo else {}

    def path_of(self, item: Item) -> Path:
        """The item's figures."""
        return self.options.output / CASES / f"{item.name}.json"

    def key_of(self, item: Item) -> str:
        """What its figures depend on."""
        return item_key(self.key, item.input_path)

    def outputs_of(self, item: Item) -> list[Path]:
        """What a finished item has: its figures, and the pictures that they name."""
        from facerf_cli.evaluation.case_files import read_figures

        path = self.path_of(item)
        kept = () if self.options.overwrite or not path.exists() else read_figures(path).files
        return [path, *(self.options.output / file for file in kept)]

    def __call__(self, item: Item) -> Outcome:
        """Measure an item's pictures one after another; its figures are written when all are measured."""
        from facerf_cli.evaluation.case_files import ItemFigures, write_figures
        from facerf_cli.evaluation.measure import Row, measure
        from facerf_cli.evaluation.report_html import StripKeeper, strip_of

        rows: list[Row] = []
        wrong: list[str] = []
        images: list[str] = []
        scaled = self.metric.startswith("si_") and self.options.space == "linear"
        keeper, measures = StripKeeper(self.metric), self.options.measures()
        for own in self.compare(item):
            if self.options.pictures:
                images += keep_images(own, self.options.output, self.settings, self.stamp)
            comparison = _with_others(own, self.options.compare, wrong)
            if wrong:
                continue  # all that is missing is to be named, at once
            measured = measure(comparison, measures)
            keeper.offer(measured, partial(strip_of, comparison, scaled))
            rows += measured
        _require_whole(item, rows, wrong)
        strips = keep_strips(keeper.kept(), self.options.output, item.name, self.settings, self.stamp)
        figures = ItemFigures(self.key_of(item), tuple(rows), strips, tuple(images))
        write_figures(self.path_of(item), figures)
        return Outcome([], {"pictures": len({row.case for row in rows}), "figures": self.path_of(item)})


def _with_others(own: "Comparison", folders: Sequence[Path], wrong: list[str]) -> "Comparison":
    """The comparison with other methods' predictions; what is missing or unfit is added to `wrong`."""
    from facerf_cli.evaluation.case import Others

    try:
        others = Others(tuple(folders), own.grey_as_given).predictions(own.case.name, own.truth.shape)
    except InputError as error:
        wrong.append(str(error))
        return own
    return replace(own, predictions={**own.predictions, **others})


def _require_whole(item: Item, rows: Sequence[object], wrong: Sequence[str]) -> None:
    """Raise InputError where pictures are missing, each named in a line of its own."""
    for line in wrong[1:]:
        log.error("%s", line)
    if wrong:
        more = f" (and {len(wrong) - 1} more of {item.name}, above)" if len(wrong) > 1 else ""
        raise InputError(f"{wrong[0]}{more}")
    if not rows:
        raise InputError(f"{item.input_path}: has no picture that can be measured")


def _finish(protocol: "Layout", items: Sequence[Item], work: _Measure) -> None:
    """Write and print the tables of finished items."""
    from facerf_cli.evaluation.case_files import images_csv, read_figures
    from facerf_cli.evaluation.summary import print_tables, summarise
    from facerf_cli.files.atomic import atomic_path

    found = {item.name: read_figures(work.path_of(item)) for item in items}
    rows = [row for figures in found.values() for row in figures.rows]
    _require_every_method(found)
    summary = summarise(protocol, rows)
    folder = work.options.output
    with atomic_path(folder / IMAGES) as temporary:
        temporary.write_text(images_csv(rows), encoding="utf-8", errors="backslashreplace")
    _write_documents(summary, rows, found, work)
    print_tables(summary)
    log.info("%s has the pictures, worst cases first; %s a row for each", folder / PAGE, folder / IMAGES)


def _require_every_method(found: "Mapping[str, ItemFigures]") -> None:
    """Raise InputError where a picture lacks a method that others have: a mean would leave it out."""
    rows = [row for figures in found.values() for row in figures.rows]
    methods = list(dict.fromkeys(row.method for row in rows))
    of_case: dict[str, set[str]] = {}
    for row in rows:
        of_case.setdefault(row.case, set()).add(row.method)
    missing = [f"{case} by {name}" for case, have in of_case.items() for name in methods if name not in have]
    for line in missing:
        log.error("%s is missing", line)
    if missing:
        raise InputError(f"{len(missing)} predictions are missing, so no summary is written")


def _write_documents(
    summary: "Summary", rows: "Sequence[Row]", found: "Mapping[str, ItemFigures]", work: _Measure
) -> None:
    """Write the summary and the page."""
    import json

    from facerf_cli.evaluation.report_html import choose, page
    from facerf_cli.files.atomic import atomic_path
    from facerf_cli.logs import json_line

    folder, about = work.options.output, _about(work)
    chosen = choose(summary, rows, [strip for figures in found.values() for strip in figures.strips])
    jpegs = {case.strip.case: (folder / case.strip.file).read_bytes() for case in chosen.all()}
    content = {"facerf": about.version, "command": about.command, **about.facts, **summary.as_dict()}
    texts = {PAGE: page(summary, about, chosen, jpegs)}
    texts[SUMMARY] = json.dumps(json.loads(json_line(content)), ensure_ascii=False, indent=1) + "\n"
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _about(work: _Measure) -> "About":
    """What was run, without the hour: equal runs give equal files."""
    import shlex
    import sys

    from facerf_cli import __version__
    from facerf_cli.evaluation.report_html import About

    networks = networks_of(work.options, work.settings)
    facts = {f"checkpoint {name}": f"SHA-256 {digest}" for name, digest in networks.items()}
    facts["values compared"] = {"linear": "scene-linear Rec.709", "display": "encoded by sRGB"}[
        work.options.space
    ]
    if work.photo:
        facts["face model"] = face_model(work.photo).credit
    return About(shlex.join(["facerf", *sys.argv[1:]]), __version__, facts)
