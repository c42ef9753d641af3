import os
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.atomic import machine_id
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.light.setups import LightSources, collect_setups
from facerf_cli.main import main
from facerf_cli.synth.sky.maps import write_sheet
from facerf_cli.synth.sky.skies import draw_sky
from tests.kinds import Said


def test_writes_seeded_maps_and_skips_finished_ones(tmp_path: Path, capsys: Said) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "3", "--size", "32", "--seed", "5"]
    assert main(line) == 0
    written = [Path(path) for path in capsys.readouterr().out.splitlines()]
    assert sorted(tmp_path.glob("[!.]*")) == written
    image = read_image(written[1])
    pixels, kind = draw_sky(1, 5, 32)
    assert written[1].name == f"00001_{kind}.exr"
    np.testing.assert_allclose(image.pixels, pixels, rtol=1e-3, atol=1e-6)
    assert image.metadata["facerf:seed"] == 5 and image.metadata["facerf:kind"] == kind
    before = written[0].stat().st_mtime_ns
    assert main(line) == 0
    assert capsys.readouterr().out == "" and written[0].stat().st_mtime_ns == before
    assert main([*line, "--overwrite", "always"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 4


def test_the_sheet_has_a_tile_for_each_map_and_a_dry_run_writes_nothing(tmp_path: Path, capsys: Said) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "4", "--size", "32", "--kind", "overcast"]
    assert main(line) == 0
    sheet = tmp_path / "envmaps.png"
    pixels = read_image(sheet).pixels
    tiles = [tile for row in np.array_split(pixels, 2) for tile in np.array_split(row, 2, 1)]
    assert all(0.05 < tile.mean() < 0.9 for tile in tiles)  # no tile is black, none is clipped
    sheet.unlink()
    capsys.readouterr()
    assert main(line) == 0  # only the sheet is made again
    assert capsys.readouterr().out.splitlines() == [str(sheet)]
    np.testing.assert_array_equal(read_image(sheet).pixels, pixels)
    assert main(["envmap", "-o", str(tmp_path / "new"), "--kind", "sun", "--dry-run", "--count", "2"]) == 0
    maps = [f"{tmp_path}/new/0000{i}_sun.exr" for i in range(2)]
    assert capsys.readouterr().out.splitlines() == [*maps, f"{tmp_path}/new/envmaps.png"]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("change", [("--size", "48"), ("--seed", "6")])
def test_maps_of_other_options_are_made_again(tmp_path: Path, capsys: Said, change: tuple[str, str]) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "2", "--size", "32", "--seed", "5", "--kind", "sun"]
    assert main(line) == main([*line, *change, "--overwrite", "never"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert main([*line, *change]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert main([*line, *change]) == 0
    assert capsys.readouterr().out == ""
    damaged = sorted(tmp_path.glob("*.exr"))[0]
    damaged.write_bytes(b"")
    assert main([*line, *change]) == 0
    assert capsys.readouterr().out.splitlines()[0] == str(damaged)


def test_no_file_of_the_user_is_replaced(tmp_path: Path, capsys: Said) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "1", "--size", "32", "--kind", "sun"]
    assert main(line) == 0
    for name in ("00000_sun.exr", "envmaps.png"):
        before = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(b"mine")
        for more in ([], ["--dry-run"]):
            assert main([*line, "--seed", "7", *more]) == 1
            assert f"{tmp_path / name}: was changed" in capsys.readouterr().err
        assert main([*line, "--seed", "7", "--overwrite", "never"]) == 0
        assert (tmp_path / name).read_bytes() == b"mine"
        if name == "envmaps.png":  # up to date
            assert main(line) == 0 and (tmp_path / name).read_bytes() == b"mine"
        (tmp_path / name).write_bytes(before)
    assert main([*line, "--seed", "7"]) == 0, "all are facerf's again"


def test_a_run_that_was_ended_before_its_sheet_is_finished(tmp_path: Path, capsys: Said) -> None:
    line = ["envmap", "-o", str(tmp_path), "--count", "2", "--size", "32"]
    assert main(line) == 0
    sheet = tmp_path / "envmaps.png"
    os.utime(sheet, (0, 0))
    left = tmp_path / f".part-{machine_id()}-{2**22 + 1}-0123456789abcdef"  # beyond Linux's process ids
    left.mkdir()
    capsys.readouterr()
    assert main(line) == 0
    assert capsys.readouterr().out.splitlines() == [str(sheet)] and not left.exists()


def test_a_folder_of_maps_is_read_without_its_sheet_whose_balls_are_lit_by_them(tmp_path: Path) -> None:
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[6:10, 6:10] = 0.02  # dim, at u = 0.25: the image's right
    write_exr(tmp_path / "right.exr", pixels)
    write_sheet([tmp_path / "right.exr"], tmp_path / "sheet.png")
    sheet = read_image(tmp_path / "sheet.png").pixels
    height, width = 96, 192
    assert sheet.shape == (height + 16, width + height, 3)
    bright = sheet[:height, :width].mean(-1) > 0.5  # of a map exposed for display
    np.testing.assert_array_equal(np.argwhere(bright).min(0), (36, 36))
    np.testing.assert_array_equal(np.argwhere(bright).max(0), (59, 59))
    left, right = np.split(sheet[:height, width:].mean(-1), 2, 1)
    assert right.mean() > 3 * left.mean() and (right > 0.1).mean() > 0.5  # shaded, not a reflection
    assert sheet[height:].max() > 0.2  # the name
    maps = tmp_path / "maps"
    assert main(["envmap", "-o", str(maps), "--count", "2", "--size", "32"]) == 0
    setups = collect_setups(LightSources(envmap=[str(maps)]), tmp_path / "out")
    found = [light.envmap for setup in setups for light in setup.lights]
    assert found == sorted(maps.glob("*.exr")) and len(setups) == 2
