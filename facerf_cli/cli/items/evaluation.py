"""The data and methods of `facerf evaluate`: people of a dataset, or photos, and reflectance models."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from facerf_cli.baselines import RelightKind
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.cli.items.photo_lights import feature_network
from facerf_cli.cli.items.photos import fit_faces, load_models_once, prepare_photos, read_photo
from facerf_cli.cli.light_options import LightOptions
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, read_pairs
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.case import Case
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person, Portrait, evenly
from facerf_cli.face.morphable import load_face_model
from facerf_cli.models import load_models
from facerf_cli.pipeline import Estimator


@dataclass(frozen=True)
class MethodOptions:
    """Which methods are compared; settings only, so that it can be sent to other processes."""

    photo: PhotoOptions
    reflectance: tuple[RelightKind, ...]
    against: tuple[Path, ...]
    light: LightOptions

    @staticmethod
    def of(
        photo: PhotoOptions, options: EvaluateOptions, light: LightOptions | None = None
    ) -> "MethodOptions":
        """The methods of the shared options; `light` tells how the field's light is estimated."""
        return MethodOptions(photo, options.reflectance, options.against, light or LightOptions(photo))


@cache
def load_methods(options: MethodOptions) -> tuple[Method, ...]:
    """The methods, in the order of their names, once a process."""
    models = load_models_once(options.photo)
    against = (load_models(path, options.photo.face_model, models.device) for path in options.against)
    light = options.light
    features = feature_network(light.vgg_weights)[0] if light.refine == "features" else None
    estimator = Estimator(light.non_negative, features)
    others = zip(options.against, against, strict=True)
    return (
        *(Method(kind, kind, models, estimator) for kind in options.reflectance),
        *(Method(path.stem, "field", other, estimator) for path, other in others),
    )


def prepare_methods(methods: MethodOptions, options: EvaluateOptions) -> None:
    """Load the methods before any item, so that an error of an option or a checkpoint is reported once.

    A dry run checks the options only.
    """
    prepare_photos(methods.photo, with_networks=False)
    if not options.dry_run:
        load_methods(methods)


def read_split(
    folder: Path, split: str, face_model: str, joint_fit: bool
) -> tuple[Dataset, dict[str, list[Pair]]]:
    """A dataset and a split's pairs by person.

    Raises UsageError if there are none, or for the joint fit of another face model.
    """
    dataset = read_dataset(folder)
    if joint_fit and load_face_model(face_model).name != dataset.face_model:
        raise UsageError(f"--joint-fit: {folder} has fits of {dataset.face_model}; give it as --face-model")
    pairs: dict[str, list[Pair]] = {}
    for pair in read_pairs(dataset):
        if split in ("all", pair.split):
            pairs.setdefault(pair.subject, []).append(pair)
    if not pairs:
        raise UsageError(
            f"{folder}: no pairs in the split {split}; run facerf relight-dataset, or give another --split"
        )
    return dataset, pairs


def every_nth(pairs: Mapping[str, Sequence[Pair]], step: int) -> dict[str, list[Pair]]:
    """Every Nth of all pairs in their order, by subject."""
    flat = [pair for of_subject in pairs.values() for pair in of_subject][::step]
    return {name: kept for name in pairs if (kept := [pair for pair in flat if pair.subject == name])}


def chosen_sources(
    folder: Path, pairs: Mapping[str, Sequence[Pair]], options: EvaluateOptions, every: int, preset: int
) -> dict[str, list[Pair]]:
    """Choose the pairs whose sources are reconstructed: every Nth, or a preset's number of all people."""
    if not options.preset:
        return every_nth(pairs, every)
    require_enough(sum(map(len, pairs.values())), preset, "sources", folder, preset / len(pairs))
    return evenly(pairs, preset)


def require_enough(found: int, needed: int, what: str, dataset: Path, per_subject: float) -> None:
    """Raise UsageError where a preset needs more than a split has; `per_subject` pairs are enough."""
    if found >= needed:
        return
    raise UsageError(
        f"{dataset}: the split has {found} {what}, --preset paper measures {needed}; run facerf "
        f"relight-dataset {dataset} --envmaps procedural:160 --per-subject {math.ceil(1.1 * per_subject)} "
        "--overwrite always, or prepare more people"
    )


def people_items(dataset: Path, subjects: Sequence[str], output: Path) -> list[Item]:
    """An item for each person."""
    return [Item(dataset / "olat" / name, output / "cases" / name, name) for name in sorted(subjects)]


def photo_items(inputs: Sequence[str], options: EvaluateOptions, preset: int) -> list[Item]:
    """The photos of the inputs; of a preset the first ones."""
    items = collect_items(inputs, options.output, PHOTO_SUFFIXES)
    if not options.preset:
        return items
    if len(items) < preset:
        raise UsageError(f"{len(items)} photos, --preset paper measures {preset}; give a folder of more")
    return items[:preset]


def note_of_chosen(chosen: Mapping[str, Sequence[Any]], joint_fit: bool) -> str:
    """Note on the number of sources or couples: those without a face are missing in the tables."""
    count = sum(map(len, chosen.values()))
    if joint_fit:
        return f"{count} were chosen; heads are those fitted to all cameras of a person at once."
    return f"{count} were chosen; those in which no face is found are left out. Each image is fitted alone."


def note_of_light(light: LightOptions) -> str:
    """Note on the estimate of the light of each image."""
    squares = "non-negative, smooth least squares" if light.non_negative else "signed least squares"
    refined = "" if light.refine == "none" else ", refined by features"
    return f"The field's light is estimated by {squares}{refined}."


def person_of(
    item: Item, dataset: Dataset, options: MethodOptions, keep_eyes: bool, joint_fit: bool
) -> Person:
    """The person of an item, fitted as the options say, by default as the first method's networks expect."""
    models, photo = load_methods(options)[0].models, options.photo
    geometry = None if joint_fit else photo.geometry or models.default_geometry
    sides = models.sides(photo.texture_side)
    return Person(dataset, item.name, geometry, sides, keep_eyes, photo.landmarks_from)


def portraits(item: Item, options: MethodOptions, keep_eyes: bool) -> Iterator[tuple[Case, Portrait]]:
    """Yield the chosen faces of a photo; each counts as a person."""
    photo, models = options.photo, load_methods(options)[0].models
    image = read_photo(item, photo)
    for face in fit_faces(item, image, photo):
        name = f"{item.name}{face.tag}"
        portrait = Portrait(image, face.found, models.sides(photo.texture_side), keep_eyes)
        try:
            portrait.by(models)
        except InputError as error:
            raise InputError(f"{item.input_path}: {error}") from None
        yield Case(name, name, {"quality": face.fit.quality}), portrait
