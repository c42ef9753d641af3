"""What the protocols of `facerf evaluate` measure on, a dataset's people or photos, and with what methods.

Photos as the items of `facerf evaluate`: read, cropped and fitted as every verb does.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from facerf_cli.cli.batch import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.cli.evaluation_options import EvaluateOptions, KindName
from facerf_cli.cli.options import refuse_given
from facerf_cli.cli.photo_options import PhotoOptions, face_model, fit_faces, load_models_once, read_photo
from facerf_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset
    from facerf_cli.dataset.pairs import Pair
    from facerf_cli.evaluation.case import Case
    from facerf_cli.evaluation.methods import Method
    from facerf_cli.evaluation.people import Portrait

DatasetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET",
        help="Folder by `facerf prepare-dataset`, with pairs by `facerf relight-dataset`.",
        show_default=False,
    ),
]
PhotosOrDatasetArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...|DATASET",
        help="Pictures, folders, - for a list on standard input; or a folder by `facerf prepare-dataset`.",
        show_default=False,
    ),
]
SplitOption = Annotated[
    Literal["train", "validation", "test", "all"],
    typer.Option("--split", help="Of DATASET; all: where nobody in it was trained on."),
]
EveryOption = Annotated[
    int, typer.Option("--every", min=1, metavar="N", help="Every Nth pair of DATASET's split only.")
]
RefitOption = Annotated[
    bool,
    typer.Option(
        "--refit", help="Fit each of DATASET's pictures by its own landmarks, not a person's all at once."
    ),
]

_OF_DATASETS = ("split", "every", "refit")
_OF_PHOTOS = ("face", "landmarks", "input_colourspace")


@dataclass(frozen=True)
class MethodOptions:
    """Which methods are compared; settings only, so that it can be sent to other processes."""

    photo: PhotoOptions
    reflectance: tuple[KindName, ...]
    against: tuple[Path, ...]

    @staticmethod
    def of(photo: PhotoOptions, options: EvaluateOptions) -> "MethodOptions":
        """What the shared options name."""
        return MethodOptions(photo, options.reflectance, options.against)


@cache
def load_methods(options: MethodOptions) -> "tuple[Method, ...]":
    """The methods, in the order of their names, once a process."""
    from facerf_cli.evaluation.methods import Method
    from facerf_cli.pipeline import load_models

    models = load_models_once(options.photo)
    against = (load_models(path, options.photo.face_model, models.device) for path in options.against)
    return (
        *(Method(kind, kind, models) for kind in options.reflectance),
        *(Method(path.stem, "field", other) for path, other in zip(options.against, against, strict=True)),
    )


def load_before(methods: MethodOptions, options: EvaluateOptions) -> None:
    """Load the methods before any item, so that what is wrong with a checkpoint is said once."""
    if not options.dry_run:
        load_methods(methods)


def is_dataset(path: Path) -> bool:
    """Whether a folder is a prepared dataset."""
    return (path / "dataset.json").is_file()


def only_dataset(inputs: Sequence[str]) -> Path | None:
    """The dataset that the inputs name, or None where they are photos; UsageError for both, or a capture."""
    from facerf_cli.capture.stage_json import STAGE_FILE

    for path in map(Path, inputs):
        if (path / STAGE_FILE).is_file():
            raise UsageError(f"{path}: is a capture; give the dataset that prepare-dataset makes of it")
    datasets = [path for path in map(Path, inputs) if is_dataset(path)]
    if datasets and len(inputs) > 1:
        raise UsageError(f"{datasets[0]}: give one dataset alone, or photos")
    return datasets[0] if datasets else None


def refuse_for_others(context: typer.Context, photos: bool) -> None:
    """UsageError for an option of datasets beside photos, or of photos beside a dataset."""
    names, kind = (_OF_DATASETS, "a prepared dataset") if photos else (_OF_PHOTOS, "photos")
    refuse_given(context, names, f"is for {kind}; leave it out here")


def refuse_without_field(context: typer.Context, options: EvaluateOptions, name: str) -> None:
    """UsageError for an option of the field where that is not among the methods."""
    if "field" not in options.reflectance and not options.against:
        refuse_given(context, (name,), "is for the field; give --reflectance field too, or leave it out")


def read_split(
    folder: Path, split: str, face_model: str, refit: bool
) -> "tuple[Dataset, dict[str, list[Pair]]]":
    """A dataset and the pairs of a split's people; UsageError for none, or fits of another face model."""
    from facerf_cli.dataset.dataset import read_dataset
    from facerf_cli.dataset.pairs import read_pairs
    from facerf_cli.face.morphable import load_face_model

    dataset = read_dataset(folder)
    if not refit and load_face_model(face_model).name != dataset.face_model:
        raise UsageError(f"{folder}: fitted with {dataset.face_model}; give that --face-model, or --refit")
    pairs: dict[str, list[Pair]] = {}
    for pair in read_pairs(dataset):
        if split in ("all", pair.split):
            pairs.setdefault(pair.subject, []).append(pair)
    if not pairs:
        raise UsageError(f"{folder}: no pairs in the split {split}; run facerf relight-dataset, or --split")
    return dataset, pairs


