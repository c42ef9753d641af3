"""`facerf evaluate`: the paper's comparisons, a verb for each protocol, on the user's own data."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.cli.brief import Verbs
from facerf_cli.cli.options import refuse_given, with_groups
from facerf_cli.errors import UsageError
from facerf_cli.evaluation.options import (
    CasesOptions,
    CompareOptions,
    EvaluateOptions,
    FaceOptions,
    GeometryOptions,
    OlatOptions,
    ReconstructionOptions,
    TransferOptions,
    YaleOptions,
)
from facerf_cli.option import Only, Without
from facerf_cli.work.photo_options import PhotoOptions

app = typer.Typer(
    cls=Verbs,
    add_completion=False,
    help="Measure the paper's tables on prepared data and photos, and any methods on frozen cases.",
)

_CAPTURE_FILE, _DATASET_FILE = "stage.json", "dataset.json"
_MADE_BY_FIELD = ("network_alone", "held_to_photo", "mean_checkpoint")
_PAIRS = ("split", "every", "joint_fit")
_OF_PHOTOS = ("face", "landmarks", "colourspace", "layer", "facts")

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
        help="Images, folders, - for standard input; or a folder of `facerf prepare-dataset`.",
        show_default=False,
    ),
]


def olat(
    context: typer.Context,
    dataset: DatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Only("face_model", "geometry", "form")],
    options: OlatOptions,
) -> None:
    """Predict single lights of held-out people from images in natural light (the paper's Table 1).

    In each source of the split's pairs the face is found and fitted, as in any photo, and relit by the light
    that the pair names, in the pose of the target camera; the truth is that light of the target's stack. That
    pose is fitted to the target camera's image under all lights. The image is the rendered face alone, as in
    the paper. In the same pose a row 'composite' is that of `facerf relight`, with the photo's detail. Tables
    are by pose, by the angle of the light, and by skin tone if the capture holds it. The row 'lambert' is the
    source's own texture under the cosine of the light: the least that a method must beat. A second
    checkpoint, --against without_normals.safetensors, gives the paper's Table 3.
    """
    _evaluate(context, "olat", replace(options, dataset=dataset), photo)


def reconstruction(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Without("texture_side", "person")],
    options: ReconstructionOptions,
) -> None:
    """Explain photos by reflectance and light, and render them again (the paper's Table 2).

    Each method estimates its own light and reflectance; the face is rendered alone into the photo's crop and
    compared with it. The field is the network's own, without the correction by the photo that `relight`
    makes: that would be exact by construction. Of a DATASET the sources of its pairs are measured; its true
    light is known, so light_error_deg is the angle between the brightest single lights.
    """
    _evaluate(context, "reconstruction", replace(options, dataset=_only_dataset(inputs)), photo, inputs)


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
    photo: Annotated[PhotoOptions, Without("texture_side", "face", "person")],
    options: TransferOptions,
) -> None:
    """Exchange the reflectances of two images of a person (the paper's Table 2).

    Image A is rendered from the reflectance that was read from B, turned to A's pose, under A's light; then B
    from A's. The same method estimates that light in the image with its own reflectance. Of a DATASET,
    couples are sources of one person with different cameras and different maps.
    """
    dataset = None if options.photos else _only_dataset(inputs)
    if dataset is None and not options.photos:
        raise UsageError(f"{inputs[0]}: not a prepared dataset; give --photos for images of people")
    options = replace(options, dataset=dataset, network_alone=not options.held_to_photo)
    _evaluate(context, "transfer", options, photo, inputs)


def geometry(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Without("texture_side", "person")],
    options: GeometryOptions,
) -> None:
    """Reconstruct photos with the fitted face and with the mean face in its pose (the paper's Table 4).

    Both are fitted to the same landmarks of one image, or with --geometry network regressed from the same
    crop, and compared where both show the face. The paper trained networks with the mean face: give them as
    --mean-checkpoint.
    """
    _evaluate(context, "geometry", replace(options, dataset=_only_dataset(inputs)), photo, inputs)


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
    photo: Annotated[PhotoOptions, Only("face_model", "geometry", "form")],
    options: YaleOptions,
) -> None:
    """Relight real people to real point lights and compare with their photos under these.

    Sources are an image under one flash and four soft lights summed from the subject's own images; targets
    are single flashes and four environments. Lights are given, not estimated. Images are read as linear, as
    measured, relit as by `facerf relight`, and compared inside one ellipse, open eyes included. Cases are
    SUBJECT/SOURCE/LIGHT. To measure a Reflectance Network of your own without the shipped Portrait Network,
    pass --reflectance field. The database is for research and never trained on.
    """
    _evaluate(context, "yale-b", options, photo, [str(folder)])


def cases(
    context: typer.Context,
    dataset: DatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Only("face_model")],
    options: CasesOptions,
) -> None:
    """Freeze pairs of a dataset as cases that any method can render, for `evaluate compare`.

    A case has a source image, the pose and the light to render, the truth and the mask of the comparison, in
    the frame of the dataset's crops: no checkpoint has a part in them. DIR/cases.csv lists them, with poses
    and lights in numbers; DIR/light has each light as a lat-long map. Sources in which no face is found are
    named and left out. docs/evaluation.md says what a method has to render.
    """
    _evaluate(context, "cases", replace(options, dataset=dataset), photo)


def compare(
    context: typer.Context,
    truth: Annotated[
        Path,
        typer.Argument(
            metavar="CASES",
            help="Folder of `evaluate cases`, of images that --pictures kept, or of any true images.",
            show_default=False,
        ),
    ],
    *,
    photo: Annotated[PhotoOptions, Only("face_model", "geometry", "form")],
    options: CompareOptions,
) -> None:
    """Compare any number of methods on frozen cases: folders of images, and facerf's own.

    Each --method is a folder of images with the names of the truths; trees are mirrored, suffixes may differ.
    --reflectance and --against render the cases of `evaluate cases` by facerf, as any other method has to: in
    the source's pose as `facerf relight`, in another the face alone. The others are compared with the first
    method. A missing, an additional or a differently sized image is an error: no table is made of what is
    left.
    """
    _evaluate(context, "compare", replace(options, truth=truth), photo)


for _protocol in (olat, reconstruction, transfer, geometry, yale_b, cases, compare):
    app.command()(with_groups(_protocol))


def _evaluate(
    context: typer.Context,
    protocol: str,
    options: EvaluateOptions,
    photo: PhotoOptions,
    inputs: Sequence[str] = (),
) -> None:
    """Run a protocol and exit; raises UsageError for options that would fail every item, or do nothing."""
    options.check()
    photo.check()
    if isinstance(options, FaceOptions):
        names, what = (_PAIRS, "a prepared dataset") if options.dataset is None else (_OF_PHOTOS, "photos")
        refuse_given(context, names, f"is for {what}; leave it out here")
    if not options.has_field:
        why = "is for the field; give --reflectance field too, or leave it out"
        refuse_given(context, _MADE_BY_FIELD, why)
    from facerf_cli.evaluation.protocols import PROTOCOLS
    from facerf_cli.evaluation.run import Evaluation

    chosen = PROTOCOLS[protocol].choose(options, inputs)
    raise typer.Exit(Evaluation(PROTOCOLS[protocol], chosen, options, photo).run())


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
