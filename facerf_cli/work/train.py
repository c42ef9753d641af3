"""One run of `facerf train`: the objective of its stage, with networks and data, and the training loop."""

import logging
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch import Tensor, nn

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, collect_items
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.dataset.crops import Photos, mean_translation_m, open_photos
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.portraits import open_dataset_portraits
from facerf_cli.dataset.textures import open_dataset_textures
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.checkpoint import load_networks, load_vgg
from facerf_cli.network.diffuse_sh import DiffuseNetwork, DiffuseSettings
from facerf_cli.network.features import AppearanceNetwork, AppearanceSettings, LightNetwork, LightSettings
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.parsing import ParsingNetwork, ParsingSettings
from facerf_cli.network.portrait import PortraitNetwork, PortraitSettings
from facerf_cli.network.reflectance import make_reflectance_network
from facerf_cli.run.logs import LOGGER_NAME, STDERR
from facerf_cli.synth.bank.face_crops import RenderedFaces
from facerf_cli.synth.bank.head_images import add_head_images
from facerf_cli.synth.bank.heads import Bank, HeadBakeSettings, add_views, bake_heads, load_bank
from facerf_cli.synth.bank.parsing import StoredPortraits
from facerf_cli.synth.bank.portrait_samples import PortraitSource, StoredTransport
from facerf_cli.synth.bank.portraits import PortraitBankSettings, add_portraits, load_backgrounds
from facerf_cli.synth.bank.texture_samples import SampleSource
from facerf_cli.synth.bank.transport import TransportBankSettings, add_proxies, add_transport
from facerf_cli.synth.head.mesh import MAKEHUMAN_LICENCE
from facerf_cli.training.diffuse_sh import DiffuseObjective, SumSettings
from facerf_cli.training.geometry import GeometryObjective, GeometryObjectiveSettings
from facerf_cli.training.joint import JointObjective, JointSettings
from facerf_cli.training.light_features import (
    AppearanceObjective,
    LightFeaturesObjective,
    LightFeaturesSettings,
)
from facerf_cli.training.loop import (
    Objective,
    Start,
    first_process_first,
    joined_processes,
    process_rank,
    train,
)
from facerf_cli.training.losses import load_features
from facerf_cli.training.parsing import ParsingObjective, ParsingObjectiveSettings
from facerf_cli.training.portrait import PortraitObjective, PortraitObjectiveSettings
from facerf_cli.training.run_folder import refuse_another_run
from facerf_cli.training.settings import Preset, Stage
from facerf_cli.training.texture import TextureObjective, TextureObjectiveSettings
from facerf_cli.work.train_options import TrainOptions

