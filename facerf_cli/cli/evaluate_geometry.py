"""`facerf evaluate geometry`: what the fitted shape is worth over the mean face (the paper's Table 4)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.evaluate_reconstruction import PAPER_PHOTOS
from facerf_cli.cli.evaluation_items import (
    EveryOption,
    MethodOptions,
    PhotosOrDatasetArgument,
    SplitOption,
    chosen_sources,
    load_methods,
    no_part_of_preset,
    only_dataset,
    people_items,
    photo_items,
    portraits,
    read_split,
    refuse_for_others,
    refuse_without_field,
)
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import FaceModelOption, InputColourspaceOption, settings_of
from facerf_cli.cli.photo_options import FaceOption, LandmarksOption, PhotoOptions

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset
    from facerf_cli.dataset.pairs import Pair
    from facerf_cli.evaluation.case import Comparison
    from facerf_cli.evaluation.methods import Method


def geometry(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    options: EvaluateOptions,
    mean_checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--mean-checkpoint",
            metavar="FILE",
            help="Trained with `facerf train --mean-face`, for the mean face.",
            show_default="that of the full fit",
        ),
    ] = None,
    split: SplitOption = "test",
    every: EveryOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Reconstruct photos with the fitted face and with the mean face in its pose (the paper's Table 4).

    Both are fitted to the same landmarks of one picture, and compared where both see the face. The paper's
    mean face has a network that was trained with it: --mean-checkpoint. --against does not apply.
    """
    from facerf_cli.errors import UsageError
    from facerf_cli.evaluation.summary import TABLE_4, Layout

    settings = settings_of(context)
    no_part_of_preset(options, every)
    if options.against:
        raise UsageError("--against does not apply to geometry; give --checkpoint and --mean-checkpoint")
    folder = only_dataset(inputs)
    refuse_for_others(context, photos=folder is None)
    refuse_without_field(context, options, "mean_checkpoint")
    photo = PhotoOptions(settings, input_colourspace, face_model, face, landmarks)
    photo.check()
    forms = _FormOptions(MethodOptions.of(photo, options), mean_checkpoint, options.keep_eyes)
    work: _OfPhotos | _OfPeople
    if folder is None:
        items = photo_items(inputs, options, PAPER_PHOTOS)
        work = _OfPhotos(forms)
    else:
        dataset, pairs = read_split(folder, split, face_model, refit=True)
        chosen = chosen_sources(folder, pairs, options, every, PAPER_PHOTOS)
        items = people_items(folder, list(chosen), options.output)
        work = _OfPeople(forms, dataset, chosen)
    layout = Layout(
        name="geometry",
        title="The fitted face and the mean face in its pose",
        metrics=("si_mse", "face_distance", "ssim"),
        by=("tone",) if folder else (),
        published=TABLE_4,
        notes=(_note(mean_checkpoint),),
    )
    if not options.dry_run:
        _mean_methods(forms)  # what is wrong with a checkpoint is said once
    return run_protocol(layout, items, work, options, settings, photo)


def _note(mean_checkpoint: Path | None) -> str:
    trained = mean_checkpoint.stem if mean_checkpoint else "the same network, which knows fitted faces only"
    return f"The mean face is rendered by {trained}; both are compared where both see the face."


@dataclass(frozen=True)
class _FormOptions:
    """What both geometries are made with."""

    methods: MethodOptions
    mean_checkpoint: Path | None
    keep_eyes: bool


@cache
def _mean_methods(options: _FormOptions) -> "tuple[Method, ...]":
    """The methods over a face model whose shapes do nothing, once a process."""
    from facerf_cli.pipeline import load_models

    found = []
    for method in load_methods(options.methods):
        models = method.models
        if options.mean_checkpoint is not None and method.kind == "field":
            models = load_models(
                options.mean_checkpoint, options.methods.photo.face_model, method.models.device
            )
        found.append(replace(method, models=replace(models, face=models.face.pose_only())))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _OfPhotos:
    """Compares both geometries of one photo's faces."""

    options: _FormOptions

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.protocols.geometry import FULL, MEAN, Form, compare_geometries

        methods, still = load_methods(self.options.methods), _mean_methods(self.options)
        for case, portrait in portraits(item, self.options.methods.photo, self.options.keep_eyes):
            mean = portrait.fitted_with(still[0].models.face)
            forms = {
                FULL: Form(portrait.view, portrait.face, methods),
                MEAN: Form(mean.view, mean.face, still),
            }
            yield compare_geometries(case, portrait.image, forms)


@dataclass(frozen=True, eq=False)
class _OfPeople:
    """Compares both geometries of one person's sources."""

    options: _FormOptions
    dataset: "Dataset"
    pairs: "Mapping[str, list[Pair]]"

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.case import Case
        from facerf_cli.evaluation.people import Person
        from facerf_cli.evaluation.protocols.geometry import FULL, MEAN, Form, compare_geometries

        methods, still = load_methods(self.options.methods), _mean_methods(self.options)
        people = [
            Person(chosen[0].models.face, self.dataset, item.name, self.options.keep_eyes, refit=True)
            for chosen in (methods, still)
        ]
        for pair in self.pairs[item.name]:
            case = Case(f"{pair.subject}/{pair.index:05d}", pair.subject, people[0].facts)
            image, _ = people[0].source(pair)
            views = [person.shot(pair.source_camera).view for person in people]
            forms = {
                name: Form(view, view.texture_of(image), chosen)
                for name, view, chosen in zip((FULL, MEAN), views, (methods, still), strict=True)
            }
            yield compare_geometries(case, image, forms)
