"""Options of the commands of `facerf evaluate`, one dataclass per protocol.

This module imports neither torch nor numpy, because the help reads it.
"""

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
    """Return a method's name: the folder, the file's stem, or for best and last checkpoints the run's folder.

    '.' is resolved; links are not.
    """
    path = Path(os.path.abspath(path))
    if path.is_dir():
        return path.name
    return path.parent.name if path.stem in ("best", "last") else path.stem


@dataclass(frozen=True)
class Measures:
    """Compared values and optional metrics.

    Attributes:
        space: Compare scene-linear values, or values encoded as sRGB.
        lpips: File with the linear heads of LPIPS (v0.1, VGG).
        vgg_weights: Also measure LPIPS, with the weights of VGG-16; imagenet downloads them.
        face_distance: Also measure Face dis in tables without it, for the methods and for the source
            (extra dlib).
    """

    space: Space = option("linear", panel=MEASURES)
    lpips: Path | None = option(None, metavar="FILE", shown_default="where installed", panel=MEASURES)
    vgg_weights: str | None = option(None, metavar="imagenet|PATH", shown_default="no LPIPS", panel=MEASURES)
    face_distance: bool = option(False, panel=MEASURES)


def _parse_kinds(names: Sequence[str]) -> tuple[RelightKind, ...]:
    if unknown := [name for name in names if name not in _KINDS]:
        raise UsageError(f"--reflectance {unknown[0]}: use {', '.join(_KINDS)}")
    return tuple(kind for name in names for kind in _KINDS if kind == name)


@dataclass(frozen=True)
class NamedPath:
    """Path of a checkpoint, a run or a folder of images, with the name of its method in the tables."""

    name: str
    path: Path

    @staticmethod
    def parse(text: str) -> "NamedPath":
        name, equals, path = text.rpartition("=")
        return NamedPath(name if equals else name_of(Path(path)), Path(path))


def _named(flag: str, kind: str) -> Any:
    return option(
        (),
        metavar=f"{kind}|NAME={kind}",
        flags=(flag,),
        shown_default="none",
        typed=list[str] | None,
        parse=lambda texts: tuple(map(NamedPath.parse, texts)),
        panel=METHODS,
    )


def _kinds(*default: RelightKind) -> Any:
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
    """Methods and metrics of a run. A protocol redeclares the other fields that it offers as options.

    Attributes:
        reflectance: Reflectance model to measure: field, diffuse-sh, specular-sh, prt, or for whole photos
            portrait. Repeatable; the others are compared with the first.
        against: Another checkpoint of the face field to measure, named after its file or run. Repeatable.
        pictures: Keep every source, ground truth, mask and prediction as EXR in DIR/pictures, for `compare`.
    """

    reflectance: tuple[RelightKind, ...] = _kinds("field")
    against: tuple[NamedPath, ...] = _named("--against", "FILE")
    measures: Measures = Measures()
    pictures: bool = option(False, panel=MEASURES)
    name: None = None  # protocols name their items
    methods: tuple[NamedPath, ...] = ()
    keep_eyes: bool = False
    joint_fit: bool = False
    network_alone: bool = True  # without the correction by the photo's ratio image
    non_negative: bool = True  # the light's least squares
    refine: str = "none"
    facts: Path | None = None
    mean_checkpoint: Path | None = None
    dataset: Path | None = field(default=None, metadata=NOT_IN_RECIPE)  # None: photos
    truth: Path = field(default=Path(), metadata=NOT_IN_RECIPE)  # the cases of `compare`

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all methods: reflectance models, checkpoints and folders of images."""
        return (*self.reflectance, *(method.name for method in (*self.against, *self.methods)))

    @property
    def renders(self) -> bool:
        """True if facerf renders the images of a method."""
        return bool(self.reflectance or self.against)

    @property
    def has_field(self) -> bool:
        """True if a method uses the neural face field."""
        return bool({"field", "portrait"} & set(self.reflectance) or self.against)

    def item(self, path: Path, name: str) -> Item:
        return Item(path, self.output / name, name)

    def check(self) -> None:
        """Raise UsageError for options that would fail every item, or that exclude each other."""
        if duplicates := sorted({name for name in self.names if self.names.count(name) > 1}):
            raise UsageError(f"two methods have the name {duplicates[0]!r}; rename one, or use NAME=PATH")
        for checkpoint in self.against:
            if not checkpoint.path.exists():
                raise UsageError(f"--against {checkpoint.path}: no such file; check the path")
        if self.measures.lpips is not None and self.measures.vgg_weights is None:
            raise UsageError("--lpips: needs VGG-16; add --vgg-weights imagenet, or a file of its weights")


@dataclass(frozen=True)
class FaceOptions(EvaluateOptions):
    """Options of the protocols that render and compare only the face, inside its crop.

    Attributes:
        split: Split of DATASET to measure; use all only if no network was trained on it.
        every: Measure only every Nth pair of DATASET's split.
        preset: Measure as many images as the paper did.
        joint_fit: Use the heads of DATASET, which are fitted to all calibrated cameras of a person at once,
            instead of fitting each image separately.
        keep_eyes: Also compare open eyes; the paper excludes them.
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
            raise UsageError("--preset fixes the number of images; remove --preset or --every")


