import json
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.dataset import weights as module
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import (
    draw_pair,
    draw_pairs,
    image_path,
    load_pairs,
    pairs_path,
    read_pairs,
    relight_subject,
    sum_sources,
    weights_path,
    write_pairs,
)
from facerf_cli.dataset.prepare import constant_weights
from facerf_cli.dataset.weights import (
    TILE_IMAGES,
    EnvmapTask,
    EnvmapWeights,
    compute_weights,
    envmap_names,
    map_directions,
    multiply,
    read_envmap,
    relit_images,
    world_to_map,
)
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.synth.sky.skies import ProceduralMaps
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Folders, Log, Patch
from tests.refusals import refused
from tests.stacks import read_olat_stack

MAPS = envmap_names(ProceduralMaps(4, 7, 32))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: Folders) -> Dataset:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), crop_px=48)


@pytest.fixture
def fresh(dataset: Dataset, tmp_path: Path) -> Dataset:
    """The same dataset without anything relit in it."""
    for part in ("olat", "fits", "dataset.json"):
        (tmp_path / part).symlink_to(dataset.folder / part)
    return read_dataset(tmp_path)


def write_map(path: Path, pixels: np.ndarray) -> str:
    write_exr(path, np.asarray(pixels, np.float32))
    return str(path)


def test_a_pair_depends_on_seed_subject_and_index_alone(dataset: Dataset) -> None:
    some, more = draw_pairs(dataset, MAPS, 3, 5), draw_pairs(dataset, MAPS, 8, 5)
    assert [pair for pair in more if pair.index < 3] == some
    assert draw_pair(dataset, MAPS, 5, "0002", 7) == next(p for p in more if p.key == ("0002", 7))
    assert more == sorted(more, key=lambda pair: pair.key)
    assert {pair.split for pair in more} == {"train", "validation", "test"}
    assert all(pair.split == dataset.split_of(pair.subject) for pair in more)
    assert draw_pairs(dataset, MAPS, 3, 6) != some
    many = draw_pairs(dataset, MAPS, 100, 5)
    same = np.mean([pair.source_camera == pair.target_camera for pair in many])
    assert 0.4 < same < 0.6
    assert {pair.source_camera for pair in many} == {"C0", "C1"} and {p.envmap for p in many} == set(MAPS)
    assert {pair.target_light for pair in many} == set(range(20))


def test_written_sources_are_their_rows_bit_for_bit(fresh: Dataset) -> None:
    pairs = write_pairs(fresh, draw_pairs(fresh, MAPS, 3, 0), overwrite=False)
    for subject, (rows, weights) in load_pairs(fresh).items():
        assert relight_subject(fresh, rows, weights) == 3
        assert relight_subject(fresh, rows, weights) == 0  # all there
        assert {row.subject for row in rows} == {subject}
    assert read_pairs(fresh) == pairs
    for pair in pairs:
        image = read_image(image_path(fresh, *pair.key))
        again = sum_sources(fresh, [pair])[0].permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(image.pixels.astype(np.float16).view(np.uint16), again.view(np.uint16))
        assert image.metadata["facerf:envmap"] == pair.envmap and image.pixels.max() > 0.02
        of_stack = read_olat_header(fresh.stack_path(pair.subject, pair.source_camera)).metadata
        assert image.metadata.items() >= of_stack.items() and image.metadata["facerf:face_model"]
        assert image.metadata["facerf:synthetic"] == 1


def test_missing_weights_are_made_by_the_same_command(fresh: Dataset) -> None:
    write_pairs(fresh, draw_pairs(fresh, MAPS, 2, 0), overwrite=False)
    kept = weights_path(fresh).read_bytes()
    weights_path(fresh).unlink()
    pairs_path(fresh).touch()  # what is in memory is forgotten
    refused(InputError, "missing; ... run relight-dataset again", load_pairs, fresh)
    write_pairs(fresh, draw_pairs(fresh, MAPS, 2, 0), overwrite=False)
    assert weights_path(fresh).read_bytes() == kept


