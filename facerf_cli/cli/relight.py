"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.cli.backgrounds import BackgroundChoice, parse_aov, parse_background
from facerf_cli.cli.batch import BatchOptions, Outcome, all_finished, run_files
from facerf_cli.cli.film_output import FilmOrFolderOption, FpsOption, film_output, run_to_film
from facerf_cli.cli.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.cli.light_options import LightOptions, for_other_photos
from facerf_cli.cli.lights import LightSetup, PhotoLight, Sampling, collect_setups, photo_lights
from facerf_cli.cli.naming import NamePattern, split_frame
from facerf_cli.cli.options import (
    BATCH,
    IMAGE,
    LIGHT,
    METHOD,
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    JobsOption,
    NetworkAloneOption,
    OverwriteOption,
    refuse_given,
    settings_of,
)
from facerf_cli.cli.output_options import (
    STDOUT,
    ColourspaceOption,
    CompressionOption,
    FormatOption,
    OcioOption,
    OutputOptions,
    ViewOption,
    check_stdout,
    config_of,
    parse_formats,
    refuse_unused,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    GeometryOption,
    LandmarksFromOption,
    LandmarksOption,
    PhotoOptions,
    TextureSizeOption,
    check_companion,
)
from facerf_cli.cli.recipe import NOT_IN_RECIPE, DigestOf, Recipe, recipe_of
from facerf_cli.cli.shots import (
    FRAMES_IN_A_ROW,
    PhotosArgument,
    SequenceOption,
    Shot,
    check_shots,
    collect_frames,
    follow_all,
    recipe_of_shots,
)
from facerf_cli.cli.values import Exposure, is_sweep, parse_exposure, parse_lights, parse_pose
from facerf_cli.errors import FacerfError, UsageError

Composite = Literal["photo", "face"]
ExposureGroup = Literal["photo", "folder", "sequence"]


