"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import itertools
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, NamePattern, collect_items
from facerf_cli.batch.made_from import FolderIndex
from facerf_cli.batch.run import BatchOptions, all_finished, print_path, run_items
from facerf_cli.cli.backgrounds import parse_aov, parse_background
from facerf_cli.cli.film_output import FilmOrFolderOption, FpsOption, film_output, run_to_film
from facerf_cli.cli.light_options import LightOptions, for_other_photos
from facerf_cli.cli.lights import LightSetup, Sampling, collect_setups, photo_lights
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
    DisplayOption,
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
from facerf_cli.cli.relight_work import Composite, ExposureGroup, Relight
from facerf_cli.cli.shots import (
    FRAMES_IN_A_ROW,
    NoCutsOption,
    PhotosArgument,
    SequenceOption,
    check_shots,
    collect_frames,
)
from facerf_cli.cli.values import is_sweep, parse_exposure, parse_lights, parse_pose
from facerf_cli.errors import UsageError


def relight(
    context: typer.Context,
    inputs: PhotosArgument,
    output: FilmOrFolderOption,
    envmap: Annotated[
        list[str] | None,
        typer.Option(
            "--envmap",
            metavar="MAP|DIR",
            help="Relight under lat-long maps (.exr, .hdr; files, folders, quoted patterns), lights of "
            "estimate-light (.json), or procedural:N, maps of facerf envmap. Repeatable.",
            show_default=False,
            rich_help_panel=LIGHT,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="LIGHT",
            help="Relight under AZ,EL in degrees (AZ > 0: from the right), keys (at=, size=, kelvin=), a rig "
            "file or a preset (rembrandt); docs/lights.md. Repeatable.",
            show_default=False,
            rich_help_panel=LIGHT,
        ),
    ] = None,
    light_from: Annotated[
        list[str] | None,
        typer.Option(
            "--light-from",
            metavar="PHOTO|DIR",
            help="Relight under the light of another photo, as estimate-light finds it. Repeatable.",
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
            metavar="KIND",
            help="Relight the whole portrait, or the face by the paper's field; or by a baseline: "
            "diffuse-sh, specular-sh, prt.",
            rich_help_panel=METHOD,
        ),
    ] = "portrait",
    exposure: Annotated[
        str,
        typer.Option(
            metavar="auto|face|EV",
            help="Expose PNG and JPEG: the face as bright as in the photo (auto), well lit (face), or by EV.",
            rich_help_panel=IMAGE,
        ),
    ] = "auto",
    exposure_group: Annotated[
        ExposureGroup,
        typer.Option(
            metavar="KIND",
            help="Share an exposure: of each photo, or the first one's by folder or sequence of frames.",
            rich_help_panel=IMAGE,
        ),
    ] = "photo",
    view: ViewOption = OutputOptions.view,
    display: DisplayOption = OutputOptions.display,
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
            metavar="KIND|FILE|COLOUR",
            help="Show behind the person the photo, an image or a colour (#RRGGBB or linear R,G,B), "
            "which keep their look; the envmap; or none (alpha).",
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
            "face alone face and uv.",
            show_default="none",
            rich_help_panel=IMAGE,
        ),
    ] = "",
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|DIR|PATTERN",
            help="Change only what a grey image shows (mattes/{stem}.png: of each its own).",
            show_default=False,
            rich_help_panel=IMAGE,
        ),
    ] = None,
    photo_of_stack: Annotated[
        Path | None,
        typer.Option(
            "--photo",
            metavar="FILE|DIR|PATTERN",
            help="Put an OLAT stack back on its photo, at the photo's resolution.",
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
    no_cuts: NoCutsOption = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Relight photos, or OLAT stacks, under environment maps and single lights.

    Each image is a scene-linear EXR with the matte as layer person.A, and a PNG at --exposure.
    A background that keeps its look has its own values in the EXR at --exposure 0, else those over 2^EV.
    A film, or images with --sequence, is one shot between cuts: one identity, and one light by which the
    field is corrected; frames steady each other's pose, expression and matte. -o FILE.mp4 or
    FILE.mov joins frames to a film, with the sound of the film that they come from.

    -o - writes one image to standard output. A stack is relit by its own lights: --lights does not apply, and
    --light takes the nearest of them.
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
        output=OutputOptions(formats, output_colourspace, compression, view, display, config_of(ocio)),
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
    if ball and not work.maps:
        raise UsageError("--ball: shows maps; give --envmap, or leave it out")
    items, shots = collect_frames(inputs, output, settings, sequence, pattern, not no_cuts)
    if photo_of_stack is not None and not _holds_a_stack(items):
        raise UsageError("--photo: is for OLAT stacks, and no input is one; leave it out")
    check_shots(shots, photo)
    in_a_row = FRAMES_IN_A_ROW if shots else 1
    options = BatchOptions(output, overwrite, dry_run, jobs, in_a_row, print_outputs=film is None)
    work = replace(work.with_leaders(items), shots=shots)
    work.refuse_meeting(items)
    if film is not None:
        raise typer.Exit(run_to_film(film, items, shots, work, options, settings))
    index = FolderIndex(output, "relight", settings.shard, work.recipes_of)
    usable, finished = work, all_finished(items, work.outputs_of, options, settings, index)
    index.edited.clear()  # they are judged again
    if not finished:
        usable = work.readable(dry_run)
        index.want(usable.recipes_of)
    code = run_items(
        "relight", items, usable, usable.outputs_of, options, settings, usable.recipes_of, index=index
    )
    if ball and not dry_run and settings.shard.number == 1:
        _write_balls(usable, options)
    raise typer.Exit(max(code, int(len(usable.setups) < len(work.setups))))


def _holds_a_stack(items: Sequence[Item]) -> bool:
    from facerf_cli.files.olat_stack import is_olat_stack

    return any(is_olat_stack(item.input_path) for item in items)


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

    missing = [
        setup
        for setup in work.maps
        if options.overwrite == "always"
        or not all(path_of(setup).with_suffix(suffix).exists() for suffix in work.output.suffixes)
    ]
    if missing:
        from facerf_cli.work.lights import readable, write_balls

        drawn = readable(missing)
        paths = [path_of(setup) for setup in drawn]
        write_balls(drawn, paths, work.exposure, work.output)
        for path, suffix in itertools.product(paths, work.output.suffixes):
            print_path(path.with_suffix(suffix))
