"""Samples of a dataset's faces: the textures of its stacks, exposed and lit as training needs them."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from facerf_cli.dataset.crops import stack_info
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.faces import DatasetFaces, SampleCrops, open_faces
from facerf_cli.dataset.pairs import Pair, draw_pairs, load_pairs, pairs_path, write_pairs
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.errors import InputError
from facerf_cli.face.fit import load_fit
from facerf_cli.face.topology import grid_triangles
from facerf_cli.network.batch import concatenate
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.raster.texture import normal_map, unwrap
from facerf_cli.synth.bank.texture_samples import Sample
from facerf_cli.synth.sky.skies import ProceduralMaps
from facerf_cli.training.loop import train
from facerf_cli.training.objective import seeded
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
def faces(dataset: Dataset) -> DatasetFaces:
    """With pairs."""
    maps = envmap_names(ProceduralMaps(3, 0, 32))
    write_pairs(dataset, draw_pairs(dataset, maps, 5, 0), overwrite=False)
    return open_faces(dataset.folder, "builtin", SIDE, LIGHTS)


def draw(faces: DatasetFaces, head: int, seed: int = 0, lights: int = 3) -> SampleCrops:
    return faces.draw(torch.tensor([head]), lights, torch.Generator().manual_seed(seed))


def sample_of(faces: DatasetFaces, seed: int = 0) -> Sample:
    return faces.sample(concatenate([draw(faces, head, seed) for head in range(3)]))


def pair_of(camera: str, target: str, light: int) -> Pair:
    return Pair("0001", 0, "train", camera, "", 0.0, 0, target, light)


def test_a_sample_is_the_unwrapped_stack(faces: DatasetFaces) -> None:
    """Targets are true textures in the colours of the camera; normals are the source's, turned."""
    dataset, source = faces.dataset, torch.rand(3, 48, 48)
    crops = faces._sample(pair_of("C0", "C1", 17), source, 3, seeded(2))
    stack = read_olat_stack(dataset.stack_path("0001", "C1"))
    fit = load_fit(dataset.fit_path("0001", "C1"))
    vertices = fit.vertices_camera(faces.model)
    wanted, visible = unwrap(stack.olats[17].float(), vertices, grid_triangles(), fit.camera, SIDE)
    sample = faces.sample(crops)
    found = torch.linalg.solve(crops.colours[0], sample.target[0, 0].flatten(1)).view(3, SIDE, SIDE)
    seen = (sample.weight[0, 0] > 0.9) & (visible > 0.9)
    assert seen.float().mean() > 0.2
    assert (found - wanted)[:, seen].abs().mean() < 0.02 * wanted[:, seen].mean()
    normals = normal_map(vertices, grid_triangles(), SIDE)
    torch.testing.assert_close(sample.normals_target[0], normals, atol=2e-3, rtol=0)
    np.testing.assert_allclose(sample.lights[0, 0], stack.header.directions[17], atol=1e-6)
    assert (
        float((sample.lights[0, 0] - stack_info(dataset.stack_path("0001", "C0")).directions[17]).norm())
        > 0.1
    )


def test_a_sample_is_exposed_and_weighed_as_the_banks_are(faces: DatasetFaces) -> None:
    sample = sample_of(faces)
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
    again = sample_of(faces)
    assert torch.equal(again.source, sample.source) and not torch.equal(
        sample_of(faces, 1).source, sample.source
    )


def test_sources_are_the_pairs_and_their_light_is_among_the_targets(faces: DatasetFaces) -> None:
    """In training neighbouring steps share the stack of their sources."""
    pairs, weights = load_pairs(faces.dataset)["0000"]
    reader = replace(faces.train, pairs=pairs)
    for pair, source in reader.draw_sources(3)[:4]:
        olats = read_olat_stack(faces.dataset.stack_path("0000", pair.source_camera)).olats.float()
        expected = torch.einsum("lc,lchw->chw", torch.from_numpy(np.array(weights[pair.index])), olats)
        torch.testing.assert_close(source.float(), expected, rtol=3e-3, atol=1e-3)
    head, crops = faces.draw_shared(2, lambda index, step=0: seeded(4, step, index), 0, 0)
    subject = faces.dataset.subjects[int(head)]
    rigs = [stack_info(faces.dataset.stack_path(subject, camera)).directions for camera in ("C0", "C1")]
    lit = {int((rig @ crops.lights[0, 0]).argmax()) for rig in rigs}
    assert lit & {pair.target_light for pair in load_pairs(faces.dataset)[subject][0]}
    assert crops.lights.shape == (1, 2, 3)


