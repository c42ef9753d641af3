"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Self

import typer

from facerf_cli.baselines import Kind
from facerf_cli.batch.inputs import (
    PHOTO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    files_read,
    is_pattern,
    refuse_read,
    split_frame,
)
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.recipe import RESULTS_VERSION, DigestOf, key_of, recipe_of
from facerf_cli.batch.run import Outcome, run_items
from facerf_cli.cli.options import FramesArgument, is_default, refuse_given
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.files.output_options import STDOUT, SUFFIXES, check_stdout, format_of_file
from facerf_cli.files.texts import file_sha256
from facerf_cli.light.entries import DELIGHT, MOST_FRAMES, ORIGINAL, is_sweep, named_entry, parse_lights
from facerf_cli.light.setups import DRAWN, LightSetup, LightSources, collect_setups, set_ambient, short_names
from facerf_cli.option import Without
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import (
    LightOptions,
    check_companion,
    for_other_photos,
    networks_of,
    parse_pose,
    refuse,
)
from facerf_cli.work.photo_work import PHOTOS_A_PROCESS, FileOrFolder
from facerf_cli.work.relight_options import (
    LIGHT_ENDING,
    DrawnMap,
    PhotoLight,
    RelightOptions,
    RelightPlan,
)
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, video_output

BACKGROUND = "background"  # value of --light-from: the background image
_OF_EVERY_IMAGE = ("person", "class", "rgb", "rgba")  # names of layers
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class RelightJob(RelightPlan):
    """Plan of the images of each photo, with the work that makes them."""

    items_a_process = PHOTOS_A_PROCESS

    def ready(self, dry_run: bool) -> Self:
        """Load the models, follow the faces of shots, and leave out the setups with unreadable maps.

        A dry run neither loads networks, nor makes maps that are missing in the user's cache.
        """
        from facerf_cli.files.image_metadata import read_header
        from facerf_cli.files.outputs import check_output
        from facerf_cli.light.over_rig import readable_setups
        from facerf_cli.work.photos import prepare_photos

        options, background = self.options, self.options.background
        check_output(options.output)
        for image in (*background.frames[:1], background.path):
            if image and image.is_file() and read_header(image) is None:
                raise UsageError(f"--background {image}: not a readable image; pass an image")
        lights = (made.options.networks for made in self.cached if isinstance(made, PhotoLight))
        prepare_photos(
            self.photo, networks_of([options.reflectance]).union(*lights), with_networks=not dry_run
        )
        if self.shots.all and not dry_run:
            from facerf_cli.work.sequence import follow_all

            follow_all(self.shots.all, self.photo)
        if dry_run and not all(made.envmap.is_file() for made in self.cached):
            return self
        setups = readable_setups(self.setups)
        if not setups:
            raise FacerfError("no map can be read; pass other maps, or procedural:8 to draw some")
        return self if len(setups) == len(self.setups) else replace(self, setups=setups)

    @property
    def process(self) -> Callable[[Item], Outcome]:
        """The function that relights an item."""
        from facerf_cli.work.relight import relight_item

        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return partial(relight_item, RelightPlan(**values))  # workers need not import the command line


