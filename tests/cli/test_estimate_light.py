"""`facerf estimate-light` and `relight --light-from`, with a network that is Lambert's law."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.files.light_files import read_light
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.image.strips import resized
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.main import main
from tests.astronaut import PATH as PHOTO
from tests.folders import rows
from tests.kinds import Folders, Patch, Said


def estimate(given: Path, output: Path, *line: str, photo: Path = PHOTO, lights: str = "12") -> int:
    fixed = ["--checkpoint", str(given / "lambert.safetensors"), "estimate-light", str(photo)]
    more = ["-o", str(output), "--lights", lights, "--landmarks", str(given / "astronaut.json")]
    return main([*fixed, *more, "--width", "64", *line])


@pytest.fixture(scope="module")
def estimated(given: Path, tmp_path_factory: Folders) -> Path:
    """What the default estimate writes."""
    folder = tmp_path_factory.mktemp("estimated")
    assert estimate(given, folder, "--sh-order", "3") == 0
    return folder


def row_of(output: Path) -> dict:
    return list(rows(output).values())[-1]


def test_a_light_is_a_map_numbers_and_a_image(given: Path, estimated: Path, capsys: Said) -> None:
    light = read_light(estimated / "astronaut_light.json")
    assert torch.allclose(light.directions, rig_directions(12), atol=1e-6) and (light.weights >= 0).all()
    harmonics = rig_coefficients(RigLight(light.directions, light.weights), 3)
    assert light.sh is not None and torch.allclose(light.sh, harmonics, atol=1e-5)
    envmap = read_image(estimated / "astronaut_light.exr").pixels
    assert envmap.shape == (32, 64, 3)
    taken_back = envmap_weights(torch.from_numpy(envmap), light.directions)
    assert (taken_back - light.weights).abs().max() < 0.02 * light.weights.max()
    assert read_image(estimated / "astronaut_light.png").pixels.shape[1] == 5 * 256
    row = row_of(estimated)
    assert row["quality"] == "good" and 0 < row["residual"] < 0.6 and row["features"] is None
    assert row["lights"] == 12 and 0 <= row["clipped"] < 0.05 and len(row["brightest_azel_deg"]) == 2
    assert light.attributes["facerf:checkpoint"] == "lambert"
    assert estimate(given, estimated, "--sh-order", "3") == 0
    assert row_of(estimated)["status"] == "done" and not capsys.readouterr().out  # finished already


def test_the_plain_form_fits_better_and_refinement_lowers_its_loss(
    given: Path, estimated: Path, tmp_path: Path
) -> None:
    assert estimate(given, tmp_path, "--signed", "--lights", "120") == 0
    plain = row_of(tmp_path)
    assert plain["residual"] < row_of(estimated)["residual"] and not plain["non_negative"]
    assert (read_light(tmp_path / "astronaut_light.json").weights < 0).any()
    assert estimate(given, tmp_path, "--refine", "features", "--sh-order", "0") == 0
    row = row_of(tmp_path)
    assert row["features"] == "S_f (shipped)" and row["feature_loss"][1] < row["feature_loss"][0]
    assert (
        read_light(tmp_path / "astronaut_light.json").attributes["facerf:light_features"] == "S_f (shipped)"
    )


def test_a_face_that_is_not_to_be_seen_is_one_line(given: Path, tmp_path: Path, capsys: Said) -> None:
    photo = read_image(PHOTO).pixels
    black, cut, matte, half = (tmp_path / f"{name}.png" for name in ("black", "cut", "matte", "half"))
    nothing = np.zeros(photo.shape[:2], np.float32)
    nothing[:9, :9] = 1  # alpha that is 0 everywhere is none
    write_display(black, np.zeros_like(photo))
    write_display(cut, photo, alpha=nothing)
    for path, word in ((black, "black"), (cut, "masked out")):
        assert estimate(given, tmp_path / "out", photo=path) == 1
        (said,) = capsys.readouterr().err.splitlines()
        assert word in said and str(path) in said
    write_display(matte, np.zeros_like(photo))
    assert estimate(given, tmp_path / "out", "--matte", str(matte)) == 1
    assert "masked out" in capsys.readouterr().err
    sliver = photo.copy() * 0
    sliver[:, 211:213] = 1
    write_display(half, sliver)
    assert estimate(given, tmp_path / "out", "--matte", str(half)) == 1
    assert "too little of the face" in capsys.readouterr().err
    write_display(matte, np.ones((8, 9, 3), np.float32))
    assert estimate(given, tmp_path / "out", "--matte", str(matte)) == 1
    assert "9 x 8" in capsys.readouterr().err


def test_the_light_of_another_photo_is_that_of_the_two_commands_and_is_kept(
    given: Path, tmp_path: Path, capsys: Said, monkeypatch: Patch
) -> None:
    other, places = tmp_path / "other.png", tmp_path / "places"
    write_display(other, read_image(PHOTO).pixels * np.float32([1.0, 0.8, 0.5]))
    places.mkdir()
    for name in ("astronaut", "other"):
        (places / f"{name}.json").write_text((given / "astronaut.json").read_text())
    models, landmarks = ["--checkpoint", str(given / "lambert.safetensors")], ["--landmarks", str(places)]
    field = ["--reflectance", "field", "--lights", "12"]
    relit = [*models, "relight", str(PHOTO), *landmarks, *field, "--rotate", "90", "-o"]
    assert main([*relit, str(tmp_path / "one"), "--light-from", str(other)]) == 0
    assert main([*models, "estimate-light", str(other), *landmarks, "-o", str(tmp_path)]) == 0
    assert main([*relit, str(tmp_path / "two"), "--envmap", str(tmp_path / "other_light.exr")]) == 0
    one, two = (
        read_image(tmp_path / name / "astronaut_other_light_rot90.exr").pixels for name in ("one", "two")
    )
    assert one.max() > 0 and (one == two).all()
    monkeypatch.setattr(
        "facerf_cli.work.estimate_light.write_lights", lambda *_: pytest.fail("estimated anew")
    )
    assert main([*relit, str(tmp_path / "one"), "--light-from", str(other), "--format", "png"]) == 0
    assert main([*relit, str(tmp_path / "no"), "--light-from", str(tmp_path / "none.jpg")]) == 1
    assert "none.jpg: cannot be read (No such file or directory)" in capsys.readouterr().err


def test_a_picture_without_a_face_gives_a_guess_and_lights_as_one(
    given: Path, tmp_path: Path, capsys: Said
) -> None:
    """A bright sky at the left, as a background and by name: the map of estimate-light, at 0 EV."""
    beach = tmp_path / "beach.png"
    sky = np.full((60, 90, 3), 0.1, np.float32)
    sky[:30, :45] = (0.9, 0.8, 0.6)
    write_display(beach, sky)
    models = ["--checkpoint", str(given / "lambert.safetensors")]
    assert main([*models, "estimate-light", str(beach), "-o", str(tmp_path), "--width", "512"]) == 0
    row, shown = row_of(tmp_path), capsys.readouterr().err
    assert row["light_from"] == "picture" and 0 < row["guess_error"] < 2
    assert "beach.png: " in shown and "guess" in shown and "60 degrees" in shown
    assert f" {100 * row['guess_error']:.0f} %" in shown.partition("matte white ball")[2]
    expected = read_image(tmp_path / "beach_light.exr").pixels
    assert expected.shape == (256, 512, 3) and read_light(tmp_path / "beach_light.json").weights.min() >= 0
    assert (expected[115, 500] > 3 * expected[115, 12]).all()  # u just below 1 is the picture's left
    relit = [*models, "relight", str(PHOTO), "--landmarks", str(given / "astronaut.json"), "-o"]
    line = ["--background", str(beach), "--light-from", "background", "--light-from", f"sky={beach}"]
    options = ["--lights", "12", "--light", "original", "--reflectance", "field"]
    assert main([*relit, str(tmp_path / "one"), *line, *options]) == 0
    by_map = ["--envmap", str(tmp_path / "beach_light.exr"), "--background", str(beach), "--exposure", "0"]
    assert main([*relit, str(tmp_path / "two"), *by_map, *options]) == 0
    one, two = (read_image(tmp_path / name / "astronaut_beach_light.exr").pixels for name in ("one", "two"))
    assert one.max() > 0
    np.testing.assert_allclose(one, two, rtol=2e-3)  # a half float's last bit: other lights are summed beside
    assert (tmp_path / "one" / "astronaut_light_sky+original.exr").is_file()
    tiny = np.tile(sky, (8, 8, 1))  # a face of 20 pixels counts as none
    photo = read_image(PHOTO).pixels
    tiny[200:264, 300:364] = resized(photo, 64, 64)
    write_display(tmp_path / "tiny.png", tiny)
    assert main([*models, "estimate-light", str(tmp_path / "tiny.png"), "-o", str(tmp_path)]) == 0
    assert row_of(tmp_path)["light_from"] == "picture"
    assert main([*models, "estimate-light", str(beach), "-o", str(tmp_path), "--fov", "100"]) == 0
    assert np.abs(read_image(tmp_path / "beach_light.exr").pixels - expected).max() > 0.05
