"""`facerf evaluate reconstruction` and `geometry`: photos or a dataset's sources, reconstructed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.inputs import Item
from facerf_cli.cli.items.evaluation import (
    MethodOptions,
    chosen_sources,
    load_methods,
    people_items,
    photo_items,
    portraits,
    prepare_methods,
    read_split,
)
from facerf_cli.cli.items.evaluation_run import run_protocol
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person
from facerf_cli.evaluation.protocols.geometry import FULL, MEAN, Form, compare_geometries
from facerf_cli.evaluation.protocols.reconstruction import reconstruct, reconstruct_person
from facerf_cli.evaluation.published import TABLE_2_RECONSTRUCTION, TABLE_4
from facerf_cli.evaluation.summary import Layout
from facerf_cli.models import load_models

_PAPER_PHOTOS = 130  # of CelebA-HQ (paper, Tables 2 and 4)


def run_reconstruction(
    inputs: Sequence[str],
    folder: Path | None,
    options: EvaluateOptions,
    photo: PhotoOptions,
    split: str,
    every: int,
    refit: bool,
) -> int:
    """Measure photos, or the split of a dataset's folder; the exit code."""
    methods = MethodOptions.of(photo, options)
    work: _ReconstructPhotos | _ReconstructPeople
    if folder is None:
        items = photo_items(inputs, options, _PAPER_PHOTOS)
        work = _ReconstructPhotos(methods, options.keep_eyes)
    else:
        dataset, pairs = read_split(folder, split, photo.face_model, refit)
        chosen = chosen_sources(folder, pairs, options, every, _PAPER_PHOTOS)
        items = people_items(folder, list(chosen), options.output)
        work = _ReconstructPeople(methods, dataset, chosen, options.keep_eyes, refit)
    layout = Layout(
        name="reconstruction",
        title="Photos explained and rendered again",
        metrics=("si_mse", "face_distance", "ssim", *(("light_error_deg",) if folder else ())),
        by=("tone",) if folder else (),
        published=TABLE_2_RECONSTRUCTION,
        notes=(
            "The field is the network's own: corrected by the photo it would be exact by construction.",
            *(() if folder else ("Each photo counts as a person.",)),
        ),
    )
    prepare = partial(prepare_methods, methods, options)
    return run_protocol(layout, items, work, options, photo.settings, photo, prepare)


@dataclass(frozen=True, eq=False)
class _ReconstructPhotos:
    """Reconstructs the faces of one photo."""

    methods: MethodOptions
    keep_eyes: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        for case, portrait in portraits(item, self.methods.photo, self.keep_eyes):
            yield reconstruct(case, portrait.view, portrait.head, methods)


@dataclass(frozen=True, eq=False)
class _ReconstructPeople:
    """Reconstructs the sources of one person's pairs."""

    methods: MethodOptions
    dataset: Dataset
    pairs: Mapping[str, list[Pair]]
    keep_eyes: bool
    refit: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        person = Person(methods[0].models.face, self.dataset, item.name, self.keep_eyes, self.refit)
        return reconstruct_person(person, self.pairs[item.name], methods)


def run_geometry(
    inputs: Sequence[str],
    folder: Path | None,
    options: EvaluateOptions,
    photo: PhotoOptions,
    split: str,
    every: int,
    mean_checkpoint: Path | None,
) -> int:
    """Measure photos, or the split of a dataset's folder, with both geometries; the exit code."""
    forms = _FormOptions(MethodOptions.of(photo, options), mean_checkpoint, options.keep_eyes)
    work: _CompareOnPhotos | _CompareOnPeople
    if folder is None:
        items = photo_items(inputs, options, _PAPER_PHOTOS)
        work = _CompareOnPhotos(forms)
    else:
        dataset, pairs = read_split(folder, split, photo.face_model, refit=True)
        chosen = chosen_sources(folder, pairs, options, every, _PAPER_PHOTOS)
        items = people_items(folder, list(chosen), options.output)
        work = _CompareOnPeople(forms, dataset, chosen)
    trained = mean_checkpoint.stem if mean_checkpoint else "the same network, trained on fitted faces only"
    layout = Layout(
        name="geometry",
        title="The fitted face and the mean face in its pose",
        metrics=("si_mse", "face_distance", "ssim"),
        by=("tone",) if folder else (),
        published=TABLE_4,
        notes=(f"The mean face is rendered by {trained}; both are compared where both show the face.",),
    )

    def prepare() -> None:
        prepare_methods(forms.methods, options)
        if not options.dry_run:
            _mean_methods(forms)

    return run_protocol(layout, items, work, options, photo.settings, photo, prepare)


@dataclass(frozen=True)
class _FormOptions:
    """The methods and checkpoints of both geometries."""

    methods: MethodOptions
    mean_checkpoint: Path | None
    keep_eyes: bool


@cache
def _mean_methods(options: _FormOptions) -> tuple[Method, ...]:
    """The methods over a face model whose shapes do nothing, once a process."""
    found = []
    for method in load_methods(options.methods):
        models = method.models
        if options.mean_checkpoint is not None and method.kind == "field":
            models = load_models(options.mean_checkpoint, options.methods.photo.face_model, models.device)
        mean = replace(models, face=models.face.pose_only(), geometry=None)  # the network regresses shapes
        found.append(replace(method, models=mean))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _CompareOnPhotos:
    """Compares both geometries on one photo's faces."""

    options: _FormOptions

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods, means = load_methods(self.options.methods), _mean_methods(self.options)
        for case, portrait in portraits(item, self.options.methods.photo, self.options.keep_eyes):
            mean = portrait.fitted_by(means[0].models)
            forms = {
                FULL: Form(portrait.view, portrait.head, methods),
                MEAN: Form(mean.view, mean.head, means),
            }
            yield compare_geometries(case, portrait.head.cropped, forms)


@dataclass(frozen=True, eq=False)
class _CompareOnPeople:
    """Compares both geometries on one person's sources."""

    options: _FormOptions
    dataset: Dataset
    pairs: Mapping[str, list[Pair]]

    def __call__(self, item: Item) -> Iterator[Comparison]:
        both = load_methods(self.options.methods), _mean_methods(self.options)
        people = [
            Person(methods[0].models.face, self.dataset, item.name, self.options.keep_eyes, refit=True)
            for methods in both
        ]
        for pair in self.pairs[item.name]:
            case = Case(f"{pair.subject}/{pair.index:05d}", pair.subject, people[0].facts)
            image = people[0].source(pair)
            forms = {
                name: Form(person.crop(pair.source_camera).view, person.head(pair, image), methods)
                for name, person, methods in zip((FULL, MEAN), people, both, strict=True)
            }
            yield compare_geometries(case, image, forms)
