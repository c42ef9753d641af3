"""Verbs that write a few files for each input: the options that their work takes. Light to import.

A class has the options of its verb as fields, is sent to the processes that take the items, and is part of
what the outputs' recipes hold. In the verb's file a subclass imports the work.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, only_item
from facerf_cli.batch.recipe import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.batch.settings import NOT_IN_RECIPE, BatchOptions, folder_not_file
from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.entries import parse_lights
from facerf_cli.option import IMAGE, LIGHT, METHOD, option
from facerf_cli.relighting import White
from facerf_cli.work.photo_options import (
    PhotoOptions,
    check_companion,
    network_alone_option,
    networks_of,
    normals_option,
    parse_pose,
    white_option,
)
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, recipe_of_shots


@dataclass(frozen=True)
class FileOrFolder(BatchOptions):
    """The contract of verbs of which one file may be wanted.

    Attributes:
        output: Write the results to this folder; or one of them, of one input, to this file, by its suffix.
    """

    output: Path = option(
        Path(),
        metavar="DIR|FILE",
        in_recipe=False,
        flags=("--output", "-o"),
        shown_default=False,
        required=True,
    )

    def of_file(self) -> Self:
        """The contract of the one file that `-o` names."""
        return replace(self, output=self.output.parent, file=self.output)


def end_of_file(output: Path, ends: Sequence[str]) -> str:
    """The end of the name of the result that `-o` wants as this file, by its suffix; '' for a folder.

    Raises UsageError for a file that has the suffix of none of the `ends` that may be written alone.
    """
    found = next((end for end in ends if output.suffix and end.endswith(output.suffix.lower())), "")
    if output.is_dir() or not found:
        folder_not_file(output, " or ".join(end[end.index(".") :] for end in ends))
        return ""
    return found


PHOTOS_A_PROCESS = 4  # take longer than its start
Written = tuple[Sequence[str], Mapping[str, Any]]  # tags of the faces that were written; facts for the report


@dataclass(frozen=True, kw_only=True)
class PhotoWork(Job):
    """A verb that writes files for each chosen face of a photo."""

    items_a_process = PHOTOS_A_PROCESS
    photo: PhotoOptions
    shots: Shots = field(default_factory=Shots, metadata=NOT_IN_RECIPE)
    alone: str = field(default="", metadata=NOT_IN_RECIPE)  # the suffix of the one file that -o names

    @property
    def endings(self) -> tuple[str, ...]:
        """Ends of the names of a face's files."""
        raise NotImplementedError

    @property
    def alone_as(self) -> tuple[str, ...]:
        """Those of them that may be written alone, to the file that `-o` names, one for each suffix."""
        return ()

    @property
    def networks(self) -> frozenset[str]:
        """Names of the networks that are used."""
        raise NotImplementedError

    def write(self, item: Item) -> Written:
        """Write the files of every chosen face."""
        raise NotImplementedError

    def checked(self) -> Self:
        """These options, with what depends on others; UsageError for what would fail every photo."""
        self.photo.check()
        return self

    def run(self, inputs: Sequence[str], batch: FileOrFolder, wanted: ShotOptions | None = None) -> int:
        """Process photos, and with `wanted` the frames of shots; return the exit code."""
        work, null_separated = self.checked(), self.photo.settings.null_separated
        if wanted is None:
            items = collect_items(inputs, batch.output, PHOTO_SUFFIXES, batch.name, null_separated)
            return work.run_on(items, batch)
        items, shots = collect_frames(inputs, wanted, batch, work.photo)
        batch = replace(batch, in_a_row=FRAMES_IN_A_ROW if shots else 1)
        return replace(work, shots=Shots(shots)).run_on(items, batch)

    def run_on(self, items: Sequence[Item], batch: FileOrFolder) -> int:
        """Process items; return the exit code."""
        if end_of_file(batch.output, self.alone_as):
            if batch.name is not None:
                raise UsageError(f"--name: is not for -o {batch.output}, one file; leave it out")
            item = only_item(items, batch.output, several=self.photo.face == "all")
            work = replace(self, alone=batch.output.suffix)
            return work.run_on([item], batch.of_file())
        return run_items(self, items, batch, self.photo.settings)

    def ready(self, dry_run: bool) -> Self:
        """Load what every photo needs, and follow the faces of shots."""
        from facerf_cli.work.photos import prepare_photos
        from facerf_cli.work.sequence import follow_all

        prepare_photos(self.photo, self.networks, with_networks=not dry_run)
        if not dry_run:
            follow_all(self.shots.all, self.photo)
        return self

    def files_of(self, item: Item, tag: str) -> list[Path]:
        """Every file of the face with a tag."""
        return [item.output(tag + ending) for ending in ([self.alone] if self.alone else self.endings)]

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return self.files_of(item, self.photo.first_tag)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots.all, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Write the files of an item."""
        if self.alone:
            return self._one_file(item)
        tags, facts = self.write(item)
        return Outcome([path for tag in tags for path in self.files_of(item, tag)], facts)

    def _one_file(self, item: Item) -> Outcome:
        """Write the files of an item out of sight, and keep one."""
        (path,) = self.outputs_of(item)
        with atomic_path(path) as temporary:
            apart = replace(item, output_base=temporary.parent / "all" / item.name)
            tags, facts = replace(self, alone="").write(apart)
            os.replace(apart.output(tags[0] + end_of_file(path, self.alone_as)), temporary)
        return Outcome([path], facts)


@dataclass(frozen=True, kw_only=True)
class PredictOlat(PhotoWork):
    """`facerf predict-olat`.

    Attributes:
        lights: Predict a uniform rig of N lights, or directions: a list in degrees, or a file (az,el or
            x y z; .lp).
        pose: Turn the head to a pose, in degrees.
        frame: Predict the whole person in the photo's frame; the face alone in that of its crop; or UV
            textures, which other poses can be rendered from.
        size_px: Scale larger photos down to this longer side, with --frame photo.
        precision: Compute the network in this precision; bf16 where the device has instructions for it.
        page: Write the web page of `facerf view`, _page.html, too.
    """

    lights: str = option("150", metavar="N|FILE|'AZ,EL;...'", panel=LIGHT)
    pose: str | None = option(None, metavar="YAW,PITCH,ROLL", shown_default="the photo's", panel=IMAGE)
    frame: Literal["photo", "face", "uv"] | None = option(
        None, shown_default="photo; face with --pose", panel=IMAGE
    )
    size_px: int = option(1024, metavar="PX", least=64, most=16384, panel=IMAGE)
    network_alone: bool = network_alone_option()
    white: White = white_option()
    normals_from: Path | None = normals_option()
    precision: Literal["float32", "bf16"] = option("float32", panel=METHOD)
    page: bool = option(False, panel=IMAGE)
    verb = "predict-olat"

    @property
    def endings(self) -> tuple[str, ...]:
        """Ends of the stack, its contact sheet and, if wanted, its page."""
        return ("_olat.exr", "_olat.png", *(["_page.html"] if self.page else []))

    @property
    def alone_as(self) -> tuple[str, ...]:
        """The stack."""
        return self.endings[:1]

    @property
    def networks(self) -> frozenset[str]:
        """The networks of the whole person, or of its face alone."""
        return networks_of(["portrait" if self.page or self.frame == "photo" else "field"])

    def checked(self) -> Self:
        """These options with their frame; UsageError for those that do not go together."""
        parse_lights(self.lights)
        parse_pose(self.pose)
        self.photo.check()
        if self.frame == "photo" and self.pose is not None:
            raise UsageError("--pose: turns the head out of its photo; use --frame face or uv with it")
        if self.page and (self.network_alone or self.pose is not None):
            raise UsageError(
                "--page: shows the photo's own pose and light; give neither --pose nor --network-alone"
            )
        check_companion(self.normals_from, "--normals-from")
        work = replace(self, frame=self.frame or ("photo" if self.pose is None else "face"))
        if self.normals_from is not None and work.frame != "photo":
            raise UsageError("--normals-from: is for the whole person; use --frame photo with it")
        return work


LARGEST_MAP_PX, MOST_ORDER = 8192, 20


def refuse_odd(name: str, width_px: int) -> None:
    """Raise UsageError for a map whose height is no whole number."""
    if width_px % 2:
        raise UsageError(f"{name} {width_px}: an odd width has no half; give an even number")
