"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Self

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, NamePattern, collect_items, files_read, refuse_read
from facerf_cli.batch.recipe import DigestOf, Recipe
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.cli.options import FramesArgument, is_default, refuse_given
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.option import Without
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.light_setups import LightSources
from facerf_cli.work.output_options import NEEDS, STDOUT, SUFFIXES, check_stdout, format_of_file
from facerf_cli.work.photo_options import networks_of
from facerf_cli.work.relight_options import RelightOptions, RelightPlan, plan_relight
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, film_output
from facerf_cli.work.verbs import PHOTOS_A_PROCESS, FileOrFolder

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class RelightJob(Job):
    """The images of a plan, as a batch makes them."""

    plan: RelightPlan
    verb = "relight"
    items_a_process = PHOTOS_A_PROCESS

    def outputs_of(self, item: Item) -> list[Path]:
        """A file of each format for each setup."""
        return self.plan.outputs_of(item)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of each file."""
        return self.plan.recipes_of(digest_of)

    def ready(self, dry_run: bool) -> Self:
        """Load the models, and keep the setups whose maps can be read.

        A dry run loads no networks, and so estimates no light of a photo.
        """
        from facerf_cli.files.image_metadata import read_header
        from facerf_cli.work.lights import readable
        from facerf_cli.work.outputs import check_output
        from facerf_cli.work.photos import prepare_photos

        check_output(self.plan.options.output)
        background = self.plan.options.background
        for picture in (*background.frames[:1], background.path):
            if picture and picture.is_file() and read_header(picture) is None:
                raise UsageError(f"--background {picture}: not a readable image; pass an image")
        photos = self.plan.photos
        uses = networks_of([self.plan.options.reflectance])
        uses = uses.union(*(photo.options.networks for photo in photos))
        prepare_photos(self.plan.photo, uses, with_networks=not dry_run)
        if self.plan.shots.all and not dry_run:
            from facerf_cli.work.sequence import follow_all

            follow_all(self.plan.shots.all, self.plan.photo)
        if dry_run and not all(photo.envmap.is_file() for photo in photos):
            return self
        setups = readable(self.plan.setups)
        if not setups:
            raise FacerfError("none of the maps serves; give others, or procedural:8 to draw some")
        return (
            self
            if len(setups) == len(self.plan.setups)
            else replace(self, plan=replace(self.plan, setups=setups))
        )

    @property
    def process(self) -> Callable[[Item], Outcome]:
        """Relights an item."""
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
            help="Write the results to this folder; one image to this file (.exr, .png, .jpg, .tif); or one "
            "film as .mp4 (H.264) or .mov (ProRes).",
            show_default=False,
        ),
    ],
    sources: LightSources,
    options: RelightOptions,
    shots: ShotOptions,
    batch: Annotated[FileOrFolder, Without("output", "name")],
) -> None:
    """Relight photos, or OLAT stacks, under environment maps and single lights.

    Each image is a scene-linear EXR with the person's matte as layer person.A, and a PNG that is exposed to
    be seen; -o FILE is one image alone. A background that keeps its look has its own values in the EXR at
    --exposure 0, else those over 2^EV. A film, or images with --sequence, is one shot between cuts: one
    identity, in one light; frames steady each other's pose, expression and matte. -o FILE.mp4 or FILE.mov
    joins frames to a film, with the sound of the film that they come from.

    -o - writes one image to standard output. A stack is relit by its own lights: --lights does not apply, and
    --light between them is a sum of the three around it.
    """
    file, formats = format_of_file(output), options.output.formats
    film = None if file else film_output(output, options.fps)
    if file is not None:
        formats = (file,) if is_default(context, "formats") else formats
        refuse_given(context, ("name", "fps"), f"is not for -o {output}, one image; leave it out")
        if [SUFFIXES[name] for name in formats] != [SUFFIXES[file]]:
            raise UsageError(f"-o {output}: is not what --format says; leave that out, or give a folder")
        one_file = replace(options.output, file_suffix=output.suffix)
        options = replace(options, output=one_file, name=NamePattern.literal(output.stem))
        batch = replace(batch, output=output).of_file()
        output = output.parent
    elif film is not None:
        refuse_given(context, ("formats", "name", "report"), f"is not for -o {output}; leave it out")
        formats, output = film.formats, film.folder
    elif output == STDOUT:
        refuse_given(context, ("dry_run", "report"), "is not for -o -, which writes one image; leave it out")
        if is_default(context, "formats"):
            formats = ("png",)
    for name, needed in NEEDS.items():
        if not set(needed) & set(formats):
            refuse_given(context, (name,), f"is for {', '.join(needed)}; add that to --format")
    options = replace(options, output=replace(options.output, formats=formats))
    plan = plan_relight(options, sources, output)
    has_alpha = plan.options.background.kind == "none" or plan.options.composite == "face"
    if film and has_alpha and not film.holds_alpha:
        raise UsageError(f"-o {film.path}: has no alpha; give FILE.mov, a folder, or --background COLOUR")
    if has_alpha and "jpg" in formats:
        log.warning("JPEG has no alpha, so the person is over black; use png, tiff or exr to keep alpha")
    if output == STDOUT:
        _write_to_stdout(inputs, plan)
        return
    batch = replace(batch, output=output, name=None if file else options.name)
    items, taken = collect_frames(inputs, shots, batch, plan.photo)
    if taken and options.normals_from is not None:
        raise UsageError("--normals-from: is for photos, not for frames of a shot; leave it out")
    plan = plan.of_items(items, Shots(taken), output)
    batch = replace(batch, in_a_row=FRAMES_IN_A_ROW if taken else 1, print_outputs=film is None)
    images = [path for item in items for path in plan.outputs_of(item)]
    refuse_read([film.path] if film else images, files_read((items, plan, sources), items))
    for photo in () if batch.dry_run else plan.photos:  # before keys of outputs, which hold the maps' content
        photo.estimate()
    recipe = film.recipe_if_new(items, taken, images, plan.recipes_of, batch) if film else ""
    if film is not None and not recipe:
        return
    code = run_items(RelightJob(plan), items, batch, plan.photo.settings)
    if film is not None:
        code = film.joined(items, images, taken, recipe, code)
    raise typer.Exit(code)


def _write_to_stdout(inputs: Sequence[str], plan: RelightPlan) -> None:
    """Write the one image of one photo as bytes; raises UsageError where there are several."""
    with tempfile.TemporaryDirectory() as folder:
        items = collect_items(inputs, Path(folder), PHOTO_SUFFIXES)
        images = len(items) * len(plan.setups)
        check_stdout(images if plan.photo.face != "all" else 2 * images, plan.options.output.formats)
        plan = plan.of_items(items, Shots(), output=Path(folder))
        for photo in plan.photos:
            photo.estimate()
        (path,) = RelightJob(plan).ready(dry_run=False).process(items[0]).outputs
        sys.stdout.buffer.write(path.read_bytes())
        sys.stdout.buffer.flush()
