"""The networks that `facerf train` trains or compares with, made of a preset and options; and their cost."""

import logging
from dataclasses import dataclass, replace
from typing import Any

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.errors import InputError, UsageError
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.checkpoint import form_of, new_network
from facerf_cli.network.vgg import load_vgg
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.synth.bank.heads import HeadBakeSettings
from facerf_cli.training.losses import load_features
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.settings import Preset

# Sizes of networks with the preset `tiny`, and the lights of the rig that it bakes heads under.
TINY_LIGHTS = 20
_TINY_CODER: dict[str, Any] = {"side": 32, "encoder_widths": (8, 12, 16), "decoder_widths": (8, 12, 16)}
_TINY_UNET: dict[str, Any] = {"widths": (8, 8, 12, 16), "blocks": (0, 1, 1, 1)}
_TINY_NETWORKS: dict[str, dict[str, Any]] = {
    "reflectance default": _TINY_CODER | {"template_channels": 2, "rig_lights": TINY_LIGHTS},
    "reflectance paper": {"side": 32, "widths": (8, 12, 16), "features": 8},
    "diffuse_sh default": _TINY_CODER | {"light_channels": 4, "light_grid": 4, "light_hidden": 16},
    "parsing default": _TINY_UNET | {"side": 64},
    "portrait default": _TINY_UNET,
}

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class PresetSizes:
    """Amounts of data and sizes of networks of a preset."""

    heads: int = 240
    views: int = 8
    texture_side: int = 128  # of a dataset's textures
    joint_side: int = 256  # of the stage joint's crops and textures
    held_out_heads: int = 12
    light_width: float = 0.25  # of S_f and V_f; 1 is VGG-16's


_SIZES: dict[Preset, PresetSizes] = {
    "default": PresetSizes(),
    "paper": PresetSizes(texture_side=512, joint_side=512, light_width=1.0),
    "tiny": PresetSizes(heads=16, views=2, joint_side=64, held_out_heads=4, light_width=0.05),
}


@dataclass(frozen=True, eq=False)
class StageNetworks:
    """The networks of a run, of the sizes that its preset and options give, and those sizes."""

    options: TrainOptions
    trained: dict[str, Any]  # networks of --start-from

    @property
    def sizes(self) -> PresetSizes:
        """Sizes of the preset, with --heads and --views if given."""
        options, preset = self.options, _SIZES[self.options.preset]
        return replace(preset, heads=options.heads or preset.heads, views=options.views or preset.views)

    @property
    def texture_side(self) -> int:
        """Side of the textures of the stages that read textures: of a dataset, or of baked heads."""
        if self.options.dataset:
            return self.options.texture_size or self.sizes.texture_side
        return self.bake_settings.side

    @property
    def joint_side(self) -> int:
        """Side of the crops and textures of the stages that read crops; `tiny` takes any dataset's."""
        options, side = self.options, self.sizes.joint_side
        if options.preset == "tiny" and options.dataset:
            side = min(side, read_dataset(options.dataset).crop_px)
        return options.texture_size or side

    @property
    def bake_settings(self) -> HeadBakeSettings:
        """Sides and lights of baked heads."""
        if self.options.preset == "tiny":
            return HeadBakeSettings(32, TINY_LIGHTS, bake=BakeSettings(light_samples=1, bounce_samples=2))
        return HeadBakeSettings()

    def frozen_appearance(self, side: int) -> Any:
        """V_f; None without one."""
        options = self.options
        if options.appearance_features:
            return load_features(options.appearance_features, "appearance_features", side)
        if options.vgg_weights is None:
            if options.preset != "paper":
                return None
            raise UsageError(
                "the paper's loss needs V_f; give --vgg-weights imagenet (553 MB), a file of it, or "
                "--appearance-features FILE, a checkpoint of `facerf train --stage appearance-features "
                f"--texture-size {side}`"
            )
        return load_vgg(options.vgg_weights)

    def frozen_light_features(self, side: int) -> Any:
        """S_f for images of a side; None without one."""
        path, options = self.options.light_features, self.options
        if path is None and options.preset == "paper" and options.stage == "joint":
            raise UsageError(
                "the paper's loss needs S_f; give --light-features FILE, a checkpoint of `facerf train "
                f"--stage light-features --texture-size {side}`"
            )
        return load_features(path, "light_features", side) if path else None

    def network(self, name: str, form: str = "default", **settings: Any) -> Any:
        """The network of --start-from, or an untrained one of the preset's sizes."""
        tiny = _TINY_NETWORKS.get(f"{name} {form_of(name, form)}") if self.options.preset == "tiny" else None
        return self.trained.get(name) or new_network(name, form, settings | (tiny or {}))

    def features(self, name: str, side: int, **settings: Any) -> Any:
        """S_f or V_f; InputError for one of --start-from that was trained on images of another side."""
        network = self.network(name, "vgg", width=self.sizes.light_width, side=side, **settings)
        if network.settings.side != side:
            trained = network.settings.side
            raise InputError(
                f"{self.options.start_from}: trained on images of {trained} px, here they have {side}; "
                f"give --texture-size {trained}"
            )
        return network

    def reflectance(self, side: int) -> Any:
        """The Reflectance Network of the options' form; the paper's works at the textures' side."""
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
                f"--without-normals: the form {form} has no setting normals; leave it out"
            ) from None

    def geometry(self, mean_translation_m: tuple[float, float, float]) -> Any:
        """The Geometry Network; with --mean-face of the pose alone (paper, 'Ablative Study')."""
        form = "paper" if self.options.preset == "paper" else "default"
        shapes = {"identity": 0, "expression": 0} if self.options.mean_face else {}
        return self.network("geometry", form, mean_translation_m=mean_translation_m, **shapes)
