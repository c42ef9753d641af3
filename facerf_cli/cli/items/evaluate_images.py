"""`facerf evaluate yale-b` and `pairs`: protocols whose images and lights are given."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.evaluation import MethodOptions, load_methods, prepare_methods
from facerf_cli.cli.items.evaluation_run import run_protocol
from facerf_cli.cli.options import Settings
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.errors import UsageError
from facerf_cli.evaluation import folder_name
from facerf_cli.evaluation.case import Comparison
from facerf_cli.evaluation.protocols.pairs import ImagePair, collect_pairs, compare_pair
from facerf_cli.evaluation.protocols.yale_b import compare_sitter, layout
from facerf_cli.evaluation.summary import Layout

_ITEMS_AT_MOST = 64


def run_yale_b(
    folder: Path,
    options: EvaluateOptions,
    photo: PhotoOptions,
    shifts: Path | None,
    subjects: Sequence[str],
    network_alone: bool,
    room: float,
) -> int:
    """Measure the subjects of Extended Yale B, all if none are named; the exit code."""
    database = read_yale_b(folder, None if shifts is None else read_shifts(shifts))
    chosen = _chosen(database, subjects)
    methods = MethodOptions.of(photo, options)
    work = _YaleB(methods, database, network_alone, room)
    items = [Item(folder / name, options.output / "cases" / name, name) for name in chosen]
    tables = layout(database, chosen, network_alone, room)
    prepare = partial(prepare_methods, methods, options)
    return run_protocol(tables, items, work, options, photo.settings, photo, prepare)


def _chosen(database: YaleB, given: Sequence[str]) -> list[str]:
    """The chosen subjects; raises UsageError for one that is not in the database."""
    wanted = {name.strip() for entry in given for name in entry.split(",") if name.strip()}
    if unknown := sorted(wanted - set(database.subjects)):
        there = ", ".join(database.subjects)
        raise UsageError(f"--subjects {', '.join(unknown)}: not in {database.folder}; give some of {there}")
    return [name for name in database.subjects if not wanted or name in wanted]


@dataclass(frozen=True, eq=False)
class _YaleB:
    """Compares one subject's cases."""

    methods: MethodOptions
    database: YaleB
    network_alone: bool
    room: float

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        photo = self.methods.photo
        geometry = photo.geometry or methods[0].models.default_geometry
        return compare_sitter(
            self.database, item.name, methods, self.network_alone, geometry, photo.landmarks_from, self.room
        )


def run_pairs(
    predictions: Sequence[Path],
    truth: Path,
    options: EvaluateOptions,
    settings: Settings,
    masks: Path | None,
    facts: Path | None,
    face_distance: bool,
) -> int:
    """Measure folders of predictions against a folder of truths; the exit code."""
    found = collect_pairs(predictions, truth, masks, facts)
    by = dict.fromkeys(n for pair in found for n, value in pair.facts.items() if isinstance(value, str))
    asked = {"lpips": options.vgg_weights is not None, "face_distance": face_distance}
    metrics = ("si_mse", "mse", "psnr", "ssim", *(name for name, wanted in asked.items() if wanted))
    tables = Layout("pairs", f"Predictions against {folder_name(truth)}", metrics, tuple(by))
    size = math.ceil(len(found) / _ITEMS_AT_MOST)
    starts = range(0, len(found), size)
    items = [Item(truth, options.output / f"part-{n:02d}", f"part-{n:02d}") for n, _ in enumerate(starts)]
    parts = {item.name: tuple(found[start : start + size]) for item, start in zip(items, starts, strict=True)}
    return run_protocol(tables, items, _Pairs(parts, face_distance), options, settings)


@dataclass(frozen=True)
class _Pairs:
    """Reads an item's pairs."""

    parts: Mapping[str, tuple[ImagePair, ...]]
    face_distance: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        for pair in self.parts[item.name]:
            yield compare_pair(pair, self.face_distance)
