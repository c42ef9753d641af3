"""Commands that write files for each face of a photo: their common work and options. Light to import.

A command's options are fields of a subclass of `PhotoWork`, which is sent to worker processes and is part of
the outputs' recipes. The subclass in `cli/` imports the heavy modules when it writes.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, only_item
from facerf_cli.batch.recipe import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.batch.settings import NOT_IN_RECIPE, OUTPUT, BatchOptions, folder_not_file
from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.entries import parse_lights
from facerf_cli.option import IMAGE, LIGHT, METHOD, option
from facerf_cli.work.photo_options import (
    FieldOptions,
    PhotoOptions,
    PortraitOptions,
    check_companion,
    networks_of,
    parse_pose,
    refuse,
)
from facerf_cli.work.shots import FRAMES_IN_A_ROW, ShotOptions, Shots, collect_frames, recipe_of_shots

PHOTOS_A_PROCESS = 4  # from this number on, another worker saves time
Written = tuple[Sequence[str], Mapping[str, Any]]  # tags of the written faces; facts for the report


@dataclass(frozen=True)
class FileOrFolder(BatchOptions):
    """The batch options of commands that can also write a single file.

    Attributes:
        output: Output folder; or a file for one result of one input, chosen by its suffix.
    """

    output: Path = option(Path(), metavar="DIR|FILE", **OUTPUT)

    def of_file(self) -> Self:
        """Return the options of a run that writes only the file that `-o` names."""
        return replace(self, output=self.output.parent, file=self.output)


def ending_of_file(output: Path, endings: Sequence[str]) -> str:
    """Return the ending with the suffix of the file that `-o` names; '' for a folder.

    Raises UsageError for a file with another suffix.
    """
    matches = (end for end in endings if output.suffix and end.endswith(output.suffix.lower()))
    if not output.is_dir() and (ending := next(matches, "")):
        return ending
    folder_not_file(output, " or ".join(end[end.index(".") :] for end in endings))
    return ""


@dataclass(frozen=True, kw_only=True)
class PhotoWork(Job):
    """A command that writes files for each chosen face of a photo.

    Subclasses set `verb`, the `endings` of a face's files, which of them `-o` may name as a single file
    (`file_endings`), and the `networks` that they use.
    """

    items_a_process = PHOTOS_A_PROCESS
    photo: PhotoOptions
    shots: Shots = field(default_factory=Shots, metadata=NOT_IN_RECIPE)
    file_suffix: str = field(default="", metadata=NOT_IN_RECIPE)  # suffix of the single file that -o names

    @property
    def endings(self) -> tuple[str, ...]:
        raise NotImplementedError

    @property
    def file_endings(self) -> tuple[str, ...]:
        return ()

    @property
    def networks(self) -> frozenset[str]:
        raise NotImplementedError

    def write(self, item: Item) -> Written:
        """Write the files of every chosen face."""
        raise NotImplementedError

    def checked(self) -> Self:
        """Return the options with dependent defaults; raise UsageError if they would fail every photo."""
        self.photo.check()
        return self

    def run(self, inputs: Sequence[str], batch: FileOrFolder, frames: ShotOptions | None = None) -> int:
        """Process photos and, if `frames` is given, frames of shots; return the exit code."""
        work, null_separated = self.checked(), self.photo.settings.null_separated
        if frames is None:
            items = collect_items(inputs, batch.output, PHOTO_SUFFIXES, batch.name, null_separated)
            return work.run_on(items, batch)
        items, shots = collect_frames(inputs, frames, batch, work.photo)
        batch = replace(batch, in_a_row=FRAMES_IN_A_ROW if shots else 1)
        return replace(work, shots=Shots(shots)).run_on(items, batch)

    def run_on(self, items: Sequence[Item], batch: FileOrFolder) -> int:
        """Process items; return the exit code."""
        if ending_of_file(batch.output, self.file_endings):
            if batch.name is not None:
                raise UsageError(f"--name: not supported with -o {batch.output}; remove it")
            item = only_item(items, batch.output, several=self.photo.face == "all")
            work = replace(self, file_suffix=batch.output.suffix)
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
        """Return the files of one face, by its tag."""
        endings = (self.file_suffix,) if self.file_suffix else self.endings
        return [item.output(tag + ending) for ending in endings]

    def outputs_of(self, item: Item) -> list[Path]:
        """Return the files of an item's first face."""
        return self.files_of(item, self.photo.first_tag)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots.all, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        if not self.file_suffix:
            tags, facts = self.write(item)
            return Outcome([path for tag in tags for path in self.files_of(item, tag)], facts)
        (path,) = self.outputs_of(item)
        with atomic_path(path) as temporary:  # write all files to a hidden folder, and keep one
            hidden = replace(item, output_base=temporary.parent / "all" / item.name)
            tags, facts = replace(self, file_suffix="").write(hidden)
            os.replace(hidden.output(tags[0] + ending_of_file(path, self.file_endings)), temporary)
        return Outcome([path], facts)


@dataclass(frozen=True, kw_only=True)
class PageWork(PhotoWork, PortraitOptions):
    """A command that writes pages of `facerf view`; `size_px` is the longer side of the photo in a page."""

    size_px: int


@dataclass(frozen=True, kw_only=True)
class PredictOlat(PageWork, FieldOptions):
    """`facerf predict-olat`.

    Attributes:
        lights: Lights to predict: the number of a uniform rig, a list in degrees, or a file of directions
            (az,el or x y z; .lp).
        pose: Head pose, in degrees.
        frame: Frame of the images: photo (the whole person), face (only the face, in its crop), or uv
            (textures that can be rendered in other poses).
        size_px: Longer side to scale larger photos down to, with --frame photo.
        precision: Precision of the network; bf16 is faster on devices with instructions for it.
        page: Also write the web page of facerf view, _page.html.
    """

    lights: str = option("150", metavar="N|FILE|'AZ,EL;...'", panel=LIGHT)
    pose: str | None = option(None, metavar="YAW,PITCH,ROLL", shown_default="the photo's", panel=IMAGE)
    frame: Literal["photo", "face", "uv"] | None = option(
        None, shown_default="photo; face with --pose", panel=IMAGE
    )
    size_px: int = option(1024, metavar="PX", least=64, most=16384, panel=IMAGE)
    precision: Literal["float32", "bf16"] = option("float32", panel=METHOD)
    page: bool = option(False, panel=IMAGE)
    verb = "predict-olat"
    file_endings = ("_olat.exr",)

    @property
    def endings(self) -> tuple[str, ...]:
        return ("_olat.exr", "_olat.png", *(["_page.html"] if self.page else []))

    @property
    def networks(self) -> frozenset[str]:
        return networks_of(["portrait" if self.page or self.frame == "photo" else "field"])

    def checked(self) -> Self:
        parse_lights(self.lights)
        parse_pose(self.pose)
        check_companion(self.normals_from, "--normals-from")
        posed = self.pose is not None
        work = replace(super().checked(), frame=self.frame or ("face" if posed else "photo"))
        refuse(
            {
                "--pose: turns the head away from its photo; use --frame face or uv": (
                    posed and work.frame == "photo"
                ),
                "--page: shows the photo's own pose and light; remove --pose and --network-alone": (
                    self.page and (self.network_alone or posed)
                ),
                "--normals-from: requires the whole person; use --frame photo": (
                    self.normals_from is not None and work.frame != "photo"
                ),
            }
        )
        return work