@dataclass(frozen=True)
class Relight:
    """Relights one item under every light setup; settings only."""

    photo: PhotoOptions
    setups: tuple[LightSetup, ...] = field(metadata=NOT_IN_RECIPE)  # each is in that of its own images
    rig: str
    sampling: Sampling
    pose: str | None
    composite: Composite
    background: BackgroundChoice
    background_blur: float
    aov: tuple[str, ...]
    matte: Path | None
    exposure: Exposure
    asked_for_photo: bool = field(metadata=NOT_IN_RECIPE)  # --composite photo is on the command line
    output: OutputOptions
    reflectance: RelightKind = "portrait"
    network_alone: bool = False
    name: NamePattern | None = field(default=None, metadata=NOT_IN_RECIPE)
    exposure_group: ExposureGroup = "photo"
    photo_of_stack: Path | None = None
    leaders: tuple[Item, ...] = field(default=(), metadata=NOT_IN_RECIPE)  # the first photo of each group
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    def outputs_of(self, item: Item) -> list[Path]:
        """A file of each format for each setup."""
        tag = "" if self.composite == "photo" else self.photo.first_tag
        suffixes = self.output.suffixes
        return [setup.output(item, tag, suffix, self.name) for setup in self.setups for suffix in suffixes]

    def for_stale(self, item: Item) -> "Relight":
        """These settings with the lights of the item's stale images; a light has all of its frames."""
        tag = "" if self.composite == "photo" else self.photo.first_tag
        stale = {
            setup.name
            for setup in self.setups
            for suffix in self.output.suffixes
            if not item.stale or setup.output(item, tag, suffix, self.name) in item.stale
        }
        return replace(self, setups=tuple(setup for setup in self.setups if setup.name in stale))

    def with_leaders(self, items: Sequence[Item]) -> "Relight":
        """These settings with the first photo of each group of --exposure-group."""
        groups = {self._group(item): item for item in reversed(items)}
        return replace(self, leaders=tuple(groups.values())) if self.exposure_group != "photo" else self

    def leader_of(self, item: Item) -> Item | None:
        """The photo whose exposure an item shares; None without groups."""
        own = self._group(item)
        return next((leader for leader in self.leaders if self._group(leader) == own), None)

    def _group(self, item: Item) -> Path:
        if self.exposure_group == "folder":
            return item.output_base.parent
        return item.output_base.with_name(split_frame(item.output_base.name)[0])

    def refuse_meeting(self, items: Sequence[Item]) -> None:
        """Raise UsageError where two images would have one path, as a --name may make them."""
        seen: set[Path] = set()
        for item in items:
            for path in self.outputs_of(item):
                if path in seen:
                    raise UsageError(
                        f"{item.input_path}: {path} would be the name of two images; give --name more fields"
                    )
                seen.add(path)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of every output, which holds the light of its own setup alone."""
        shared = recipe_of(self, digest_of)
        if self.leaders:
            shared["leaders"] = [digest_of(leader.input_path) for leader in self.leaders]
        shared |= recipe_of_shots(self.shots, digest_of)
        lit = [recipe_of(setup, digest_of) | shared for setup in self.setups]
        return [recipe | {"format": name} for recipe in lit for name in self.output.formats]

    def readable(self, dry_run: bool) -> "Relight":
        """Load the models, and keep the setups whose maps can be read.

        A dry run loads no networks, and so estimates no light of a photo.
        """
        from facerf_cli.cli.items.light_weights import readable
        from facerf_cli.cli.items.outputs import check_output

        check_output(self.output)
        self.photo.preparation(dry_run)()
        follow_all(self.shots, self.photo, dry_run)
        if dry_run and any(isinstance(setup.envmap, PhotoLight) for setup in self.setups):
            return self
        setups = readable(self.setups)
        if not setups:
            raise FacerfError("no map can be read; give others")
        return replace(self, setups=setups)

    def __call__(self, item: Item) -> Outcome:
        """Relight a photo, a frame or a stack."""
        from facerf_cli.cli.items.relight_photos import relight_item

        written, facts = relight_item(item, self.for_stale(item))
        outputs = [path.with_suffix(suffix) for path in written for suffix in self.output.suffixes]
        exposures_ev = {path.stem: exposure_ev for path, exposure_ev in written.items()}
        return Outcome(outputs, facts | {"exposure_ev": exposures_ev})


def relight(
    context: typer.Context,
    inputs: PhotosArgument,
    output: FilmOrFolderOption,
    envmap: Annotated[
        list[str] | None,
        typer.Option(
            "--envmap",
            metavar="SKY.exr|DIR|procedural:N",
            help="Relight under lat-long maps (.exr, .hdr): files, folders or quoted patterns; a light of "
            "estimate-light or convert-light (.json); or the first N maps that facerf envmap draws from "
            "--seed. Repeatable; .exr and .hdr files that follow it directly are maps, too.",
            show_default=False,
            rich_help_panel=LIGHT,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="LIGHT",
            help="Relight under AZ,EL[,R,G,B] in degrees (AZ > 0: from the image's right), several by ;, "
            "a light by its keys (at=, from=, size=, kelvin=, ...), a rig file or a preset "
            "(rembrandt). NAME= makes a layer. Repeatable.",
            show_default=False,
            rich_help_panel=LIGHT,
        ),
    ] = None,
    light_from: Annotated[
        list[str] | None,
        typer.Option(
            "--light-from",
            metavar="PHOTO|DIR",
            help="Relight under the light of another photo, estimated from its largest face as `facerf "
            "estimate-light` does by default (with this --reflectance). Repeatable.",
            show_default=False,
            rich_help_panel=LIGHT,
        ),
    ] = None,
    lights: Annotated[
        str,
        typer.Option(
            "--lights",
            metavar="N|FILE",
            help="Approximate maps by a rig of N lights, or by a file of directions.",
            rich_help_panel=LIGHT,
        ),
    ] = "150",
    rotate: Annotated[
        str | None,
        typer.Option(
            "--rotate",
            metavar="DEG|FROM:TO:N",
            help="Rotate the maps: add DEG to every azimuth; or render N frames .0000 on, without TO.",
            show_default="as they are",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="YAW,PITCH,ROLL",
            help="Turn the head to a pose, in degrees; shows the face alone.",
            show_default="the photo's",
            rich_help_panel=IMAGE,
        ),
    ] = None,
    reflectance: Annotated[
        RelightKind,
        typer.Option(
            help="Relight the whole portrait, or only the face by the paper's field; or, to compare, diffuse "
            "under spherical harmonics, with a specular lobe, or diffuse with shadows (docs/baselines.md).",
            rich_help_panel=METHOD,
        ),
    ] = "portrait",
    exposure: Annotated[
        str,
        typer.Option(
            metavar="auto|face|EV",
            help="Expose PNG and JPEG so that the face is as bright as in the photo (auto) or well lit "
            "(face); or by a number of EV.",
            rich_help_panel=IMAGE,
        ),
    ] = "auto",
    exposure_group: Annotated[
        ExposureGroup,
        typer.Option(
            help="Choose an exposure for each photo, or from the first one for a whole folder or sequence "
            "of frames.",
            rich_help_panel=IMAGE,
        ),
    ] = "photo",
    view: ViewOption = OutputOptions.view,
    format_: FormatOption = "",
    output_colourspace: ColourspaceOption = None,
    compression: CompressionOption = OutputOptions.compression,
    ocio: OcioOption = None,
    composite: Annotated[
        Composite | None,
        typer.Option(
            help="Show the photo with its face relit, or the rendered face alone, with alpha.",
            show_default="photo; face with --pose",
            rich_help_panel=IMAGE,
        ),
    ] = None,
    background: Annotated[
        str,
        typer.Option(
            metavar="photo|envmap|none|FILE|COLOUR",
            help="Show behind the person the photo's background, as it was; the map, seen by the photo's "
            "camera; nothing (alpha); an image; or a colour, #RRGGBB or linear R,G,B.",
            rich_help_panel=IMAGE,
        ),
    ] = "photo",
    background_blur: Annotated[
        float,
        typer.Option(
            metavar="PERCENT",
            min=0.0,
            max=50.0,
            help="Blur the map behind the person as a lens does, in percent of the longer side.",
            rich_help_panel=IMAGE,
        ),
    ] = 1.0,
    aov: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Add layers to the EXR: albedo, normal, position, depth, shadow, specular, classes; of the "
            "face alone face (its soft mask) and uv. The matte, person.A, is always there.",
            show_default="none",
            rich_help_panel=IMAGE,
        ),
    ] = "",
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|DIR|PATTERN",
            help="Change only what a grey image, or its alpha, of the photo's size shows "
            "(mattes/{stem}.png: of each its own).",
            show_default=False,
            rich_help_panel=IMAGE,
        ),
    ] = None,
    photo_of_stack: Annotated[
        Path | None,
        typer.Option(
            "--photo",
            metavar="FILE|DIR|PATTERN",
            help="Put an OLAT stack of predict-olat back on its photo, at the photo's resolution.",
            show_default=False,
            rich_help_panel=IMAGE,
        ),
    ] = None,
    ball: Annotated[
        bool,
        typer.Option(
            "--ball",
            help="Write a mirror ball and a diffuse ball under each map, too.",
            rich_help_panel=IMAGE,
        ),
    ] = False,
    envmap_sampling: Annotated[
        Sampling | None,
        typer.Option(
            help="Give each light the map's integral over its cell; share it smoothly among lights; or, "
            "as in the paper, one pixel.",
            show_default="cell; smooth for --rotate FROM:TO:N",
            rich_help_panel=LIGHT,
        ),
    ] = None,
    network_alone: NetworkAloneOption = False,
    texture_size: TextureSizeOption = None,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    fps: FpsOption = None,
    name: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN",
            help="Name the images by a pattern of {dir}, {parent}, {stem}, {ext}, {light} and {frame:04}.",
            show_default="{dir}/{stem}_{light}",
            rich_help_panel=BATCH,
        ),
    ] = None,
    sequence: SequenceOption = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Relight photos under environment maps and single lights.

    Each image is written as a scene-linear EXR, with the layer person.A (the matte) and those of --aov, and
    as a PNG at --exposure, or as --format says; -o - writes one image to standard output. One prediction
    serves all maps and rotations of a photo. Frame numbers at the end of a name (sky.0001.exr) stay at the
    end.

    A film, or images with --sequence, is one shot: one identity, and one light by which the field is
    corrected; the frames around a frame steady its pose, expression and matte. -o FILE.mp4 or FILE.mov joins
    frames to a film, with the sound of the film that they come from.

    An OLAT stack in place of a photo is relit by its own lights: --lights does not apply, and --light takes
    the nearest of them.
    """
    settings = settings_of(context)
    pattern = NamePattern.parse(name, "--name") if name else None
    film = film_output(output, fps)
    if film is not None:
        refuse_given(context, ("format_", "ball", "name"), f"is not for -o {output}; leave it out")
        output = film.folder
    formats = film.formats if film else parse_formats(format_ or ("png" if output == STDOUT else "exr,png"))
    refuse_unused(context, formats)
    if pose is not None and composite == "photo":
        raise UsageError("--pose: turns the head out of its photo; use --composite face with it")
    parse_pose(pose)
    parse_lights(lights)
    if network_alone and reflectance not in ("field", "portrait"):
        raise UsageError("--network-alone: is for the fields; leave it out, or use --reflectance field")
    photo = PhotoOptions(
        settings,
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry,
        texture_size,
        landmarks_from,
        config_of(ocio),
    )
    photo.check()
    behind = parse_background(background)
    if behind.kind != "photo" and (composite == "face" or pose is not None):
        raise UsageError("--background: is for the whole photo; leave out --pose and --composite face")
    if film and (behind.kind == "none" or composite == "face" or pose is not None):
        raise UsageError(f"-o {film.path}: a film has no alpha; give a folder, or --background COLOUR")
    check_companion(matte, "--matte")
    check_companion(photo_of_stack, "--photo")
    shown: Composite = composite or ("photo" if pose is None else "face")
    of_light: Kind = "field" if reflectance == "portrait" else reflectance
    lit = photo_lights(light_from or (), output, LightOptions(for_other_photos(photo), of_light))
    work = Relight(
        photo=photo,
        setups=collect_setups(envmap or (), rotate, light or (), output, settings.seed, lit),
        rig=lights,
        sampling=envmap_sampling or ("smooth" if rotate and is_sweep(rotate) else "cell"),
        pose=pose,
        composite=shown,
        background=behind,
        background_blur=background_blur / 100,
        aov=parse_aov(aov),
        matte=matte,
        exposure=parse_exposure(exposure),
        asked_for_photo=composite == "photo",
        output=OutputOptions(formats, output_colourspace, compression, view, config_of(ocio)),
        reflectance="field" if shown == "face" and reflectance == "portrait" else reflectance,
        network_alone=network_alone,
        name=pattern,
        exposure_group=exposure_group,
        photo_of_stack=photo_of_stack,
    )
    if output == STDOUT:
        refuse_given(context, ("ball", "dry_run"), "is not for -o -, which writes one image; leave it out")
        _write_to_stdout(inputs, work)
        return
    items, shots = collect_frames(inputs, output, settings, sequence, pattern)
    check_shots(shots, photo)
    in_a_row = FRAMES_IN_A_ROW if shots else 1
    options = BatchOptions(output, overwrite, dry_run, jobs, in_a_row, print_outputs=film is None)
    work = replace(work.with_leaders(items), shots=shots)
    work.refuse_meeting(items)
    if film is not None:
        raise typer.Exit(run_to_film(film, items, shots, work, options, settings))
    finished = all_finished("relight", items, work.outputs_of, options, settings, work.recipes_of)
    usable = work if finished else work.readable(dry_run)
    code = run_files("relight", items, usable, usable.outputs_of, options, settings, usable.recipes_of)
    if ball and not dry_run and settings.shard.number == 1:
        _write_balls(usable, options)
    raise typer.Exit(max(code, int(len(usable.setups) < len(work.setups))))


