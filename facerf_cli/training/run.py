"""Run `facerf train`: provide what a stage's `build` needs, build its objective and start the loop."""

import importlib
import logging
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.faces import DatasetFaces, open_faces
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import alone_in
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.checkpoint import form_of, installed_class, load_networks, new_network, use_form
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME, STDERR
from facerf_cli.run.machine import processors
from facerf_cli.synth.bank.backgrounds import BACKGROUND_HEAPS, BACKGROUND_MAPS, load_backgrounds
from facerf_cli.synth.bank.heads import HeadBakeSettings, add_views, bake_heads, load_bank
from facerf_cli.synth.bank.people import PHOTO_BANK, TINY_BANK, PeopleBankSettings, add_people
from facerf_cli.synth.bank.texture_samples import SampleSource
from facerf_cli.synth.head.mesh import MAKEHUMAN_LICENCE
from facerf_cli.training.loop import Start, train
from facerf_cli.training.losses import load_features
from facerf_cli.training.objective import Objective
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.processes import first_process_first, joined_processes, process_rank
from facerf_cli.training.run_folder import refuse_another_run
from facerf_cli.training.settings import (
    CONFIG,
    STAGES,
    Sizes,
    TrainSettings,
    network_settings_of,
    sizes_of,
    write_config,
)

