import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_checkpoint, load_networks, save_checkpoint
from facerf_cli.network.files import SHIPPED


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
def test_what_is_no_checkpoint_is_refused_in_one_line(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
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
    with pytest.raises(InputError, match=r"b\.safetensors") as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)
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
