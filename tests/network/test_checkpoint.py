import pickle
import subprocess
import sys
from copy import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_checkpoint, load_networks, save_checkpoint, save_networks
from facerf_cli.network.diffuse_sh import DiffuseNetwork, DiffuseSettings
from facerf_cli.network.features import AppearanceNetwork, AppearanceSettings, LightNetwork, LightSettings
from facerf_cli.network.files import SHIPPED
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.parsing import ParsingNetwork, ParsingSettings
from facerf_cli.network.portrait import PortraitNetwork, PortraitSettings
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork, PaperReflectanceSettings
from tests.kinds import Said
from tests.refusals import refused

FEW = (8, 8, 12)
NETWORKS: dict[str, tuple[type[nn.Module], Any]] = {
    "reflectance": (DefaultReflectanceNetwork, DefaultReflectanceSettings(16, FEW, FEW, rig_lights=4)),
    "paper": (PaperReflectanceNetwork, PaperReflectanceSettings(32, (8, 8, 12, 16), 8)),
    "geometry": (GeometryNetwork, GeometryNetworkSettings(identity=5, expression=3)),
    "light_features": (LightNetwork, LightSettings(width=1 / 16, grid=4, hidden=8)),
    "appearance_features": (AppearanceNetwork, AppearanceSettings(3, 32, 1 / 16, grid=2, hidden=4)),
    "diffuse_sh": (DiffuseNetwork, DiffuseSettings(16, FEW, FEW, 4, 4, 8)),
    "parsing": (ParsingNetwork, ParsingSettings((8, 8, 12, 16), (0, 1, 1, 1), 64, 5, 70)),
    "portrait": (PortraitNetwork, PortraitSettings(FEW, (0, 1, 1), side=32)),
}
NONSENSE: list[Any] = [
    [],
    [8] * 5000,
    [0],
    [[1]],
    [1e400],
    -1,
    1e30,
    10**30,
    float("inf"),
    float("nan"),
    "x",
    None,
]
NONSENSE.append({"a": 1})
# Settings that no tensor betrays, and what is nearly right.
CHANGES: list[tuple[str, dict[str, Any]]] = [
    *(
        ("reflectance", change)
        for change in ({"side": -4}, {"side": 4_000_000}, {"side": 1.5}, {"normals": 1})
    ),
    *(("geometry", change) for change in ({"identity": 10**9}, {"form": "large"}, {"identity": None})),
    *(("geometry", {"mean_translation_m": place}) for place in ([0, 0, 1], [0, 0])),
    *(("parsing", {"widths": widths}) for widths in ([8, 8], [8, 8, 12, 999])),
    *(("parsing", {"blocks": blocks}) for blocks in ([0, 1, 1], [0, 1, 1, 99])),
    *(("parsing", change) for change in ({"classes": 1}, {"landmarks": 7}, {"side": 65})),
    *(
        ("portrait", change)
        for change in ({"widths": [8]}, {"side": 33}, {"classes": 1}, {"blocks": [0, 1, 99]})
    ),
    *(("diffuse_sh", {key: value}) for key, value in (("light_hidden", 0), ("encoder_widths", (4, 10**6)))),
    ("diffuse_sh", {"light_grid": 0.5}),
    *(("light_features", change) for change in ({"width": float("nan")}, {"width": 1e9}, {"colour": 1})),
]


def small(name: str) -> tuple[str, nn.Module]:
    """The name of a network in a checkpoint, and a small one."""
    kind, settings = NETWORKS[name]
    return "reflectance" if name == "paper" else name, kind(settings)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_comes_back_with_its_settings_and_weights(name: str, tmp_path: Path) -> None:
    path, (kind, network) = tmp_path / "a.safetensors", small(name)
    save_networks(path, {kind: network}, {"layout_version": 3})
    loaded: Any = load_networks(path, 3)[0][kind]
    assert type(loaded) is type(network) and loaded.settings == network.settings
    for key, tensor in loaded.state_dict().items():
        assert torch.equal(tensor, network.state_dict()[key]), key


