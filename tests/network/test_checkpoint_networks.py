from pathlib import Path
from typing import Any

import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.network.checkpoint import load_networks, save_checkpoint
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.features import LightNetwork
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.reflectance_paper import PaperReflectanceSettings

DESCRIBED: dict[str, dict[str, Any]] = {
    "reflectance": {"form": "default", **DefaultReflectanceSettings().__dict__},
    "paper": {"form": "paper", **PaperReflectanceSettings().__dict__},
    "geometry": {"form": "default", **GeometryNetworkSettings().__dict__},
    "light_features": LightNetwork().as_metadata(),
    "diffuse_sh": DiffuseNetwork().as_metadata(),
}
REFUSED = r"do not fit this version's network|is not a finite number|too large"
NONSENSE = [
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
    {"a": 1},
]


@pytest.mark.parametrize(("name", "key"), [(name, key) for name in DESCRIBED for key in DESCRIBED[name]])
@pytest.mark.filterwarnings("ignore:Initializing zero-element tensors")  # torch's, of layers without channels
def test_settings_that_make_no_network_are_refused_in_words(tmp_path: Path, name: str, key: str) -> None:
    path = tmp_path / "a.safetensors"
    for value in NONSENSE:
        kind = "reflectance" if name == "paper" else name
        networks = {kind: DESCRIBED[name] | {key: value}}
        save_checkpoint(path, {f"{kind}.x": torch.zeros(1)}, {"layout_version": 3, "networks": networks})
        with pytest.raises(InputError, match=REFUSED):
            load_networks(path, 3)


@pytest.mark.parametrize(
    "networks", [[], "x", {"reflectance": []}, {"reflectance": {}}, {"other": {"form": "a"}}]
)
def test_metadata_that_describe_no_networks_are_refused_in_words(tmp_path: Path, networks: Any) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, {"w": torch.zeros(1)}, {"layout_version": 3, "networks": networks})
    with pytest.raises(InputError, match="do not fit this version's network"):
        load_networks(path, 3)


def test_weights_of_other_sizes_are_refused_in_words(tmp_path: Path) -> None:
    network = GeometryNetwork()
    tensors = {f"geometry.{name}": tensor for name, tensor in network.state_dict().items()}
    tensors["geometry.regress.bias"] = torch.zeros(3)
    path = tmp_path / "a.safetensors"
    described = {"geometry": network.as_metadata()}
    save_checkpoint(path, tensors, {"layout_version": 3, "networks": described})
    with pytest.raises(InputError, match="do not fit this version's network"):
        load_networks(path, 3)


@pytest.mark.parametrize("setting", [{"side": -4}, {"side": 4_000_000}, {"side": 1.5}, {"normals": 1}])
def test_settings_that_no_tensor_betrays_are_refused_in_words(
    tmp_path: Path, setting: dict[str, Any]
) -> None:
    network = DefaultReflectanceNetwork(
        DefaultReflectanceSettings(side=16, encoder_widths=(8,), decoder_widths=(8,), rig_lights=4)
    )
    path = tmp_path / "a.safetensors"
    tensors = {f"reflectance.{name}": tensor for name, tensor in network.state_dict().items()}
    described = {"reflectance": network.as_metadata()}
    save_checkpoint(path, tensors, {"layout_version": 3, "networks": described})
    load_networks(path, 3)
    described["reflectance"] |= setting
    save_checkpoint(path, tensors, {"layout_version": 3, "networks": described})
    with pytest.raises(InputError, match="do not fit this version's network"):
        load_networks(path, 3)
