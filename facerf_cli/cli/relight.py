"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

import itertools
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, files_read, refuse_read
from facerf_cli.batch.made_from import FolderIndex
from facerf_cli.batch.run import BatchOptions, Outcome, all_finished, print_path, run_items
from facerf_cli.cli.options import FramesArgument, is_default, refuse_given
from facerf_cli.errors import UsageError
from facerf_cli.option import Without
from facerf_cli.work.light_setups import LightSetup, LightSources
from facerf_cli.work.output_options import NEEDS, STDOUT, check_stdout, format_of_file
from facerf_cli.work.relight_options import Relight
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, film_output


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
    work: Relight,
    shots: ShotOptions,
    batch: Annotated[BatchOptions, Without("output", "name")],
) -> None:
    """Relight photos, or OLAT stacks, under environment maps and single lights.

    Each image is a scene-linear EXR with the matte as layer person.A, and a PNG at --exposure.
    A background that keeps its look has its own values in the EXR at --exposure 0, else those over 2^EV.
    A film, or images with --sequence, is one shot between cuts: one identity, and one light by which the
    field is corrected; frames steady each other's pose, expression and matte. -o FILE.mp4 or
    FILE.mov joins frames to a film, with the sound of the film that they come from.

    -o - writes one image to standard output. A stack is relit by its own lights: --lights does not apply, and
    --light between them is a sum of the three around it.
    """
    file, formats = format_of_file(output), work.output.formats
    film = None if file else film_output(output, work.fps)
    if file is not None:
        formats = (file,) if is_default(context, "formats") else formats
        refuse_given(context, ("ball", "name", "fps"), f"is not for -o {output}, one image; leave it out")
        work, output = work.into_file(output, file, formats), output.parent
    elif film is not None:
        refuse_given(context, ("formats", "ball", "name"), f"is not for -o {output}; leave it out")
        formats, output = film.formats, film.folder
    elif output == STDOUT:
        refuse_given(context, ("ball", "dry_run"), "is not for -o -, which writes one image; leave it out")
        if is_default(context, "formats"):
            formats = ("png",)
    for name, needed in NEEDS.items():
        if not set(needed) & set(formats):
            refuse_given(context, (name,), f"is for {', '.join(needed)}; add that to --format")
    work = replace(work, output=replace(work.output, formats=formats))
    batch = replace(batch, output=output, name=work.name)
    work = work.checked(sources, batch, film)
    if output == STDOUT:
        _write_to_stdout(inputs, work)
        return
    if work.ball and not work.maps:
        raise UsageError("--ball: shows maps; give --envmap, or leave it out")
    items, taken = collect_frames(inputs, shots, batch, work.photo)
    if work.photo_of_stack is not None and not _holds_a_stack(items):
        raise UsageError("--photo: is for OLAT stacks, and no input is one; leave it out")
    batch = replace(batch, in_a_row=FRAMES_IN_A_ROW if taken else 1, print_outputs=film is None)
    work = replace(work.with_leaders(items), shots=Shots(taken))
    work.refuse_meeting(items)
    images = [path for item in items for path in work.outputs_of(item)]
    balls = [path for setup in work.maps if work.ball for path in _balls_of(setup, work, output)]
    refuse_read([film.path] if film else images + balls, files_read((items, work, sources), items))
    key = film.key_of_new(items, taken, images, work.recipes_of, batch) if film else ""
    if film is not None and not key:
        return
    index = FolderIndex(output, "relight", batch.shard, work.recipes_of)
    usable, finished = work, all_finished(items, work.outputs_of, batch, index)
    index.edited.clear()  # they are judged again
    if not finished:
        usable = work.readable(batch.dry_run)
        index.want(usable.recipes_of)
    process, settings = partial(_relit, usable), work.photo.settings
    code = run_items("relight", items, process, usable.outputs_of, batch, settings, index=index)
    if film is not None:
        raise typer.Exit(film.joined(images, taken, key, code))
    if work.ball and not batch.dry_run and batch.shard.number == 1:
        _write_balls(usable, batch)
    raise typer.Exit(max(code, int(len(usable.setups) < len(work.setups))))


def _relit(work: Relight, item: Item) -> Outcome:
    """Relight an item under the lights of its stale images."""
    from facerf_cli.work.relight import relight_item

    return relight_item(item, work.for_stale(item))


def _holds_a_stack(items: Sequence[Item]) -> bool:
    from facerf_cli.files.olat_stack import is_olat_stack

    return any(is_olat_stack(item.input_path) for item in items)


def _write_to_stdout(inputs: Sequence[str], work: Relight) -> None:
    """Write the one image of one photo as bytes; raises UsageError where there are several."""
    with tempfile.TemporaryDirectory() as folder:
        items = collect_items(inputs, Path(folder), PHOTO_SUFFIXES)
        images = len(items) * len(work.setups)
        check_stdout(images if work.photo.face != "all" else 2 * images, work.output.formats)
        (path,) = _relit(work.readable(False), items[0]).outputs
        sys.stdout.buffer.write(path.read_bytes())
        sys.stdout.buffer.flush()


def _balls_of(setup: LightSetup, work: Relight, folder: Path) -> list[Path]:
    """The files of the balls under a map, of each format."""
    return [folder / "balls" / f"{setup.name}{setup.frame}{suffix}" for suffix in work.output.suffixes]


def _write_balls(work: Relight, options: BatchOptions) -> None:
    """Write the balls under each map to `balls/NAME` in each format, unless they are there."""
    files = {setup: _balls_of(setup, work, options.output) for setup in work.maps}
    always = options.overwrite == "always"
    missing = [setup for setup, paths in files.items() if always or not all(map(Path.exists, paths))]
    if missing:
        from facerf_cli.work.lights import readable, write_balls

        drawn = readable(missing)
        write_balls(drawn, [files[setup][0] for setup in drawn], work.exposure_rule, work.output)
        for path in itertools.chain.from_iterable(files[setup] for setup in drawn):
            print_path(path)
