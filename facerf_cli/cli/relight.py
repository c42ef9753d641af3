"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import logging
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Self

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, NamePattern, collect_items, files_read, refuse_read
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.recipe import DigestOf, Recipe
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.cli.options import FramesArgument, is_default, refuse_given
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.files.texts import file_sha256
from facerf_cli.option import Without
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.light_setups import LightSources, PhotoLight
from facerf_cli.work.output_options import STDOUT, SUFFIXES, check_stdout, format_of_file
from facerf_cli.work.photo_options import networks_of
from facerf_cli.work.photo_work import PHOTOS_A_PROCESS, FileOrFolder
from facerf_cli.work.relight_options import RelightOptions, RelightPlan, plan_relight
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, video_output

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class RelightJob(Job):
    """Relights the items of a batch by a plan."""

    plan: RelightPlan
    verb = "relight"
    items_a_process = PHOTOS_A_PROCESS

    def outputs_of(self, item: Item) -> list[Path]:
        """List the files of an item: one per format and setup."""
        return self.plan.outputs_of(item)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """Return the recipe of each file."""
        return self.plan.recipes_of(digest_of)

    def ready(self, dry_run: bool) -> Self:
        """Load the models, follow the faces of shots, and leave out the setups with unreadable maps.

        A dry run neither loads networks, nor makes maps that are missing in the user's cache.
        """
        from facerf_cli.files.image_metadata import read_header
        from facerf_cli.light.over_rig import readable_setups
        from facerf_cli.work.outputs import check_output
        from facerf_cli.work.photos import prepare_photos

        plan, background = self.plan, self.plan.options.background
        check_output(plan.options.output)
        for image in (*background.frames[:1], background.path):
            if image and image.is_file() and read_header(image) is None:
                raise UsageError(f"--background {image}: not a readable image; pass an image")
        uses = networks_of([plan.options.reflectance]).union(
            *(made.options.networks for made in plan.cached if isinstance(made, PhotoLight))
        )
        prepare_photos(plan.photo, uses, with_networks=not dry_run)
        if plan.shots.all and not dry_run:
            from facerf_cli.work.sequence import follow_all

            follow_all(plan.shots.all, plan.photo)
        if dry_run and not all(made.envmap.is_file() for made in plan.cached):
            return self
        setups = readable_setups(plan.setups)
        if not setups:
            raise FacerfError("no map can be read; pass other maps, or procedural:8 to draw some")
        return self if len(setups) == len(plan.setups) else replace(self, plan=replace(plan, setups=setups))

    @property
    def process(self) -> Callable[[Item], Outcome]:
        """The function that relights an item."""
        from facerf_cli.work.relight import relight_item

        return partial(relight_item, self.plan)


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
    -o FILE writes a single image instead; -o - writes one image to standard output. Backgrounds that keep
    their look (photo, image, colour) are divided by 2^EV in the EXR; with --exposure 0 they keep their own
    values.

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
            (path,) = RelightJob(plan).ready(dry_run=False).process(items[0]).outputs
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
    code = run_items(RelightJob(plan), items, batch, plan.photo.settings)
    if video is not None:
        code = video.joined(items, written, taken, recipe, code)
    raise typer.Exit(code)
