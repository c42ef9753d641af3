"""What `facerf train` trains: an objective, its networks and its data, from the options.

How a run of training shows itself: a bar on a terminal, a line a validation elsewhere.
"""

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from facerf_cli.cli.options import Settings
from facerf_cli.errors import UsageError
from facerf_cli.logs import LOGGER_NAME, STDERR

if TYPE_CHECKING:
    from torch import nn

    from facerf_cli.synth.heads_bank import Bank
    from facerf_cli.synth.texture_samples import SampleSource
    from facerf_cli.training.objective import Objective

Preset = Literal["default", "paper", "tiny"]
Stage = Literal["reflectance", "geometry", "joint", "light-features", "diffuse-sh"]
_TINY_WIDTHS = (8, 12, 16)
_TINY_LIGHTS = 20  # of the rig that heads are baked under


@dataclass(frozen=True)
class _Sizes:
    """Of what a preset draws."""

    heads: int = 240
    views: int = 8
    images: int = 24  # of a head, for the Geometry Network
    joint_side: int = 256  # of the stage joint's crops and textures
    held_out_heads: int = 12
    light_width: float = 0.25  # of S_f; 1 is VGG-16's


_SIZES: dict[Preset, _Sizes] = {
    "default": _Sizes(),
    "paper": _Sizes(joint_side=512, light_width=1.0),
    "tiny": _Sizes(heads=16, views=2, images=2, joint_side=64, held_out_heads=4, light_width=0.05),
}


@dataclass(frozen=True)
class TrainOptions:
    """The line, checked; `networks` are those of --start-from."""

    output: Path
    preset: Preset
    stage: Stage
    dataset: Path | None
    heads_from: str
    fit_with: str
    heads: int | None
    views: int | None
    bank: Path | None
    texture_size: int
    photos: Path | None
    vgg_weights: str | None
    light_features: Path | None
    without_normals: bool
    mean_face: bool
    jobs: int
    settings: Settings
    networks: dict[str, "nn.Module"] = field(default_factory=dict)

    @property
    def sizes(self) -> _Sizes:
        """The preset's, and what the line says of them."""
        preset = _SIZES[self.preset]
        return replace(preset, heads=self.heads or preset.heads, views=self.views or preset.views)


def build_objective(options: TrainOptions) -> "Objective":
    """The stage's objective; bakes, unwraps and finds whatever it draws from, where that is missing."""
    builders = {
        "reflectance": _chart,
        "geometry": _geometry,
        "light-features": _light_features,
        "joint": _joint,
        "diffuse-sh": _diffuse_sh,
    }
    return builders[options.stage](options)


def trained_networks(stage: Stage) -> tuple[str, ...]:
    """Names of the networks that a stage trains."""
    return ("reflectance", "geometry") if stage == "joint" else (stage.replace("-", "_"),)


def _chart(options: TrainOptions) -> "Objective":
    from facerf_cli.training.pretrained import load_light_features
    from facerf_cli.training.texture_objective import TextureObjective, TextureObjectiveSettings

    light = load_light_features(options.light_features) if options.light_features else None
    network = options.networks.get("reflectance") or _reflectance(options)
    settings = TextureObjectiveSettings(held_out_heads=options.sizes.held_out_heads)
    return TextureObjective(_samples(options), network, light, settings)


def _light_features(options: TrainOptions) -> "Objective":
    from facerf_cli.network.feature_networks import LightNetwork, LightSettings
    from facerf_cli.training.light_features_objective import LightFeaturesObjective, LightFeaturesSettings

    network: Any = options.networks.get("light_features")
    network = network or LightNetwork(LightSettings(width=options.sizes.light_width))
    settings = LightFeaturesSettings(held_out_heads=options.sizes.held_out_heads)
    return LightFeaturesObjective(_samples(options), network, settings)


def _diffuse_sh(options: TrainOptions) -> "Objective":
    from facerf_cli.network.diffuse_sh import DiffuseNetwork, DiffuseSettings
    from facerf_cli.training.diffuse_sh_objective import DiffuseObjective, SumSettings

    sizes = DiffuseSettings()
    if options.preset == "tiny":
        sizes = DiffuseSettings(32, _TINY_WIDTHS, _TINY_WIDTHS, 4, 4, 16)
    network: Any = options.networks.get("diffuse_sh") or DiffuseNetwork(sizes)
    settings = SumSettings(held_out_heads=options.sizes.held_out_heads)
    return DiffuseObjective(_samples(options), network, settings)


def _geometry(options: TrainOptions) -> "Objective":
    from facerf_cli.synth.face_crops import RenderedFaces
    from facerf_cli.synth.head_images import add_head_images
    from facerf_cli.training.geometry_objective import GeometryObjective, GeometryObjectiveSettings

    folder = options.bank or options.output / "bank"
    provenance, sizes = _bake(options, folder), options.sizes
    images = folder / "pictures"
    add_head_images(folder / "heads", images, sizes.images, options.jobs, options.settings.seed)
    faces = RenderedFaces(images, provenance)
    network: Any = options.networks.get("geometry")
    network = network or _geometry_network(options, faces.mean_translation_m())
    settings = GeometryObjectiveSettings(held_out_heads=sizes.held_out_heads)
    return GeometryObjective(faces, network, settings)


