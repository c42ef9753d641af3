"""One run of `facerf train`: the objective of its stage, with networks and data, and the training loop."""

import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, collect_items
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.dataset.crops import mean_translation_m, open_photos, require_crops
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.light_crops import open_light_stacks
from facerf_cli.dataset.portraits import open_dataset_portraits
from facerf_cli.dataset.textures import open_dataset_textures
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.atomic import alone_in
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.network.checkpoint import load_networks, use_form
from facerf_cli.network.files import serving_files
from facerf_cli.network.installed import installed
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME, STDERR
from facerf_cli.run.machine import processors
from facerf_cli.synth.bank.backgrounds import BACKGROUND_HEAPS, BACKGROUND_MAPS, load_backgrounds
from facerf_cli.synth.bank.face_crops import RenderedFaces
from facerf_cli.synth.bank.heads import add_views, bake_heads, load_bank
from facerf_cli.synth.bank.parsing import StoredPortraits
from facerf_cli.synth.bank.people import TINY_BANK, PeopleBankSettings, add_people
from facerf_cli.synth.bank.portrait_samples import PortraitSource, StoredTransport
from facerf_cli.synth.bank.proxies import add_proxies
from facerf_cli.synth.bank.texture_samples import SampleSource
from facerf_cli.synth.head.mesh import MAKEHUMAN_LICENCE
from facerf_cli.training.diffuse_sh import DiffuseObjective, SumSettings
from facerf_cli.training.geometry import GeometryObjective, GeometryObjectiveSettings
from facerf_cli.training.joint import JointObjective, JointSettings
from facerf_cli.training.light_features import AppearanceObjective, LightFeaturesObjective
from facerf_cli.training.loop import Start, train
from facerf_cli.training.objective import Objective
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.parsing import ParsingObjective, ParsingObjectiveSettings
from facerf_cli.training.portrait import PortraitObjective, PortraitObjectiveSettings
from facerf_cli.training.processes import first_process_first, joined_processes, process_rank
from facerf_cli.training.run_folder import refuse_another_run
from facerf_cli.training.settings import CONFIG, Stage, TrainSettings, write_config
from facerf_cli.training.stage_networks import TINY_LIGHTS, StageNetworks
from facerf_cli.training.texture import HeadsSettings, TextureObjective, TextureObjectiveSettings

_WORKERS_ON_GPU = 4
_SMOOTH = 0.95  # of the moving average of the losses
_PACE_S = 600.0  # of the last steps, whose pace gives the time left
log = logging.getLogger(LOGGER_NAME)


def run_training(options: TrainOptions) -> None:
    """Train in this process or, under torchrun, in several, and print the path of the last checkpoint."""
    with joined_processes(), ExitStack() as stack:
        device, first = _device(options.settings), process_rank() == 0
        use_form(options.form)
        if first:
            stack.enter_context(alone_in(options.output, ".facerf-lock"))
        workers = options.workers
        if workers is None:
            workers = _WORKERS_ON_GPU if device.type == "cuda" else int(processors() > 1)
        training, networks = replace(options.training, workers=workers), _networks(options, device)
        trained, start = _load_start(options)
        with first_process_first():
            if first and not options.resume:
                refuse_another_run(options.output)  # before hours of baking
            stage = _TrainedStage(options, StageNetworks(options, trained), networks)
            objective = _OBJECTIVES[options.stage](stage)
        if first and not (options.resume and (options.output / CONFIG).exists()):
            write_config(options.output, options.typed, training, options.settings.seed)
        progress = TrainProgress(training, options.settings, first)
        with progress.bar:
            checkpoint = train(
                objective, options.output, training, start, options.resume, device, progress.row
            )
        if first:
            print(checkpoint)


def _device(settings: Settings) -> torch.device:
    """The device of --device; `auto` passes Apple's GPUs by."""
    device: torch.device = torch_device(settings)
    if device.type != "mps":
        return device
    if settings.device == "auto":
        return torch.device("cpu")
    raise UsageError("--device mps: training needs float64, which Apple's GPUs lack; give --device cpu")


def _networks(options: TrainOptions, device: torch.device) -> Networks:
    """Networks that look at people in photos; UsageError for a --checkpoint that the stage does not use."""
    looks = options.stage == "portrait" or options.photos is not None
    uses = ["parsing"] if looks or options.settings.checkpoints_by_default else []
    user = f"facerf train --stage {options.stage}"
    return Networks(serving_files(options.settings.checkpoints, uses, user), device)


def _load_start(options: TrainOptions) -> tuple[dict[str, Any], Start]:
    """Load --start-from: the networks that the stage trains, and the content that the run copies."""
    if options.start_from is None:
        return {}, Start()
    networks, metadata = load_networks(options.start_from, LAYOUT_VERSION)
    stage = options.stage
    names = ("reflectance", "geometry") if stage == "joint" else (stage.replace("-", "_"),)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)


