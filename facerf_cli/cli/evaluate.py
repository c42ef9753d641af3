"""`facerf evaluate`: the paper's comparisons, a verb for each protocol, on the user's own data."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.cli.evaluation_options import (
    DATA,
    MEASURES,
    METHODS,
    DatasetArgument,
    EvaluateOptions,
    EveryOption,
    JointFitOption,
    PhotosOrDatasetArgument,
    SplitOption,
    measures_portraits,
    no_part_of_preset,
    only_dataset,
    refuse_for_others,
    refuse_without_field,
    with_shared_options,
)
from facerf_cli.cli.light_options import LightOptions, NonNegativeOption, Refine, RefineOption
from facerf_cli.cli.options import (
    EPILOG,
    HELP_NAMES,
    FaceModelOption,
    InputColourspaceOption,
    NetworkAloneOption,
    settings_of,
    with_machines,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    GeometryOption,
    LandmarksFromOption,
    LandmarksOption,
    PhotoOptions,
)
from facerf_cli.errors import UsageError

app = typer.Typer(help="Measure the paper's tables on prepared data and photos, and other methods' images.")


def olat(
    context: typer.Context,
    dataset: DatasetArgument,
    options: EvaluateOptions,
    split: SplitOption = "test",
    every: EveryOption = 1,
    joint_fit: JointFitOption = False,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    network_alone: NetworkAloneOption = False,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Predict single lights of held-out people from images in natural light (the paper's Table 1).

    In each source of the split's pairs the face is found and fitted, as in any photo, and relit by the light
    that the pair names, in the pose of the target camera; the truth is that light of the target's stack. That
    pose is fitted to the target camera's image under all lights. In the same pose the image
    is that of `facerf relight`, in another one the face alone, as with --pose. Tables are by pose, by the
    angle of the light, and by skin tone if the capture holds it. The row 'lambert' is the source's own
    texture under the cosine of the light: the least that a method must beat. A second checkpoint, --against
    without_normals.safetensors, gives the paper's Table 3.
    """
    no_part_of_preset(options, every)
    refuse_without_field(context, options, "network_alone")
    from facerf_cli.cli.items.evaluate_olat import run_olat

    photo = PhotoOptions(
        settings_of(context), face_model=face_model, geometry=geometry, landmarks_from=landmarks_from
    )
    photo.check()
    return run_olat(dataset, options, photo, split, every, joint_fit, network_alone)


def _light_options(
    photo: PhotoOptions, options: EvaluateOptions, non_negative: bool, refine: Refine
) -> LightOptions:
    """Options of the light of each image; V_f, if its weights are given, refines it."""
    vgg_weights = options.vgg_weights if refine == "features" else None
    light = LightOptions(photo, non_negative=non_negative, refine=refine, vgg_weights=vgg_weights)
    light.check()
    return light


def reconstruction(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    options: EvaluateOptions,
    split: SplitOption = "test",
    every: EveryOption = 1,
    joint_fit: JointFitOption = False,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    non_negative: NonNegativeOption = True,
    refine: RefineOption = "none",
) -> int:
    """Explain photos by reflectance and light, and render them again (the paper's Table 2).

    Each method estimates its own light and reflectance; the face is rendered alone into the photo's crop and
    compared with it. The field is the network's own, without the correction by the photo that `relight`
    makes: that would be exact by construction. Of a DATASET the sources of its pairs are measured; its true
    light is known, so light_error_deg is the angle between the brightest single lights.
    """
    no_part_of_preset(options, every)
    folder = only_dataset(inputs)
    refuse_for_others(context, photos=folder is None)
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry=geometry,
        landmarks_from=landmarks_from,
    )
    photo.check()
    light = _light_options(photo, options, non_negative, refine)
    from facerf_cli.cli.items.evaluate_photos import run_reconstruction

    return run_reconstruction(inputs, folder, options, photo, light, split, every, joint_fit)


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
    options: EvaluateOptions,
    photos: Annotated[
        bool,
        typer.Option("--photos", help="Read photos, two of each person or in folders.", rich_help_panel=DATA),
    ] = False,
    held_to_photo: Annotated[
        bool,
        typer.Option(
            "--held-to-photo",
            help="Correct the field by the quotient of its photo, as `relight` does.",
            rich_help_panel=METHODS,
        ),
    ] = False,
    split: SplitOption = "test",
    every: EveryOption = 1,
    joint_fit: JointFitOption = False,
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    non_negative: NonNegativeOption = True,
    refine: RefineOption = "none",
) -> int:
    """Exchange the reflectances of two images of a person (the paper's Table 2).

    Image A is rendered from the reflectance that was read from B, turned to A's pose, under A's light; then B
    from A's. The same method estimates that light in the image with its own reflectance. Of a DATASET,
    couples are sources of one person with different cameras and different maps.
    """
    no_part_of_preset(options, every)
    refuse_for_others(context, photos)
    refuse_without_field(context, options, "held_to_photo")
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        landmarks=landmarks,
        geometry=geometry,
        landmarks_from=landmarks_from,
    )
    photo.check()
    light = _light_options(photo, options, non_negative, refine)
    from facerf_cli.cli.items.evaluate_transfer import run_transfer

    folder = None if photos else only_dataset(inputs)
    if not photos and folder is None:
        raise UsageError(f"{inputs[0]}: not a prepared dataset; give --photos for images of people")
    return run_transfer(inputs, folder, options, photo, light, split, every, joint_fit, not held_to_photo)


