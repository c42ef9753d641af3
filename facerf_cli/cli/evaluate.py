"""`facerf evaluate`: the paper's comparisons on your own data, one command per protocol."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.cli.help import Verbs
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
    help="Measure the paper's tables on prepared data and photos, and any methods on fixed cases.",
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

    The face in each source of the split's pairs is found and fitted like any photo, and relit by the pair's
    light in the target camera's pose, which is fitted to that camera's image under all lights. The ground
    truth is that light of the target's stack. The image is only the rendered face, as in the paper; in the
    same pose, a row 'composite' is the result of `facerf relight`, with the photo's detail. Tables are by
    pose, by the angle of the light, and by skin tone if the capture states it. The row 'lambert', the
    source's texture under the cosine of the light, is the lower bound. A second checkpoint, --against
    without_normals.safetensors, gives the paper's Table 3.
    """
    _evaluate(context, "olat", replace(options, dataset=dataset), photo)


def reconstruction(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Without("texture_side", "person")],
    options: ReconstructionOptions,
) -> None:
    """Explain photos by reflectance and light, and re-render them (the paper's Table 2).

    Each method estimates its own light and reflectance; the rendered face is compared with the photo's crop.
    The field is the network's, without the correction by the photo's ratio image, which would be exact by
    construction. For a DATASET, the sources of its pairs are measured; their light is known, so
    light_error_deg is the angle between the brightest single lights.
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

    Image A is rendered with B's reflectance in A's pose and light, then B with A's reflectance. The same
    method estimates the light of each image with the image's own reflectance. For a DATASET, pairs are
    sources of one person with different cameras and different maps.
    """
    dataset = None if options.photos else _only_dataset(inputs)
    if dataset is None and not options.photos:
        raise UsageError(f"{inputs[0]}: not a prepared dataset; add --photos for images of people")
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
    crop, and compared where both show the face. The paper trained networks with the mean face: pass them as
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
    """Relight real people by real point lights, and compare with photos under these lights.

    Sources are an image under one flash, and four soft lights summed from the subject's images; targets are
    single flashes and four environments. Lights are known, not estimated. Images are read as linear, relit
    like `facerf relight`, and compared inside one ellipse, which includes the open eyes. Cases are
    SUBJECT/SOURCE/LIGHT. To measure your own Reflectance Network without the shipped Portrait Network, use
    --reflectance field. The database is for research, and facerf is not trained on it.
    """
    _evaluate(context, "yale-b", options, photo, [str(folder)])


def cases(
    context: typer.Context,
    dataset: DatasetArgument,
    *,
    photo: Annotated[PhotoOptions, Only("face_model")],
    options: CasesOptions,
) -> None:
    """Write pairs of a dataset as fixed cases that any method can render, for `evaluate compare`.

    A case is a source image, the pose and light to render, the ground truth and the mask of the comparison,
    in the frame of the dataset's crops; cases do not depend on a checkpoint. DIR/cases.csv lists poses and
    lights as numbers; DIR/light contains each light as a lat-long map. Sources without a detected face are
    logged and skipped. docs/evaluation.md describes what a method must render.
    """
    _evaluate(context, "cases", replace(options, dataset=dataset), photo)


def compare(
    context: typer.Context,
    truth: Annotated[
        Path,
        typer.Argument(
            metavar="CASES",
            help="Folder of `evaluate cases`, of images that --pictures kept, or of ground truth images.",
            show_default=False,
        ),
    ],
    *,
    photo: Annotated[PhotoOptions, Only("face_model", "geometry", "form")],
    options: CompareOptions,
) -> None:
    """Compare any number of methods on fixed cases: folders of images, and facerf's own.

    Each --method is a folder of images with the names of the ground truth; trees are mirrored, suffixes may
    differ. --reflectance and --against render the cases of `evaluate cases` with facerf: in the source's pose
    like `facerf relight`, in other poses only the face. All methods are compared with the first one. A
    missing, additional or differently sized image is an error, and no table is written.
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
    """Run a protocol and exit; raise UsageError for options that would fail every item, or have no effect."""
    options.check()
    photo.check()
    if isinstance(options, FaceOptions):
        names, what = (_PAIRS, "a prepared dataset") if options.dataset is None else (_OF_PHOTOS, "photos")
        refuse_given(context, names, f"requires {what}; remove it")
    if not options.has_field:
        refuse_given(context, _MADE_BY_FIELD, "requires the field; add --reflectance field, or remove it")
    from facerf_cli.evaluation.protocols import PROTOCOLS
    from facerf_cli.evaluation.run import Evaluation

    chosen = PROTOCOLS[protocol].choose(options, inputs)
    raise typer.Exit(Evaluation(PROTOCOLS[protocol], chosen, options, photo).run())


def _only_dataset(inputs: Sequence[str]) -> Path | None:
    """Return the dataset among the inputs, None for photos; raise UsageError for both, or for a capture."""
    for path in map(Path, inputs):
        if (path / _CAPTURE_FILE).is_file():
            raise UsageError(f"{path}: a capture, not a dataset; run prepare-dataset, and pass its output")
    datasets = [path for path in map(Path, inputs) if (path / _DATASET_FILE).is_file()]
    if datasets and len(inputs) > 1:
        raise UsageError(f"{datasets[0]}: one dataset among several inputs; pass only it, or only photos")
    return datasets[0] if datasets else None
