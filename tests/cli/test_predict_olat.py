"""`facerf predict-olat` from the command line, with a network that is Lambert's law until it is trained."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import luminance
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.main import main
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.viewer.page import strip_of
from tests.astronaut import PATH as PHOTO
from tests.folders import only_row
from tests.kinds import Patch, Said
from tests.stacks import OlatStack, read_olat_stack

SIDES = "70,0;-70,0;0,80"


def predict(given: Path, output: Path, *line: str, photo: Path = PHOTO) -> int:
    head = ["--checkpoint", str(given / "lambert.safetensors"), "predict-olat", str(photo)]
    frame = () if "--frame" in line else ("--frame", "uv")
    return main([*head, "-o", str(output), "--landmarks", str(given / "astronaut.json"), *frame, *line])


def stack_of(given: Path, output: Path, *line: str) -> OlatStack:
    assert predict(given, output, *line) == 0
    return read_olat_stack(output / "astronaut_olat.exr")


def side_of_light(stack: OlatStack, light: int) -> np.ndarray:
    """Centre of an OLAT's light, less the centre of what it falls on; in shares of the side: right, down."""
    seen = stack.header.seen
    light_map = luminance(stack.olats[light].float().permute(1, 2, 0).numpy()) * seen
    rows, columns = np.indices(seen.shape)
    centres = [np.array([(m * axis).sum() / m.sum() for axis in (columns, rows)]) for m in (light_map, seen)]
    return (centres[0] - centres[1]) / len(seen)


@pytest.mark.parametrize("kind", ["uv", "face"])
def test_lights_fall_from_where_the_stack_says(given: Path, tmp_path: Path, kind: str) -> None:
    stack = stack_of(given, tmp_path, "--lights", SIDES, "--frame", kind)
    assert stack.header.kind == {"uv": "texture", "face": "image"}[kind]
    expected = azel_to_direction(torch.tensor([70.0, -70, 0]), torch.tensor([0.0, 0, 80])).numpy()
    assert np.abs(stack.header.directions - expected).max() < 1e-6
    right, left, above = (side_of_light(stack, light) for light in range(3))
    assert right[0] > 0.04 and left[0] < -0.04 and above[1] < -0.01
    side = {"uv": 256, "face": 512}[kind]
    assert stack.olats.shape == (3, 3, side, side) and (stack.olats >= 0).all()
    sheet = read_image(tmp_path / "astronaut_olat.png").pixels
    assert sheet.shape[0] in (128, 258) and sheet.max() > 0.5


def test_a_stack_shows_the_person_in_the_photos_frame(given: Path, tmp_path: Path) -> None:
    line = ["--lights", SIDES, "--frame", "photo", "--size", "256"]
    stack = stack_of(given, tmp_path / "olat", *line)
    header = stack.header
    assert header.kind == "photo" and stack.olats.shape == (3, 3, 256, 256)
    assert 0.2 < header.seen.mean() < 0.8 and float(stack.olats[:, :, header.seen == 0].abs().max()) == 0
    right, left, _ = (side_of_light(stack, light) for light in range(3))
    assert right[0] > left[0] + 0.05
    path = tmp_path / "olat/astronaut_olat.exr"
    line = ["relight", str(path), "--light", "70,0", "--exposure", "0", "-o", str(tmp_path / "relit")]
    assert main(line) == 0
    relit = read_image(tmp_path / "relit/astronaut_olat_light_70_0.exr")
    assert relit.alpha is not None and relit.pixels.shape[:2] == (256, 256)


