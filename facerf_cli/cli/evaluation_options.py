"""The options that the protocols of `facerf evaluate` share, each named and explained once."""

import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer

from facerf_cli.baselines import RelightKind
from facerf_cli.cli.options import (
    DryRunOption,
    JobsOption,
    OutputOption,
    Overwrite,
    OverwriteOption,
    refuse_given,
    was_given,
)
from facerf_cli.errors import UsageError
from facerf_cli.evaluation import folder_name

# Panels of a protocol's options in its help.
DATA, METHODS, MEASURES = "Data", "Methods", "Measures"

PredictionsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--compare",
        metavar="DIR",
        help="Measure predictions of another method, DIR/CASE.exr, .png or .npy, under the folder's name. "
        "Repeatable.",
        show_default="none",
        rich_help_panel=METHODS,
    ),
]
ReflectanceOption = Annotated[
    list[str] | None,  # typer has no lists of choices
    typer.Option(
        "--reflectance",
        metavar="KIND",
        help="Measure field, diffuse-sh, specular-sh or prt, of whole photos also portrait; repeatable, and "
        "the others are compared with the first.",
        show_default="field; of yale-b portrait",
        rich_help_panel=METHODS,
    ),
]
AgainstOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--against",
        metavar="FILE",
        help="Measure another checkpoint of the field, named by its stem. Repeatable.",
        show_default="none",
        rich_help_panel=METHODS,
    ),
]
PicturesOption = Annotated[
    bool,
    typer.Option(
        "--pictures",
        help="Keep every source, truth, mask and prediction as EXR in DIR/pictures, for other methods.",
        rich_help_panel=MEASURES,
    ),
]
KeepEyesOption = Annotated[
    bool,
    typer.Option(
        "--keep-eyes",
        help="Compare open eyes, too (default: not, as in the paper).",
        rich_help_panel=MEASURES,
    ),
]
SpaceOption = Annotated[
    Literal["linear", "display"],
    typer.Option(
        "--space", help="Measure scene-linear values, or values encoded by sRGB.", rich_help_panel=MEASURES
    ),
]
LpipsOption = Annotated[
    Path | None,
    typer.Option(
        "--lpips",
        metavar="FILE",
        help="Read the linear heads of LPIPS (v0.1, VGG) from a file.",
        show_default="where installed",
        rich_help_panel=MEASURES,
    ),
]
VggWeightsOption = Annotated[
    str | None,
    typer.Option(
        "--vgg-weights",
        metavar="imagenet|PATH",
        help="Measure LPIPS, too, with VGG-16: imagenet downloads it; or a file.",
        show_default="no LPIPS",
        rich_help_panel=MEASURES,
    ),
]
PresetOption = Annotated[
    Literal["paper"] | None,
    typer.Option(
        "--preset",
        help="Measure as many images as the paper did.",
        show_default="none",
        rich_help_panel=MEASURES,
    ),
]


DatasetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET",
        help="Folder of `facerf prepare-dataset`, with pairs of `facerf relight-dataset`.",
        show_default=False,
    ),
]
PhotosOrDatasetArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="PHOTO...|DATASET",
        help="Images, folders, - for a list on standard input; or a folder of `facerf prepare-dataset`.",
        show_default=False,
    ),
]
SplitOption = Annotated[
    Literal["train", "validation", "test", "all"],
    typer.Option(
        "--split",
        help="Measure this split of DATASET; all if no network was trained on it.",
        rich_help_panel=DATA,
    ),
]
EveryOption = Annotated[
    int,
    typer.Option(
        "--every",
        min=1,
        metavar="N",
        help="Measure every Nth pair of DATASET's split only.",
        rich_help_panel=DATA,
    ),
]
JointFitOption = Annotated[
    bool,
    typer.Option(
        "--joint-fit",
        help="Use the heads of DATASET, which are fitted to all calibrated cameras of a person at once, "
        "instead of each image alone.",
        rich_help_panel=DATA,
    ),
]

_CAPTURE_FILE, _DATASET_FILE = "stage.json", "dataset.json"
_OF_DATASETS = ("split", "every", "joint_fit")
_OF_PHOTOS = ("face", "landmarks", "input_colourspace")