def _joint(options: TrainOptions) -> "Objective":
    from facerf_cli.dataset.crops import mean_translation_m
    from facerf_cli.dataset.dataset import read_dataset
    from facerf_cli.face.morphable import load_face_model
    from facerf_cli.training.joint_objective import JointObjective, JointSettings
    from facerf_cli.training.pretrained import load_light_features, load_vgg

    assert options.dataset
    dataset = read_dataset(options.dataset)
    vgg = options.vgg_weights is not None or options.preset == "paper"  # which does not go without
    appearance = load_vgg(options.vgg_weights) if vgg else None
    if options.preset == "paper" and options.light_features is None:
        raise UsageError(
            "the paper's loss wants S_f: give --light-features FILE, which "
            "`facerf train --stage light-features` makes, or take another preset"
        )
    side = options.sizes.joint_side
    return JointObjective(
        dataset,
        load_face_model(),  # a Geometry Network's, whatever the dataset was fitted with
        options.networks.get("reflectance") or _reflectance(options),
        options.networks.get("geometry") or _geometry_network(options, mean_translation_m(dataset)),
        appearance,
        load_light_features(options.light_features) if options.light_features else None,
        _photos(options, side),
        JointSettings(side, side, mean_face=options.mean_face, seed=options.settings.seed),
    )


def _photos(options: TrainOptions, side: int) -> Any:
    from facerf_cli.cli.batch import PHOTO_SUFFIXES, collect_items
    from facerf_cli.dataset.photos import open_photos

    if options.photos is None:
        return None
    items = collect_items([str(options.photos)], options.output, PHOTO_SUFFIXES)
    paths = [item.input_path for item in items]
    return open_photos(paths, options.output / "photos", side, options.jobs)


def _reflectance(options: TrainOptions) -> Any:
    from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
    from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork, PaperReflectanceSettings

    normals = not options.without_normals
    if options.preset == "paper":
        return PaperReflectanceNetwork(PaperReflectanceSettings(normals=normals))
    if options.preset == "tiny":
        return DefaultReflectanceNetwork(
            DefaultReflectanceSettings(32, _TINY_WIDTHS, _TINY_WIDTHS, 2, _TINY_LIGHTS, normals)
        )
    return DefaultReflectanceNetwork(DefaultReflectanceSettings(normals=normals))


def _geometry_network(options: TrainOptions, mean_m: tuple[float, float, float] | None = None) -> Any:
    from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings

    form: Any = "paper" if options.preset == "paper" else "default"
    return GeometryNetwork(GeometryNetworkSettings(form, mean_translation_m=mean_m or (0.0, 0.0, -1.1)))


def _samples(options: TrainOptions) -> "SampleSource":
    """A dataset's textures, or the bank."""
    from facerf_cli.dataset.samples import open_dataset_textures
    from facerf_cli.light.sphere import RIG_LIGHTS

    if options.dataset:
        rig = _TINY_LIGHTS if options.preset == "tiny" else RIG_LIGHTS  # of the mean face's shadows
        return open_dataset_textures(
            options.dataset, options.fit_with, options.texture_size, options.jobs, rig
        )
    return _fill_bank(options, options.bank or options.output / "bank")


def _fill_bank(options: TrainOptions, folder: Path) -> "Bank":
    from facerf_cli.face.morphable import load_face_model
    from facerf_cli.synth.heads_bank import add_views, load_bank

    provenance = _bake(options, folder)
    fitted_with = _mean_model(options, folder) if options.mean_face else options.fit_with
    fitted = load_face_model(fitted_with)
    views = folder / f"views-{fitted.name}"
    add_views(folder / "heads", views, fitted_with, options.sizes.views, options.jobs, options.settings.seed)
    fit = {"fitted_with": fitted.credit, "skin": "procedural (facerf)"}
    return load_bank(folder / "heads", views, provenance | fit)


def _bake(options: TrainOptions, folder: Path) -> dict[str, Any]:
    """Bake the heads that are missing; what they are made of."""
    from facerf_cli.face.morphable import load_face_model
    from facerf_cli.light.transport import BakeSettings
    from facerf_cli.synth.bake_heads import HeadBakeSettings, bake_heads

    heads, held_out, bake = options.sizes.heads, options.sizes.held_out_heads, HeadBakeSettings()
    if heads < held_out + 2:
        raise UsageError(f"--heads {heads}: the mean face and {held_out} heads are held out; give more")
    if options.preset == "tiny":
        bake = HeadBakeSettings(32, _TINY_LIGHTS, bake=BakeSettings(light_samples=1, bounce_samples=2))
    drawn = load_face_model(options.heads_from)
    load_face_model(options.fit_with)  # a bad one is named before anything is baked
    bake_heads(folder / "heads", options.heads_from, heads, options.jobs, options.settings.seed, bake)
    found = len(list((folder / "heads").glob("*.safetensors")))
    return {
        "heads": f"{found} synthetic heads drawn from {drawn.credit}",
        "licence": f"MIT; the heads' shapes: {drawn.licence}",
    }


def _mean_model(options: TrainOptions, folder: Path) -> str:
    """The face model to fit with, with shapes that do nothing: its fit is a pose."""
    from facerf_cli.face.morphable import load_face_model, save_face_model

    still = load_face_model(options.fit_with).pose_only()
    path = folder / f"{still.name}.npz"
    save_face_model(path, still)
    return str(path)


_SMOOTH = 0.95  # of the losses that are shown
log = logging.getLogger(LOGGER_NAME)


class TrainProgress:
    """Step, losses, the last validation, the share of time that waited for data, and the time left."""

    def __init__(self, steps: int | None, max_seconds: float | None, settings: Settings, shown: bool) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

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
        """By the pace of this leg, or by the clock, whichever ends first; None while it has no pace yet."""
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