_WORKERS_ON_GPU = 4
_SMOOTH = 0.95  # of the moving average of the losses
_PACE_S = 600.0  # of the last steps, whose pace gives the time left
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Run:
    """Run of `facerf train`.

    Attributes:
        training: Settings of the loop.
        trained: Networks of --start-from that the stage trains, by name.
        people: Networks that find and parse people in photos.
    """

    options: TrainOptions
    training: TrainSettings
    trained: dict[str, Any]
    people: Networks

    @property
    def sizes(self) -> Sizes:
        """Sizes of the preset, with --heads and --views if given."""
        options, sizes = self.options, sizes_of(self.options.preset)
        return replace(sizes, heads=options.heads or sizes.heads, views=options.views or sizes.views)

    @property
    def is_tiny(self) -> bool:
        return self.options.preset == "tiny"

    @property
    def bank(self) -> Path:
        """Folder of baked heads and people."""
        return self.options.bank or self.options.output / "bank"

    def dataset(self) -> Dataset:
        """Read the dataset of --dataset."""
        if self.options.dataset is None:
            raise UsageError(f"--stage {self.options.stage}: needs a prepared dataset; pass --dataset")
        return read_dataset(self.options.dataset)

    @property
    def texture_side(self) -> int:
        """Side of the textures of a dataset, or of baked heads."""
        if self.options.dataset:
            return self.options.texture_size or self.sizes.texture_side
        return self.sizes.bake_side

    def crop_side(self, dataset: Dataset) -> int:
        """Return the side of the crops of the stages that read crops; `tiny` accepts any dataset's."""
        side = min(self.sizes.joint_side, dataset.crop_px) if self.is_tiny else self.sizes.joint_side
        return self.options.texture_size or side

    def objective(self, kind: type[Objective]) -> Any:
        """Return the class of the stage's objective, or the subclass of --objective."""
        name = self.options.objective
        if name is None:
            return kind
        return installed_class(name, "--objective", kind)

    def network(self, name: str, form: str = "default", **settings: Any) -> Any:
        """Return the network of --start-from, or an untrained one of the preset's sizes."""
        settings |= network_settings_of(self.options.preset, name, form_of(name, form))
        return self.trained.get(name) or new_network(name, form, settings)

    def reflectance(self, side: int) -> Any:
        """Make the Reflectance Network of the options' form; the paper's works at the textures' side."""
        form, without_normals = self.options.form, self.options.without_normals
        settings: dict[str, Any] = {"side": side} if form_of("reflectance", form) == "paper" else {}
        if without_normals:
            settings["normals"] = False
        try:
            return self.network("reflectance", form, **settings)
        except TypeError:
            if not without_normals:
                raise
            raise UsageError(
                f"--without-normals: the form {form} has no setting normals; remove the option"
            ) from None

    def geometry(self, mean_translation_m: tuple[float, float, float]) -> Any:
        """Make the Geometry Network; with --mean-face it regresses only poses (paper, 'Ablative Study')."""
        form = "paper" if self.options.preset == "paper" else "default"
        shapes = {"identity": 0, "expression": 0} if self.options.mean_face else {}
        return self.network("geometry", form, mean_translation_m=mean_translation_m, **shapes)

    def features(self, name: str, side: int, **settings: Any) -> Any:
        """Make S_f or V_f; InputError if --start-from was trained on images of another side."""
        network = self.network(name, "vgg", width=self.sizes.light_width, side=side, **settings)
        if network.settings.side != side:
            trained = network.settings.side
            raise InputError(
                f"{self.options.start_from}: trained on images of {trained} px, here they have {side}; "
                f"pass --texture-size {trained}"
            )
        return network

    def light_features(self, side: int) -> Any:
        """Load the frozen S_f of --light-features, for textures of a side; None without one."""
        path = self.options.light_features
        return load_features(path, "light_features", side) if path else None

    def faces(self) -> SampleSource | DatasetFaces:
        """Open the dataset, or the bank of synthetic heads, whose missing heads and views are made first."""
        options, folder, sizes = self.options, self.bank, self.sizes
        if options.dataset:
            return open_faces(options.dataset, options.fit_with, self.texture_side, sizes.rig_lights)
        provenance, fitted_with = self.bake_heads(), options.fit_with
        if options.mean_face:  # a model without shapes fits only the pose
            still = load_face_model(fitted_with).pose_only()
            fitted_with = str(folder / f"{still.name}.npz")
            save_face_model(Path(fitted_with), still)
        fitted = load_face_model(fitted_with)
        views, seed = folder / f"views-{fitted.name}", options.settings.seed
        add_views(folder / "heads", views, fitted_with, sizes.views, options.jobs, seed)
        fit = {"fitted_with": fitted.credit, "skin": "procedural (facerf)"}
        return load_bank(folder / "heads", views, provenance | fit)

    def bake_heads(self) -> dict[str, Any]:
        """Bake the heads that are missing; return their provenance."""
        options, folder, sizes = self.options, self.bank / "heads", self.sizes
        if sizes.heads < sizes.held_out_people + 2:
            held_out = f"the mean face and {sizes.held_out_people} heads are held out"
            raise UsageError(f"--heads {sizes.heads}: {held_out}; use more")
        drawn = load_face_model(options.heads_from)
        load_face_model(options.fit_with)  # raises for an invalid model before anything is baked
        settings = HeadBakeSettings(sizes.bake_side, sizes.rig_lights)
        if self.is_tiny:
            settings = replace(settings, bake=BakeSettings(light_samples=1, bounce_samples=2))
        bake_heads(folder, options.heads_from, sizes.heads, options.jobs, options.settings.seed, settings)
        return {
            "heads": f"{len(list(folder.glob('*.safetensors')))} synthetic heads drawn from {drawn.credit}",
            "licence": f"MIT; the heads' shapes: {drawn.licence}",
        }

    def bake_people(self, held_out: int, with_squares: bool) -> tuple[Path, dict[str, Any]]:
        """Bake the synthetic people that are missing; return their folder and their provenance.

        The stage portrait needs the transport in the person's square (`with_squares`).
        """
        options, heads = self.options, self.sizes.heads
        if heads <= held_out:
            raise UsageError(f"--heads {heads}: {held_out} people are held out; use more")
        folder, models = self.bank / "people", options.heads_from.split(",")
        drawn = [load_face_model(model) for model in models]
        full = PeopleBankSettings() if with_squares else PHOTO_BANK
        settings = replace(TINY_BANK if self.is_tiny else full, with_squares=with_squares)
        add_people(folder, models, range(heads), options.jobs, options.settings.seed, settings)
        shapes = [f"the heads' shapes: {model.licence}" for model in drawn]
        return folder, {
            "heads": f"synthetic people drawn from {' and '.join(model.credit for model in drawn)}",
            "licence": "; ".join(["MIT", *shapes, MAKEHUMAN_LICENCE]),
        }

    def backgrounds(self, folder: Path) -> Tensor:
        """Load the backgrounds of photos; draw them if the folder lacks their file."""
        maps, shapes = (1, 4) if self.is_tiny else (BACKGROUND_MAPS, BACKGROUND_HEAPS)
        return load_backgrounds(folder / "backgrounds.safetensors", maps, shapes, self.options.settings.seed)


