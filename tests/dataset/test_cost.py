"""What a dry run says that files take is what the files take."""

from pathlib import Path

import pytest
import torch

from facerf_cli.dataset.cost import Cost, cost_of_sources, cost_of_textures, recipe_bytes
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import (
    draw_pairs,
    image_path,
    load_pairs,
    pairs_path,
    relight_subject,
    weights_path,
    write_pairs,
)
from facerf_cli.dataset.textures import open_dataset_textures
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.face.morphable import load_face_model
from facerf_cli.synth.sky.skies import ProceduralMaps
from facerf_cli.training.run_folder import begin, save_state
from facerf_cli.training.settings import PRESETS, Preset
from facerf_cli.training.stage_networks import checkpoint_bytes
from tests.dataset.dataset_fixture import write_small_dataset

SIDE = 32


def bytes_of(*paths: Path) -> int:
    return sum(path.stat().st_size for path in paths)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), lights=20, crop_px=48)


def test_recipes_sources_and_textures(dataset: Dataset) -> None:
    drawn = draw_pairs(dataset, envmap_names(ProceduralMaps(3, 0, 32)), 6, 0)
    pairs = write_pairs(dataset, drawn, overwrite=False)
    files = bytes_of(pairs_path(dataset), weights_path(dataset))
    assert recipe_bytes(dataset, drawn) == pytest.approx(files, rel=0.02)
    sources, subjects = cost_of_sources(dataset, pairs), dataset.subjects[:3]
    assert not list(pairs_path(dataset).parent.glob("*/*.exr"))
    for rows, weights in load_pairs(dataset).values():
        relight_subject(dataset, rows, weights)
    written = bytes_of(*(image_path(dataset, *pair.key) for pair in pairs))
    assert sources.file_bytes == pytest.approx(written, rel=0.1) and sources.core_s > 0
    assert cost_of_sources(dataset, []) == Cost()
    model, folder = load_face_model(), dataset.folder / f"textures-{SIDE}"
    textures = cost_of_textures(dataset, model, SIDE, subjects)
    assert not folder.exists() and textures.core_s > 0
    open_dataset_textures(dataset.folder, "builtin", SIDE, 1, 20)  # of training and validation
    assert textures.file_bytes == pytest.approx(bytes_of(*folder.glob("*/*.*")), rel=0.02)
    assert cost_of_textures(dataset, model, SIDE, subjects) == Cost()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_the_state_of_a_run(preset: Preset, tmp_path: Path) -> None:
    networks, settings = torch.nn.ModuleDict({"toy": torch.nn.Linear(256, 256)}), PRESETS[preset]
    state = begin(networks, settings, {}, {})
    networks["toy"](torch.ones(1, 256)).sum().backward()
    state.optimizer.step()
    save_state(tmp_path / "state.pt", state, settings)
    _, expected = checkpoint_bytes({"toy": networks["toy"]}, bool(settings.ema_decay))
    assert bytes_of(tmp_path / "state.pt") == pytest.approx(expected, rel=0.02)
