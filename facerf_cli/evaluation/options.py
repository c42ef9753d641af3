"""The options of `facerf evaluate`, a class for each protocol; light to import."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import NOT_IN_RECIPE, BatchOptions
from facerf_cli.errors import UsageError
from facerf_cli.option import DATA, MEASURES, METHODS, Only, option
from facerf_cli.work.photo_options import FieldOptions, SolveOptions

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


def _kinds(*default: RelightKind) -> Any:
    """Make the field of `--reflectance`."""
    return option(
        default,
        metavar="KIND",
        shown_default=default[0] if default else "none",
        typed=list[str] | None,
        parse=_parse_kinds,
        panel=METHODS,
    )


@dataclass(frozen=True)
class EvaluateOptions(BatchOptions):
    """The methods and the measures of a run; protocols that offer the other fields declare them again.

    Attributes:
        reflectance: Measure field, diffuse-sh, specular-sh or prt, of whole photos also portrait;
            repeatable, and the others are compared with the first.
        against: Measure another checkpoint of the field, under its name or that of its run. Repeatable.
        pictures: Keep every source, truth, mask and prediction as EXR in DIR/pictures, for `compare`.
    """

    reflectance: tuple[RelightKind, ...] = _kinds("field")
    against: tuple[NamedPath, ...] = _named("--against", "FILE")
    measures: Measures = Measures()
    pictures: bool = option(False, panel=MEASURES)
    name: None = None  # protocols name their items
    methods: tuple[NamedPath, ...] = ()
    keep_eyes: bool = False
    joint_fit: bool = False
    network_alone: bool = True  # the photo does not correct the field
    non_negative: bool = True  # the light's least squares
    refine: str = "none"
    facts: Path | None = None
    mean_checkpoint: Path | None = None
    dataset: Path | None = field(default=None, metadata=NOT_IN_RECIPE)  # None: photos
    truth: Path = field(default=Path(), metadata=NOT_IN_RECIPE)  # of `compare`

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
        if self.measures.lpips is not None and self.measures.vgg_weights is None:
            raise UsageError("--lpips: needs VGG-16; add --vgg-weights imagenet, or a file of its weights")


@dataclass(frozen=True)
class FaceOptions(EvaluateOptions):
    """Options of protocols that compare faces of a prepared dataset, alone in their crops.

    Attributes:
        split: Measure this split of DATASET; all if no network was trained on it.
        every: Measure every Nth pair of DATASET's split only.
        preset: Measure as many images as the paper did.
        joint_fit: Use the heads of DATASET, which are fitted to all calibrated cameras of a person at once,
            instead of each image alone.
        keep_eyes: Compare open eyes, too (default: not, as in the paper).
    """

    split: Literal["train", "validation", "test", "all"] = option("test", panel=DATA, everyday=True)
    every: int = option(1, metavar="N", least=1, panel=DATA)
    preset: Literal["paper"] | None = option(None, shown_default="none", panel=MEASURES, everyday=True)
    joint_fit: bool = option(False, panel=DATA)
    keep_eyes: bool = option(False, panel=MEASURES)
    same_pose: bool = False

    def check(self) -> None:
        super().check()
        if self.preset and self.every > 1:
            raise UsageError(
                "--preset and --every exclude each other: a preset has a fixed number of images; leave one "
                "out"
            )


@dataclass(frozen=True)
class FactsOptions:
    """A list of images.

    Attributes:
        facts: Read a row for each image: name, person, and columns for the list of images; in `compare` those
            that are text break the tables down.
    """

    facts: Path | None = option(
        None, metavar="CSV", shown_default="a person is an image's topmost folder", panel=DATA
    )


@dataclass(frozen=True)
class OlatOptions(FieldOptions, FaceOptions):
    """Options of `evaluate olat`."""


@dataclass(frozen=True)
class ReconstructionOptions(SolveOptions, FactsOptions, FaceOptions):
    """Options of `evaluate reconstruction`."""


@dataclass(frozen=True)
class TransferOptions(SolveOptions, FaceOptions):
    """Options of `evaluate transfer`.

    Attributes:
        photos: Read photos, two of each person or in folders.
        held_to_photo: Correct the field by the quotient of its photo, as `relight` does.
    """

    photos: bool = option(False, in_recipe=False, flags=("--photos",), panel=DATA)
    held_to_photo: bool = option(False, flags=("--held-to-photo",), panel=METHODS)


@dataclass(frozen=True)
class GeometryOptions(FactsOptions, FaceOptions):
    """Options of `evaluate geometry`.

    Attributes:
        mean_checkpoint: Use a checkpoint of `facerf train --mean-face` for the mean face.
    """

    against: tuple[NamedPath, ...] = ()
    joint_fit: bool = False
    mean_checkpoint: Path | None = option(
        None, metavar="FILE", shown_default="that of the fitted face", panel=METHODS
    )


@dataclass(frozen=True)
class CasesOptions(FaceOptions):
    """Options of `evaluate cases`, which keeps every image and measures none.

    Attributes:
        same_pose: Take the pairs alone whose target camera is that of the source.
    """

    same_pose: bool = option(False, flags=("--same-pose",), panel=DATA)
    reflectance: tuple[RelightKind, ...] = ()
    against: tuple[NamedPath, ...] = ()
    measures: Annotated[Measures, Only()] = Measures()
    pictures: bool = False
    joint_fit: bool = True


@dataclass(frozen=True)
class YaleOptions(FieldOptions, EvaluateOptions):
    """Options of `evaluate yale-b`.

    Attributes:
        shifts: Align images by rows subject,light,dy,dx: pixels down and right that move an image onto its
            subject's frontal one.
        subjects: Measure these subjects only, such as yaleB05,yaleB15. Repeatable.
        room: Light from all around that comes with each flash, as a room sends it back: a share of it.
    """

    reflectance: tuple[RelightKind, ...] = _kinds("portrait")
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


@dataclass(frozen=True)
class CompareOptions(FieldOptions, FactsOptions, EvaluateOptions):
    """Options of `evaluate compare`.

    Attributes:
        methods: Measure a folder of images (.exr .hdr .npy, linear; .png .jpg .tif ...) with the truths'
            names. Repeatable.
        masks: Compare inside masks: images with the truths' names, white inside.
    """

    reflectance: tuple[RelightKind, ...] = _kinds()
    methods: tuple[NamedPath, ...] = _named("--method", "DIR")
    masks: Path | None = option(
        None, metavar="DIR", shown_default="those of CASES, the truths' alpha, else everything", panel=DATA
    )
    pictures: bool = False

    def check(self) -> None:
        super().check()
        if not self.names:
            raise UsageError("compare: no method; give --method NAME=FOLDER, or --reflectance field")
        for read in (*(one.path for one in self.methods), self.truth, self.masks):
            if read and not read.is_dir():
                raise UsageError(f"{read}: no such folder; give one that exists")
            if read and Path(os.path.realpath(self.output)).is_relative_to(os.path.realpath(read)):
                raise UsageError(f"-o {self.output}: lies in {read}, which is read; give another folder")


@dataclass(frozen=True)
class Chosen:
    """The content of a run: what each item holds, and files that shape the figures beside the items' own.

    `groups` counts the sources or couples of a dataset; those without a face are missing in the tables.
    """

    items: Mapping[Item, Any] = field(metadata=NOT_IN_RECIPE)
    files: tuple[Path, ...] = ()
    groups: int | None = field(default=None, metadata=NOT_IN_RECIPE)
