"""Crops of pairs: exposed, placed and moved as training needs them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.dataset import pairs
from facerf_cli.dataset.crops import (
    UNMOVED,
    CropMove,
    PairReader,
    mean_translation_m,
    open_pairs,
    spread_pairs,
)
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.faces import open_faces
from facerf_cli.dataset.pairs import Pair, draw_pairs, load_pairs, sum_sources, write_pairs
from facerf_cli.dataset.weights import envmap_names, relit_images
from facerf_cli.errors import InputError
from facerf_cli.face.fit import load_fit
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.synth.sky.skies import ProceduralMaps
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Folders, Log, Patch
from tests.refusals import refused
from tests.stacks import read_olat_stack

CROP_PX = 48


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: Folders) -> Dataset:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), lights=20, crop_px=CROP_PX)


@pytest.fixture(scope="module")
def reader(dataset: Dataset) -> PairReader:
    maps = envmap_names(ProceduralMaps(3, 0, 32))
    write_pairs(dataset, draw_pairs(dataset, maps, 4, 0), overwrite=False)
    return open_pairs(dataset, "train", CROP_PX)


def _face(dataset: Dataset, pair: Pair, camera: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A camera's stack [L, 3, S, S], where it sees the face [S, S], and its mean under a constant map."""
    stack = read_olat_stack(dataset.stack_path(pair.subject, camera))
    seen = torch.from_numpy(stack.header.seen) > 0.5
    return stack.olats.float(), seen, torch.from_numpy(stack.header.source[seen.numpy()]).mean()


def test_pairs_are_the_datasets_images_exposed(dataset: Dataset, reader: PairReader) -> None:
    assert {pair.split for pair in reader.pairs} == {"train"} and len(reader.pairs) == 8
    for pair in reader.pairs[:3]:
        (found,) = reader.read([pair])
        weights = torch.from_numpy(np.array(load_pairs(dataset)[pair.subject][1][pair.index]))
        olats, seen, _ = _face(dataset, pair, pair.source_camera)
        source = torch.einsum("lc,lchw->chw", weights, olats)
        expected = source / source[:, seen].mean() * MEAN_RADIANCE
        assert torch.allclose(found.source[0], expected, rtol=5e-3, atol=1e-3)
        olats, _, albedo = _face(dataset, pair, pair.target_camera)
        expected = olats[pair.target_light] * MEAN_RADIANCE / albedo
        assert torch.allclose(found.target[0], expected, rtol=1e-3, atol=1e-5)


