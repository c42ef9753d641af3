"""The options that every protocol of `facerf evaluate` has beside its own, named and explained once."""

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from facerf_cli.cli.options import DryRunOption, JobsOption, OutputOption, OverwriteOption
from facerf_cli.errors import UsageError
from facerf_cli.evaluation.case import folder_name

if TYPE_CHECKING:
    from facerf_cli.evaluation.measure import Measures

KindName = Literal["field", "diffuse-sh", "specular-sh", "prt"]  # as `baselines/base.py` has them
PredictionsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--compare",
        metavar="DIR",
        help="Predictions of another method, DIR/CASE.exr, .png or .npy; the folder's name is the method's. "
        "May be given several times.",
        show_default="none",
    ),
]
ReflectanceOption = Annotated[
    list[str] | None,  # typer has no lists of choices
    typer.Option(
        "--reflectance",
        metavar="KIND",
        help="field, diffuse-sh, specular-sh or prt; may be given several times, and the first is what "
        "the others are held against.",
        show_default="field",
    ),
]
AgainstOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--against",
        metavar="FILE",
        help="A further checkpoint of the field, named by its stem; may be given several times.",
        show_default="none",
    ),
]
PicturesOption = Annotated[
    bool,
    typer.Option(
        "--pictures",
        help="Keep every source, truth, mask and prediction as EXR in DIR/pictures, for other methods' use.",
    ),
]
KeepEyesOption = Annotated[
    bool, typer.Option("--keep-eyes", help="Compare open eyes too (default: out of the mask, as the paper).")
]
SpaceOption = Annotated[
    Literal["linear", "display"], typer.Option("--space", help="The values that metrics see.")
]
LpipsOption = Annotated[
    Path | None,
    typer.Option(
        "--lpips", metavar="FILE", help="LPIPS's linear heads (v0.1, VGG).", show_default="where installed"
    ),
]
VggWeightsOption = Annotated[
    str | None,
    typer.Option(
        "--vgg-weights",
        metavar="imagenet|PATH",
        help="Measure LPIPS too, by VGG-16: imagenet fetches it; or a file.",
        show_default="no LPIPS",
    ),
]
PresetOption = Annotated[
    Literal["paper"] | None,
    typer.Option("--preset", help="paper: as many pictures as the paper measured.", show_default="none"),
]


@dataclass(frozen=True)
class EvaluateOptions:
    """The shared options, as the user gave them; settings only, so that it can go to other processes."""

    output: Path
    reflectance: tuple[KindName, ...] = ("field",)
    against: tuple[Path, ...] = ()
    compare: tuple[Path, ...] = ()
    pictures: bool = False
    keep_eyes: bool = False
    space: Literal["linear", "display"] = "linear"
    lpips: Path | None = None
    vgg_weights: str | None = None
    preset: Literal["paper"] | None = None
    jobs: int = 1
    overwrite: bool = False
    dry_run: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """The reflectance models' and the checkpoints' names: what a protocol's predictions are called."""
        return (*self.reflectance, *(path.stem for path in self.against))

    def check(self) -> None:
        """Raise for what would fail every item alike."""
        names = [*self.methods, *map(folder_name, self.compare)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise UsageError(f"two methods are called {twice[0]!r}; rename one's file or folder")
        for path in self.against:
            if not path.is_file():
                raise UsageError(f"--against {path}: no such file")
        for folder in self.compare:
            if not folder.is_dir():
                raise UsageError(f"--compare {folder}: no such folder")
        self.require_output_apart(self.compare)
        if self.lpips is not None and self.vgg_weights is None:
            raise UsageError("--lpips is measured with --vgg-weights imagenet, or a file of VGG-16's weights")

    def require_output_apart(self, folders: Iterable[Path]) -> None:
        """UsageError for an output folder in one whose pictures are read: the next run would read it too."""
        for folder in folders:
            if self.output.resolve().is_relative_to(folder.resolve()):
                raise UsageError(
                    f"-o {self.output}: is {folder} or lies in it, which is read; give another one"
                )

    def measures(self) -> "Measures":
        """How pictures are measured."""
        from facerf_cli.evaluation.measure import Measures

        return Measures(space=self.space, lpips=self.lpips, vgg_weights=self.vgg_weights)


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
    jobs: JobsOption = 1,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
) -> EvaluateOptions:
    """The shared options from the command line; a command's signature ends with these parameters."""
    given = EvaluateOptions(
        output,
        _kinds(reflectance or ["field"]),
        tuple(against or ()),
        tuple(compare or ()),
        pictures=pictures,
        keep_eyes=keep_eyes,
        space=space,
        lpips=lpips,
        vgg_weights=vgg_weights,
    )
    return replace(given, preset=preset, jobs=jobs, overwrite=overwrite, dry_run=dry_run)


def _kinds(given: Sequence[str]) -> tuple[KindName, ...]:
    found = []
    for name in given:
        kind = next((kind for kind in get_args(KindName) if kind == name), None)
        if kind is None:
            raise UsageError(f"--reflectance {name}: give {', '.join(get_args(KindName))}")
        found.append(kind)
    return tuple(found)


def with_shared_options(command: Callable[..., int], left_out: Sequence[str] = ()) -> Callable[..., None]:
    """A protocol's command with the shared options after its own, but those that mean nothing to it.

    The command takes its own parameters and `options: EvaluateOptions`, and gives the exit code. typer reads
    signatures, so the function that it gets has one that lists them all.
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