@pytest.mark.filterwarnings("ignore:Initializing zero-element tensors")  # torch's, of layers without channels
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(
            (name, [{key: value} for value in NONSENSE])
            for name in NETWORKS
            for key in vars(NETWORKS[name][1])
        ),
        *((name, [change]) for name, change in CHANGES),
    ],
)
def test_settings_that_make_no_network_are_refused_in_words(
    tmp_path: Path, name: str, changes: list[dict[str, Any]]
) -> None:
    path, (kind, network) = tmp_path / "a.safetensors", small(name)
    lying: Any = copy(network)
    for change in changes:
        lying.as_metadata = lambda change=change: network.as_metadata() | change
        save_networks(path, {kind: lying}, {"layout_version": 3})
        with pytest.raises(
            InputError, match=r"do not fit this version's network|is not a finite number|too large"
        ):
            load_networks(path, 3)


@pytest.mark.parametrize(
    "networks", [[], "x", {"reflectance": []}, {"reflectance": {}}, {"other": {"form": "a"}}]
)
def test_metadata_and_weights_of_no_network_are_refused_in_words(tmp_path: Path, networks: Any) -> None:
    path, network = tmp_path / "a.safetensors", GeometryNetwork()
    tensors = {f"geometry.{name}": tensor for name, tensor in network.state_dict().items()}
    tensors["geometry.regress.bias"] = torch.zeros(3)
    for stored, described in (
        ({"w": torch.zeros(1)}, networks),
        (tensors, {"geometry": network.as_metadata()}),
    ):
        save_checkpoint(path, stored, {"layout_version": 3, "networks": described})
        refused(InputError, "do not fit this version's network", load_networks, path, 3)


def test_round_trip_in_half_precision(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    tensors = {"w": torch.randn(3, 4), "bytes": torch.arange(5, dtype=torch.uint8)}
    save_checkpoint(path, tensors, {"network": {"side": 128}})
    loaded, metadata = load_checkpoint(path)
    assert loaded["w"].dtype == torch.float32 and torch.equal(loaded["w"], tensors["w"].half().float())
    assert torch.equal(loaded["bytes"], tensors["bytes"]) and metadata == {"network": {"side": 128}}
    assert list(tmp_path.iterdir()) == [path]


class _Bomb:
    def __reduce__(self) -> tuple:
        return (print, ("a pickle was loaded",))


@pytest.mark.parametrize("kind", ["missing", "text", "pickle", "truncated", "foreign", "list", "nan"])
def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path, kind: str, capsys: Said) -> None:
    path = tmp_path / "b.safetensors"
    if kind == "text":
        path.write_text("hello")
    elif kind == "pickle":
        path.write_bytes(pickle.dumps(_Bomb()))
    elif kind == "truncated":
        save_checkpoint(path, {"w": torch.zeros(100)}, {})
        path.write_bytes(path.read_bytes()[:-60])
    elif kind == "foreign":
        save_file({"w": torch.zeros(2)}, path)
    elif kind == "list":
        save_file({"w": torch.zeros(2)}, path, {"format": "facerf-checkpoint-1", "facerf": "[]"})
    elif kind == "nan":
        save_checkpoint(path, {"w": torch.tensor([1.0, torch.nan])}, {})
    refused(InputError, "b.safetensors", load_checkpoint, path)
    assert "pickle was loaded" not in capsys.readouterr().out


def test_loading_draws_no_values_and_leaves_torchs_compiler_out() -> None:
    """Values drawn for weights that the file replaces cost seconds; those of the file are all there."""
    before = torch.get_rng_state()
    networks, _ = load_networks(SHIPPED["reflectance"], LAYOUT_VERSION)
    assert torch.equal(torch.get_rng_state(), before)
    stored, _ = load_checkpoint(SHIPPED["reflectance"])
    for name, network in networks.items():
        for key, value in network.state_dict().items():
            assert torch.equal(value, stored[f"{name}.{key}"]), key
    code = f"""
from pathlib import Path
from facerf_cli.network.checkpoint import load_networks
load_networks(Path({str(SHIPPED["reflectance"])!r}), {LAYOUT_VERSION})
import sys
print(*sorted({{"torch._dynamo", "sympy"}} & sys.modules.keys()))
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == ""