@pytest.mark.slow
def test_a_page_is_written_beside_the_stack(given: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("facerf_cli.viewer.basis.rig_directions", lambda: rig_directions(12))
    line = ["--lights", SIDES, "--frame", "photo", "--size", "256", "--page"]
    assert predict(given, tmp_path, *line) == 0
    made = (tmp_path / "astronaut_page.html").read_text()
    assert strip_of(made) and 'id="data"' in made
    assert (tmp_path / "astronaut_olat.exr").exists()


@pytest.mark.parametrize("frame", ["uv", "photo"])
def test_the_contact_sheet_does_not_grow_with_the_lights(
    frame: str, given: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr("facerf_cli.work.predict_olat._SHEET_PX", 9 * 20**2)
    assert predict(given, tmp_path, "--lights", "9", "--frame", frame, "--size", "64") == 0
    sheet = read_image(tmp_path / "astronaut_olat.png").pixels
    assert (
        sheet.shape[0] * sheet.shape[1] <= 12 * 22**2
    )  # tiles of 20 pixels, gaps of 2 and a place left over


def test_the_stack_is_enough_to_render_the_face(given: Path, tmp_path: Path) -> None:
    header = stack_of(given, tmp_path, "--lights", "2", "--pose", "30,-5,2").header
    fit = fit_from_arrays(header.fit)
    assert torch.allclose(torch.from_numpy(header.rotation).float(), pose_to_rotation(30, -5, 2), atol=1e-6)
    assert fit.vertices_camera(load_face_model("builtin")).isfinite().all() and fit.quality == "good"
    assert header.source.shape == (256, 256, 3) and header.layout_version == LAYOUT_VERSION
    assert np.allclose(np.linalg.norm(header.normals, axis=-1), 1, atol=2e-3)
    assert header.metadata["facerf:input"] == PHOTO.name and header.metadata["facerf:synthetic"] == 1
    row = only_row(tmp_path)
    assert row["lights"] == 2 and row["quality"] == "good" and len(row["pose_deg"]) == 3


def test_a_turned_head_keeps_its_lights_and_memory_and_precision_change_little(
    given: Path, tmp_path: Path
) -> None:
    straight = stack_of(given, tmp_path / "a", "--lights", SIDES, "--pose", "0,0,0").olats.float()
    turned = stack_of(given, tmp_path / "b", "--lights", SIDES, "--pose", "40,0,0").olats.float()
    right, left, _ = turned.mean((1, 2, 3)) / straight.mean((1, 2, 3))
    assert right > 1.2 and left < 0.7  # a nose to the picture's right faces the light from there
    usual = stack_of(given, tmp_path / "usual", "--lights", "7").olats.float()
    frugal = stack_of(given, tmp_path / "frugal", "--lights", "7", "--memory", "0.1").olats.float()
    coarse = stack_of(given, tmp_path / "c", "--lights", "7", "--precision", "bf16").olats.float()
    assert torch.allclose(usual, frugal, atol=1e-3) and (usual - coarse).abs().max() < 0.05 * usual.max()


def test_lights_from_a_file_and_a_long_list_that_is_no_files_name(given: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.txt").write_text("# az, el\n10, 20\n\n-30 5  # left\n")
    stack = stack_of(given, tmp_path / "o", "--lights", str(tmp_path / "rig.txt"))
    assert len(stack.header.directions) == 2 and stack.header.directions[1, 0] < 0
    many = ";".join(f"{azimuth_deg},{azimuth_deg / 4}" for azimuth_deg in range(60))
    assert len(many) > 256
    assert predict(given, tmp_path / "many", "--lights", many, "--dry-run") == 0


def test_all_faces_get_a_number_and_finished_ones_are_skipped(given: Path, tmp_path: Path) -> None:
    line = ["--lights", "1", "--face", "all"]
    assert predict(given, tmp_path, *line) == 0
    written = tmp_path / "astronaut_face0_olat.exr"
    stamp = written.stat().st_mtime_ns
    assert predict(given, tmp_path, *line) == 0
    assert written.stat().st_mtime_ns == stamp


def test_bad_photos_leave_the_good_one_unharmed(given: Path, tmp_path: Path, capsys: Said) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "good.jpg").write_bytes(PHOTO.read_bytes())
    (photos / "cut.jpg").write_bytes(PHOTO.read_bytes()[:5000])
    (photos / "text.exr").write_text("hello")
    write_display(photos / "empty.png", np.full((90, 120, 3), 0.2, np.float32))
    write_display(photos / "dot.png", np.full((1, 1, 3), 0.2, np.float32))
    head = ["--checkpoint", str(given / "lambert.safetensors"), "predict-olat", str(photos)]
    assert main([*head, "-o", str(tmp_path / "o"), "--lights", "1"]) == 1
    err = capsys.readouterr().err
    assert all(f"error: {photos / name}" in err for name in ("cut.jpg", "text.exr", "empty.png", "dot.png"))
    assert "good.jpg: detection is sure" in err  # the one word about a photo
    assert "4 of 5 failed" in err and "Traceback" not in err and err.count("\n") == 6
    assert (tmp_path / "o" / "good_olat.exr").is_file()
