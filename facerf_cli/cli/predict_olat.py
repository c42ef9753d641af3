"""`facerf predict-olat`: a photo's face under every light of a rig, as an OLAT stack."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.inputs import Item, collect_items, file_pattern
from facerf_cli.batch.made_from import OneRecipe
from facerf_cli.batch.run import BatchOptions, Outcome, run_items
from facerf_cli.cli.options import (
    IMAGE,
    LIGHT,
    METHOD,
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    NameOption,
    NetworkAloneOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    GeometryOption,
    LandmarksFromOption,
    LandmarksOption,
    PhotoOptions,
    TextureSizeOption,
    networks_of,
)
from facerf_cli.cli.values import parse_lights, parse_pose
from facerf_cli.errors import UsageError

Precision = Literal["float32", "bf16"]
Frame = Literal["photo", "face", "uv"]
StackFormat = Literal["exr", "relight"]
_LARGEST_PX = 16384


@dataclass(frozen=True)
class PredictOlat:
    """Predicts one item's stack and contact sheet; settings only."""

    photo: PhotoOptions
    lights: str
    pose: str | None
    frame: Frame
    size_px: int
    network_alone: bool
    precision: Precision
    format: StackFormat = "exr"
    page: bool = False

    def outputs_of(self, item: Item) -> list[Path]:
        """The stack, its contact sheet and, where they are asked for, its page."""
        return self.files_of(item, self.photo.first_tag)

    def files_of(self, item: Item, tag: str) -> list[Path]:
        """The files of the face with a tag: stack, contact sheet, page."""
        stack = f"{tag}_olat.exr" if self.format == "exr" else f"{tag}_relight/info.json"
        pages = [item.output(f"{tag}.html")] if self.page else []
        return [item.output(stack), item.output(f"{tag}_olat.png"), *pages]

    def __call__(self, item: Item) -> Outcome:
        """Predict every chosen face."""
        from facerf_cli.work.stacks import write_stacks

        return Outcome(*write_stacks(item, self))


def predict_olat(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    lights: Annotated[
        str,
        typer.Option(
            metavar="N|FILE|'AZ,EL;...'",
            help="Predict a uniform rig of N lights, or directions in degrees: a text file, or a list.",
            rich_help_panel=LIGHT,
        ),
    ] = "150",
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="YAW,PITCH,ROLL",
            help="Turn the head to a pose, in degrees.",
            show_default="the photo's",
            rich_help_panel=IMAGE,
        ),
    ] = None,
    frame: Annotated[
        Frame | None,
        typer.Option(
            help="Predict the whole person in the photo's frame; the face alone in that of its crop; or UV "
            "textures, which other poses can be rendered from.",
            show_default="photo; face with --pose",
            rich_help_panel=IMAGE,
        ),
    ] = None,
    size: Annotated[
        int,
        typer.Option(
            min=64,
            max=_LARGEST_PX,
            metavar="PX",
            help="Scale larger photos down to this longer side, with --frame photo.",
            rich_help_panel=IMAGE,
        ),
    ] = 1024,
    network_alone: NetworkAloneOption = False,
    texture_size: TextureSizeOption = None,
    precision: Annotated[
        Precision,
        typer.Option(
            help="Compute the network in this precision; bf16 where the device has instructions for it.",
            rich_help_panel=METHOD,
        ),
    ] = "float32",
    format_: Annotated[
        StackFormat,
        typer.Option(
            "--format",
            help="Write OpenEXR; or a folder for the web viewers Relight and OpenLIME, front lights only.",
            rich_help_panel=IMAGE,
        ),
    ] = "exr",
    page: Annotated[
        bool,
        typer.Option("--page", help="Write the web page of `facerf view`, too.", rich_help_panel=IMAGE),
    ] = False,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    name: NameOption = None,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Predict a photo's person under every single light of a rig (OLAT, one light at a time).

    Each photo gives an OLAT stack (an OpenEXR file with a part for each light, the person over black;
    `facerf relight` takes it in place of a photo, and with --photo puts it back on its photo) and a contact
    sheet. Lights are fixed to the camera and of
    unit intensity: AZ > 0 lights the image's right side, EL > 0 comes from above.
    """
    settings = settings_of(context)
    parse_lights(lights)
    parse_pose(pose)
    photo = PhotoOptions(
        settings, input_colourspace, face_model, face, landmarks, geometry, texture_size, landmarks_from
    )
    photo.check()
    if frame == "photo" and pose is not None:
        raise UsageError("--pose: turns the head out of its photo; use --frame face or uv with it")
    chosen: Frame = frame or ("photo" if pose is None else "face")
    if format_ == "relight" and chosen == "uv":
        raise UsageError("--format relight: shows images, not UV textures; use --frame photo or face")
    if page and (network_alone or pose is not None):
        raise UsageError(
            "--page: shows the photo's own pose and light; give neither --pose nor --network-alone"
        )
    work = PredictOlat(photo, lights, pose, chosen, size, network_alone, precision, format_, page)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    kinds = ["portrait" if page or chosen == "photo" else "field"]
    items = collect_items(inputs, output, pattern=file_pattern(name), null_separated=settings.null_separated)
    code = run_items(
        "predict-olat",
        items,
        work,
        work.outputs_of,
        options,
        settings,
        OneRecipe(work),
        prepare=photo.preparation(dry_run, networks_of(kinds)),
    )
    raise typer.Exit(code)
