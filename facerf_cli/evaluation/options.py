"""The options of `facerf evaluate`, of which each protocol has some; light to import."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import BatchOptions
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.option import DATA, MEASURES, METHODS, option

Space = Literal["linear", "display"]
_KINDS = get_args(RelightKind)


def name_of(path: Path) -> str:
    """The name of a method: a folder's, a checkpoint's, or for the best and the last of a run its folder's.

    '.' is resolved, a link is not.
    """
    path = Path(os.path.abspath(path))
    if path.is_dir():
        return path.name
    return path.parent.name if path.stem in ("best", "last") else path.stem


@dataclass(frozen=True)
class Measures:
    """The values and metrics of images; LPIPS is measured if VGG-16's weights are given.

    Attributes:
        space: Measure scene-linear values, or values encoded by sRGB.
        lpips: Read the linear heads of LPIPS (v0.1, VGG) from a file.
        vgg_weights: Measure LPIPS, too, with VGG-16: imagenet downloads it; or a file.
        face_distance: Measure Face dis, too, where no table of the paper has it (extra dlib), and that of the
            source, for comparison.
    """

    space: Space = option("linear", panel=MEASURES)
    lpips: Path | None = option(None, metavar="FILE", shown_default="where installed", panel=MEASURES)
    vgg_weights: str | None = option(None, metavar="imagenet|PATH", shown_default="no LPIPS", panel=MEASURES)
    face_distance: bool = option(False, panel=MEASURES)


def _parse_kinds(names: Sequence[str]) -> tuple[RelightKind, ...]:
    """The reflectance models of `--reflectance`; raises UsageError for a name of none."""
    if unknown := [name for name in names if name not in _KINDS]:
        raise UsageError(f"--reflectance {unknown[0]}: give {', '.join(_KINDS)}")
    return tuple(kind for name in names for kind in _KINDS if kind == name)


@dataclass(frozen=True)
class NamedPath:
    """A checkpoint, a run's folder or a folder of images, under the name of its method."""

    name: str
    path: Path

    @staticmethod
    def parse(text: str) -> "NamedPath":
        """Parse PATH or NAME=PATH."""
        name, equals, path = text.rpartition("=")
        return NamedPath(name if equals else name_of(Path(path)), Path(path))


def _named(flag: str, kind: str) -> Any:
    """Make the field of an option that names methods."""
    return option(
        (),
        metavar=f"{kind}|NAME={kind}",
        flags=(flag,),
        shown_default="none",
        typed=list[str] | None,
        parse=lambda given: tuple(map(NamedPath.parse, given)),
        panel=METHODS,
    )


