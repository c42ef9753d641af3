"""`facerf estimate-light`: the light of a photo as a map, as numbers and as an image."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.baselines import Kind
from facerf_cli.batch.inputs import Item, file_pattern
from facerf_cli.batch.made_from import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import BatchOptions, Outcome, run_items
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.cli.light_options import LightOptions, NonNegativeOption, RefineOption
from facerf_cli.cli.options import (
    FACE,
    LIGHT,
    METHOD,
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    JobsOption,
    NameOption,
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
)
from facerf_cli.cli.shots import (
    NoCutsOption,
    PhotosArgument,
    SequenceOption,
    Shot,
    check_shots,
    collect_frames,
    follow_all,
    recipe_of_shots,
    whole_shots,
)
from facerf_cli.errors import UsageError

_OUTPUTS = ("_light.exr", "_light.json", "_light.png")
_MOST_ORDER = 20


@dataclass(frozen=True)
class EstimateLight:
    """Estimates the light of one photo and writes it; settings only."""

    options: LightOptions
    width_px: int
    sh_order: int
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.options.photo.first_tag + ending) for ending in _OUTPUTS]

    def prepare(self, dry_run: bool) -> None:
        """Load the models, before the first photo; in a dry run check the options only."""
        from facerf_cli.work.light_of_photo import prepare_light

        prepare_light(self.options, with_networks=not dry_run)
        follow_all(self.shots, self.options.photo, dry_run)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all outputs."""
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Estimate the light of every chosen face, or that of a shot."""
        from facerf_cli.work.light_of_photo import write_lights, write_shot_light

        for shot in self.shots:
            if item.output_base == shot.base:
                tags, facts = write_shot_light(shot, item, self.options, self.width_px, self.sh_order)
                break
        else:
            tags, facts = write_lights(item, self.options, self.width_px, self.sh_order)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _OUTPUTS], facts)


def estimate_light(
    context: typer.Context,
    inputs: PhotosArgument,
    output: OutputOption,
    lights: Annotated[
        str,
        typer.Option(
            "--lights",
            metavar="N|FILE",
            help="Solve for the light of a rig of N lights, or of a file of directions.",
            rich_help_panel=LIGHT,
        ),
    ] = "150",
    non_negative: NonNegativeOption = True,
    refine: RefineOption = "none",
    vgg_weights: Annotated[
        str | None,
        typer.Option(
            metavar="imagenet|PATH",
            help="Use the paper's V_f in --refine features: download it once (528 MiB), or read a file.",
            show_default="S_f, the shipped network trained to find the light",
            rich_help_panel=METHOD,
        ),
    ] = None,
    reflectance: Annotated[
        Kind,
        typer.Option(
            help="Choose the reflectance model; each baseline estimates its own light.",
            rich_help_panel=METHOD,
        ),
    ] = "field",
    keep_eyes: Annotated[
        bool,
        typer.Option(
            "--keep-eyes", help="Use the eyes, too (the paper leaves them out).", rich_help_panel=FACE
        ),
    ] = False,
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|DIR|PATTERN",
            help="Use only what a grey image, or its alpha, of the photo's size shows, such as skin alone.",
            show_default="the photo's alpha",
            rich_help_panel=FACE,
        ),
    ] = None,
    width: Annotated[
        int,
        typer.Option(
            min=16,
            max=8192,
            metavar="PX",
            help="Write a map of this width; the height is half of it.",
            rich_help_panel=LIGHT,
        ),
    ] = 512,
    sh_order: Annotated[
        int,
        typer.Option(
            min=0,
            max=_MOST_ORDER,
            help="Write spherical harmonics of this order in the JSON.",
            rich_help_panel=LIGHT,
        ),
    ] = 2,
    texture_size: TextureSizeOption = None,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    name: NameOption = None,
    sequence: SequenceOption = False,
    no_cuts: NoCutsOption = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Estimate the light of photos from the shading of their faces.

    For each photo: _light.exr, a lat-long map for `relight --envmap`; _light.json, the weights of the lights
    and their spherical harmonics; and _light.png: the photo, the face under the estimated light, where that
    is too bright (red) and too dark (blue), a mirror ball and a diffuse ball. The report holds the residual
    inside the mask, the brightest direction (azimuth, elevation) and the share of clipped texels.

    A film, or images with --sequence, has one light between cuts, estimated from several frames together
    (_take2_light.exr after the first cut).

    A face shows much of the light in front of it and little of the light behind it. Brightness and colour of
    the light cannot be separated from those of the skin; they depend on the albedo that the network assumes.
    """
    if width % 2:
        raise UsageError(f"--width {width}: an odd width has no half; give an even number")
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry,
        texture_size,
        landmarks_from,
    )
    photo.check()
    how = LightOptions(photo, reflectance, lights, non_negative, refine, vgg_weights, keep_eyes, matte)
    how.check()
    items, shots = collect_frames(inputs, output, photo.settings, sequence, file_pattern(name), not no_cuts)
    check_shots(shots, photo)
    if shots and (refine != "none" or reflectance != "field" or matte is not None):
        raise UsageError(
            "a film or --sequence: its light is that of the field; leave out --refine, "
            "--reflectance and --matte"
        )
    work = EstimateLight(how, width, sh_order, shots)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    code = run_items(
        "estimate-light",
        whole_shots(items, shots),
        work,
        work.outputs_of,
        options,
        photo.settings,
        work.recipes_of,
        prepare=partial(work.prepare, dry_run),
    )
    raise typer.Exit(code)