def relight(
    context: typer.Context,
    inputs: FramesArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|FILE",
            help="Output folder; a file for one image (.exr, .png, .jpg, .tif) or one video (.mp4: H.264, "
            ".mov: ProRes); or - for standard output.",
            show_default=False,
        ),
    ],
    sources: LightSources,
    options: RelightOptions,
    shots: ShotOptions,
    batch: Annotated[FileOrFolder, Without("output", "name")],
) -> None:
    """Relight people in photos or OLAT stacks under environment maps and single lights.

    Each result is a scene-linear EXR, with the person's matte as layer person.A, plus an exposed PNG.
    -o FILE writes a single image instead; -o - writes one image to standard output. In the EXR, a
    background that keeps its look (photo, image, colour) is divided by 2^EV, the exposure of the PNG.

    A video, or an image sequence with --sequence, is split at cuts. Each shot has one identity and one light
    estimate; pose, expression and matte are smoothed across neighbouring frames. -o FILE.mp4 or FILE.mov
    encodes the frames as a video with the source's audio.

    OLAT stacks use the lights they contain: --lights has no effect, and a --light between them is
    interpolated from the three surrounding ones.
    """
    file, formats = format_of_file(output), options.output.formats
    video = None if file else video_output(output, options.fps)
    unused = f"is not supported with -o {output}; remove it"
    if file is not None:
        formats = (file,) if is_default(context, "formats") else formats
        refuse_given(context, ("name",), unused)
        if [SUFFIXES[name] for name in formats] != [SUFFIXES[file]]:
            raise UsageError(f"-o {output}: differs from --format; remove --format, or pass a folder")
        one_file = replace(options.output, file_suffix=output.suffix)
        options = replace(options, output=one_file, name=NamePattern.literal(output.stem))
        batch = replace(batch, output=output).of_file()
        output = output.parent
    elif video is not None:
        refuse_given(context, ("formats", "name", "report"), unused)
        formats, output = video.formats, video.folder
    elif output == STDOUT:
        refuse_given(context, ("dry_run", "report"), unused)
        formats = ("png",) if is_default(context, "formats") else formats
    if "exr" not in formats:
        refuse_given(context, ("aov",), "requires EXR; add exr to --format")
    options = replace(options, output=replace(options.output, formats=formats))
    batch = replace(batch, output=output, name=None if file else options.name)
    digest_of: DigestOf = file_sha256
    if sources.light_from:  # whose maps are named by digests of photos and networks
        digest_of = Journal(output, RelightJob.verb, batch.shard, batch.file).digest_of
    plan = plan_relight(options, sources, output, digest_of)
    has_alpha = plan.options.background.kind == "none" or plan.options.composite == "face"
    if has_alpha and video and not video.holds_alpha:
        raise UsageError(f"-o {video.path}: has no alpha; use FILE.mov, a folder, or --background COLOUR")
    if has_alpha and "jpg" in formats:
        log.warning("JPEG has no alpha, so the background is black; use png, tiff or exr to keep alpha")
    if output == STDOUT:
        with tempfile.TemporaryDirectory() as folder:
            items = collect_items(inputs, Path(folder), PHOTO_SUFFIXES)
            images = len(items) * len(plan.setups)
            check_stdout(images if plan.photo.face != "all" else 2 * images, plan.options.output.formats)
            plan = plan.of_items(items, Shots(), output=Path(folder))
            plan.write_maps()
            (path,) = plan.ready(dry_run=False).process(items[0]).outputs
            sys.stdout.buffer.write(path.read_bytes())
            sys.stdout.buffer.flush()
        return
    items, taken = collect_frames(inputs, shots, batch, plan.photo)
    if taken and options.normals_from is not None:
        raise UsageError("--normals-from: requires photos, not frames of a shot; remove it")
    plan = plan.of_items(items, Shots(taken), output)
    batch = replace(batch, in_a_row=FRAMES_IN_A_ROW if taken else 1, print_outputs=video is None)
    written = [path for item in items for path in plan.outputs_of(item)]
    refuse_read([video.path] if video else written, files_read((items, plan, sources), items))
    if not batch.dry_run:
        plan.write_maps()  # before the outputs' keys, which contain digests of the maps
    recipe = video.recipe_if_new(items, taken, written, plan.recipes_of, batch) if video else ""
    if video is not None and not recipe:
        return
    code = run_items(plan, items, batch, plan.photo.settings)
    if video is not None:
        code = video.joined(items, written, taken, recipe, code)
    raise typer.Exit(code)


def plan_relight(
    options: RelightOptions, sources: LightSources, output: Path, digest_of: DigestOf = file_sha256
) -> RelightJob:
    """List the images of each photo; raise UsageError for options that exclude each other.

    Args:
        options: The options that all images share.
        sources: The lights.
        output: The output folder, which is not searched for inputs.
        digest_of: Returns the SHA-256 of a photo whose light is used, or of a network.
    """
    photo = replace(options.photo, ocio_config=options.output.config)
    photo.check()
    parse_pose(options.pose)
    parse_lights(options.rig)
    check_companion(options.matte, "--matte")
    check_companion(options.normals_from, "--normals-from")
    background = options.background
    if background.path is not None and not background.path.is_file():
        from_behind = any(entry.rpartition("=")[2] == BACKGROUND for entry in sources.light_from or ())
        if from_behind or is_pattern(str(background.path)):
            background = background.listed(output)
    of_light: Kind = "field" if options.reflectance == "portrait" else options.reflectance
    how = LightOptions(photo=for_other_photos(photo), reflectance=of_light)
    image_behind = (*background.frames, background.path)[0]
    lights = photo_lights(sources, how, image_behind, output, digest_of)
    cached = (*drawn_maps(sources, photo.settings.seed), *lights)
    setups = collect_setups(sources, output, cached)
    refuse(_rules(options, setups))
    if options.exposure is None:  # 0 EV if the lights are as bright as the photo, or the background image
        behind = {light.envmap for light in lights if light.is_background}
        setups = tuple(
            replace(setup, exposure_ev=0.0)
            if setup.by_photo or not behind.isdisjoint(light.envmap for light in setup.lights)
            else setup
            for setup in setups
        )
    face_only, dark = options.is_face_only, background.is_dark
    sweeps = sources.rotate is not None and is_sweep(sources.rotate)
    filled = replace(
        options,
        photo=photo,
        background=background,
        composite="face" if face_only else "photo",
        exposure="auto" if options.exposure is None else options.exposure,
        reflectance="field" if face_only and options.reflectance == "portrait" else options.reflectance,
    )
    return RelightJob(
        filled,
        tuple(set_ambient(setup, sources.ambient, face_only or dark(setup)) for setup in setups),
        sources.sampling or ("smooth" if sweeps else "cell"),
        cached,
        has_ambient=sources.ambient is not None,
    )


