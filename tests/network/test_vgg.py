import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.downloads import PublishedFile
from facerf_cli.network import vgg as feature_networks
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.features import LightNetwork, LightSettings, VggFeatures
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.network.vgg import VGG16, load_vgg
from facerf_cli.training.losses import load_features
from tests.kinds import Patch, Said
from tests.refusals import refused

# What is beyond the trunk in the published file, smaller here.
BEYOND = {"features.17.weight": torch.zeros(2, 2), "classifier.6.bias": torch.zeros(1000)}


@pytest.fixture
def weights() -> dict[str, torch.Tensor]:
    return dict(VggFeatures().state_dict()) | BEYOND


@pytest.mark.parametrize("kind", ["new.pth", "old.pth", "a.safetensors"])
def test_a_path_is_taken_as_it_is(tmp_path: Path, weights: dict[str, torch.Tensor], kind: str) -> None:
    path = tmp_path / kind
    if path.suffix == ".pth":  # the published file is of the old kind
        torch.save(weights, path, _use_new_zipfile_serialization=kind == "new.pth")
    else:
        save_file(weights, path)
    network = load_vgg(path)
    assert torch.equal(network.state_dict()["features.14.weight"], weights["features.14.weight"])
    assert not any(parameter.requires_grad for parameter in network.parameters()) and not network.training


def test_imagenet_is_the_published_file_in_the_cache(
    tmp_path: Path, weights: dict[str, torch.Tensor], monkeypatch: Patch
) -> None:
    asked = []

    def fetched(published: PublishedFile, option: str) -> Path:
        asked.append((published, option))
        torch.save(weights, tmp_path / "vgg.pth")
        return tmp_path / "vgg.pth"

    monkeypatch.setattr(feature_networks, "fetch", fetched)
    load_vgg("imagenet")
    assert asked == [(VGG16, "--vgg-weights PATH")]
    assert VGG16.sha256.startswith("397923af") and len(VGG16.sha256) == 64 and "397923af" in VGG16.name


def test_without_weights_the_words_help() -> None:
    refused(UsageError, "--vgg-weights imagenet ... --vgg-weights PATH", load_vgg, None)


class _Bomb:
    def __reduce__(self) -> tuple:
        return (print, ("a pickle was run",))


BROKEN = ("missing", "folder", "text", "empty", "pickle", "old pickle", "list", "other", "safetensors")


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_vgg_is_refused_in_one_line(tmp_path: Path, kind: str, capsys: Said) -> None:
    path = tmp_path / ("b.safetensors" if kind == "safetensors" else "b.pth")
    if kind == "folder":
        path.mkdir()
    elif kind in ("text", "safetensors"):
        path.write_text("hello, I am no tensor")
    elif kind == "empty":
        path.touch()
    elif kind == "pickle":
        torch.save({"features.0.weight": _Bomb()}, path)
    elif kind == "old pickle":
        path.write_bytes(pickle.dumps(_Bomb()))
    elif kind == "list":
        torch.save([1, 2], path)
    elif kind == "other":
        torch.save({"conv1.weight": torch.zeros(1)}, path)
    refused(InputError, "b.", load_vgg, path)
    assert "a pickle was run" not in capsys.readouterr().out


def test_light_features_come_back_frozen_or_are_refused(tmp_path: Path) -> None:
    network = LightNetwork(LightSettings(width=1 / 16, grid=2, hidden=4))
    path = tmp_path / "last.safetensors"
    save_networks(path, {"light_features": network}, {"layout_version": LAYOUT_VERSION})
    loaded = load_features(path, "light_features")
    texture = torch.rand(2, 3, 16, 16)
    assert torch.allclose(loaded(texture), network(texture), atol=1e-2)  # stored in half precision
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    network = DefaultReflectanceNetwork(DefaultReflectanceSettings(32, (8, 8), (8, 8), 2, 4))
    save_networks(path, {"reflectance": network}, {"layout_version": LAYOUT_VERSION})
    refused(InputError, "facerf train", load_features, path, "light_features")


def test_offline_names_the_option(tmp_path: Path, monkeypatch: Patch) -> None:
    nowhere = PublishedFile("http://127.0.0.1:9/vgg16-397923af.pth", VGG16.sha256, VGG16.size_limit)
    monkeypatch.setattr(feature_networks, "VGG16", nowhere)
    monkeypatch.setattr("facerf_cli.files.downloads.cache_folder", lambda: tmp_path)
    with pytest.raises(FacerfError, match=r"cannot be fetched .*, or use --vgg-weights PATH$"):
        load_vgg("imagenet")