def test_a_constant_map_gives_the_fully_lit_image(fresh: Dataset, tmp_path: Path) -> None:
    maps = [write_map(tmp_path / "white.exr", np.full((5, 10, 3), 0.25))]
    pairs = write_pairs(fresh, draw_pairs(fresh, maps, 1, 0), overwrite=False)
    assert {pair.exposure_ev for pair in pairs} == {2}  # 0.25 brought to 1
    for pair in pairs:
        lit = read_olat_header(fresh.stack_path(pair.subject, pair.source_camera)).source
        image = sum_sources(fresh, [pair])[0].permute(1, 2, 0).float().numpy()
        # Cells are cut anew in the crop's frame there and in the world's here.
        np.testing.assert_allclose(image, lit, atol=0.01 * lit.max())


def test_all_cameras_see_the_same_light_and_it_turns_about_the_vertical(
    fresh: Dataset, tmp_path: Path
) -> None:
    sky = np.full((16, 32, 3), 0.01)
    sky[7:9, 8] = 200.0  # u = 0.25 is +x, the picture's right
    name = write_map(tmp_path / "lamp.exr", sky)
    directions = map_directions(fresh)
    result = compute_weights(EnvmapTask(name, directions, (0.0, 90.0, 270.0), (fresh.lights_of("0000"),) * 3))
    assert isinstance(result, EnvmapWeights)
    for rgb, toward in zip(result.weights, ([1.0, 0, 0], [0, 0, -1.0], [0, 0, 1.0]), strict=True):
        weights = torch.from_numpy(rgb).sum(-1)
        brightest = directions[int(weights.argmax())]
        assert float(brightest @ torch.tensor(toward, dtype=torch.float64)) > 0.8
    for camera in fresh.cameras["0000"]:
        header = read_olat_header(fresh.stack_path("0000", camera))
        image = next(relit_images(fresh.stack_path("0000", camera), torch.from_numpy(rgb)[None]))
        in_head = torch.from_numpy(header.normals) @ torch.from_numpy(header.rotation).float()
        cosines = (in_head @ directions.float().T).clamp_min(0)  # the same lamps for each camera
        lit, constant = (
            header.source.mean(-1),
            cosines @ torch.from_numpy(constant_weights(directions.numpy())),
        )
        expected = torch.from_numpy(lit) / constant.clamp_min(1e-3) * (cosines @ weights / 3)
        torch.testing.assert_close(image.float().mean(0), expected, rtol=0.03, atol=0.02)
        assert expected.max() > 0.5


