"""`facerf relight`: photos, or stacks of predicted lights, under environment maps and lamps."""

from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.baselines import Kind
from facerf_cli.cli.batch import BatchOptions, run_batch
from facerf_cli.cli.items.relight import Composite, Relight
from facerf_cli.cli.light_options import LightOptions, of_other_photos
from facerf_cli.cli.lights import Sampling, collect_shots, photo_lights, usable, write_balls
from facerf_cli.cli.options import (
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    LandmarksOption,
    PhotoOptions,
    TextureSizeOption,
    load_models_once,
)
from facerf_cli.cli.values import numbers, parse_directions, parse_pose
from facerf_cli.errors import FacerfError, UsageError


def relight(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    envmap: Annotated[
        list[str] | None,
        typer.Option(
            "--envmap",
            metavar="SKY.exr|DIR|procedural:N",
            help="Lat-long maps (.exr, .hdr), twice as wide as high: files, folders or quoted patterns; a "
            "light of estimate-light or convert-light (.json); or N maps drawn from --seed, the first N of "
            "facerf envmap. May be repeated; .exr and .hdr files that follow it directly are maps too.",
            show_default=False,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="AZ,EL[,R,G,B][;...]",
            help="A picture under a single light from azimuth and elevation in degrees (AZ > 0: from the "
            "picture's right), or under several that shine together, with ; between them. May be repeated.",
            show_default=False,
        ),
    ] = None,
    light_from: Annotated[
        list[str] | None,
        typer.Option(
            "--light-from",
            metavar="PHOTO|DIR",
            help="The light of another photo's largest face, as `facerf estimate-light` reads it by default "
            "(with this --reflectance); it turns and has balls as a map. May be repeated.",
            show_default=False,
        ),
    ] = None,
    lights: Annotated[
        str, typer.Option("--lights", metavar="N|FILE", help="The rig that maps are weighed over.")
    ] = "150",
    rotate: Annotated[
        str | None,
        typer.Option(
            "--rotate",
            metavar="DEG|FROM:TO:N",
            help="Turn the maps: DEG is added to every azimuth; or N frames .0000, .0001, ... (TO left out).",
            show_default="as they are",
        ),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="YAW,PITCH,ROLL",
            help="Turn the head to this pose, in degrees; gives the face alone.",
            show_default="the photo's",
        ),
    ] = None,
    reflectance: Annotated[
        Kind,
        typer.Option(
            help="What the face is taken to be: the field of the network, or, to compare, diffuse under "
            "spherical harmonics, with a specular lobe, or diffuse with shadows (docs/baselines.md)."
        ),
    ] = "field",
    exposure: Annotated[
        str,
        typer.Option(
            metavar="EV|auto", help="Of the PNG; the EXR holds absolute light. auto: by the lit face."
        ),
    ] = "auto",
    composite: Annotated[
        Composite | None,
        typer.Option(
            help="The photo with its face relit, or the rendered face with alpha.",
            show_default="photo; face with --pose",
        ),
    ] = None,
    keep_background: Annotated[
        bool,
        typer.Option(
            "--keep-background",
            help="Leave hair and background as they are, bit for bit; "
            "--exposure is then that of the light on the face.",
        ),
    ] = False,
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What the light may change: a grey picture (or its alpha) of the photo's size.",
            show_default=False,
        ),
    ] = None,
    ball: Annotated[
        bool, typer.Option("--ball", help="Also a mirror ball and a diffuse ball under each map.")
    ] = False,
    envmap_sampling: Annotated[
        Sampling,
        typer.Option(help="A light takes the map's integral over its cell, or, as in the paper, one pixel."),
    ] = "cell",
    texture_size: TextureSizeOption = 256,
    memory: Annotated[float, typer.Option(metavar="GB", min=0.1, help="For the prediction, about.")] = 2.0,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> None:
    """Relight photos under environment maps and single lights.

    Each picture is an EXR of absolute, scene-linear light, with the layers face.A (the face's soft mask),
    normal, position (camera space; metres) and uv, and a PNG at --exposure. One prediction serves all maps
    and rotations of a photo. Frame numbers at the end of a name (sky.0001.exr) stay there.

    A stack is relit by its own lights: --lights does not apply, and --light takes the nearest of them.
    """
    settings = settings_of(context)
    if pose is not None and composite == "photo":
        raise UsageError("--pose turns the head out of its photo; use --composite face with it")
    parse_pose(pose)
    parse_directions(lights)
    exposure_ev = None if exposure == "auto" else numbers(exposure, ("EV or auto",), "--exposure")[0]
    photo = PhotoOptions(settings, input_colourspace, face_model, face, landmarks, texture_size)
    photo.check()
    if matte is not None and not matte.is_file():
        raise UsageError(f"--matte {matte}: no such file")
    lit = photo_lights(light_from or (), output, LightOptions(of_other_photos(photo), reflectance))
    asked = collect_shots(envmap or (), rotate, light or (), output, settings.seed, lit)
    shots = asked if dry_run and lit else usable(asked)  # a photo's light takes its time
    if not shots:
        raise FacerfError("no map can be used")
    mode: Composite = composite or ("photo" if pose is None else "face")
    work = Relight(
        photo=photo,
        shots=shots,
        rig=lights,
        sampling=envmap_sampling,
        pose=pose,
        composite=mode,
        surround=not keep_background,
        matte=matte,
        exposure_ev=exposure_ev,
        memory_bytes=int(memory * 2**30),
        asked_for_photo=composite == "photo",
        reflectance=reflectance,
    )
    if not dry_run:
        load_models_once(photo)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    code = run_batch("relight", inputs, work, work.outputs_of, options, settings)
    if ball and not dry_run and settings.shard.number == 1:
        write_balls(shots, output, exposure_ev, overwrite)
    raise typer.Exit(max(code, int(len(shots) < len(asked))))