def _rules(options: RelightOptions, setups: Sequence[LightSetup]) -> dict[str, bool]:
    """Return whether each rule between options is broken, by its message."""
    baseline, whole = options.reflectance not in ("field", "portrait"), not options.is_face_only
    of_field = "requires --reflectance portrait or field"
    of_whole = "requires the whole photo; remove --pose and --composite face"
    by_photo = [light for setup in setups for light in setup.by_photo]
    word = ORIGINAL if by_photo and by_photo[0].original else DELIGHT
    layers = {*_OF_EVERY_IMAGE, *options.aov, *(["wrap"] if options.light_wrap else [])}
    taken = [name for setup in setups for name in setup.names if name in layers]
    keeps_background = options.background.kind in ("photo", "none")
    return {
        "--pose: turns the head away from its photo; use --composite face": (
            options.pose is not None and options.composite == "photo"
        ),
        f"--network-alone: {of_field}": options.network_alone and baseline,
        f"--white-balance: {of_field}": options.white_balance != "keep" and baseline,
        f"--light {word}: {of_field}": bool(by_photo) and baseline,
        f"--background: {of_whole}": options.background.kind != "photo" and not whole,
        f"--light {ORIGINAL}: {of_whole}": any(setup.has_original for setup in setups) and not whole,
        "--normals-from: requires --reflectance portrait and the whole photo": (
            options.normals_from is not None and (options.reflectance != "portrait" or not whole)
        ),
        "--light-wrap: requires a new background; add --background FILE, COLOUR or envmap": (
            bool(options.light_wrap) and keeps_background
        ),
        f"--light: {''.join(taken[:1])} is also a layer of the EXR; rename the light": bool(taken),
    }


def drawn_maps(sources: LightSources, seed: int) -> tuple[DrawnMap, ...]:
    """List the maps of `procedural:N`; if it is there several times, the largest N counts."""
    words = [entry for entry in sources.envmap or () if entry.startswith(DRAWN)]
    if not words:
        return ()
    from facerf_cli.synth.sky.skies import kind_of, parse_envmaps

    most = max(len(parse_envmaps(word, seed)) for word in words)
    if most > MOST_FRAMES:
        raise UsageError(f"--envmap {DRAWN}{most}: too many maps; use {MOST_FRAMES} at most")
    folder = _cached("maps", f"{RESULTS_VERSION}-{seed}")
    return tuple(
        DrawnMap(folder / f"{index:05d}_{kind_of(index, seed)}.exr", index, seed) for index in range(most)
    )


def photo_lights(
    sources: LightSources, how: LightOptions, background: Path | None, output: Path, digest_of: DigestOf
) -> tuple[PhotoLight, ...]:
    """List the lights of photos that --light-from names, each once.

    Args:
        sources: The options.
        how: How the lights are estimated.
        background: The background image.
        output: The output folder, which is not searched for photos.
        digest_of: Returns the SHA-256 of a photo or a network.
    """
    entries = dict.fromkeys(sources.light_from or ())
    if not entries:
        return ()
    options = replace(how, fov_deg=sources.fov_deg)
    recipe = recipe_of(options, digest_of)

    def light(photo: Path, name: str, layer: str = "", is_background: bool = False) -> PhotoLight:
        folder = _cached("lights", key_of(recipe | {"photo": digest_of(photo)}))
        path = folder / f"{name}{LIGHT_ENDING}.exr"
        return PhotoLight(path, photo, options, is_background, layer=layer)

    lights, unnamed = [], []
    for layer, path in map(named_entry, entries):
        if path == BACKGROUND:
            if background is None:
                raise UsageError(
                    "--light-from background: there is no background image; add --background FILE, or write "
                    "./background for a file of that name"
                )
            lights.append(light(background, split_frame(background.stem)[0], layer, is_background=True))
        elif layer:
            (item,) = collect_items([path], Path(), PHOTO_SUFFIXES)
            lights.append(light(item.input_path, Path(item.name).name, layer))
        else:
            unnamed.append(path)
    items = collect_items(unnamed, output, PHOTO_SUFFIXES) if unnamed else []
    lights += [light(item.input_path, name) for item, name in zip(items, short_names(items), strict=True)]
    return tuple(lights)


def _cached(*parts: str) -> Path:
    from facerf_cli.files.downloads import cache_folder  # --help does without it

    return cache_folder().joinpath(*parts)
