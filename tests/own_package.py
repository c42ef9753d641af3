"""A package with a network and an objective, as a user could install it."""

import sys
from pathlib import Path

import pytest

from facerf_cli.network import checkpoint

OWN = """
from dataclasses import dataclass
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.training.texture import TextureObjective

@dataclass(frozen=True)
class Small(DefaultReflectanceSettings):
    side: int = 32
    encoder_widths: tuple[int, ...] = (8, 12, 16)
    decoder_widths: tuple[int, ...] = (8, 12, 16)
    template_channels: int = 2
    rig_lights: int = 20

class Darker(DefaultReflectanceNetwork):
    kind_of_settings = Small

    def decode_root(self, *given):
        return 0.5 * super().decode_root(*given)

class Same(Darker):
    pass

class Doubled(TextureObjective):
    def forward(self, batch):
        return {name: 2 * term for name, term in super().forward(batch).items()}

number = 3
"""
NAME = "my_lab.networks:Darker"
FORMS = dict(checkpoint._CLASSES)


def write_own_package(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package in a folder, and forget its forms afterwards."""
    (site / "my_lab").mkdir(parents=True)
    (site / "my_lab/__init__.py").touch()
    (site / "my_lab/networks.py").write_text(OWN)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(checkpoint, "_CLASSES", dict(FORMS))
    for name in ("my_lab", "my_lab.networks"):
        monkeypatch.delitem(sys.modules, name, raising=False)
