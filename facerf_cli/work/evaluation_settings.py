"""The options that protocols of `facerf evaluate` share: groups of the command line, light to import."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.run import BatchOptions
from facerf_cli.errors import UsageError
from facerf_cli.evaluation import folder_name
from facerf_cli.option import DATA, MEASURES, METHODS, option


@dataclass(frozen=True)
class SplitOptions:
    """The images of a prepared dataset that are measured."""

    split: Literal["train", "validation", "test", "all"] = option(
        "test", "Measure this split of DATASET; all if no network was trained on it.", panel=DATA
    )
    every: int = option(1, "Measure every Nth pair of DATASET's split only.", "N", least=1, panel=DATA)
    joint_fit: bool = option(
        False,
        "Use the heads of DATASET, which are fitted to all calibrated cameras of a person at once, instead "
        "of each image alone.",
        panel=DATA,
    )


@dataclass(frozen=True)
class YaleOptions:
    """The images of Extended Yale B that are measured."""

    shifts: Path | None = option(
        None,
        "Align images by rows subject,light,dy,dx: pixels down and right that move an image onto its "
        "subject's frontal one.",
        "CSV",
        shown_default="no alignment",
        panel=DATA,
    )
    subjects: list[str] | None = option(
        None,
        "Measure these subjects only, such as yaleB05,yaleB15. Repeatable.",
        "NAME,...",
        in_recipe=False,  # an item is a subject
        shown_default="all",
        panel=DATA,
    )
    room: float = option(
        0.0,
        "Light from all around that comes with each flash, as a room sends it back: a share of it.",
        "SHARE",
        least=0.0,
        most=1.0,
        panel=DATA,
    )


@dataclass(frozen=True)
class PairsOptions:
    """The images that predictions are compared with."""

    truth: Path = option(
        ...,
        "Compare with the truths in this folder: .exr .hdr .npy (linear), .png .jpg .tif ...",
        "DIR",
        in_recipe=False,  # an item's input
        shown_default=False,
    )
    masks: Path | None = option(
        None,
        "Compare inside masks: images with the truths' names, white inside.",
        "DIR",
        shown_default="the truths' alpha, else everything",
        panel=DATA,
    )
    facts: Path | None = option(
        None,
        "Read a row for each image: name, person, and columns for the tables (text) or for the list of "
        "images (numbers).",
        "CSV",
        shown_default="a person is a truth's topmost folder",
        panel=DATA,
    )
    face_distance: bool = option(False, "Detect the truths' faces and measure Face dis, too.", panel=MEASURES)


@dataclass(frozen=True)
class EvaluateOptions(BatchOptions):
    """Settings of what is measured, by which methods, and where it goes, for other processes too."""

    reflectance: list[str] | None = option(  # typer has no lists of choices; None: field
        None,
        "Measure field, diffuse-sh, specular-sh or prt, of whole photos also portrait; repeatable, and the "
        "others are compared with the first.",
        "KIND",
        shown_default="field; of yale-b portrait",
        panel=METHODS,
    )
    against: list[Path] | None = option(
        None,
        "Measure another checkpoint of the field, named by its stem. Repeatable.",
        "FILE",
        shown_default="none",
        panel=METHODS,
    )
    compare: list[Path] | None = option(
        None,
        "Measure predictions of another method, DIR/CASE.exr, .png or .npy, under the folder's name. "
        "Repeatable.",
        "DIR",
        shown_default="none",
        panel=METHODS,
    )
    pictures: bool = option(
        False,
        "Keep every source, truth, mask and prediction as EXR in DIR/pictures, for other methods.",
        panel=MEASURES,
    )
    keep_eyes: bool = option(False, "Compare open eyes, too (default: not, as in the paper).", panel=MEASURES)
    space: Literal["linear", "display"] = option(
        "linear", "Measure scene-linear values, or values encoded by sRGB.", panel=MEASURES
    )
    lpips: Path | None = option(
        None,
        "Read the linear heads of LPIPS (v0.1, VGG) from a file.",
        "FILE",
        shown_default="where installed",
        panel=MEASURES,
    )
    vgg_weights: str | None = option(
        None,
        "Measure LPIPS, too, with VGG-16: imagenet downloads it; or a file.",
        "imagenet|PATH",
        shown_default="no LPIPS",
        panel=MEASURES,
    )
    preset: Literal["paper"] | None = option(
        None, "Measure as many images as the paper did.", shown_default="none", panel=MEASURES
    )

    @property
    def kinds(self) -> tuple[RelightKind, ...]:
        """The reflectance models that are measured; raises UsageError for a name of none."""
        names: dict[str, RelightKind] = {kind: kind for kind in get_args(RelightKind)}
        given = ["field"] if self.reflectance is None else self.reflectance
        if unknown := [name for name in given if name not in names]:
            raise UsageError(f"--reflectance {unknown[0]}: give {', '.join(names)}")
        return tuple(names[name] for name in given)

    @property
    def checkpoints(self) -> tuple[Path, ...]:
        """The checkpoints of `--against`."""
        return tuple(self.against or ())

    @property
    def folders(self) -> tuple[Path, ...]:
        """The folders of other methods' predictions."""
        return tuple(self.compare or ())

    @property
    def methods(self) -> tuple[str, ...]:
        """The names of all methods: reflectance models, checkpoints, and folders of predictions."""
        return (*self.kinds, *(path.stem for path in self.checkpoints), *map(folder_name, self.folders))

    @property
    def has_field(self) -> bool:
        """True if the neural field is among the methods."""
        return bool({"field", "portrait"} & set(self.kinds) or self.checkpoints)

    def check(self) -> None:
        """Raise UsageError for an option that would fail every item."""
        twice = sorted({name for name in self.methods if self.methods.count(name) > 1})
        if twice:
            raise UsageError(f"two methods have the name {twice[0]!r}; rename the file or folder of one")
        for path in self.checkpoints:
            if not path.is_file():
                raise UsageError(f"--against {path}: no such file; give one that exists")
        for folder in self.folders:
            if not folder.is_dir():
                raise UsageError(f"--compare {folder}: no such folder; give one that exists")
        self.require_output_apart(self.folders)
        if self.lpips is not None and self.vgg_weights is None:
            raise UsageError("--lpips: needs VGG-16; add --vgg-weights imagenet, or a file of its weights")

    def require_output_apart(self, folders: Iterable[Path]) -> None:
        """Raise UsageError for an output folder inside one that is read: the next run would read it, too."""
        for folder in folders:
            if Path(os.path.realpath(self.output)).is_relative_to(os.path.realpath(folder)):
                raise UsageError(f"-o {self.output}: lies in {folder}, which is read; give another folder")
