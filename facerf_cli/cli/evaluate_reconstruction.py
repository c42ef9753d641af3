"""`facerf evaluate reconstruction`: photos taken apart and put together again (the paper's Table 2)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from facerf_cli.cli.batch import Item
from facerf_cli.cli.evaluation_items import (
    EveryOption,
    MethodOptions,
    PhotosOrDatasetArgument,
    RefitOption,
    SplitOption,
    chosen_sources,
    load_before,
    load_methods,
    no_part_of_preset,
    only_dataset,
    people_items,
    photo_items,
    portraits,
    read_split,
    refuse_for_others,
)
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.evaluation_run import run_protocol
from facerf_cli.cli.options import FaceModelOption, InputColourspaceOption, settings_of
from facerf_cli.cli.photo_options import FaceOption, LandmarksOption, PhotoOptions

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset
    from facerf_cli.dataset.pairs import Pair
    from facerf_cli.evaluation.case import Comparison

PAPER_PHOTOS = 130  # of CelebA-HQ (paper, Tables 2 and 4)


def reconstruction(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    options: EvaluateOptions,
    split: SplitOption = "test",
    every: EveryOption = 1,
    refit: RefitOption = False,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Explain photos by reflectance and light, and put them together again (the paper's Table 2).

    Each method finds its own light and its own reflectance; the face is rendered into the photo's crop and
    compared with it. The field is taken as the network has it, not held to the photo as `relight` holds it:
    then it would be exact by construction. Of a DATASET, the sources of its pairs are taken, and as the true
    light is known there, light_error_deg is the angle between the brightest single lights.
    """
    from facerf_cli.evaluation.summary import TABLE_2_RECONSTRUCTION, Layout

    settings = settings_of(context)
    no_part_of_preset(options, every)
    folder = only_dataset(inputs)
    refuse_for_others(context, photos=folder is None)
    photo = PhotoOptions(settings, input_colourspace, face_model, face, landmarks)
    photo.check()
    methods = MethodOptions.of(photo, options)
    work: _OfPhotos | _OfPeople
    if folder is None:
        items = photo_items(inputs, options, PAPER_PHOTOS)
        work = _OfPhotos(methods, options.keep_eyes)
    else:
        dataset, pairs = read_split(folder, split, face_model, refit)
        chosen = chosen_sources(folder, pairs, options, every, PAPER_PHOTOS)
        items = people_items(folder, list(chosen), options.output)
        work = _OfPeople(methods, dataset, chosen, options.keep_eyes, refit)
    layout = Layout(
        name="reconstruction",
        title="Photos explained and put together again",
        metrics=("si_mse", "face_distance", "ssim", *(("light_error_deg",) if folder else ())),
        by=("tone",) if folder else (),
        published=TABLE_2_RECONSTRUCTION,
        notes=(
            "The field is the network's own, not held to the photo: it would be exact by construction.",
            *(() if folder else ("Each photo counts as a person of its own.",)),
        ),
    )
    load_before(methods, options)
    return run_protocol(layout, items, work, options, settings, photo)


@dataclass(frozen=True, eq=False)
class _OfPhotos:
    """Reconstructs the faces of one photo."""

    methods: MethodOptions
    keep_eyes: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.protocols.reconstruction import reconstruct

        methods = load_methods(self.methods)
        for case, portrait in portraits(item, self.methods.photo, self.keep_eyes):
            yield reconstruct(case, portrait.view, portrait.image, portrait.face, methods)


@dataclass(frozen=True, eq=False)
class _OfPeople:
    """Reconstructs the sources of one person's pairs."""

    methods: MethodOptions
    dataset: "Dataset"
    pairs: "Mapping[str, list[Pair]]"
    keep_eyes: bool
    refit: bool

    def __call__(self, item: Item) -> "Iterator[Comparison]":
        from facerf_cli.evaluation.people import Person
        from facerf_cli.evaluation.protocols.reconstruction import reconstruct_person

        methods = load_methods(self.methods)
        person = Person(methods[0].models.face, self.dataset, item.name, self.keep_eyes, self.refit)
        return reconstruct_person(person, self.pairs[item.name], methods)
