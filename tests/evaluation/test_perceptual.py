"""LPIPS's weights: found, checked, and refused in words."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.evaluation import measure as perceptual
from facerf_cli.evaluation.measure import perceptual_metric
from facerf_cli.network.features import Lpips
from tests.kinds import Patch
from tests.refusals import refused


@pytest.fixture(autouse=True)
def _small_and_not_loaded(monkeypatch: Patch) -> None:
    monkeypatch.setattr(perceptual, "Lpips", small)
    perceptual_metric.cache_clear()


def small() -> Lpips:
    return Lpips(width=1 / 16)


@pytest.fixture
def heads() -> dict[str, torch.Tensor]:
    names = [f"lin{place}.model.1.weight" for place in range(5)]
    return {
        n: head.detach().reshape(1, -1, 1, 1).clone() for n, head in zip(names, small().heads, strict=True)
    }


@pytest.fixture
def vgg(tmp_path: Path) -> Path:
    torch.save(small().trunk.state_dict(), tmp_path / "vgg16.pth")
    return tmp_path / "vgg16.pth"


def save(path: Path, tensors: dict[str, torch.Tensor]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(tensors, path)
    return path


def known(monkeypatch: Patch, tensors: dict[str, torch.Tensor]) -> None:
    """Let these heads be the published ones."""
    network = small()
    network.load_heads(tensors)
    monkeypatch.setattr(perceptual, "_DIGEST", perceptual._digest(network))


def test_a_metric_from_files(
    tmp_path: Path, vgg: Path, heads: dict[str, torch.Tensor], monkeypatch: Patch
) -> None:
    known(monkeypatch, heads)
    metric = perceptual_metric(save(tmp_path / "heads.pth", heads), vgg)
    image = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
    assert metric(image, image) == 0 < metric(1 - image, image)
    refused(InputError, "16 px", metric, image[:15], image[:15])


def test_heads_of_the_installed_package_are_found_without_importing_it(
    tmp_path: Path, vgg: Path, heads: dict[str, torch.Tensor], monkeypatch: Patch
) -> None:
    known(monkeypatch, heads)
    save(tmp_path / "site/lpips/weights/v0.1/vgg.pth", heads)
    (tmp_path / "site/lpips/__init__.py").write_text("raise ImportError('torchvision')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    assert callable(perceptual_metric(None, vgg)) and "lpips" not in sys.modules


def test_other_heads_are_refused(tmp_path: Path, vgg: Path, heads: dict[str, torch.Tensor]) -> None:
    path = tmp_path / "heads.pth"
    for content, words in (
        (None, "heads.pth: no"),
        ({"a": Path("x")}, "heads.pth: no"),
        ({"features.0.weight": torch.zeros(1)}, "heads.pth: no"),
        (heads, "LPIPS v0.1"),  # of another version
    ):
        if content is not None:
            torch.save(content, path)
        refused(InputError, words, perceptual_metric, path, vgg)
