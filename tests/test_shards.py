import time
from pathlib import Path

import pytest

from facerf_cli.run.workers import in_shards


def _fail_or_wait(items: list[Path]) -> None:
    if items[0].name == "fails":
        raise ValueError("no")
    time.sleep(60)
    items[0].touch()


def _write(items: list[Path]) -> None:
    for path in items:
        path.touch()


def test_every_item_is_worked_on_once(tmp_path: Path) -> None:
    paths = [tmp_path / str(i) for i in range(5)]
    in_shards(_write, paths, 2)
    assert all(path.exists() for path in paths)


def test_an_error_ends_the_other_shards(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no"):
        in_shards(_fail_or_wait, [tmp_path / "fails", tmp_path / "waits"], 2)
    assert not (tmp_path / "waits").exists()
