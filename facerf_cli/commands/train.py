"""`facerf train`: the Reflectance Network, on synthetic heads baked for it or on a prepared dataset."""

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facerf_cli.commands.options import Settings, settings_of, torch_device
from facerf_cli.errors import UsageError
from facerf_cli.records import STDERR

if TYPE_CHECKING:
    from facerf_cli.stage.bank import Bank
    from facerf_cli.stage.samples import SampleSource

_OF_THE_BANK = ("heads_from", "heads", "views", "bank")
_OF_A_DATASET = ("texture_size",)
_UNITS_S = {"s": 1, "m": 60, "h": 3600}


def train(
    context: typer.Context,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the run.")],
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            metavar="DIR",
            help="Train on this prepared dataset (prepare-dataset, relight-dataset) in the place of heads.",
            show_default="synthetic heads",
        ),
    ] = None,
    heads_from: Annotated[
        str, typer.Option(metavar="NAME|PATH", help="Face model that the synthetic heads are drawn from.")
    ] = "builtin",
    fit_with: Annotated[
        str,
        typer.Option(metavar="NAME|PATH", help="Face model that they are, or the dataset was, fitted with."),
    ] = "builtin",
    heads: Annotated[int, typer.Option(min=16, help="Synthetic heads to bake.")] = 240,
    views: Annotated[int, typer.Option(min=1, help="Fitted views of each head.")] = 8,
    bank: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where baked heads are kept.", show_default="DIR/bank")
    ] = None,
    texture_size: Annotated[
        int, typer.Option(min=32, max=1024, metavar="PX", help="Side of a dataset's textures.")
    ] = 128,
    max_time: Annotated[str, typer.Option(metavar="TIME", help="Stop after 90s, 45m or 2h.")] = "2h",
    start_from: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Checkpoint whose weights to begin with.", show_default="none"),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes that bake, or unwrap.")] = 2,
) -> None:
    """Train the Reflectance Network on synthetic heads, without a light stage, or on a prepared dataset.

    Heads are drawn from a face model and their light transport is baked once; skins, lights and cameras are
    drawn anew at every step. DIR gets last.safetensors (for --checkpoint), log.jsonl and validation.png.

    A dataset is unwrapped once into DATASET/textures-PX; its split train is trained on, its split validation
    measured (si_mse in the log), its split test left alone. Sources are those of relight-dataset, or, where
    there are none, the stacks under lights that are drawn.
    """
    from facerf_cli.face.topology import LAYOUT_VERSION
    from facerf_cli.network.saved import load_networks
    from facerf_cli.training import TrainSettings
    from facerf_cli.training import train as run_training

    settings = settings_of(context)
    training = TrainSettings(max_seconds=_seconds(max_time), seed=settings.seed)
    if dataset is None:
        _refuse(context, _OF_A_DATASET, "is for a prepared dataset; give --dataset beside it")
    else:
        _refuse(
            context, _OF_THE_BANK, "is for synthetic heads, and --dataset takes their place; give one of them"
        )
    if start_from:
        load_networks(start_from, LAYOUT_VERSION)  # a bad file is named before hours of baking
    source: SampleSource
    if dataset is not None:
        source = _open_dataset(dataset, fit_with, texture_size, jobs)
    else:
        source = _fill_bank(bank or output / "bank", heads_from, fit_with, heads, views, jobs, settings)
    report = _Progress(training.max_seconds, settings)
    with report:
        checkpoint = run_training(
            source, output, training, start_from=start_from, device=torch_device(settings), report=report.row
        )
    print(checkpoint)


def _refuse(context: typer.Context, names: tuple[str, ...], why: str) -> None:
    """Raise for options that were given although they mean nothing here."""
    for name in names:
        given = context.get_parameter_source(name)
        if given is not None and given.name == "COMMANDLINE":
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _open_dataset(folder: Path, fit_with: str, side: int, jobs: int) -> "SampleSource":
    from facerf_cli.stage.data.captured import open_captured

    return open_captured(folder, fit_with, side, jobs)


def _seconds(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if not match:
        raise UsageError(f"--max-time {text}: write a number and s, m or h, such as 45m")
    return float(match[1]) * _UNITS_S[match[2]]


def _fill_bank(
    folder: Path, heads_from: str, fit_with: str, heads: int, views: int, jobs: int, settings: Settings
) -> "Bank":
    from facerf_cli.face.morphable import load_face_model
    from facerf_cli.stage.bank import add_views, load_bank
    from facerf_cli.stage.geometries import build_geometries

    drawn, fitted = load_face_model(heads_from), load_face_model(fit_with)
    build_geometries(folder / "heads", heads_from, heads, jobs, settings.seed)
    add_views(folder / "heads", folder / f"views-{fitted.name}", fit_with, views, jobs, settings.seed)
    filled = load_bank(folder / "heads", folder / f"views-{fitted.name}", {})
    provenance = {
        "heads": f"{len(filled.geometries)} synthetic heads drawn from {drawn.name} ({drawn.licence})",
        "fitted_with": f"{fitted.name} ({fitted.licence})",
        "skin": "procedural (facerf)",
        "licence": f"MIT; the heads' shapes: {drawn.licence}",
    }
    return replace(filled, provenance=provenance)


class _Progress:
    """A bar on stderr where that is a terminal: time, step, loss, and the share of time spent drawing."""

    def __init__(self, total_s: float, settings: Settings) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
        self.bar = Progress(*columns, console=STDERR, disable=not shown)
        self.task = self.bar.add_task("training", total=total_s)
        self.smooth: float | None = None

    def __enter__(self) -> "_Progress":
        self.bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.bar.stop()

    def row(self, row: dict[str, float]) -> None:
        """Show one row of the log."""
        self.smooth = row["loss"] if self.smooth is None else 0.98 * self.smooth + 0.02 * row["loss"]
        text = f"step {row['step']:.0f}  loss {self.smooth:.4f}  drawing {100 * row['drawing']:.0f} %"
        self.bar.update(self.task, completed=row["seconds"], description=text)