def test_light_and_landmarks_follow_camera_and_crop(dataset: Dataset, reader: PairReader) -> None:
    """What it lights of a Lambertian face is what looks toward it."""
    for pair in reader.pairs:
        header = read_olat_stack(dataset.stack_path(pair.subject, pair.target_camera)).header
        (found,) = reader.read([pair])
        cosine = torch.from_numpy(header.normals) @ found.light[0]
        seen = torch.from_numpy(header.seen) > 0.5
        lit = found.target[0].mean(0) > 1e-4
        assert found.light.norm().item() == pytest.approx(1, abs=1e-5)
        assert (lit == (cosine > 0))[seen].float().mean() > 0.97
    pair = next(pair for pair in reader.pairs if pair.source_camera != pair.target_camera)
    (smaller,) = open_pairs(dataset, "train", CROP_PX // 2).read([pair])
    for name, camera in (("source", pair.source_camera), ("target", pair.target_camera)):
        expected = load_fit(dataset.fit_path(pair.subject, camera)).landmarks_px
        assert torch.allclose(getattr(smaller, f"{name}_landmarks_px")[0], expected / 2, atol=1e-3)
        assert getattr(smaller, name).shape == (1, 3, CROP_PX // 2, CROP_PX // 2)
    (same,) = reader.read([pair])
    assert torch.allclose(torch.nn.functional.avg_pool2d(same.target, 2), smaller.target, atol=1e-5)


def test_crops_are_never_enlarged_and_heads_stand_where_their_fits_say(dataset: Dataset) -> None:
    with pytest.raises(InputError, match=f"{CROP_PX} px, the networks need {2 * CROP_PX}.*--texture-size"):
        open_pairs(dataset, "train", 2 * CROP_PX)
    fits = [load_fit(dataset.fit_path(s, c)) for s in dataset.splits["train"] for c in dataset.cameras[s]]
    expected = torch.stack([fit.translation_m for fit in fits]).mean(0)
    assert torch.allclose(torch.tensor(mean_translation_m(dataset)), expected, atol=1e-6)
    assert expected[2] < -0.9


def test_a_drawn_crop_is_moved_with_its_landmarks(dataset: Dataset, reader: PairReader) -> None:
    """As far as a detector's box may be off; the content follows the landmarks."""
    pair, move = reader.pairs[0], CropMove(1.25, (0.1, -0.05))
    (plain,), (source,) = reader.read([pair]), sum_sources(dataset, [pair])
    moved = reader._crop(pair, source.float(), move, UNMOVED)
    assert torch.equal(moved.target, plain.target)
    middle = torch.full((2,), CROP_PX / 2)
    wanted_px = (plain.source_landmarks_px - middle) * 1.25 + middle + CROP_PX * torch.tensor([0.1, -0.05])
    torch.testing.assert_close(moved.source_landmarks_px, wanted_px)
    rows, columns = torch.meshgrid(*[torch.arange(CROP_PX) + 0.5] * 2, indexing="ij")

    def centre_px(image: torch.Tensor) -> torch.Tensor:
        weight = image[0].mean(0)
        return torch.stack([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()

    still = CropMove(1.0, (0.04, 0.02)).image(plain.source, CROP_PX)
    off_px = centre_px(still) - centre_px(plain.source)
    assert (off_px - CROP_PX * torch.tensor([0.04, 0.02])).abs().max() < 0.5
    inner = CropMove(0.5).image(torch.ones(1, 1, 8, 8), 8)  # the border repeats beyond the crop
    assert inner.min() == 1
    dot = torch.zeros(1, 1, 9, 9)
    dot[..., 4, 6] = 1.0
    wide, narrow = (CropMove(scale).image(dot, 9)[0, 0].sum(0).argmax() - 4 for scale in (1.9, 0.6))
    assert wide > 2 > narrow  # a larger scale moves points away from the centre
    draws = [CropMove.draw(torch.Generator().manual_seed(seed)) for seed in range(200)]
    spread = torch.tensor([draw.shift for draw in draws]).std(0)
    assert (spread / torch.tensor([0.1, 0.03]) - 0.9).abs().max() < 0.15  # normal, cut at two deviations


def _generator_of(step: int, seed: int = 0) -> Callable[..., torch.Generator]:
    return lambda index, step=step: torch.Generator().manual_seed(hash((seed, step, index)))


def test_drawing_depends_on_the_generator_and_is_spread_over_subjects(reader: PairReader) -> None:
    one, again, other = (reader.draw(1, _generator_of(0, seed), 0) for seed in (1, 1, 2))
    assert torch.equal(one.source, again.source) and torch.equal(one.target, again.target)
    assert not torch.equal(one.target, other.target)
    found = spread_pairs(reader, 4, lambda pair: True)
    assert found == spread_pairs(reader, 4, lambda pair: True)
    assert {pair.subject for pair in found} == {pair.subject for pair in reader.pairs}
    assert spread_pairs(reader, 99, lambda pair: pair.index == 0) == [p for p in reader.pairs if p.index == 0]
    assert spread_pairs(reader, 3, lambda pair: False) == []


def test_a_stack_gives_the_sources_of_many_steps(reader: PairReader, monkeypatch: Patch) -> None:
    """They are those that reading gives, whatever the step that drawing begins at."""
    opened: list[Path] = []
    monkeypatch.setattr(
        pairs, "relit_images", lambda path, rows: opened.append(path) or relit_images(path, rows)
    )
    first, resumed = replace(reader), replace(reader)
    drawn = [first.draw(1, _generator_of(step), step) for step in range(130)]
    assert len(opened) <= 18  # 16 stacks for 8 steps each, and 2 more
    again = resumed.draw(1, _generator_of(70), 70)
    assert torch.equal(again.source, drawn[70].source) and torch.equal(again.target, drawn[70].target)
    assert (
        len({float(batch.source.sum()) for batch in drawn}) > 100
    )  # of many pairs, each moved in its own way


def test_the_only_person_is_validated_on_and_a_split_without_pairs_is_named(
    tmp_path: Path, caplog: Log
) -> None:
    dataset = write_small_dataset(tmp_path, counts=(1, 0, 0), cameras=1, lights=8, crop_px=32)
    refused(InputError, "make them with `facerf relight-", open_pairs, dataset, "train", 32)
    write_pairs(dataset, draw_pairs(dataset, envmap_names(ProceduralMaps(1, 0, 32)), 2, 0), overwrite=False)
    train, validation = (open_pairs(dataset, split, 32).pairs for split in ("train", "validation"))
    assert len(train) == 2 and validation == train and "only one person" in caplog.text
    people = open_faces(dataset.folder, "builtin", 32).people(12)
    assert [part.tolist() for part in people] == [[0], [0]]