def geometry(
    context: typer.Context,
    inputs: PhotosOrDatasetArgument,
    options: EvaluateOptions,
    mean_checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--mean-checkpoint",
            metavar="FILE",
            help="Use a checkpoint of `facerf train --mean-face` for the mean face.",
            show_default="that of the fitted face",
            rich_help_panel=METHODS,
        ),
    ] = None,
    split: SplitOption = "test",
    every: EveryOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Reconstruct photos with the fitted face and with the mean face in its pose (the paper's Table 4).

    Both are fitted to the same landmarks of one image, or with --geometry network regressed from the same
    crop, and compared where both show the face. The paper trained networks with the mean face: give them as
    --mean-checkpoint. --against does not apply.
    """
    no_part_of_preset(options, every)
    if options.against:
        raise UsageError("--against: does not apply to geometry; give --checkpoint and --mean-checkpoint")
    folder = only_dataset(inputs)
    refuse_for_others(context, photos=folder is None)
    refuse_without_field(context, options, "mean_checkpoint")
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry=geometry,
        landmarks_from=landmarks_from,
    )
    photo.check()
    from facerf_cli.cli.items.evaluate_photos import run_geometry

    return run_geometry(inputs, folder, options, photo, split, every, mean_checkpoint)


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
    options: EvaluateOptions,
    shifts: Annotated[
        Path | None,
        typer.Option(
            "--shifts",
            metavar="CSV",
            help="Align images by rows subject,light,dy,dx: pixels down and right that move an image onto "
            "its subject's frontal one.",
            show_default="no alignment",
            rich_help_panel=DATA,
        ),
    ] = None,
    subjects: Annotated[
        list[str] | None,
        typer.Option(
            "--subjects",
            metavar="NAME,...",
            help="Measure these subjects only, such as yaleB05,yaleB15. Repeatable.",
            show_default="all",
            rich_help_panel=DATA,
        ),
    ] = None,
    room: Annotated[
        float,
        typer.Option(
            "--room",
            metavar="SHARE",
            min=0.0,
            max=1.0,
            help="Light from all around that comes with each flash, as a room sends it back: a share of it.",
            rich_help_panel=DATA,
        ),
    ] = 0.0,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    network_alone: NetworkAloneOption = False,
    face_model: FaceModelOption = "builtin",
) -> int:
    """Relight real people to real point lights and compare with their photos under these.

    Sources are an image under one flash and four soft lights summed from the subject's own images; targets
    are single flashes and four environments. Lights are given, not estimated. Images are read as linear, as
    measured, relit as by `facerf relight`, and compared inside one ellipse, open eyes included. Cases are
    SUBJECT/SOURCE/LIGHT; the rows of other methods were published for the same images. A method for --compare
    runs on the sources that --pictures keeps; its PNGs are read as given, too, and its colours are averaged.
    The database is for research and never trained on.
    """
    refuse_without_field(context, options, "network_alone")
    options = measures_portraits(context, options)
    from facerf_cli.cli.items.evaluate_images import run_yale_b

    photo = PhotoOptions(
        settings_of(context), face_model=face_model, geometry=geometry, landmarks_from=landmarks_from
    )
    return run_yale_b(folder, options, photo, shifts, subjects or [], network_alone, room)


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
    truth: Annotated[
        Path,
        typer.Option(
            "--truth",
            metavar="DIR",
            help="Compare with the truths in this folder: .exr .hdr .npy (linear), .png .jpg .tif ...",
            show_default=False,
        ),
    ],
    options: EvaluateOptions,
    masks: Annotated[
        Path | None,
        typer.Option(
            "--masks",
            metavar="DIR",
            help="Compare inside masks: images with the truths' names, white inside.",
            show_default="the truths' alpha, else everything",
            rich_help_panel=DATA,
        ),
    ] = None,
    facts: Annotated[
        Path | None,
        typer.Option(
            "--facts",
            metavar="CSV",
            help="Read a row for each image: name, person, and columns for the tables (text) or for the list "
            "of images (numbers).",
            show_default="a person is a truth's topmost folder",
            rich_help_panel=DATA,
        ),
    ] = None,
    face_distance: Annotated[
        bool,
        typer.Option(
            "--face-distance",
            help="Detect the truths' faces and measure Face dis, too.",
            rich_help_panel=MEASURES,
        ),
    ] = False,
) -> int:
    """Measure folders of predictions against a folder of truths, image by image.

    Trees are mirrored; names must match, suffixes may differ. A missing, an additional or a differently sized
    prediction is an error: no table is made of what is left.
    """
    options.require_output_apart([*predictions, truth, *([] if masks is None else [masks])])
    from facerf_cli.cli.items.evaluate_images import run_pairs

    return run_pairs(predictions, truth, options, settings_of(context), masks, facts, face_distance)


# Each protocol, and the shared options that it has no use for.
_PROTOCOLS: tuple[tuple[Callable[..., int], tuple[str, ...]], ...] = (
    (olat, ()),
    (reconstruction, ()),
    (transfer, ()),
    (geometry, ()),
    (yale_b, ("keep_eyes", "preset")),  # the mask is one ellipse, and the paper has no such figures
    (pairs, ("reflectance", "against", "compare", "keep_eyes", "pictures", "preset")),  # no model is run
)

for _function, _left_out in _PROTOCOLS:
    _command = with_machines(with_shared_options(_function, _left_out))
    app.command(epilog=EPILOG, context_settings=HELP_NAMES)(_command)