@dataclass(frozen=True)
class EvaluateOptions(BatchOptions):
    """Options of all protocols: the images, the methods, the measures; those that one lacks are as here.

    Attributes:
        split: Measure this split of DATASET; all if no network was trained on it.
        every: Measure every Nth pair of DATASET's split only.
        same_pose: Take the pairs alone whose target camera is that of the source.
        joint_fit: Use the heads of DATASET, which are fitted to all calibrated cameras of a person at once,
            instead of each image alone.
        photos: Read photos, two of each person or in folders.
        shifts: Align images by rows subject,light,dy,dx: pixels down and right that move an image onto its
            subject's frontal one.
        subjects: Measure these subjects only, such as yaleB05,yaleB15. Repeatable.
        room: Light from all around that comes with each flash, as a room sends it back: a share of it.
        masks: Compare inside masks: images with the truths' names, white inside.
        facts: Read a row for each image: name, person, and columns for the list of images; in `compare` those
            that are text break the tables down.
        reflectance: Measure field, diffuse-sh, specular-sh or prt, of whole photos also portrait;
            repeatable, and the others are compared with the first.
        against: Measure another checkpoint of the field, under its name or that of its run. Repeatable.
        mean_checkpoint: Use a checkpoint of `facerf train --mean-face` for the mean face.
        held_to_photo: Correct the field by the quotient of its photo, as `relight` does.
        methods: Measure a folder of images (.exr .hdr .npy, linear; .png .jpg .tif ...) with the truths'
            names. Repeatable.
        pictures: Keep every source, truth, mask and prediction as EXR in DIR/pictures, for `compare`.
        keep_eyes: Compare open eyes, too (default: not, as in the paper).
        preset: Measure as many images as the paper did.
    """

    split: Literal["train", "validation", "test", "all"] = option("test", panel=DATA, everyday=True)
    every: int = option(1, metavar="N", least=1, panel=DATA)
    same_pose: bool = option(False, flags=("--same-pose",), panel=DATA)
    joint_fit: bool = option(False, panel=DATA)
    photos: bool = option(False, in_recipe=False, flags=("--photos",), panel=DATA)
    shifts: Path | None = option(None, metavar="CSV", shown_default="no alignment", panel=DATA)
    subjects: tuple[str, ...] = option(
        (),
        metavar="NAME,...",
        in_recipe=False,
        shown_default="all",
        typed=list[str] | None,
        parse=lambda given: tuple(name.strip() for text in given for name in text.split(",") if name.strip()),
        panel=DATA,
    )
    room: float = option(0.0, metavar="SHARE", least=0.0, most=1.0, panel=DATA)
    masks: Path | None = option(
        None, metavar="DIR", shown_default="those of CASES, the truths' alpha, else everything", panel=DATA
    )
    facts: Path | None = option(
        None, metavar="CSV", shown_default="a person is an image's topmost folder", panel=DATA
    )
    reflectance: tuple[RelightKind, ...] = option(
        ("field",),
        metavar="KIND",
        shown_default="field; of compare none; of yale-b portrait",
        typed=list[str] | None,
        parse=_parse_kinds,
        panel=METHODS,
    )
    against: tuple[NamedPath, ...] = _named("--against", "FILE")
    methods: tuple[NamedPath, ...] = _named("--method", "DIR")
    mean_checkpoint: Path | None = option(
        None, metavar="FILE", shown_default="that of the fitted face", panel=METHODS
    )
    held_to_photo: bool = option(False, flags=("--held-to-photo",), panel=METHODS)
    pictures: bool = option(False, panel=MEASURES)
    keep_eyes: bool = option(False, panel=MEASURES)
    measures: Measures = Measures()
    preset: Literal["paper"] | None = option(None, shown_default="none", panel=MEASURES, everyday=True)
    # What the command line fills in.
    network_alone: bool = True  # the photo does not correct the field
    non_negative: bool = True  # the light's least squares
    refine: str = "none"
    truth: Path | None = field(default=None, metadata=NOT_IN_RECIPE)  # the folder of `compare`
    dataset: Path | None = field(default=None, metadata=NOT_IN_RECIPE)  # None: photos

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all methods: reflectance models, checkpoints, and folders of images."""
        return (*self.reflectance, *(one.name for one in (*self.against, *self.methods)))

    @property
    def ours(self) -> bool:
        """True if facerf renders images of a method."""
        return bool(self.reflectance or self.against)

    @property
    def has_field(self) -> bool:
        """True if the neural field is among the methods."""
        return bool({"field", "portrait"} & set(self.reflectance) or self.against)

    def item(self, path: Path, name: str) -> Item:
        return Item(path, self.output / name, name)

    def check(self) -> None:
        """Raise UsageError for options that would fail every item, or that exclude each other."""
        if twice := sorted({name for name in self.names if self.names.count(name) > 1}):
            raise UsageError(f"two methods have the name {twice[0]!r}; rename one, or give NAME=PATH")
        for one in self.against:
            if not one.path.exists():
                raise UsageError(f"--against {one.path}: no such file; give one that exists")
        for read in (*(one.path for one in self.methods), self.truth, self.masks):
            if read and not read.is_dir():
                raise UsageError(f"{read}: no such folder; give one that exists")
            if read and Path(os.path.realpath(self.output)).is_relative_to(os.path.realpath(read)):
                raise UsageError(f"-o {self.output}: lies in {read}, which is read; give another folder")
        if self.measures.lpips is not None and self.measures.vgg_weights is None:
            raise UsageError("--lpips: needs VGG-16; add --vgg-weights imagenet, or a file of its weights")
        if self.preset and self.every > 1:
            raise UsageError(
                "--preset and --every exclude each other: a preset has a fixed number of images; leave one "
                "out"
            )


@dataclass(frozen=True)
class Chosen:
    """The content of a run: what each item holds, and files that shape the figures beside the items' own.

    `groups` counts the sources or couples of a dataset; those without a face are missing in the tables.
    """

    items: Mapping[Item, Any] = field(metadata=NOT_IN_RECIPE)
    files: tuple[Path, ...] = ()
    groups: int | None = field(default=None, metadata=NOT_IN_RECIPE)
