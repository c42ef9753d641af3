"""`facerf evaluate`: the paper's comparisons, a verb for each protocol, on the user's own data."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.cli.options import HELP_NAMES, is_default, refuse_given, settings_of, with_groups
from facerf_cli.errors import UsageError
from facerf_cli.evaluation.options import (
    EvaluateOptions,
    FactsOptions,
    GeometryOptions,
    PairsOptions,
    SplitOptions,
    TransferOptions,
    YaleOptions,
    folder_name,
    has_own_field_alone,
)
from facerf_cli.option import Only, Without
from facerf_cli.work.evaluation_settings import FaceSettings
from facerf_cli.work.photo_options import FieldOptions, PhotoOptions, SolveOptions

app = typer.Typer(help="Measure the paper's tables on prepared data and photos, and other methods' images.")

_CAPTURE_FILE, _DATASET_FILE = "stage.json", "dataset.json"
_BATCH = ("output", "measures", "overwrite", "dry_run", "jobs", "shard", "ray")
_MADE_BY_FIELD = ("network_alone", "held_to_photo", "mean_checkpoint")

DatasetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET",
        help="Folder of `facerf prepare-dataset`, with pairs of `facerf relight-dataset`.",
        show_default=False,
    ),
]
PhotosOrDatasetArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...|DATASET",
        help="Images, folders, - for a list on standard input; or a folder of `facerf prepare-dataset`.",
        show_default=False,
    ),
]


def olat(
    context: typer.Context,
    dataset: DatasetArgument,
    *,
    data: SplitOptions,
    photo: Annotated[PhotoOptions, Only("face_model", "geometry")],
    field: FieldOptions,
    options: Annotated[EvaluateOptions, Without("name")],
) -> None:
    """Predict single lights of held-out people from images in natural light (the paper's Table 1).

    In each source of the split's pairs the face is found and fitted, as in any photo, and relit by the light
    that the pair names, in the pose of the target camera; the truth is that light of the target's stack. That
    pose is fitted to the target camera's image under all lights. The image is the rendered face alone, as in
    the paper. In the same pose a row 'composite' is that of `facerf relight`, with the photo's detail. Tables
    are by pose, by the angle of the light, and by skin tone if the capture holds it. The row 'lambert' is the
    source's own texture under the cosine of the light: the least that a method must beat. A second
    checkpoint, --against without_normals.safetensors, gives the paper's Table 3. DIR/pairs.json lists the
    pairs, for --pairs.
    """
    settings = FaceSettings("olat", options, photo, data, field.network_alone)
    _check(context, settings, photos=False)
    from facerf_cli.work.evaluate_items import run_on_people

    raise typer.Exit(run_on_people(settings, dataset))


def reconstruction(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    *,
    data: SplitOptions,
    people: FactsOptions,
    photo: Annotated[PhotoOptions, Without("texture_side", "person", "matte_from")],
    solve: SolveOptions,
    options: Annotated[EvaluateOptions, Without("name")],
) -> None:
    """Explain photos by reflectance and light, and render them again (the paper's Table 2).

    Each method estimates its own light and reflectance; the face is rendered alone into the photo's crop and
    compared with it. The field is the network's own, without the correction by the photo that `relight`
    makes: that would be exact by construction. Of a DATASET the sources of its pairs are measured; its true
    light is known, so light_error_deg is the angle between the brightest single lights.
    """
    settings = FaceSettings("reconstruction", options, photo, data, solve=solve, facts=people.facts)
    _run(context, settings, inputs)


def transfer(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="DATASET|PHOTO...",
            help="Folder of `facerf prepare-dataset`; or with --photos, two images of each person (A B A B "
            "...), or a folder of images for each person.",
            show_default=False,
        ),
    ],
    *,
    exchange: TransferOptions,
    data: SplitOptions,
    photo: Annotated[PhotoOptions, Without("texture_side", "face", "person", "matte_from")],
    solve: SolveOptions,
    options: Annotated[EvaluateOptions, Without("name")],
) -> None:
    """Exchange the reflectances of two images of a person (the paper's Table 2).

    Image A is rendered from the reflectance that was read from B, turned to A's pose, under A's light; then B
    from A's. The same method estimates that light in the image with its own reflectance. Of a DATASET,
    couples are sources of one person with different cameras and different maps.
    """
    alone = not exchange.held_to_photo
    settings = FaceSettings("transfer", options, photo, data, alone, solve)
    if not exchange.photos:
        _run(context, settings, inputs)
    _check(context, settings, photos=True)
    from facerf_cli.work.evaluate_items import run_on_couples

    raise typer.Exit(run_on_couples(settings, inputs))


def geometry(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    *,
    mean: GeometryOptions,
    data: Annotated[SplitOptions, Only("split", "every", "pairs")],
    people: FactsOptions,
    photo: Annotated[PhotoOptions, Without("texture_side", "person", "matte_from")],
    options: Annotated[EvaluateOptions, Without("name")],
) -> None:
    """Reconstruct photos with the fitted face and with the mean face in its pose (the paper's Table 4).

    Both are fitted to the same landmarks of one image, or with --geometry network regressed from the same
    crop, and compared where both show the face. The paper trained networks with the mean face: give them as
    --mean-checkpoint. --against does not apply.
    """
    settings = FaceSettings(
        "geometry", options, photo, data, mean_checkpoint=mean.mean_checkpoint, facts=people.facts
    )
    _run(context, settings, inputs)


def yale_b(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="Folder of the cropped Extended Yale Face Database B, with yaleB01, yaleB02 and so on.",
            show_default=False,
        ),
    ],
    *,
    yale: YaleOptions,
    photo: Annotated[PhotoOptions, Only("face_model", "geometry")],
    field: FieldOptions,
    options: Annotated[EvaluateOptions, Only("reflectance", "against", "compare", "pictures", *_BATCH)],
) -> None:
    """Relight real people to real point lights and compare with their photos under these.

    Sources are an image under one flash and four soft lights summed from the subject's own images; targets
    are single flashes and four environments. Lights are given, not estimated. Images are read as linear, as
    measured, relit as by `facerf relight`, and compared inside one ellipse, open eyes included. Cases are
    SUBJECT/SOURCE/LIGHT. An own Reflectance Network is measured alone; with --reflectance portrait its row
    names both networks. The rows of other methods were published for the same images. A method for --compare
    runs on the sources that --pictures keeps; its PNGs are read as given, too, and its colours are averaged.
    The database is for research and never trained on.
    """
    if is_default(context, "reflectance") and not has_own_field_alone(photo.settings.checkpoints):
        options = replace(options, reflectance=("portrait",))
    settings = FaceSettings("yale-b", options, photo, network_alone=field.network_alone)
    _check(context, settings, photos=False)
    from facerf_cli.work.evaluate_items import run_yale_b

    raise typer.Exit(run_yale_b(settings, yale, folder))


def pairs(
    context: typer.Context,
    predictions: Annotated[
        list[Path],
        typer.Argument(
            metavar="PREDICTIONS...",
            help="Folders of images with the names of the truths; each folder is a method. Others are "
            "compared with the first.",
            show_default=False,
        ),
    ],
    compared: PairsOptions,
    options: Annotated[EvaluateOptions, Only(*_BATCH)],
) -> None:
    """Measure folders of predictions against a folder of truths, image by image.

    Trees are mirrored; names must match, suffixes may differ. A missing, an additional or a differently sized
    prediction is an error: no table is made of what is left.
    """
    options = replace(options, reflectance=())
    options.check()
    options.require_output_apart([*predictions, *filter(None, (compared.truth, compared.masks))])
    names = tuple(map(folder_name, predictions))
    compared = replace(compared, predictions=tuple(predictions), names=names)
    from facerf_cli.work.evaluate_items import run_pairs

    raise typer.Exit(run_pairs(compared, options, settings_of(context)))


for _protocol in (olat, reconstruction, transfer, geometry, yale_b, pairs):
    app.command(context_settings=HELP_NAMES)(with_groups(_protocol))


def _run(context: typer.Context, settings: FaceSettings, inputs: Sequence[str]) -> None:
    """Run a protocol on the dataset of the inputs, or on photos, and exit."""
    folder = _only_dataset(inputs)
    if folder is None and settings.protocol == "transfer":
        raise UsageError(f"{inputs[0]}: not a prepared dataset; give --photos for images of people")
    _check(context, settings, photos=folder is None)
    from facerf_cli.work.evaluate_items import run_on_people, run_on_photos

    raise typer.Exit(run_on_photos(settings, inputs) if folder is None else run_on_people(settings, folder))


def _only_dataset(inputs: Sequence[str]) -> Path | None:
    """The dataset of the inputs, or None for photos; raises UsageError for both, or for a capture."""
    for path in map(Path, inputs):
        if (path / _CAPTURE_FILE).is_file():
            raise UsageError(
                f"{path}: a capture, not a dataset; run prepare-dataset on it and give the result"
            )
    datasets = [path for path in map(Path, inputs) if (path / _DATASET_FILE).is_file()]
    if datasets and len(inputs) > 1:
        raise UsageError(f"{datasets[0]}: one dataset among several inputs; give it alone, or give photos")
    return datasets[0] if datasets else None


def _check(context: typer.Context, settings: FaceSettings, photos: bool) -> None:
    """Raise UsageError for options that would fail every item, or that would do nothing."""
    settings.check()
    if photos:
        refuse_given(
            context, ("split", "every", "pairs", "joint_fit"), "is for a prepared dataset; leave it out here"
        )
    else:
        refuse_given(
            context,
            ("face", "landmarks", "colourspace", "layer", "facts"),
            "is for photos; leave it out here",
        )
    if not settings.options.has_field:
        why = "is for the field; give --reflectance field too, or leave it out"
        refuse_given(context, _MADE_BY_FIELD, why)