def test_the_mean_face_is_the_models(faces: DatasetFaces) -> None:
    normals, visibility, directions = faces.mean_face()
    assert len(visibility) == len(directions) == LIGHTS
    front, behind = int(directions[:, 2].argmax()), int(directions[:, 2].argmin())
    assert visibility[front].mean() > 0.8 > 0.3 > visibility[behind].mean()
    np.testing.assert_allclose(normals.norm(dim=0), 1, atol=1e-5)


def without_pairs(dataset: Dataset, folder: Path) -> Dataset:
    for part in ("olat", "fits", "dataset.json"):
        (folder / part).symlink_to(dataset.folder / part)
    return read_dataset(folder)


def test_without_pairs_the_light_is_drawn(dataset: Dataset, faces: DatasetFaces, tmp_path: Path) -> None:
    """Of steps that share a stack each has its own light and target."""
    assert not pairs_path(without_pairs(dataset, tmp_path)).exists()
    free = open_faces(tmp_path, "builtin", SIDE, LIGHTS)
    sample = sample_of(free)
    assert sample.source.isfinite().all() and sample.source.std() > 0.02
    drawn = free.train.draw_sources(1)
    assert len({pair.source_camera for pair, _ in drawn}) == 1
    targets = [pair.target_camera for seed in range(4) for pair, _ in free.train.draw_sources(seed)]
    assert {*targets} == {"C0", "C1"}
    assert len({float(source.float().sum()) for _, source in drawn}) > len(drawn) / 2  # flashes are alike
    colours = free.source_colours(48, seeded(0))
    assert colours.shape == (48, 3) and (colours > 0).all()


def test_crops_are_resized_to_twice_the_texture_at_most(faces: DatasetFaces) -> None:
    small = open_faces(faces.dataset.folder, "builtin", 16, LIGHTS)
    crops = draw(small, 0)
    assert crops.source.images.shape[-1] == crops.target.seen.shape[-1] == 32
    fine = open_faces(faces.dataset.folder, "builtin", SIDE, LIGHTS)
    whole = F.avg_pool2d(fine.unwrapped(draw(fine, 0).target)[0][0], 2)
    half = small.unwrapped(crops.target)[0][0]
    both = (whole > 0) & (half > 0)
    assert both.float().mean() > 0.1 and (whole - half)[both].abs().mean() < 0.05 * whole[both].mean()


def test_textures_do_not_depend_on_what_was_unwrapped_before(faces: DatasetFaces) -> None:
    fresh = open_faces(faces.dataset.folder, "builtin", SIDE, LIGHTS)
    parts = [draw(fresh, head).target for head in range(3)]
    expected = [fresh.unwrapped(part)[0] for part in parts]
    fresh.point_weights.pop(next(iter(fresh.point_weights)))
    mixed, _ = fresh.unwrapped(concatenate([*parts, *parts]))  # one stack is unknown again, and twice there
    torch.testing.assert_close(mixed, torch.cat([*expected, *expected]))


def test_training_on_a_dataset_lowers_the_loss_and_names_it(faces: DatasetFaces, tmp_path: Path) -> None:
    objective = TextureObjective(
        faces, DefaultReflectanceNetwork(NETWORK), settings=TextureObjectiveSettings(lights=3)
    )
    path = train(objective, tmp_path, replace(PRESETS["tiny"], steps=60, validate_every=100))
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    losses = torch.tensor([row["loss"] for row in rows])
    assert losses[-10:].mean() < 0.85 * losses[:10].mean()
    _, metadata = load_networks(path, 1)
    assert metadata["provenance"]["trained_on"] == f"{faces.dataset.folder.name}, 2 subjects"
    assert metadata["metrics"]["si_mse"] > 0 and faces.dataset.folder.name in metadata["licence"]


def test_splits_and_models_that_cannot_be_trained_on(dataset: Dataset, tmp_path: Path) -> None:
    refused(InputError, "no such face model", open_faces, dataset.folder, "nobody.npz", SIDE)
    none = write_small_dataset(tmp_path, counts=(2, 0, 0), cameras=1, lights=4, crop_px=32)
    refused(InputError, "run prepare-dataset", open_faces(none.folder, "builtin", SIDE).people, 1)
    text = (tmp_path / "dataset.json").read_text().replace('"face_model": "builtin"', '"face_model": "other"')
    (tmp_path / "dataset.json").write_text(text)
    refused(InputError, "--fit-with", open_faces, none.folder, "builtin", SIDE)


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
    dataset: Dataset, tmp_path: Path, provenance: dict[str, object], words: str
) -> None:
    for part in ("olat", "fits"):
        (tmp_path / part).symlink_to(dataset.folder / part)
    content = json.loads((dataset.folder / "dataset.json").read_text()) | {"provenance": provenance}
    (tmp_path / "dataset.json").write_text(json.dumps(content))
    assert words in open_faces(tmp_path, "builtin", SIDE).provenance["licence"]