@dataclass(frozen=True, eq=False)
class _TrainedStage:
    """Makes the objective of each stage; bakes, unwraps or detects its data where that is missing."""

    options: TrainOptions
    make: StageNetworks
    networks: Networks

    def reflectance(self) -> Objective:
        """The Reflectance Network on textures."""
        side = self.make.texture_side
        light, network = self.make.frozen_light_features(side), self.make.reflectance(side)
        settings = TextureObjectiveSettings(held_out_heads=self.make.sizes.held_out_heads)
        return self._kind(TextureObjective)(self._samples(), network, light, settings)

    def light_features(self) -> Objective:
        """S_f on textures."""
        side = self.make.texture_side
        network, options = self.make.features("light_features", side), self.options
        settings = HeadsSettings(held_out_heads=self.make.sizes.held_out_heads)
        stacks = open_light_stacks(options.dataset, options.fit_with) if options.dataset else None
        return self._kind(LightFeaturesObjective)(stacks or self._samples(), network, settings)

    def appearance_features(self) -> Objective:
        """V_f on a dataset's crops."""
        assert self.options.dataset
        dataset, side = read_dataset(self.options.dataset), self.make.joint_side
        network = self.make.features("appearance_features", side, people=len(dataset.subjects))
        return self._kind(AppearanceObjective)(dataset, load_face_model(dataset.face_model), network)

    def diffuse_sh(self) -> Objective:
        """The network of the baseline diffuse-sh, on textures."""
        settings = SumSettings(held_out_heads=self.make.sizes.held_out_heads)
        return self._kind(DiffuseObjective)(self._samples(), self.make.network("diffuse_sh"), settings)

    def geometry(self) -> Objective:
        """The Geometry Network on photos of synthetic people."""
        sizes = self.make.sizes
        folder, provenance = self._people(sizes.held_out_heads, with_squares=False)
        faces = RenderedFaces(folder, self._backgrounds(self._bank), provenance)
        network = self.make.geometry(faces.mean_translation_m())
        settings = GeometryObjectiveSettings(held_out_heads=sizes.held_out_heads)
        return self._kind(GeometryObjective)(faces, network, settings)

    def joint(self) -> Objective:
        """Both networks through the rasterizer."""
        options, side = self.options, self.make.joint_side
        assert options.dataset
        dataset = read_dataset(options.dataset)
        appearance, light, _ = _all_or_none(
            partial(self.make.frozen_appearance, side),
            partial(self.make.frozen_light_features, side),
            partial(require_crops, dataset, dataset.crop_px, side),
        )
        reflectance, geometry = self.make.reflectance(side), None  # heads are fitted to landmarks
        model = load_face_model(options.fit_with)  # whatever fitted the dataset
        if options.geometry == "network":
            geometry = self.make.geometry(mean_translation_m(dataset))
        photos = None
        if options.photos:
            items = collect_items([str(options.photos)], options.output, PHOTO_SUFFIXES)
            paths, cache = [item.input_path for item in items], _cache_of(options.photos, options.output)
            photos = open_photos(paths, cache, self.networks, side, options.jobs)
        settings = JointSettings(side, side, weights=options.training.loss, seed=options.settings.seed)
        kind = self._kind(JointObjective)
        return kind(dataset, model, reflectance, geometry, appearance, light, photos, settings)

    def parsing(self) -> Objective:
        """The Parsing Network on photos of synthetic people."""
        folder, provenance = self._people(self.make.sizes.held_out_heads, with_squares=False)
        stored = StoredPortraits(folder, self._backgrounds(self._bank), provenance)
        objective = ParsingObjectiveSettings(held_out_people=self.make.sizes.held_out_heads)
        return self._kind(ParsingObjective)(stored, self.make.network("parsing"), objective)

    def portrait(self) -> Objective:
        """The Portrait Network on a dataset, or on synthetic people."""
        options, few = self.options, self.options.preset == "tiny"
        source: PortraitSource
        if options.dataset:
            backgrounds = self._backgrounds(options.output)
            source = open_dataset_portraits(options.dataset, backgrounds, self.networks, options.jobs)
        else:
            source = self._stored_transport()
        settings = PortraitObjectiveSettings(held_out_people=self._held_out_of_few)
        settings = replace(settings, targets=2) if few else settings
        return self._kind(PortraitObjective)(source, self.make.network("portrait"), settings)

    def _stored_transport(self) -> StoredTransport:
        """Synthetic people, and what the networks see of them."""
        folder, provenance = self._people(self._held_out_of_few, with_squares=True)
        backgrounds, options = self._backgrounds(self._bank), self.options
        add_proxies(folder, backgrounds, self.networks, options.jobs, options.settings.seed)
        return StoredTransport(folder, backgrounds, provenance)

    @property
    def _held_out_of_few(self) -> int:
        """Number of people that the stage portrait holds out: an eighth of a small bank."""
        return min(self.make.sizes.held_out_heads, max(1, self.make.sizes.heads // 8))

    def _people(self, held_out: int, with_squares: bool) -> tuple[Path, dict[str, Any]]:
        """Bake the synthetic people that are missing; return their folder and their provenance."""
        options, heads = self.options, self.make.sizes.heads
        if heads <= held_out:
            raise UsageError(f"--heads {heads}: {held_out} people are held out; use more")
        folder, models = self._bank / "people", options.heads_from.split(",")
        drawn = [load_face_model(model) for model in models]
        settings = TINY_BANK if options.preset == "tiny" else PeopleBankSettings()
        settings = replace(settings, with_squares=with_squares)
        add_people(folder, models, range(heads), options.jobs, options.settings.seed, settings)
        shapes = [f"the heads' shapes: {model.licence}" for model in drawn]
        return folder, {
            "heads": f"synthetic people drawn from {' and '.join(model.credit for model in drawn)}",
            "licence": "; ".join(["MIT", *shapes, MAKEHUMAN_LICENCE]),
        }

    def _backgrounds(self, folder: Path) -> Tensor:
        """Backgrounds of photos, drawn where the folder lacks their file."""
        maps, shapes = (1, 4) if self.options.preset == "tiny" else (BACKGROUND_MAPS, BACKGROUND_HEAPS)
        return load_backgrounds(folder / "backgrounds.safetensors", maps, shapes, self.options.settings.seed)

    @property
    def _bank(self) -> Path:
        return self.options.bank or self.options.output / "bank"

    def _kind(self, objective: type[Objective]) -> Any:
        """The class of the stage's objective, or the subclass of --objective."""
        name = self.options.objective
        if name is None:
            return objective
        kind = installed(name, "--objective")
        if not issubclass(kind, objective):
            needed = f"{objective.__module__}:{objective.__name__}"
            raise UsageError(f"--objective {name}: is no subclass of {needed}, the stage's own")
        return kind

    def _samples(self) -> SampleSource:
        """Open a dataset's textures, or the bank of synthetic heads, whose missing views are fitted first."""
        options, folder = self.options, self._bank
        if options.dataset:
            rig_lights = TINY_LIGHTS if options.preset == "tiny" else RIG_LIGHTS
            side = self.make.texture_side
            return open_dataset_textures(options.dataset, options.fit_with, side, options.jobs, rig_lights)
        provenance, fitted_with = self._bake(), options.fit_with
        if options.mean_face:  # a fit of a model without shapes is a pose alone
            still = load_face_model(fitted_with).pose_only()
            fitted_with = str(folder / f"{still.name}.npz")
            save_face_model(Path(fitted_with), still)
        fitted = load_face_model(fitted_with)
        views, count = folder / f"views-{fitted.name}", self.make.sizes.views
        add_views(folder / "heads", views, fitted_with, count, options.jobs, options.settings.seed)
        fit = {"fitted_with": fitted.credit, "skin": "procedural (facerf)"}
        return load_bank(folder / "heads", views, provenance | fit)

    def _bake(self) -> dict[str, Any]:
        """Bake the heads that are missing; return their provenance."""
        options, folder = self.options, self._bank / "heads"
        heads, held_out = self.make.sizes.heads, self.make.sizes.held_out_heads
        if heads < held_out + 2:
            raise UsageError(f"--heads {heads}: the mean face and {held_out} heads are held out; give more")
        drawn = load_face_model(options.heads_from)
        load_face_model(options.fit_with)  # raises for an invalid model before anything is baked
        seed = options.settings.seed
        bake_heads(folder, options.heads_from, heads, options.jobs, seed, self.make.bake_settings)
        found = len(list(folder.glob("*.safetensors")))
        return {
            "heads": f"{found} synthetic heads drawn from {drawn.credit}",
            "licence": f"MIT; the heads' shapes: {drawn.licence}",
        }


_OBJECTIVES: dict[Stage, Callable[[_TrainedStage], Objective]] = {
    "reflectance": _TrainedStage.reflectance,
    "geometry": _TrainedStage.geometry,
    "joint": _TrainedStage.joint,
    "light-features": _TrainedStage.light_features,
    "appearance-features": _TrainedStage.appearance_features,
    "diffuse-sh": _TrainedStage.diffuse_sh,
    "parsing": _TrainedStage.parsing,
    "portrait": _TrainedStage.portrait,
}


def _cache_of(photos: Path, output: Path) -> Path:
    """Folder of faces found in photos: next to them, for all runs, or the run's if that is not writable."""
    folder = photos if photos.is_dir() else photos.parent
    return folder / ".facerf-faces" if os.access(folder, os.W_OK) else output / "photos"


def _all_or_none(*loads: Callable[[], Any]) -> list[Any]:
    """Load what a stage needs; where some is missing or unfit, one error names all of it."""
    found, wrong = [], []
    for load in loads:
        try:
            found.append(load())
        except FacerfError as error:
            wrong.append(error)
    if len(wrong) > 1:
        raise UsageError("; ".join(map(str, wrong)))
    if wrong:
        raise wrong[0]
    return found


class TrainProgress:
    """Progress of a run: a bar on a terminal, otherwise a log line a validation.

    It shows losses, last validation, the share of time spent waiting for batches, and the time left.
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