@dataclass(frozen=True)
class EvaluateOptions:
    """The shared options, as the user gave them; settings only, so that it can go to other processes."""

    output: Path
    reflectance: tuple[RelightKind, ...] = ("field",)
    against: tuple[Path, ...] = ()
    compare: tuple[Path, ...] = ()
    pictures: bool = False
    keep_eyes: bool = False
    space: Literal["linear", "display"] = "linear"
    lpips: Path | None = None
    vgg_weights: str | None = None
    preset: Literal["paper"] | None = None
    jobs: int = 1
    overwrite: Overwrite = "changed"
    dry_run: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """The names of a protocol's predictions: those of the reflectance models and the checkpoints."""
        return (*self.reflectance, *(path.stem for path in self.against))

    def check(self) -> None:
        """Raise UsageError for an option that would fail every item."""
        names = [*self.methods, *map(folder_name, self.compare)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise UsageError(f"two methods have the name {twice[0]!r}; rename the file or folder of one")
        for path in self.against:
            if not path.is_file():
                raise UsageError(f"--against {path}: no such file; give one that exists")
        for folder in self.compare:
            if not folder.is_dir():
                raise UsageError(f"--compare {folder}: no such folder; give one that exists")
        self.require_output_apart(self.compare)
        if self.lpips is not None and self.vgg_weights is None:
            raise UsageError("--lpips: needs VGG-16; add --vgg-weights imagenet, or a file of its weights")

    def require_output_apart(self, folders: Iterable[Path]) -> None:
        """Raise UsageError for an output folder inside one that is read: the next run would read it, too."""
        for folder in folders:
            if Path(os.path.realpath(self.output)).is_relative_to(os.path.realpath(folder)):
                raise UsageError(f"-o {self.output}: lies in {folder}, which is read; give another folder")


def _evaluate_options(
    output: OutputOption,
    reflectance: ReflectanceOption = None,
    against: AgainstOption = None,
    compare: PredictionsOption = None,
    pictures: PicturesOption = False,
    keep_eyes: KeepEyesOption = False,
    space: SpaceOption = "linear",
    lpips: LpipsOption = None,
    vgg_weights: VggWeightsOption = None,
    preset: PresetOption = None,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> EvaluateOptions:
    """Collect the shared options; a command's signature ends with these parameters."""
    return EvaluateOptions(
        output,
        _kinds(reflectance or ["field"]),
        tuple(against or ()),
        tuple(compare or ()),
        pictures=pictures,
        keep_eyes=keep_eyes,
        space=space,
        lpips=lpips,
        vgg_weights=vgg_weights,
        preset=preset,
        jobs=jobs,
        overwrite=overwrite,
        dry_run=dry_run,
    )


def _kinds(given: Sequence[str]) -> tuple[RelightKind, ...]:
    found = []
    for name in given:
        kind = next((kind for kind in get_args(RelightKind) if kind == name), None)
        if kind is None:
            raise UsageError(f"--reflectance {name}: give {', '.join(get_args(RelightKind))}")
        found.append(kind)
    return tuple(found)


def only_dataset(inputs: Sequence[str]) -> Path | None:
    """The dataset of the inputs, or None for photos; raises UsageError for both, or for a capture."""
    for path in map(Path, inputs):
        if (path / _CAPTURE_FILE).is_file():
            raise UsageError(
                f"{path}: a capture, not a dataset; run prepare-dataset on it and give the result"
            )
    datasets = [path for path in map(Path, inputs) if (path / _DATASET_FILE).is_file()]
    if datasets and len(inputs) > 1:
        raise UsageError(f"{datasets[0]}: one dataset among several inputs; give it alone, or give photos")
    return datasets[0] if datasets else None


def refuse_for_others(context: typer.Context, photos: bool) -> None:
    """Raise UsageError for an option of datasets given with photos, or of photos given with a dataset."""
    names, kind = (_OF_DATASETS, "a prepared dataset") if photos else (_OF_PHOTOS, "photos")
    refuse_given(context, names, f"is for {kind}; leave it out here")


def measures_portraits(context: typer.Context, options: EvaluateOptions) -> EvaluateOptions:
    """The options of a protocol that measures whole portraits unless another model is asked for."""
    given = was_given(context, "reflectance")
    return options if given or options.against else replace(options, reflectance=("portrait",))


def refuse_without_field(context: typer.Context, options: EvaluateOptions, name: str) -> None:
    """Raise UsageError for an option of the field if that is not among the methods."""
    if not {"field", "portrait"} & set(options.reflectance) and not options.against:
        refuse_given(context, (name,), "is for the field; give --reflectance field too, or leave it out")


def no_part_of_preset(options: EvaluateOptions, every: int) -> None:
    """Raise UsageError where `--every` would reduce a preset."""
    if options.preset and every > 1:
        raise UsageError(
            "--preset and --every exclude each other: a preset has a fixed number of images; leave one out"
        )


def with_shared_options(command: Callable[..., int], left_out: Sequence[str] = ()) -> Callable[..., None]:
    """Add the shared options to a protocol's command, except those that it has no use for.

    The command takes its own parameters and `options: EvaluateOptions`, and returns the exit code. typer
    reads signatures, so the returned function has one that lists all parameters.
    """
    own = [p for name, p in inspect.signature(command).parameters.items() if name != "options"]
    of_all = inspect.signature(_evaluate_options).parameters
    shared = [parameter for name, parameter in of_all.items() if name not in left_out]

    def run(**values: Any) -> None:
        options = _evaluate_options(**{parameter.name: values.pop(parameter.name) for parameter in shared})
        if "reflectance" in left_out:
            options = replace(options, reflectance=())
        options.check()
        raise typer.Exit(command(**values, options=options))

    parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in [*own, *shared]]
    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    return run