def _write_to_stdout(inputs: list[str], work: Relight) -> None:
    """Write the one image of one photo as bytes; raises UsageError where there are several."""
    with tempfile.TemporaryDirectory() as folder:
        items = collect_items(inputs, Path(folder), PHOTO_SUFFIXES)
        images = len(items) * len(work.setups)
        check_stdout(images if work.photo.face != "all" else 2 * images, work.output.formats)
        (path,) = work.readable(False)(items[0]).outputs
        sys.stdout.buffer.write(path.read_bytes())
        sys.stdout.buffer.flush()


def _write_balls(work: Relight, options: BatchOptions) -> None:
    """Write the balls under each map to `balls/NAME` in each format, unless they are there."""

    def path_of(setup: LightSetup) -> Path:
        return options.output / "balls" / f"{setup.name}{setup.frame}.exr"

    maps = [setup for setup in work.setups if setup.envmap is not None]
    missing = [
        setup
        for setup in maps
        if options.overwrite == "always"
        or not all(path_of(setup).with_suffix(suffix).exists() for suffix in work.output.suffixes)
    ]
    if missing:
        from facerf_cli.cli.items.light_weights import readable, write_balls

        drawn = readable(missing)
        write_balls(drawn, [path_of(setup) for setup in drawn], work.exposure, work.output)
