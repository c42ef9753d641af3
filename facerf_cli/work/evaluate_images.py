"""`facerf evaluate yale-b` and `pairs`: protocols whose images and lights are given."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import NOT_IN_RECIPE, Settings
from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.errors import UsageError
from facerf_cli.evaluation import folder_name
from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.pairs import ImagePair, collect_pairs, compare_pair
from facerf_cli.evaluation.summary import Layout
from facerf_cli.evaluation.yale_b import compare_sitter, layout
from facerf_cli.work.evaluate import run_protocol
from facerf_cli.work.evaluate_faces import methods_of
from facerf_cli.work.evaluation_settings import EvaluateOptions
from facerf_cli.work.photo_options import PhotoOptions, networks_of
from facerf_cli.work.photos import load_models_once, prepare_photos

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
    work = _YaleB(photo, options.kinds, options.checkpoints, shifts, network_alone, room, database)
    items = [Item(folder / name, options.output / "cases" / name, name) for name in chosen]

    def prepare() -> None:
        prepare_photos(photo, networks_of(options.kinds), with_networks=not options.dry_run)
        if not options.dry_run:
            methods_of(photo, options.kinds, options.checkpoints)

    tables = layout(database, chosen, network_alone, room)
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

    photo: PhotoOptions
    kinds: tuple[RelightKind, ...]
    checkpoints: tuple[Path, ...]
    shifts: Path | None
    network_alone: bool
    room: float
    database: YaleB = field(metadata=NOT_IN_RECIPE)

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = methods_of(self.photo, self.kinds, self.checkpoints)
        geometry = self.photo.geometry or methods[0].models.default_geometry
        landmarks_from = self.photo.landmarks_from
        return compare_sitter(
            self.database, item.name, methods, self.network_alone, geometry, landmarks_from, self.room
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
    pairs = collect_pairs(predictions, truth, masks, facts)
    by = dict.fromkeys(n for pair in pairs for n, value in pair.facts.items() if isinstance(value, str))
    asked = {"lpips": options.vgg_weights is not None, "face_distance": face_distance}
    metrics = ("si_mse", "mse", "psnr", "ssim", *(name for name, wanted in asked.items() if wanted))
    tables = Layout("pairs", f"Predictions against {folder_name(truth)}", metrics, tuple(by))
    size = math.ceil(len(pairs) / _ITEMS_AT_MOST)
    starts = range(0, len(pairs), size)
    items = [Item(truth, options.output / f"part-{n:02d}", f"part-{n:02d}") for n, _ in enumerate(starts)]
    parts = {item.name: tuple(pairs[start : start + size]) for item, start in zip(items, starts, strict=True)}
    names = tuple(map(folder_name, predictions))
    work = _Pairs(names, tuple(predictions), masks, facts, face_distance, settings, parts)
    return run_protocol(tables, items, work, options, settings)


@dataclass(frozen=True)
class _Pairs:
    """Reads an item's pairs."""

    names: tuple[str, ...]
    predictions: tuple[Path, ...]
    masks: Path | None
    facts: Path | None
    face_distance: bool
    settings: Settings
    parts: Mapping[str, tuple[ImagePair, ...]] = field(metadata=NOT_IN_RECIPE)

    def __call__(self, item: Item) -> Iterator[Comparison]:
        finder = (
            load_models_once(PhotoOptions(self.settings)).networks.parsing if self.face_distance else None
        )
        for pair in self.parts[item.name]:
            yield compare_pair(pair, finder)
