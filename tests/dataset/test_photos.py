"""Photos' faces are detected once, and drawn as crops with their landmarks."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.dataset import photos as module
from facerf_cli.dataset.crops import CropMove
from facerf_cli.dataset.photos import CACHED_SIDE_PX, open_photos
from facerf_cli.errors import InputError
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.files.write import write_display
from facerf_cli.portrait.find import Face
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Networks
from tests.kinds import Log, Patch

SIDE_PX = 200


def _landmarks_px(x: float) -> np.ndarray:
    """A face whose nose is at x, as large as half the photo."""
    return np.array([x, 100]) + LANDMARKS_M[:, :2] * [1, -1] * 500


@pytest.fixture
def looked_at() -> list[str]:
    """What the detector was shown."""
    return []


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch, looked_at: list[str]) -> Path:
    """Three photos; in the two darker ones there is a face."""

    def find(_: object, pixels: np.ndarray, name: str) -> list[Face]:
        looked_at.append(name)
        if pixels.mean() > 0.7:
            raise InputError(f"{name}: no face found")
        return [Face((50, 50, 150, 150), 1.0, _landmarks_px(90 if pixels.mean() < 0.4 else 110))]

    monkeypatch.setattr(module, "find_faces", find)
    for name, value in (("a.png", 0.2), ("b.png", 0.6), ("c.png", 0.9)):
        write_display(tmp_path / name, np.full((SIDE_PX, SIDE_PX, 3), value, np.float32))
    return tmp_path


def test_faces_are_found_once(folder: Path, looked_at: list[str], caplog: Log, monkeypatch: Patch) -> None:
    paths, cache = sorted(folder.glob("*.png")), folder / "cache"
    with caplog.at_level(logging.WARNING):
        first = open_photos(paths, cache, SHIPPED_NETWORKS, 64)
    assert [Path(name).name for name in looked_at] == ["a.png", "b.png", "c.png"]
    assert caplog.text.count("c.png: no face found") == 1
    again = open_photos(paths, cache, SHIPPED_NETWORKS, 64)
    assert len(looked_at) == 3 and again.paths == first.paths and len(first.paths) == 2
    os.utime(paths[0], (0, 0))
    open_photos(paths, cache, SHIPPED_NETWORKS, 64)
    assert len(looked_at) == 4  # the one that changed
    monkeypatch.setattr(Networks, "sha256", lambda networks, name: "another")
    open_photos(paths, cache, SHIPPED_NETWORKS, 64)
    assert len(looked_at) == 7  # by another network


def test_crops_hold_their_landmarks_and_no_face_at_all_is_an_error(folder: Path) -> None:
    found = open_photos(sorted(folder.glob("*.png")), folder / "cache", SHIPPED_NETWORKS, 64)
    drawn = found.draw(torch.Generator().manual_seed(0))
    assert drawn.crops.shape == (1, 3, 64, 64) and drawn.landmarks_px.shape == (1, 68, 2)
    full = found.landmarks_px / CACHED_SIDE_PX
    move = CropMove.draw(_after_the_choice(0))  # as a detector's box would cut the crop
    assert any(torch.allclose(drawn.landmarks_px[0] / 64, move.points(face), atol=1e-5) for face in full)
    assert full.min() > 0 and full.max() < 1 and (full[:, :, 0].amax(1) - full[:, :, 0].amin(1)).min() > 0.4
    records = [json.loads(path.read_text()) for path in (folder / "cache").glob("*.json")]
    assert sum(record["landmarks_px"] is None for record in records) == 1
    with pytest.raises(InputError, match="--photos: no face in any of 1 photos; use"):
        open_photos([folder / "c.png"], folder / "cache", SHIPPED_NETWORKS, 64)


def _after_the_choice(seed: int) -> torch.Generator:
    """The generator of a draw once it has chosen one of two photos."""
    generator = torch.Generator().manual_seed(seed)
    torch.randint(2, (), generator=generator)
    return generator
