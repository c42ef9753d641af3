import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import (
    draw_pairs,
    image_path,
    load_pairs,
    pairs_path,
    relight_subject,
    write_pairs,
)
from facerf_cli.dataset.textures import DatasetTextures, heads_of, open_dataset_textures
from facerf_cli.dataset.unwrapped import UnwrappedView, texture_path
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.errors import InputError
from facerf_cli.face.topology import grid_triangles
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.raster.texture import unwrap
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.synth.sky.skies import ProceduralMaps
from facerf_cli.training.loop import train
from facerf_cli.training.settings import PRESETS
from facerf_cli.training.texture import TextureObjective, TextureObjectiveSettings
from tests.dataset.dataset_fixture import write_small_dataset
from tests.refusals import refused
from tests.stacks import read_olat_stack

SIDE, LIGHTS = 32, 20
NETWORK = DefaultReflectanceSettings(
    side=32, encoder_widths=(8, 12, 16), decoder_widths=(8, 12, 16), template_channels=2, rig_lights=LIGHTS
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), lights=LIGHTS, crop_px=48)


@pytest.fixture(scope="module")
def lazy(dataset: Dataset) -> DatasetTextures:
    """Pairs without pictures."""
    maps = envmap_names(ProceduralMaps(3, 0, 32))
    write_pairs(dataset, draw_pairs(dataset, maps, 5, 0), overwrite=False)
    return open_dataset_textures(dataset.folder, "builtin", SIDE, 1, LIGHTS)


@pytest.fixture(scope="module")
def written(dataset: Dataset, lazy: DatasetTextures) -> DatasetTextures:
    """The same with their pictures."""
    for rows, weights in load_pairs(dataset).values():
        relight_subject(dataset, rows, weights)
    return open_dataset_textures(dataset.folder, "builtin", SIDE, 1, LIGHTS)


def draw(captured: DatasetTextures, seed: int = 0) -> Sample:
    return captured.draw(torch.tensor([0, 1, 2]), 3, torch.Generator().manual_seed(seed))


def test_textures_are_the_unwrapped_stack(lazy: DatasetTextures) -> None:
    dataset = lazy.dataset
    stack = read_olat_stack(dataset.stack_path("0001", "C1"))
    from facerf_cli.face.fit import load_fit

    fit = load_fit(dataset.fit_path("0001", "C1"))
    vertices = fit.vertices_camera(lazy.model)
    image = stack.olats[17].float()
    texture, visible = unwrap(image, vertices, grid_triangles(), fit.camera, SIDE)
    with safe_open(texture_path(dataset, SIDE, "0001", "C1"), "pt") as file:
        torch.testing.assert_close(file.get_tensor("olats")[17], texture.half())
        seen = file.get_tensor("visible")[0].float()
        torch.testing.assert_close(file.get_tensor("directions").double().numpy(), stack.header.directions)
    assert seen.max() > 0.9 and bool((seen <= visible + 1e-3).all())
    assert not texture_path(dataset, SIDE, "0003", "C0").exists()  # of the split test


def test_lazy_sources_are_the_written_ones(lazy: DatasetTextures, written: DatasetTextures) -> None:
    assert not lazy.sources and set(written.sources) == {"0000", "0001", "0002"}
    generator = torch.Generator().manual_seed(1)
    for subject in ("0000", "0002"):
        for _ in range(4):
            state = generator.get_state()
            computed = lazy._draw_face(subject, 3, generator)
            generator.set_state(state)
            read = written._draw_face(subject, 3, generator)
            seen = computed.visible > 0.5
            assert bool(seen.any())
            for a, b in zip(computed.texture, read.texture, strict=True):
                torch.testing.assert_close(a[seen[0]], b[seen[0]], rtol=3e-3, atol=1e-3)
            assert torch.equal(computed.target, read.target)


def test_a_sample_is_exposed_and_weighed_as_the_banks_are(lazy: DatasetTextures) -> None:
    sample = draw(lazy)
    assert sample.source.shape == (3, 3, SIDE, SIDE) and sample.target.shape == (3, 3, 3, SIDE, SIDE)
    assert all(getattr(sample, field.name).isfinite().all() for field in fields(sample))
    mean = (sample.source.mean(1, keepdim=True) * sample.visible).sum((1, 2, 3)) / sample.visible.sum(
        (1, 2, 3)
    )
    torch.testing.assert_close(mean, torch.full((3,), MEAN_RADIANCE), rtol=0.02, atol=0)
    assert sample.weight.max() <= 1 and sample.weight.mean() > 0.3
    torch.testing.assert_close(sample.lights.norm(dim=-1), torch.ones(3, 3))
    # Lambert's law holds between what the network is given: the target goes with n.l.
    cosine = torch.einsum("blc,bcij->blij", sample.lights, sample.normals_target).clamp_min(0)
    seen = (sample.weight > 0.9)[:, None, 0].expand_as(cosine)
    lit = sample.target.mean(2)
    correlation = torch.corrcoef(torch.stack([cosine[seen], lit[seen]]))[0, 1]
    assert correlation > 0.8
    again = draw(lazy)
    assert torch.equal(again.source, sample.source) and not torch.equal(draw(lazy, 1).source, sample.source)