def every_nth(pairs: "Mapping[str, Sequence[Pair]]", step: int) -> "dict[str, list[Pair]]":
    """Every Nth of all pairs in their order, by subject."""
    flat = [pair for of_subject in pairs.values() for pair in of_subject][::step]
    return {name: kept for name in pairs if (kept := [pair for pair in flat if pair.subject == name])}


def chosen_sources(
    folder: Path, pairs: "Mapping[str, Sequence[Pair]]", options: EvaluateOptions, every: int, preset: int
) -> "dict[str, list[Pair]]":
    """The pairs whose sources are reconstructed: every Nth, or a preset's number evenly over people."""
    from facerf_cli.evaluation.people import evenly

    if not options.preset:
        return every_nth(pairs, every)
    require_enough(sum(map(len, pairs.values())), preset, "sources", folder, preset / len(pairs))
    return evenly(pairs, preset)


def no_part_of_preset(options: EvaluateOptions, every: int) -> None:
    """UsageError where `--every` would take a part of a preset."""
    if options.preset and every > 1:
        raise UsageError("--preset and --every exclude each other: a preset says how many pictures")


def require_enough(found: int, needed: int, what: str, dataset: Path, per_subject: float) -> None:
    """UsageError where a preset needs more than a dataset's split has; `per_subject` pairs would do."""
    if found >= needed:
        return
    raise UsageError(
        f"{dataset}: the split has {found} {what}, --preset paper measures {needed}; run facerf "
        f"relight-dataset {dataset} --envmaps procedural:160 --per-subject {math.ceil(1.1 * per_subject)} "
        "--overwrite, or prepare more people"
    )


def people_items(dataset: Path, subjects: Sequence[str], output: Path) -> list[Item]:
    """An item a person."""
    return [Item(dataset / "olat" / name, output / "cases" / name, name) for name in sorted(subjects)]


def photo_items(inputs: Sequence[str], options: EvaluateOptions, preset: int) -> list[Item]:
    """The photos that the inputs name; of a preset the first so many."""
    items = collect_items(inputs, options.output, PHOTO_SUFFIXES)
    if not options.preset:
        return items
    if len(items) < preset:
        raise UsageError(f"{len(items)} photos, --preset paper measures {preset}; give a folder of more")
    return items[:preset]


def portraits(item: Item, photo: PhotoOptions, keep_eyes: bool) -> "Iterator[tuple[Case, Portrait]]":
    """The faces of a photo that were asked for; each is a person of its own."""
    from facerf_cli.evaluation.case import Case
    from facerf_cli.evaluation.people import Portrait

    image = read_photo(item, photo)
    for face in fit_faces(item, image, photo):
        name = f"{item.name}{face.tag}"
        try:
            portrait = Portrait.of(face_model(photo), face.fit, face.cropped, image, keep_eyes)
        except InputError as error:
            raise InputError(f"{item.input_path}: {error}") from None
        yield Case(name, name, {"quality": face.fit.quality}), portrait
