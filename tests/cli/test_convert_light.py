"""`facerf convert-light` from the command line: every form there and back."""

import json
import math
from pathlib import Path

import pytest
import torch

from facerf_cli.files.light_files import LightRecord, read_light, write_light
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sh import CONVENTION
from facerf_cli.light.sphere import azel_to_direction, direction_to_uv, rig_directions
from facerf_cli.main import main
from tests.kinds import Said


def a_map(folder: Path, height: int = 32) -> Path:
    """A dim map with one bright spot to the picture's right, above and in front."""
    envmap = torch.full((height, 2 * height, 3), 0.25)
    u, v = direction_to_uv(azel_to_direction(54, 36)).tolist()
    envmap[int(v * height), int(u * 2 * height)] = torch.tensor([600.0, 400, 200])
    write_exr(folder / "spot.exr", envmap.numpy())
    return folder / "spot.exr"


def convert(source: Path, output: Path, *line: str) -> int:
    return main(["convert-light", str(source), "-o", str(output), *line])


def pixels(path: Path) -> torch.Tensor:
    return torch.from_numpy(read_image(path).pixels)


def brightest(path: Path) -> tuple[float, float]:
    """u, v of a map's brightest pixel."""
    envmap = pixels(path)
    row, column = divmod(int(envmap.mean(-1).argmax()), envmap.shape[1])
    return (column + 0.5) / envmap.shape[1], (row + 0.5) / envmap.shape[0]


def test_a_map_to_json_and_back_to_a_smooth_map(tmp_path: Path) -> None:
    assert convert(a_map(tmp_path), tmp_path, "--to", "json") == 0
    record = read_light(tmp_path / "spot_rig.json")
    weights = envmap_weights(pixels(tmp_path / "spot.exr"), rig_directions())
    torch.testing.assert_close(record.weights, weights)
    assert record.attributes["facerf:input"] == "spot.exr"
    assert convert(tmp_path / "spot_rig.json", tmp_path / "b", "--to", "latlong", "--width", "256") == 0
    smooth = pixels(tmp_path / "b/spot_rig_latlong.exr")
    assert smooth.shape == (128, 256, 3)
    again = envmap_weights(smooth, rig_directions())
    assert float((again - weights).abs().max()) < 0.01 * float(weights.max())


def test_other_programs_maps_come_back_as_they_were(tmp_path: Path) -> None:
    source = a_map(tmp_path)
    assert convert(source, tmp_path, "--to", "blender", "--to", "mitsuba") == 0
    assert brightest(tmp_path / "spot_blender.exr") == pytest.approx((0.6, 0.3), abs=0.02)  # seen in Blender
    assert torch.equal(pixels(tmp_path / "spot_mitsuba.exr"), pixels(source))
    assert convert(tmp_path / "spot_blender.exr", tmp_path, "--to", "latlong", "--from-axes", "blender") == 0
    assert torch.equal(pixels(tmp_path / "spot_blender_latlong.exr"), pixels(source))


def test_a_smaller_map_keeps_the_power(tmp_path: Path) -> None:
    source = a_map(tmp_path)
    assert convert(source, tmp_path, "--to", "latlong", "--width", "16") == 0
    rig = rig_directions(6)
    small = envmap_weights(pixels(tmp_path / "spot_latlong.exr"), rig).sum(0)
    torch.testing.assert_close(small, envmap_weights(pixels(source), rig).sum(0), rtol=2e-3, atol=0)


def test_one_form_to_a_file_and_another_rig(tmp_path: Path) -> None:
    write_light(tmp_path / "a.json", LightRecord(rig_directions(), torch.full((150, 3), 4 / 150)))
    assert convert(tmp_path / "a.json", tmp_path / "sky.EXR", "--to", "latlong", "--width", "32") == 0
    assert pixels(tmp_path / "sky.EXR").shape == (16, 32, 3)
    assert convert(tmp_path / "a.json", tmp_path, "--to", "json", "--lights", "40") == 0
    record = read_light(tmp_path / "a_rig.json")
    assert len(record.directions) == 40
    torch.testing.assert_close(record.weights, torch.full((40, 3), 0.1), rtol=0.15, atol=0)


def test_harmonics_as_json_and_maps(tmp_path: Path, capsys: Said) -> None:
    assert convert(a_map(tmp_path), tmp_path, "--to", "sh") == 0
    of_map = read_light(tmp_path / "spot_sh.json").sh
    assert of_map is not None and of_map.convention == CONVENTION and len(of_map.coefficients) == 9
    assert convert(tmp_path / "spot_sh.json", tmp_path, "--to", "latlong", "--to", "json", "--signed") == 0
    assert convert(tmp_path / "spot_sh_latlong.exr", tmp_path, "--to", "sh") == 0
    of_drawn = read_light(tmp_path / "spot_sh_latlong_sh.json").sh
    assert of_drawn is not None
    torch.testing.assert_close(of_drawn.coefficients, of_map.coefficients, rtol=0.02, atol=0.02)
    assert "negative" in capsys.readouterr().err  # a spot's cut series rings
    front = azel_to_direction(54, 36)
    rig = read_light(tmp_path / "spot_sh_rig.json")
    brightest_light = rig.directions[rig.weights.sum(1).argmax()]
    assert float(brightest_light @ front) > math.cos(math.radians(15))


def test_a_map_of_harmonics_can_shine(tmp_path: Path, capsys: Said) -> None:
    assert convert(a_map(tmp_path), tmp_path, "--to", "sh") == 0
    assert convert(tmp_path / "spot_sh.json", tmp_path, "--to", "latlong", "--to", "json") == 0
    assert float(pixels(tmp_path / "spot_sh_latlong.exr").min()) >= 0
    assert float(read_light(tmp_path / "spot_sh_rig.json").weights.min()) >= 0
    assert "negative" not in capsys.readouterr().err
    assert convert(tmp_path / "spot_sh_latlong.exr", tmp_path, "--to", "sh") == 0
    before, after = (read_light(tmp_path / f"spot_{name}.json").sh for name in ("sh", "sh_latlong_sh"))
    assert before is not None and after is not None
    error = (after.coefficients - before.coefficients).norm() / before.coefficients.norm()
    assert float(error) < 0.05


def test_bad_lights_are_a_line_each_and_the_others_go_on(tmp_path: Path, capsys: Said) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    a_map(folder)
    write_exr(folder / "square.exr", torch.ones(8, 8, 3).numpy())
    (folder / "other.json").write_text('{"format": "facerf-light-1", "sh": {"coefficients": [[1, 1, 1]]}}')
    (folder / "broken.json").write_text("{")
    assert convert(folder, tmp_path / "out", "--to", "json") == 1
    lines = capsys.readouterr().err.splitlines()
    for words in ("twice as wide", "another convention", "broken.json: not JSON"):
        assert sum(words in line for line in lines) == 1
    assert not any("Traceback" in line for line in lines)
    rows = [json.loads(line) for line in (tmp_path / "out/report.jsonl").read_text().splitlines()]
    assert sorted(row["status"] for row in rows) == ["done", "failed", "failed", "failed"]
    assert next(row["light"] for row in rows if row["status"] == "done") == "a map of 64 x 32 pixels"