def test_the_pairs_light_is_among_the_targets_and_the_mean_face_is_the_models(lazy: DatasetTextures) -> None:
    pairs, _ = load_pairs(lazy.dataset)["0000"]
    wanted = {pair.target_light for pair in pairs}
    for seed in range(4):
        face = lazy._draw_face("0000", 2, torch.Generator().manual_seed(seed))
        world = torch.from_numpy(lazy.dataset.directions_world).float()
        rotations = [_rotation(lazy, pair.target_camera) for pair in pairs]
        numbers = {int((world @ rotation.T @ face.lights[0]).argmax()) for rotation in rotations}
        assert numbers & wanted and len(face.lights) == 2
    normals, visibility, directions = lazy.mean_face()
    assert len(visibility) == len(directions) == LIGHTS
    front, behind = int(directions[:, 2].argmax()), int(directions[:, 2].argmin())
    assert visibility[front].mean() > 0.8 > 0.3 > visibility[behind].mean()
    np.testing.assert_allclose(normals.norm(dim=0), 1, atol=1e-5)
    assert image_path(lazy.dataset, "0000", 3).name == "00003.exr"


def test_a_target_of_another_camera_has_its_normals_and_lights(lazy: DatasetTextures) -> None:
    with lazy._open("0000", "C0") as file:
        source = UnwrappedView.read(file)
    face = lazy._face("0000", "C1", source, source.lit, 5, 3, torch.Generator().manual_seed(0))
    with lazy._open("0000", "C1") as file:
        target = UnwrappedView.read(file)
        assert torch.equal(face.target[0], file.get_tensor("olats")[5].float())
    torch.testing.assert_close(face.normals_target, target.normals, atol=2e-3, rtol=0)
    torch.testing.assert_close(face.lights[0], target.directions[5])
    assert float((face.lights[0] - source.directions[5]).norm()) > 0.1
    assert bool((face.weight <= target.visible).all())


def _rotation(captured: DatasetTextures, camera: str) -> torch.Tensor:
    with safe_open(texture_path(captured.dataset, SIDE, "0000", camera), "pt") as file:
        return file.get_tensor("rotation")


def test_without_pairs_the_light_is_drawn(dataset: Dataset, lazy: DatasetTextures, tmp_path: Path) -> None:
    for part in ("olat", "fits", "dataset.json", f"textures-{SIDE}"):
        (tmp_path / part).symlink_to(dataset.folder / part)
    assert not pairs_path(replace(dataset, folder=tmp_path)).exists()
    captured = open_dataset_textures(tmp_path, "builtin", SIDE, 1, LIGHTS)
    sample = draw(captured)
    assert sample.source.isfinite().all() and sample.source.std() > 0.02


def test_a_changed_stack_or_a_damaged_texture_is_unwrapped_again(
    dataset: Dataset, lazy: DatasetTextures
) -> None:
    path = texture_path(dataset, SIDE, "0000", "C0")
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    open_dataset_textures(dataset.folder, "builtin", SIDE, 1, LIGHTS)
    assert path.read_bytes() == whole
    before = path.stat().st_mtime_ns
    open_dataset_textures(dataset.folder, "builtin", SIDE, 1, LIGHTS)
    assert path.stat().st_mtime_ns == before
    dataset.stack_path("0000", "C0").touch()
    open_dataset_textures(dataset.folder, "builtin", SIDE, 1, LIGHTS)
    assert path.stat().st_mtime_ns != before


def test_training_on_a_dataset_lowers_the_loss_and_names_it(lazy: DatasetTextures, tmp_path: Path) -> None:
    objective = TextureObjective(
        lazy, DefaultReflectanceNetwork(NETWORK), settings=TextureObjectiveSettings(lights=3)
    )
    path = train(objective, tmp_path, replace(PRESETS["tiny"], steps=60, validate_every=100))
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    losses = torch.tensor([row["loss"] for row in rows])
    assert losses[-10:].mean() < 0.85 * losses[:10].mean()
    _, metadata = load_networks(path, 1)
    assert metadata["provenance"]["trained_on"] == f"{lazy.dataset.folder.name}, 2 subjects"
    assert metadata["metrics"]["si_mse"] > 0 and lazy.dataset.folder.name in metadata["licence"]


def test_the_only_person_is_validated_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one = write_small_dataset(tmp_path, counts=(1, 0, 0), cameras=1, lights=4, crop_px=32)
    assert [heads.tolist() for heads in heads_of(one, 12)] == [[0], [0]]
    assert "nobody is held out" in caplog.text


def test_splits_and_models_that_cannot_be_trained_on(dataset: Dataset, tmp_path: Path) -> None:
    refused(InputError, "no such face model", open_dataset_textures, dataset.folder, "nobody.npz", SIDE, 1)
    none = write_small_dataset(tmp_path, counts=(2, 0, 0), cameras=1, lights=4, crop_px=32)
    refused(InputError, "run prepare-dataset", open_dataset_textures, none.folder, "builtin", SIDE, 1)
    text = (tmp_path / "dataset.json").read_text().replace('"face_model": "builtin"', '"face_model": "other"')
    (tmp_path / "dataset.json").write_text(text)
    refused(InputError, "give --fit-with", open_dataset_textures, none.folder, "builtin", SIDE, 1)


@pytest.mark.parametrize(
    ("provenance", "words"),
    [
        ({"licence": "CC0"}, "CC0"),
        ({"capture": {"licence": "for research"}}, "for research"),
        (
            {"capture": {"synthetic": True, "face_model_licence": "MIT (USC)"}},
            "MIT; the heads' shapes: MIT (USC)",
        ),
        ({"capture": "a stage"}, "that of the dataset"),
    ],
)
def test_the_licence_is_what_the_dataset_says(
    dataset: Dataset, lazy: DatasetTextures, tmp_path: Path, provenance: dict[str, object], words: str
) -> None:
    for part in ("olat", "fits", f"textures-{SIDE}"):
        (tmp_path / part).symlink_to(dataset.folder / part)
    content = json.loads((dataset.folder / "dataset.json").read_text()) | {"provenance": provenance}
    (tmp_path / "dataset.json").write_text(json.dumps(content))
    assert words in open_dataset_textures(tmp_path, "builtin", SIDE, 1, LIGHTS).provenance["licence"]