def run_training(options: TrainOptions, training: TrainSettings, typed: dict[str, Any]) -> None:
    """Train in this process or, under torchrun, in several, and print the path of the last checkpoint.

    typed: The options that were set, by name, for config.toml.
    """
    with joined_processes(), ExitStack() as stack:
        device, first, workers = _device(options.settings), process_rank() == 0, options.workers
        use_form(options.form)
        if first:
            stack.enter_context(alone_in(options.output, ".facerf-lock"))
        if workers is None:
            workers = _WORKERS_ON_GPU if device.type == "cuda" else int(processors() > 1)
        training, people = replace(training, workers=workers), _people_networks(options, device)
        trained, start = _load_start(options)
        with first_process_first():
            if first and not options.resume:
                refuse_another_run(options.output)  # before hours of baking
            module, _, build = STAGES[options.stage].build.partition(":")
            stage = importlib.import_module(f"facerf_cli.training.{module}")
            objective: Objective = getattr(stage, build)(Run(options, training, trained, people))
        if first and not (options.resume and (options.output / CONFIG).exists()):
            write_config(options.output, typed, training, options.settings.seed)
        progress = TrainProgress(training, options.settings, first)
        with progress.bar:
            checkpoint = train(
                objective, options.output, training, start, options.resume, device, progress.row
            )
        if first:
            print(checkpoint)


def _device(settings: Settings) -> torch.device:
    """Return the device of --device; `auto` ignores Apple's GPUs."""
    device: torch.device = torch_device(settings)
    if device.type != "mps":
        return device
    if settings.device == "auto":
        return torch.device("cpu")
    raise UsageError("--device mps: training needs float64, which Apple's GPUs lack; use --device cpu")


def _people_networks(options: TrainOptions, device: torch.device) -> Networks:
    """Return the networks that look at people in photos; UsageError for a --checkpoint that is not used."""
    looks = options.stage == "portrait" or options.photos is not None
    uses = ["parsing"] if looks or options.settings.checkpoints_by_default else []
    user = f"facerf train --stage {options.stage}"
    return Networks(serving_files(options.settings.checkpoints, uses, user), device)


def _load_start(options: TrainOptions) -> tuple[dict[str, Any], Start]:
    """Load --start-from: the networks that the stage trains, and the content that the run copies."""
    if options.start_from is None:
        return {}, Start()
    networks, metadata = load_networks(options.start_from, LAYOUT_VERSION)
    names = STAGES[options.stage].networks or (options.stage.replace("-", "_"),)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)


class TrainProgress:
    """Show progress: a bar on a terminal, otherwise a log line per validation.

    It contains losses, the last validation, the fraction of time spent waiting for batches, and the time
    left.
    """

    def __init__(self, training: TrainSettings, settings: Settings, shown: bool) -> None:
        text, left = TextColumn("{task.description}"), TextColumn("left")
        columns = (text, BarColumn(bar_width=20), TimeElapsedColumn(), TimeRemainingColumn(), left)
        self.on = shown and STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
        self.training = training
        self.bar = Progress(*columns, console=STDERR, disable=not self.on, speed_estimate_period=_PACE_S)
        self.task = self.bar.add_task("training", total=1.0)
        self.smooth: dict[str, float] = {}
        self.validation = ""

    def row(self, row: dict[str, Any]) -> None:
        """Show one row of the log."""
        losses = {"loss": row["loss"], **(row["terms"] if len(row["terms"]) > 1 else {})}
        for name, value in losses.items():
            self.smooth[name] = _SMOOTH * self.smooth.get(name, value) + (1 - _SMOOTH) * value
        words = _figures(self.smooth)
        if "validation" in row:
            self.validation = _figures(row["validation"])
            if not self.on:
                log.info("step %d  %s  |  %s", row["step"], words, self.validation)
        text = f"step {row['step']}  {words}  waiting {100 * row['waiting']:.0f} %"
        text += f"  |  {self.validation}" if self.validation else ""
        done = self.training.done(row["step"], row["seconds"])
        self.bar.update(self.task, completed=done, description=text)


def _figures(values: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
