"""People of a prepared dataset, as the stage portrait sees them."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.dataset.squares import DatasetSquares, open_squares
from facerf_cli.errors import InputError
from facerf_cli.network.portrait import SKIN
from facerf_cli.portrait.person import SIDE_PX
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.portrait_samples import PortraitSample
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Folders, Patch
from tests.refusals import refused

LACKS = 3


def backgrounds() -> Tensor:
    return torch.full((1, 3, 16, 16), 90).byte()


@pytest.fixture(scope="module")
def portraits(tmp_path_factory: Folders) -> DatasetSquares:
    folder = tmp_path_factory.mktemp("dataset")
    write_small_dataset(folder, (2, 1, 0), 1, lights=14, crop_px=192, lacking={"0001": range(LACKS)})
    with pytest.MonkeyPatch.context() as patch:  # another test has processes
        patch.setattr("facerf_cli.dataset.squares.in_shards", lambda work, items, jobs: work(items))
        return open_squares(folder, backgrounds(), SHIPPED_NETWORKS, 1)


def drawn(portraits: DatasetSquares, person: int, seed: int = 1) -> PortraitSample:
    return portraits.draw([person], 2, torch.Generator().manual_seed(seed))


def test_people_are_those_of_the_splits_with_the_lights_of_their_stacks(portraits: DatasetSquares) -> None:
    assert portraits.people(5) == ([0, 1], [2]) and portraits.people(0)[1] == []
    # A matt face without shadows: each target is its light's cosine, but for the exposure.
    sample = drawn(portraits, 0)
    assert sample.targets.shape == (1, 2, 3, SIDE_PX, SIDE_PX) and sample.labelled.tolist() == [0.0]
    sure = (sample.shares[0, SKIN] > 0.95) & (sample.inputs.covered[0, 0] > 0.5)
    cosine = torch.einsum("tc,cij->tij", sample.lights[0], sample.inputs.normals[0]).clamp_min(0)
    for light in range(2):
        lambert = (sample.albedo[0].mean(0) * cosine[light])[sure]
        found = sample.targets[0, light].mean(0)[sure]
        if lambert.mean() > 0.02:
            assert float(torch.corrcoef(torch.stack([lambert, found]))[0, 1]) > 0.8
            assert float(found.mean()) == pytest.approx(float(lambert.mean()), rel=0.25)
    whole, fewer = drawn(portraits, 0), drawn(portraits, 1)
    assert whole.rig.shape == fewer.rig.shape and whole.rig_visible.shape == fewer.rig_visible.shape
    assert (fewer.weights[0, -LACKS:] == 0).all() and (whole.weights[0, -LACKS:] > 0).any()


def test_what_is_seen_lies_on_the_images(portraits: DatasetSquares) -> None:
    """Moved by 3 pixels the skin covers less of the lit face."""
    seen = load_file(portraits.views[0][0])
    face = (seen["lit"].float().mean(0) > 0.02).float()
    skin = seen["classes"][SKIN].float() / 255
    moves = [(x, y) for x in (-3, 0, 3) for y in (-3, 0, 3)]
    errors = [float((skin.roll(move, (0, 1)) - face).abs().mean()) for move in moves]
    assert moves[errors.index(min(errors))] == (0, 0)


def test_finished_portraits_are_kept(portraits: DatasetSquares) -> None:
    path = portraits.views[0][0]
    before = path.stat().st_mtime_ns
    open_squares(portraits.dataset.folder, backgrounds(), SHIPPED_NETWORKS, 1)
    assert path.stat().st_mtime_ns == before


def test_a_split_without_a_face_or_anybody_is_refused(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("facerf_cli.dataset.squares._make_missing", lambda *_: None)
    monkeypatch.setattr("facerf_cli.dataset.squares._shows_a_face", lambda _: False)
    for count, expected in (
        (2, "no subject in the split validation"),
        (1, "no face was found in the split train"),
    ):
        folder = tmp_path / str(count)
        write_small_dataset(folder, (count, 0, 0), 1, lights=4, crop_px=192)
        refused(InputError, expected, open_squares, folder, backgrounds(), SHIPPED_NETWORKS, 1)
