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
    note_of_chosen,
    note_of_light,
    people_items,
    person_of,
    photo_items,
    portraits,
    prepare_methods,
    read_split,
)
from facerf_cli.cli.items.evaluation_run import run_protocol
from facerf_cli.cli.light_options import LightOptions
from facerf_cli.cli.photo_options import PhotoOptions
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.protocols.geometry import FULL, MEAN, compare_geometries
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
    light: LightOptions,
    split: str,
    every: int,
    joint_fit: bool,
) -> int:
    """Measure photos, or the split of a dataset's folder; the exit code."""
    methods = MethodOptions.of(photo, options, light)
    work: _ReconstructPhotos | _ReconstructPeople
    of_people = "Each photo counts as a person."
    if folder is None:
        items = photo_items(inputs, options, _PAPER_PHOTOS)
        work = _ReconstructPhotos(methods, options.keep_eyes)
    else:
        dataset, pairs = read_split(folder, split, photo.face_model, joint_fit)
        chosen = chosen_sources(folder, pairs, options, every, _PAPER_PHOTOS)
        items = people_items(folder, list(chosen), options.output)
        of_people = note_of_chosen(chosen, joint_fit)
        work = _ReconstructPeople(methods, dataset, chosen, options.keep_eyes, joint_fit)
    layout = Layout(
        name="reconstruction",
        title="Photos explained and rendered again",
        metrics=("si_mse", "face_distance", "ssim", *(("light_error_deg",) if folder else ())),
        by=("tone",) if folder else (),
        published=TABLE_2_RECONSTRUCTION,
        notes=(
            "The field is the network's own: corrected by the photo it would be exact by construction.",
            note_of_light(light),
            of_people,
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
        for case, portrait in portraits(item, self.methods, self.keep_eyes):
            yield reconstruct(case, portrait, methods)


@dataclass(frozen=True, eq=False)
class _ReconstructPeople:
    """Reconstructs the sources of one person's pairs."""

    methods: MethodOptions
    dataset: Dataset
    pairs: Mapping[str, list[Pair]]
    keep_eyes: bool
    joint_fit: bool

    def __call__(self, item: Item) -> Iterator[Comparison]:
        methods = load_methods(self.methods)
        person = person_of(item, self.dataset, self.methods, self.keep_eyes, self.joint_fit)
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
        dataset, pairs = read_split(folder, split, photo.face_model, joint_fit=False)
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
        found.append(replace(method, models=replace(models, face=models.face.pose_only())))
    return tuple(found)


def _forms(options: _FormOptions) -> dict[str, tuple[Method, ...]]:
    return {FULL: load_methods(options.methods), MEAN: _mean_methods(options)}


@dataclass(frozen=True, eq=False)
class _CompareOnPhotos:
    """Compares both geometries on one photo's faces."""

    options: _FormOptions

    def __call__(self, item: Item) -> Iterator[Comparison]:
        forms = _forms(self.options)
        for case, portrait in portraits(item, self.options.methods, self.options.keep_eyes):
            yield compare_geometries(case, portrait, forms)


@dataclass(frozen=True, eq=False)
class _CompareOnPeople:
    """Compares both geometries on one person's sources."""

    options: _FormOptions
    dataset: Dataset
    pairs: Mapping[str, list[Pair]]

    def __call__(self, item: Item) -> Iterator[Comparison]:
        options, forms = self.options, _forms(self.options)
        person = person_of(item, self.dataset, options.methods, options.keep_eyes, joint_fit=False)
        for pair, portrait in person.portraits(self.pairs[item.name]):
            case = Case(f"{pair.subject}/{pair.index:05d}", pair.subject, person.facts)
            yield compare_geometries(case, portrait, forms)
