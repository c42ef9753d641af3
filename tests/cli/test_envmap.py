from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.images import read_image
from facerf_cli.main import main
from facerf_cli.synth.sky.skies import draw_sky


def test_writes_seeded_maps_and_skips_finished_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "3", "--size", "32", "--seed", "5"]
    assert main(line) == 0
    written = [Path(path) for path in capsys.readouterr().out.splitlines()]
    assert sorted(tmp_path.iterdir()) == written
    image = read_image(written[1])
    pixels, kind = draw_sky(1, 5, 32)
    assert written[1].name == f"00001_{kind}.exr"
    np.testing.assert_allclose(image.pixels, pixels, rtol=1e-3, atol=1e-6)
    assert image.metadata["facerf:seed"] == 5 and image.metadata["facerf:kind"] == kind
    before = written[0].stat().st_mtime_ns
    assert main(line) == 0
    assert capsys.readouterr().out == "" and written[0].stat().st_mtime_ns == before
    assert main([*line, "--overwrite", "always"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["envmap", "-o", str(tmp_path / "new"), "--kind", "sun", "--dry-run", "--count", "2"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{tmp_path}/new/0000{i}_sun.exr" for i in range(2)]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("options", [["--kind", "moon"], ["--size", "33"], ["--count", "0"]])
def test_bad_options_are_refused(tmp_path: Path, options: list[str]) -> None:
    assert main(["envmap", "-o", str(tmp_path / "new"), *options]) == 2
    assert not (tmp_path / "new").exists()