@pytest.mark.parametrize(
    "world_to_capture", [np.diag([1.0, -1, -1]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.eye(3)]
)
def test_the_vertical_is_found_whatever_the_capture_calls_it(
    dataset: Dataset, world_to_capture: np.ndarray
) -> None:
    """A capture whose y points down, or whose z points up, lights its faces from the same sky."""
    tilted = dataset.model_copy(update={"directions_world": dataset.directions_world @ world_to_capture.T})
    np.testing.assert_allclose(world_to_map(tilted), world_to_capture.T, atol=1e-12)
    torch.testing.assert_close(map_directions(tilted), map_directions(dataset))


def test_the_product_is_the_sum_whatever_the_parts() -> None:
    """Odd sizes: the plain sum within a half, the same bits in any company."""
    olats = torch.rand(7, 37, 150, 3).half().permute(0, 3, 1, 2)  # as a stack that was read
    weights = torch.rand(TILE_IMAGES, 7, 3)
    images = torch.empty(TILE_IMAGES, 3, 37, 150, dtype=torch.float16)
    multiply(olats, weights, images)
    truth = torch.einsum("mlc,lchw->mchw", weights.double(), olats.double())
    torch.testing.assert_close(images.double(), truth, rtol=1e-3, atol=1e-4)
    order = torch.randperm(TILE_IMAGES)
    few = torch.empty(5, 3, 37, 150, dtype=torch.float16)
    multiply(olats, weights[order[:5]], few)
    assert torch.equal(few, images[order[:5]])  # a picture's bits do not depend on its neighbours


def test_images_that_fit_the_memory_are_summed_at_once_and_have_the_same_bits(
    dataset: Dataset, monkeypatch: Patch
) -> None:
    path, weights = dataset.stack_path("0000", "C0"), torch.rand(3, 20, 3)
    together = torch.stack(list(relit_images(path, weights)))
    parts: list[int] = []
    monkeypatch.setattr(module, "multiply", lambda *given: parts.append(len(given[1])) or multiply(*given))
    monkeypatch.setattr("facerf_cli.run.memory.left_bytes", lambda: 2 * 2 * 6 * 48 * 48)
    assert torch.equal(torch.stack(list(relit_images(path, weights))), together) and parts == [2, 1]
    olats = read_olat_stack(path).olats.double()
    truth = torch.einsum("mlc,lchw->mchw", weights.double(), olats)
    torch.testing.assert_close(together.double(), truth, rtol=1e-3, atol=1e-3)


def test_parts_of_a_stack_and_a_stack_of_another_rig(dataset: Dataset) -> None:
    path = dataset.stack_path("0001", "C1")
    stack = read_olat_stack(path)
    assert torch.equal(read_olats(path), stack.olats)
    assert torch.equal(read_olats(path, slice(3, 7), slice(5, 30)), stack.olats[3:7, :, 5:30])
    header = read_olat_header(path)
    np.testing.assert_array_equal(header.normals, stack.header.normals)
    np.testing.assert_array_equal(header.directions, stack.header.directions)
    content = dataset.content() | {"folder": dataset.folder}
    content["rig"]["lights"] = content["rig"]["lights"][:12]
    fewer = Dataset.model_validate(content)
    refused(InputError, "20 lights, the dataset has 12", world_to_map, fewer)
    with pytest.raises(InputError, match="20 lights, the dataset has 12"):
        list(relit_images(dataset.stack_path("0000", "C0"), torch.ones(1, 12, 3)))


def test_other_recipes_need_overwrite_and_take_the_old_images_with_them(fresh: Dataset) -> None:
    drawn = draw_pairs(fresh, MAPS, 2, 0)
    write_pairs(fresh, drawn, overwrite=False)
    rows, weights = load_pairs(fresh)["0000"]
    relight_subject(fresh, rows, weights)
    before = weights_path(fresh)
    refused(UsageError, "another seed", write_pairs, fresh, draw_pairs(fresh, MAPS, 2, 1), overwrite=False)
    assert image_path(fresh, "0000", 1).exists()
    write_pairs(fresh, draw_pairs(fresh, MAPS, 4, 0), overwrite=False)  # more of the same
    assert image_path(fresh, "0000", 1).exists() and not before.exists() and len(read_pairs(fresh)) == 16
    write_pairs(fresh, draw_pairs(fresh, MAPS, 2, 1), overwrite=True)
    assert not image_path(fresh, "0000", 1).exists()
    pairs_path(fresh).write_text("{}\n")
    refused(InputError, "line 1 is not a pair", write_pairs, fresh, drawn, overwrite=False)
    assert len(write_pairs(fresh, drawn, overwrite=True)) == 8


def test_fewer_or_other_pairs_leave_no_image_without_its_own(fresh: Dataset) -> None:
    write_pairs(fresh, draw_pairs(fresh, MAPS, 3, 0), overwrite=False)
    few = write_pairs(fresh, draw_pairs(fresh, MAPS, 2, 0), overwrite=False)  # recipes alone may go
    assert len(few) == 8
    rows, weights = load_pairs(fresh)["0000"]
    relight_subject(fresh, rows, weights)
    with pytest.raises(UsageError, match="a larger --per-subject"):
        write_pairs(fresh, draw_pairs(fresh, MAPS, 1, 0), overwrite=False)
    assert len(read_pairs(fresh)) == 8 and image_path(fresh, "0000", 1).exists()
    write_pairs(fresh, draw_pairs(fresh, MAPS, 1, 0), overwrite=True)
    assert not image_path(fresh, "0000", 1).exists()


def test_as_many_pairs_of_other_subjects_are_other_pairs(fresh: Dataset) -> None:
    drawn = draw_pairs(fresh, MAPS, 2, 0)
    write_pairs(fresh, [pair for pair in drawn if pair.subject < "0002"], overwrite=False)
    settled = write_pairs(fresh, [pair for pair in drawn if pair.index == 0], overwrite=False)
    assert [pair.subject for pair in settled] == ["0000", "0001", "0002", "0003"] == list(load_pairs(fresh))


def test_images_without_their_pairs_are_not_taken_for_finished(fresh: Dataset) -> None:
    path = image_path(fresh, "0000", 0)
    path.parent.mkdir(parents=True)
    path.write_text("of an unknown light")
    refused(UsageError, "move the folder", write_pairs, fresh, draw_pairs(fresh, MAPS, 1, 0), overwrite=False)
    write_pairs(fresh, draw_pairs(fresh, MAPS, 1, 0), overwrite=True)
    assert not path.exists()


def test_a_map_that_changed_is_another_map(fresh: Dataset, tmp_path: Path) -> None:
    name = write_map(tmp_path / "sky.exr", np.full((4, 8, 3), 1.0))
    drawn = draw_pairs(fresh, [name], 1, 0)
    write_pairs(fresh, drawn, overwrite=False)
    rows, weights = load_pairs(fresh)["0000"]
    relight_subject(fresh, rows, weights)
    write_map(tmp_path / "sky.exr", np.full((4, 8, 3), 8.0))
    refused(UsageError, "other envmaps", write_pairs, fresh, draw_pairs(fresh, [name], 2, 0), overwrite=False)
    assert write_pairs(fresh, drawn, overwrite=True)[0].exposure_ev == -3


def test_overwriting_with_bad_maps_takes_nothing_away(fresh: Dataset, tmp_path: Path) -> None:
    write_pairs(fresh, draw_pairs(fresh, MAPS, 1, 0), overwrite=False)
    rows, weights = load_pairs(fresh)["0000"]
    relight_subject(fresh, rows, weights)
    with pytest.raises(FacerfError, match="cannot be used"):
        write_pairs(fresh, draw_pairs(fresh, [str(tmp_path / "none.exr")], 1, 0), overwrite=True)
    assert image_path(fresh, "0000", 0).exists() and len(read_pairs(fresh)) == 4


@pytest.mark.parametrize(
    "change",
    [{"split": "test"}, {"subject": "9999"}, {"source_camera": "C7"}, {"target_light": 20}, {"index": 1}],
)
def test_a_row_that_is_no_pair_of_the_dataset(fresh: Dataset, change: dict[str, object]) -> None:
    write_pairs(fresh, draw_pairs(fresh, MAPS, 2, 0), overwrite=False)
    first, *others = pairs_path(fresh).read_text().splitlines()
    changed = json.dumps(json.loads(first) | change)
    pairs_path(fresh).write_text("\n".join([changed, *others]))
    number = 2 if change == {"index": 1} else 1  # twice the same pair
    refused(InputError, f"line {number} is not a pair", read_pairs, fresh)


@pytest.mark.parametrize("name", ["procedural:0:0:99999999", "procedural:0:0:0", "procedural:0"])
def test_a_row_cannot_ask_for_a_map_of_any_size(name: str) -> None:
    refused(InputError, "no such file", read_envmap, name)


def test_one_camera_predicts_itself(tmp_path: Path) -> None:
    dataset = write_small_dataset(tmp_path, (1, 0, 0), cameras=1, lights=6, crop_px=32)
    (pair,) = write_pairs(dataset, draw_pairs(dataset, MAPS, 1, 0), overwrite=False)
    assert pair.source_camera == pair.target_camera == "C0"
    assert sum_sources(dataset, [pair])[0].isfinite().all()


def test_every_bad_map_is_named_and_nothing_is_written(fresh: Dataset, tmp_path: Path, caplog: Log) -> None:
    good = write_map(tmp_path / "good.exr", np.ones((4, 8, 3)))
    square = write_map(tmp_path / "square.exr", np.ones((4, 4, 3)))
    black = write_map(tmp_path / "black.exr", np.zeros((4, 8, 3)))
    (tmp_path / "text.hdr").write_text("no map")
    maps = [good, square, black, str(tmp_path / "text.hdr")]
    with (
        caplog.at_level("ERROR", "facerf"),
        pytest.raises(FacerfError, match="3 of 4 maps cannot be used; repair or remove them"),
    ):
        write_pairs(fresh, draw_pairs(fresh, maps, 20, 0), overwrite=False)
    assert not pairs_path(fresh).exists()
