"""`facerf demo`: the sheet of the photo that facerf brings along."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.cli import demo
from facerf_cli.files.read import read_image
from facerf_cli.main import main
from tests.kinds import Patch, Said


@pytest.mark.slow
def test_the_sheet_shows_the_photo_and_it_under_eight_lights(
    tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    said = capsys.readouterr()
    assert said.out == "facerf_demo.jpg\n" and said.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["facerf_demo.jpg"]
    sheet = read_image(Path("facerf_demo.jpg")).pixels
    side, high = demo._TILE_PX + 2, demo._TILE_PX + demo._LABEL_PX + 2
    tiles = [
        sheet[y : y + demo._TILE_PX, x : x + demo._TILE_PX]
        for y in (0, high, 2 * high)
        for x in (0, side, 2 * side)
    ]
    means = np.array([tile[:150, 100:250].mean() for tile in tiles])
    assert (means > 0.01).all() and len(set(means.round(4))) == 9
    left, right = (tiles[5][50:140, columns].mean() for columns in (slice(0, 165), slice(165, None)))
    assert left > 1.5 * right  # --light -75,0


def test_no_file_is_overwritten_and_what_it_needs_is_small(tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "mine.jpg").write_bytes(b"mine")
    assert main(["demo", "-o", str(tmp_path / "mine.jpg")]) == 2
    assert "mine.jpg: file exists" in capsys.readouterr().err
    assert (tmp_path / "mine.jpg").read_bytes() == b"mine"
    assert main(["demo", "-o", str(tmp_path)]) == 2
    files = [path for path in demo._DEMO.rglob("*") if path.is_file()]
    assert len(files) == 5 and sum(path.stat().st_size for path in files) < 2 << 20
