"""Subjects whose stacks lack lights: maps are weighed over the lights that each has, pairs ask for those."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.dataset.crops import open_pairs
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.faces import open_faces
from facerf_cli.dataset.pairs import (
    draw_pairs,
    load_pairs,
    pairs_path,
    read_pairs,
    weights_path,
    write_pairs,
)
from facerf_cli.dataset.weights import envmap_names, map_directions, read_envmap
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.network.batch import concatenate
from facerf_cli.synth.sky.skies import ProceduralMaps
from facerf_cli.training.objective import seeded
from tests.dataset.dataset_fixture import write_small_dataset

LIGHTS = 20
LACKING = {"0000": (0, 7, 8), "0001": (19,)}
MAPS = envmap_names(ProceduralMaps(3, 7, 32))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("dataset")
    return write_small_dataset(folder, lights=LIGHTS, crop_px=48, lacking=LACKING)


def fresh(dataset: Dataset, folder: Path) -> Dataset:
    """The same dataset without anything relit in it."""
    for part in ("olat", "fits", "dataset.json"):
        (folder / part).symlink_to(dataset.folder / part)
    return read_dataset(folder)


def test_each_subject_has_its_own_lights_of_which_one_is_the_target(dataset: Dataset) -> None:
    assert dataset.lights_of("0000") == (*range(1, 7), *range(9, 20))
    assert dataset.lights_of("0001") == tuple(range(19)) and dataset.lights_of("0002") == tuple(range(20))
    for subject in dataset.subjects:
        header = read_olat_header(dataset.stack_path(subject, "C1"))
        world = dataset.directions_world[list(dataset.lights_of(subject))]
        np.testing.assert_allclose(world @ header.rotation.T, header.directions, atol=1e-6)
    pairs = draw_pairs(dataset, MAPS, 150, 5)
    for subject in dataset.subjects:
        asked = {pair.target_light for pair in pairs if pair.subject == subject}
        assert asked == set(range(len(dataset.lights_of(subject))))


def test_a_map_is_weighed_over_the_cells_of_the_lights_there_are(dataset: Dataset, tmp_path: Path) -> None:
    here = fresh(dataset, tmp_path)
    settled = write_pairs(here, draw_pairs(here, MAPS, 4, 0), overwrite=False)
    assert read_pairs(here) == settled
    for subject, (pairs, weights) in load_pairs(here).items():
        lights = list(here.lights_of(subject))
        assert weights.shape == (4, len(lights), 3)
        for pair, row in zip(pairs, weights, strict=True):
            envmap, directions = read_envmap(pair.envmap), map_directions(here)
            expected = envmap_weights(envmap, directions[lights], pair.rotate_deg) * 2.0**pair.exposure_ev
            torch.testing.assert_close(torch.from_numpy(np.array(row)), expected)
            everything = envmap_weights(envmap, directions, pair.rotate_deg).sum(0) * 2.0**pair.exposure_ev
            torch.testing.assert_close(expected.sum(0), everything)  # no light of the map is lost
    stored = np.load(weights_path(here))
    assert stored.shape[1] == LIGHTS and (stored[:4, 17:] == 0).all() and (stored[8:, 17:] > 0).any()


def test_they_train_beside_those_who_have_all(dataset: Dataset, tmp_path: Path) -> None:
    """With pairs and without; more lights than somebody has are not asked."""
    here = fresh(dataset, tmp_path)
    free = open_faces(here.folder, "builtin", 32)
    write_pairs(here, draw_pairs(here, MAPS, 2, 0), overwrite=False)
    for faces in (free, open_faces(here.folder, "builtin", 32)):
        drawn = [faces.draw(torch.tensor([head]), LIGHTS, seeded(head)) for head in range(3)]
        sample = faces.sample(concatenate(drawn))
        assert sample.target.shape[:2] == (3, 17) and sample.source.isfinite().all()
    reader = open_pairs(here, "train", 48)
    assert all(batch.target.isfinite().all() for batch in reader.read(reader.pairs))


def test_a_pair_of_a_light_that_the_subject_lacks_is_none(dataset: Dataset, tmp_path: Path) -> None:
    here = fresh(dataset, tmp_path)
    pair = write_pairs(here, draw_pairs(here, MAPS, 1, 0), overwrite=False)[0]
    text = pairs_path(here).read_text()
    wrong = text.replace(f'"target_light": {pair.target_light}', '"target_light": 17', 1)
    assert wrong != text
    pairs_path(here).write_text(wrong)
    with pytest.raises(Exception, match="line 1 is not a pair"):
        read_pairs(here)