@dataclass(frozen=True)
class FactsOptions:
    """Option of the protocols that read people and metadata of images from a file.

    Attributes:
        facts: CSV with one row per image: name, person, and additional columns for images.csv. In `compare`,
            text columns also break down the tables.
    """

    facts: Path | None = option(
        None, metavar="CSV", shown_default="a person is the image's topmost folder", panel=DATA
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
        photos: The inputs are photos: two per person, or one folder per person.
        held_to_photo: Correct the field with the photo's ratio image, like `relight`.
    """

    photos: bool = option(False, in_recipe=False, flags=("--photos",), panel=DATA)
    held_to_photo: bool = option(False, flags=("--held-to-photo",), panel=METHODS)


@dataclass(frozen=True)
class GeometryOptions(FactsOptions, FaceOptions):
    """Options of `evaluate geometry`.

    Attributes:
        mean_checkpoint: Checkpoint of `facerf train --mean-face` that renders the mean face.
    """

    against: tuple[NamedPath, ...] = ()
    joint_fit: bool = False
    mean_checkpoint: Path | None = option(
        None, metavar="FILE", shown_default="the checkpoint of the fitted face", panel=METHODS
    )


@dataclass(frozen=True)
class CasesOptions(FaceOptions):
    """Options of `evaluate cases`, which writes every image and measures none.

    Attributes:
        same_pose: Write only pairs whose source and target have the same camera.
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
        shifts: CSV of subject,light,dy,dx: pixels down and to the right that align an image with its
            subject's frontal image.
        subjects: Measure only these subjects, such as yaleB05,yaleB15. Repeatable.
        ambient: Uniform ambient light added to each flash, as a fraction of the flash.
    """

    reflectance: tuple[RelightKind, ...] = _kinds("portrait")
    shifts: Path | None = option(None, metavar="CSV", shown_default="no alignment", panel=DATA)
    subjects: tuple[str, ...] = option(
        (),
        metavar="NAME,...",
        in_recipe=False,
        shown_default="all",
        typed=list[str] | None,
        parse=lambda texts: tuple(name.strip() for text in texts for name in text.split(",") if name.strip()),
        panel=DATA,
    )
    ambient: float = option(0.0, metavar="SHARE", least=0.0, most=1.0, panel=DATA)


@dataclass(frozen=True)
class CompareOptions(FieldOptions, FactsOptions, EvaluateOptions):
    """Options of `evaluate compare`.

    Attributes:
        methods: Folder of images to measure (.exr .hdr .npy, linear; .png .jpg .tif ...), with the names of
            the ground truths. Repeatable.
        masks: Folder of masks with the names of the ground truths; white pixels are compared.
    """

    reflectance: tuple[RelightKind, ...] = _kinds()
    methods: tuple[NamedPath, ...] = _named("--method", "DIR")
    masks: Path | None = option(
        None, metavar="DIR", shown_default="the masks of CASES, else alpha, else all", panel=DATA
    )
    pictures: bool = False

    def check(self) -> None:
        super().check()
        if not self.names:
            raise UsageError("compare: no method; add --method NAME=FOLDER, or --reflectance field")
        for folder in (*(method.path for method in self.methods), self.truth, self.masks):
            if folder and not folder.is_dir():
                raise UsageError(f"{folder}: no such folder; check the path")
            if folder and Path(os.path.realpath(self.output)).is_relative_to(os.path.realpath(folder)):
                raise UsageError(f"-o {self.output}: lies in the input folder {folder}; use another folder")


@dataclass(frozen=True)
class Chosen:
    """Content of a run: the data of each item, and additional input files that the results depend on.

    `groups` is the number of sources or couples of a dataset; those without a face are missing in the tables.
    """

    items: Mapping[Item, Any] = field(metadata=NOT_IN_RECIPE)
    files: tuple[Path, ...] = ()
    groups: int | None = field(default=None, metadata=NOT_IN_RECIPE)
