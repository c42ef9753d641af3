"""People that are baked for a while: those that are finished are numbered from 0 on."""

import time
from pathlib import Path

import pytest
import torch

from tools import bake_people


def test_finished_people_are_kept_in_a_row(tmp_path: Path) -> None:
    for number in (0, 2, 3, 5):
        for name in (f"{number:05d}_0", f"{number:05d}_1", f"photo_{number:05d}_0", f"seen_{number:05d}_0"):
            (tmp_path / f"{name}.safetensors").write_text(name)
    (tmp_path / ".00004_0.part").touch()
    bake_people.keep(tmp_path, [5, 0, 3])
    people = [
        {path.name[-19:-14] for path in tmp_path.glob(f"{kind}*_0.*")} for kind in ("0", "photo", "seen")
    ]
    assert people == 3 * [{"00000", "00001", "00002"}]
    assert (tmp_path / "photo_00002_0.safetensors").read_text() == "photo_00005_0"
    assert len(list(tmp_path.iterdir())) == 12


def test_nobody_is_begun_when_the_time_is_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake_people, "bake_person", lambda *_: pytest.fail("a person is baked"))
    assert bake_people.bake(tmp_path, ["builtin"], torch.zeros(1), time.time() - 1, 3) is None
