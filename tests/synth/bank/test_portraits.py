"""A person of the bank is photographed by several cameras, and its truth fits its photos."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from facerf_cli.portrait.parse import CLASSES, MORE_LANDMARKS, class_index
from facerf_cli.synth import bank
from facerf_cli.synth.bank import portraits
from facerf_cli.synth.bank.portraits import PortraitBankSettings, add_portraits, photos_of

SMALL = PortraitBankSettings(views=2, photos=3, side_px=64)


@pytest.fixture(scope="module")
def photos() -> dict[str, Tensor]:
    return photos_of("builtin", 0, 3, SMALL)


@pytest.mark.slow
def test_photos_differ_by_light_and_share_their_truth(photos: dict[str, Tensor]) -> None:
    assert photos["pictures"].shape == (2, 3, 3, 64, 64) and photos["alpha"].shape == (2, 64, 64)
    assert photos["landmarks_px"].shape == (2, 68 + len(MORE_LANDMARKS), 2)
    assert int(photos["label"].min()) >= 1 and int(photos["label"].max()) < len(CLASSES)
    pictures, covered = photos["pictures"].float(), photos["alpha"] > 250
    assert (pictures[0, 0] - pictures[0, 1]).abs()[:, covered[0]].mean() > 3
    for view in range(2):
        assert (pictures[view][..., photos["alpha"][view] == 0] == 0).all()
        assert pictures[view][..., covered[view]].mean() > 10
    face = {
        class_index(name) for name in ("skin", "brows", "eyes", "lips", "mouth", "beard", "hand", "glasses")
    }
    for view in range(2):
        points = photos["landmarks_px"][view, 27:68].long()
        inside = ((points >= 0) & (points < 64)).all(1)
        seen = photos["label"][view][points[inside, 1], points[inside, 0]].tolist()
        assert inside.sum() > 20 and sum(label in face for label in seen) > 0.8 * len(seen)


def test_finished_people_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def draw(model: str, index: int, seed: int, settings: PortraitBankSettings) -> dict[str, Tensor]:
        made.append(index)
        return {"of": torch.tensor([index])}

    monkeypatch.setattr(portraits, "photos_of", draw)
    monkeypatch.setattr(bank, "in_shards", lambda work, items, jobs: work(items))
    add_portraits(tmp_path, ["a", "b"], range(3), 1, 0)
    add_portraits(tmp_path, ["a", "b"], range(4), 1, 0)
    assert made == [0, 1, 2, 3] and len(list(tmp_path.iterdir())) == 4