_MAPS, _HEAPS = 60, 240  # backgrounds: surroundings, each seen from several sides, and heaps of shapes
_TINY_U_WIDTHS, _TINY_BLOCKS = (8, 8, 12, 16), (0, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class WholePeople:
    """Synthetic people by number, the face models they take turns in, and what else the banks need."""

    indices: range
    held_out: int
    models: list[str]
    backgrounds_path: Path
    seed: int
    jobs: int
    tiny: bool

    @cached_property
    def backgrounds(self) -> Tensor:
        """Backgrounds of their photos."""
        return drawn_backgrounds(self.backgrounds_path, self.seed, self.tiny)

    def provenance(self) -> dict[str, Any]:
        """Origin and licence of the people."""
        drawn = [load_face_model(model) for model in self.models]
        shapes = [f"the heads' shapes: {model.licence}" for model in drawn]
        return {
            "heads": f"synthetic people drawn from {' and '.join(model.credit for model in drawn)}",
            "licence": "; ".join(["MIT", *shapes, MAKEHUMAN_LICENCE]),
        }


def drawn_backgrounds(path: Path, seed: int, tiny: bool) -> Tensor:
    """Backgrounds of photos, drawn where their file is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    maps, heaps = (1, 4) if tiny else (_MAPS, _HEAPS)
    return load_backgrounds(path, maps, heaps, seed)


def parsing_objective(people: WholePeople, folder: Path, network: Any) -> ParsingObjective:
    """The stage parsing; photos that are missing in `folder` are taken first."""
    provenance = people.provenance()
    settings = PortraitBankSettings(views=1, photos=1, side_px=96) if people.tiny else PortraitBankSettings()
    add_portraits(folder, people.models, people.indices, people.jobs, people.seed, settings)
    stored = StoredPortraits(folder, people.backgrounds, provenance)
    own = ParsingSettings(_TINY_U_WIDTHS, _TINY_BLOCKS, side=64) if people.tiny else ParsingSettings()
    objective = ParsingObjectiveSettings(held_out_people=people.held_out)
    return ParsingObjective(stored, network or ParsingNetwork(own), objective)


def stored_transport(people: WholePeople, folder: Path) -> StoredTransport:
    """Synthetic people of the stage portrait; those that are missing in `folder` are baked and seen first."""
    settings = TransportBankSettings(views=1, looks=1, lights=12) if people.tiny else TransportBankSettings()
    add_transport(folder, people.models, people.indices, people.jobs, people.seed, settings)
    add_proxies(folder, people.backgrounds, people.jobs, people.seed)
    return StoredTransport(folder, people.backgrounds, people.provenance())


def portrait_objective(source: PortraitSource, held_out: int, tiny: bool, network: Any) -> PortraitObjective:
    """The stage portrait on people of a source, of whom at most `held_out` are held out."""
    own = PortraitSettings(_TINY_U_WIDTHS, _TINY_BLOCKS) if tiny else PortraitSettings()
    settings = PortraitObjectiveSettings(held_out_people=held_out, targets=2 if tiny else 4)
    return PortraitObjective(source, network or PortraitNetwork(own), settings)


_SMOOTH = 0.95  # of the moving average of the losses
log = logging.getLogger(LOGGER_NAME)


class TrainProgress:
    """Step, losses, last validation, share of time spent waiting for batches, and the time left."""

    def __init__(self, steps: int | None, max_seconds: float | None, settings: Settings, shown: bool) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )
        self.on = shown and STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
        self.steps, self.max_seconds = steps, max_seconds
        self.bar = Progress(*columns, console=STDERR, disable=not self.on)
        self.task = self.bar.add_task("training", total=1.0, left="")
        self.smooth: dict[str, float] = {}
        self.validation = ""
        self.begun: tuple[int, float] | None = None

    def __enter__(self) -> "TrainProgress":
        self.bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.bar.stop()

    def row(self, row: dict[str, Any]) -> None:
        """Show one row of the log."""
        losses = {"loss": row["loss"], **(row["terms"] if len(row["terms"]) > 1 else {})}
        for name, value in losses.items():
            self.smooth[name] = _SMOOTH * self.smooth.get(name, value) + (1 - _SMOOTH) * value
        words = "  ".join(f"{name} {value:.4g}" for name, value in self.smooth.items())
        if "validation" in row:
            self.validation = "  ".join(f"{name} {value:.4g}" for name, value in row["validation"].items())
            if not self.on:
                log.info("step %d  %s  |  %s", row["step"], words, self.validation)
        text = f"step {row['step']}  {words}  waiting {100 * row['waiting']:.0f} %"
        text += f"  |  {self.validation}" if self.validation else ""
        left_s = self._left_s(row)
        done = 0.0 if left_s is None else row["seconds"] / max(row["seconds"] + left_s, 1e-9)
        left = "" if left_s is None else f"{_clock(left_s)} left"
        self.bar.update(self.task, completed=done, description=text, left=left)

    def _left_s(self, row: dict[str, Any]) -> float | None:
        """Seconds left by this process's pace or by --max-time, whichever ends first; None while unknown."""
        self.begun = self.begun or (row["step"], row["seconds"])
        steps = row["step"] - self.begun[0]
        left = []
        if self.max_seconds:
            left.append(self.max_seconds - row["seconds"])
        if self.steps and steps:
            left.append((self.steps - row["step"]) * (row["seconds"] - self.begun[1]) / steps)
        return max(0.0, min(left)) if left else None


def _clock(seconds: float) -> str:
    minutes = int(seconds) // 60
    return f"{minutes // 60}:{minutes % 60:02d}:{int(seconds) % 60:02d}"


_WORKERS_ON_GPU = 4
_TINY_WIDTHS = (8, 12, 16)
_TINY_LIGHTS = 20  # of the rig that the preset `tiny` bakes heads under
_TINY_FORMS: dict[str, dict[str, Any]] = {  # settings of the forms with the preset `tiny`
    "default": {
        "side": 32,
        "encoder_widths": _TINY_WIDTHS,
        "decoder_widths": _TINY_WIDTHS,
        "template_channels": 2,
        "rig_lights": _TINY_LIGHTS,
    },
    "paper": {"side": 32, "widths": _TINY_WIDTHS, "features": 8},
}

Networks = dict[str, nn.Module]  # by name; of --start-from


@dataclass(frozen=True)
class _PresetSizes:
    """Amounts of data and sizes of networks of a preset."""

    heads: int = 240
    views: int = 8
    images: int = 24  # of each head, for the Geometry Network
    texture_side: int = 128  # of a dataset's textures
    joint_side: int = 256  # of the stage joint's crops and textures
    held_out_heads: int = 12
    light_width: float = 0.25  # of S_f and V_f; 1 is VGG-16's


_SIZES: dict[Preset, _PresetSizes] = {
    "default": _PresetSizes(),
    "paper": _PresetSizes(texture_side=512, joint_side=512, light_width=1.0),
    "tiny": _PresetSizes(heads=16, views=2, images=2, joint_side=64, held_out_heads=4, light_width=0.05),
}


def run_training(options: TrainOptions) -> None:
    """Train in this process or, under torchrun, in several, and print the path of the last checkpoint."""
    with joined_processes():
        device, first = torch_device(options.settings), process_rank() == 0
        training = replace(options.training, workers=_workers(options, device))
        networks, start = _load_start(options.start_from, options.stage)
        with first_process_first():
            if first and not options.resume:
                refuse_another_run(options.output)  # before hours of baking
            objective = _build_objective(options, networks)
        with TrainProgress(training.steps, training.max_seconds, options.settings, first) as progress:
            checkpoint = train(
                objective, options.output, training, start, options.resume, device, progress.row
            )
        if first:
            print(checkpoint)


def _workers(options: TrainOptions, device: torch.device) -> int:
    if options.workers is not None:
        return options.workers
    return _WORKERS_ON_GPU if device.type == "cuda" else int((os.cpu_count() or 1) > 1)


def _load_start(path: Path | None, stage: Stage) -> tuple[Networks, Start]:
    """Load a checkpoint: the networks that the stage trains, and the content that the run copies."""
    if path is None:
        return {}, Start()
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    names = ("reflectance", "geometry") if stage == "joint" else (stage.replace("-", "_"),)
    trained = {name: network for name, network in networks.items() if name in names}
    return trained, Start({k: v for k, v in networks.items() if k not in names}, metadata)


def _sizes(options: TrainOptions) -> _PresetSizes:
    """Sizes of the preset, with --heads and --views if given."""
    preset = _SIZES[options.preset]
    return replace(preset, heads=options.heads or preset.heads, views=options.views or preset.views)


def _build_objective(options: TrainOptions, networks: Networks) -> Objective:
    """Make the stage's objective; bake, unwrap or detect its data where that is missing."""
    builders = {
        "reflectance": _texture,
        "geometry": _geometry,
        "light-features": _light_features,
        "appearance-features": _appearance_features,
        "joint": _joint,
        "diffuse-sh": _diffuse_sh,
        "parsing": _parsing,
        "portrait": _portrait,
    }
    return builders[options.stage](options, networks)


def _texture(options: TrainOptions, networks: Networks) -> Objective:
    side = _texture_side(options)
    light = _load_light_features(options, side)
    network = networks.get("reflectance") or _reflectance_network(options, side)
    settings = TextureObjectiveSettings(held_out_heads=_sizes(options).held_out_heads)
    return TextureObjective(_samples(options), network, light, settings)


def _light_features(options: TrainOptions, networks: Networks) -> Objective:
    sizes, side = _sizes(options), _texture_side(options)
    network: Any = networks.get("light_features")
    network = network or LightNetwork(LightSettings(width=sizes.light_width, side=side))
    _require_side(options.start_from, network.settings.side, side)
    settings = LightFeaturesSettings(held_out_heads=sizes.held_out_heads)
    return LightFeaturesObjective(_samples(options), network, settings)


def _appearance_features(options: TrainOptions, networks: Networks) -> Objective:
    assert options.dataset
    dataset, side = read_dataset(options.dataset), _joint_side(options)
    network: Any = networks.get("appearance_features")
    if network is None:
        people, width = len(dataset.subjects), _sizes(options).light_width
        network = AppearanceNetwork(AppearanceSettings(people, side, width))
    _require_side(options.start_from, network.settings.side, side)
    return AppearanceObjective(dataset, load_face_model(dataset.face_model), network)


def _diffuse_sh(options: TrainOptions, networks: Networks) -> Objective:
    sizes = DiffuseSettings()
    if options.preset == "tiny":
        sizes = DiffuseSettings(32, _TINY_WIDTHS, _TINY_WIDTHS, 4, 4, 16)
    network: Any = networks.get("diffuse_sh") or DiffuseNetwork(sizes)
    settings = SumSettings(held_out_heads=_sizes(options).held_out_heads)
    return DiffuseObjective(_samples(options), network, settings)


def _geometry(options: TrainOptions, networks: Networks) -> Objective:
    folder, sizes = _bank_folder(options), _sizes(options)
    provenance = _bake(options, folder)
    images = folder / "pictures"
    add_head_images(folder / "heads", images, sizes.images, options.jobs, options.settings.seed)
    faces = RenderedFaces(images, provenance)
    network: Any = networks.get("geometry")
    network = network or _geometry_network(options, faces.mean_translation_m())
    settings = GeometryObjectiveSettings(held_out_heads=sizes.held_out_heads)
    return GeometryObjective(faces, network, settings)


def _parsing(options: TrainOptions, networks: Networks) -> Objective:
    people = _whole_people(options)
    return parsing_objective(people, _bank_folder(options) / "portraits", networks.get("parsing"))


def _portrait(options: TrainOptions, networks: Networks) -> Objective:
    tiny, held_out = options.preset == "tiny", _sizes(options).held_out_heads
    source: PortraitSource
    if options.dataset:
        path = options.output / "backgrounds.safetensors"
        backgrounds = drawn_backgrounds(path, options.settings.seed, tiny)
        source = open_dataset_portraits(options.dataset, backgrounds, options.jobs)
    else:
        source = stored_transport(_whole_people(options), _bank_folder(options) / "transport")
    return portrait_objective(source, held_out, tiny, networks.get("portrait"))


def _whole_people(options: TrainOptions) -> WholePeople:
    sizes, models = _sizes(options), options.heads_from.split(",")
    if sizes.heads < sizes.held_out_heads + 1:
        raise UsageError(f"--heads {sizes.heads}: {sizes.held_out_heads} people are held out; give more")
    return WholePeople(
        range(sizes.heads),
        sizes.held_out_heads,
        models,
        _bank_folder(options) / "backgrounds.safetensors",
        options.settings.seed,
        options.jobs,
        options.preset == "tiny",
    )


def _joint(options: TrainOptions, networks: Networks) -> Objective:
    assert options.dataset
    dataset = read_dataset(options.dataset)
    side = _joint_side(options)
    appearance = _load_appearance(options, side)
    if options.preset == "paper" and options.light_features is None:
        raise UsageError(
            "--preset paper: its loss needs S_f; give --light-features FILE, a checkpoint of "
            "`facerf train --stage light-features`, or another preset"
        )
    return JointObjective(
        dataset,
        load_face_model(),  # the built-in one, for the Geometry Network, whatever the dataset is fitted with
        networks.get("reflectance") or _reflectance_network(options, side),
        _joint_geometry(options, networks, dataset),
        appearance,
        _load_light_features(options, side),
        _photos(options, side),
        JointSettings(side, side, seed=options.settings.seed),
    )


def _texture_side(options: TrainOptions) -> int:
    """Side of the textures of the stages that read textures: of a dataset, or of baked heads."""
    if options.dataset:
        return options.texture_size or _sizes(options).texture_side
    return _bake_settings(options).side


def _joint_geometry(options: TrainOptions, networks: Networks, dataset: Dataset) -> Any:
    """The Geometry Network of the stage joint; None where heads are fitted to landmarks."""
    if options.geometry == "landmarks":
        return None
    return networks.get("geometry") or _geometry_network(options, mean_translation_m(dataset))


def _joint_side(options: TrainOptions) -> int:
    """Side of the crops and textures of the stages that read crops."""
    return options.texture_size or _sizes(options).joint_side


def _load_appearance(options: TrainOptions, side: int) -> Any:
    """Load V_f; None without one."""
    if options.appearance_features:
        return load_features(options.appearance_features, "appearance_features", side)
    if options.vgg_weights is None and options.preset != "paper":
        return None
    return load_vgg(options.vgg_weights)


def _load_light_features(options: TrainOptions, side: int) -> Any:
    """Load S_f for images of a side; None without one."""
    path = options.light_features
    return load_features(path, "light_features", side) if path else None


def _require_side(start_from: Path | None, trained: int, side: int) -> None:
    """Raise InputError where a network of --start-from was trained on images of another side."""
    if trained != side:
        raise InputError(
            f"{start_from}: trained on images of {trained} px, here they have {side}; "
            f"give --texture-size {trained}"
        )


def _photos(options: TrainOptions, side: int) -> Photos | None:
    if options.photos is None:
        return None
    items = collect_items([str(options.photos)], options.output, PHOTO_SUFFIXES)
    paths = [item.input_path for item in items]
    return open_photos(paths, options.output / "photos", side, options.jobs)


def _reflectance_network(options: TrainOptions, side: int) -> Any:
    """Make an untrained network of the options' form; the paper's works at the textures' side."""
    settings = {"side": side} if options.form == "paper" else {}
    if options.preset == "tiny":
        settings = _TINY_FORMS.get(options.form, {})
    ablation = {"normals": False} if options.without_normals else {}
    try:
        return make_reflectance_network(options.form, **settings, **ablation)
    except TypeError:
        if not options.without_normals:
            raise
        raise UsageError(
            f"--without-normals: the form {options.form} has no setting normals; leave it out"
        ) from None


def _geometry_network(options: TrainOptions, mean_translation_m: tuple[float, float, float]) -> nn.Module:
    """Make an untrained network; with --mean-face it regresses the pose alone (paper, 'Ablative Study')."""
    settings = GeometryNetworkSettings(
        "paper" if options.preset == "paper" else "default", mean_translation_m=mean_translation_m
    )
    if options.mean_face:
        settings = replace(settings, identity=0, expression=0)
    return GeometryNetwork(settings)


def _samples(options: TrainOptions) -> SampleSource:
    """Open a dataset's textures, or the bank of synthetic heads."""
    if options.dataset:
        rig_lights = _TINY_LIGHTS if options.preset == "tiny" else RIG_LIGHTS
        return open_dataset_textures(
            options.dataset,
            options.fit_with,
            _texture_side(options),
            options.jobs,
            rig_lights,
        )
    return _fill_bank(options, _bank_folder(options))


def _bank_folder(options: TrainOptions) -> Path:
    return options.bank or options.output / "bank"


def _fill_bank(options: TrainOptions, folder: Path) -> Bank:
    """Bake the heads and fit the views that are missing, and open the bank."""
    provenance = _bake(options, folder)
    fitted_with = _save_pose_model(options, folder) if options.mean_face else options.fit_with
    fitted = load_face_model(fitted_with)
    views, count = folder / f"views-{fitted.name}", _sizes(options).views
    add_views(folder / "heads", views, fitted_with, count, options.jobs, options.settings.seed)
    fit = {"fitted_with": fitted.credit, "skin": "procedural (facerf)"}
    return load_bank(folder / "heads", views, provenance | fit)


def _bake(options: TrainOptions, folder: Path) -> dict[str, Any]:
    """Bake the heads that are missing; return their provenance."""
    sizes = _sizes(options)
    heads, held_out = sizes.heads, sizes.held_out_heads
    if heads < held_out + 2:
        raise UsageError(f"--heads {heads}: the mean face and {held_out} heads are held out; give more")
    drawn = load_face_model(options.heads_from)
    load_face_model(options.fit_with)  # raises for an invalid model before anything is baked
    bake_heads(
        folder / "heads",
        options.heads_from,
        heads,
        options.jobs,
        options.settings.seed,
        _bake_settings(options),
    )
    found = len(list((folder / "heads").glob("*.safetensors")))
    return {
        "heads": f"{found} synthetic heads drawn from {drawn.credit}",
        "licence": f"MIT; the heads' shapes: {drawn.licence}",
    }


def _bake_settings(options: TrainOptions) -> HeadBakeSettings:
    if options.preset == "tiny":
        return HeadBakeSettings(32, _TINY_LIGHTS, bake=BakeSettings(light_samples=1, bounce_samples=2))
    return HeadBakeSettings()


def _save_pose_model(options: TrainOptions, folder: Path) -> str:
    """Save the face model of --fit-with without shapes, with which a fit is a pose alone; return its path."""
    still = load_face_model(options.fit_with).pose_only()
    path = folder / f"{still.name}.npz"
    save_face_model(path, still)
    return str(path)
