"""FaceOLAT's layout and Metashape's calibration, by a stage that was rewritten in them."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.capture.capture import distorted
from facerf_cli.capture.faceolat import sphere_centre
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.metashape import read_metashape
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.errors import InputError
from facerf_cli.main import main
from tests.refusals import refused
from tests.stacks import read_olat_stack
from tests.worlds import HEAD_WORLD, LENS, write_capture, write_faceolat

FAR_M, NEAR_M = 1000.0, 1.6
Given = tuple[Path, Path, dict[str, str]]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    """A stage, and the same as FaceOLAT, its second subject a stop dark."""
    folder = tmp_path_factory.mktemp("stages")
    write_capture(folder / "stage", subjects=2, lights=12)
    takes = write_faceolat(folder / "stage", folder / "faceolat", FAR_M, dark="0001")
    return folder / "stage", folder / "faceolat", takes


def test_frames_lights_cameras_and_colours_are_those_of_the_stage(given: Given) -> None:
    stage, (folder, takes) = read_capture(given[0]), given[1:]
    capture = read_capture(folder, ReadSettings("faceolat"))
    assert capture.subjects == {"ID10001": {"person": "001"}, "ID20090": {"person": "090"}}
    assert len(capture.light_ids) == 12 and dict(capture.stops) == {"ID20090": -1}
    np.testing.assert_allclose(capture.directions_world, stage.directions_world, atol=1e-6)
    middle = HEAD_WORLD.numpy()
    for (name, posed), there in zip(capture.cameras.items(), stage.cameras.values(), strict=True):
        assert name[:3] == "Cam" and (posed.focal_px, posed.centre_px) == (there.focal_px, there.centre_px)
        torch.testing.assert_close(posed.rotation, there.rotation, atol=1e-9, rtol=0)
        seen = there.translation_m + there.rotation @ torch.from_numpy(middle)  # about the lights' middle
        torch.testing.assert_close(posed.translation_m, seen, atol=1e-6, rtol=0)
    for subject, take in takes.items():
        found, true = capture.frame(take, "Cam01", 7), stage.frame(subject, "C1", 7)
        np.testing.assert_allclose(found, true, atol=2e-3)


def test_a_missing_first_file_shifts_no_take(given: Given, tmp_path: Path) -> None:
    whole = read_capture(given[1], ReadSettings("faceolat"))
    folder = tmp_path / "faceolat"
    shutil.copytree(given[1], folder, copy_function=os.symlink)
    (folder / "Cam00/ID10001/ID10001.000001.exr").unlink()
    (folder / "Cam00/ID10001/ID10001.txt").touch()
    assert read_capture(folder, ReadSettings("faceolat")).light_ids == whole.light_ids


@pytest.mark.slow
def test_it_is_prepared_as_the_stage_and_trains(given: Given, tmp_path: Path) -> None:
    line = ["--crop", "64", "--split", "1/1/0"]
    for folder, layout in zip(given, ("stage", "faceolat"), strict=False):
        out = ["-o", str(tmp_path / layout), "--layout", layout, "--checks", "off"]
        assert main(["prepare-dataset", str(folder), *out, *line]) == 0
    one, other = (read_dataset(tmp_path / layout) for layout in ("stage", "faceolat"))
    for subject, take in given[2].items():
        stacks = [
            read_olat_stack(made.stack_path(name, made.cameras[name][0]))
            for made, name in ((one, subject), (other, take))
        ]
        by_light = [np.argsort(stack.header.directions[:, 0]) for stack in stacks]
        np.testing.assert_allclose(
            *(stack.olats[order].numpy() for stack, order in zip(stacks, by_light, strict=True)), atol=0.02
        )
    data = str(tmp_path / "faceolat")
    assert main(["relight-dataset", data, "--envmaps", "procedural:10", "--per-subject", "2"]) == 0
    run = ["train", "-o", str(tmp_path / "run"), "--dataset", data, "--preset", "tiny", "--steps", "5"]
    assert main([*run, "--texture-size", "32"]) == 0
    table = ["evaluate", "olat", data, "-o", str(tmp_path / "table"), "--split", "validation"]
    assert main([*table, "--checkpoint", str(tmp_path / "run/last.safetensors")]) == 0


def test_near_light_falls_with_the_distance_to_the_head(given: Given, tmp_path: Path) -> None:
    write_faceolat(given[0], tmp_path, NEAR_M)
    capture = read_capture(tmp_path, ReadSettings("faceolat"))
    np.testing.assert_allclose(np.linalg.norm(capture.positions_m, axis=1), NEAR_M, rtol=1e-6)
    head_m = np.array([0.1, -0.2, 0.05])
    about = capture.about(head_m)
    place = capture.directions_world[3] * NEAR_M - head_m
    distance_m = np.linalg.norm(place)
    np.testing.assert_allclose(about.directions_world[3], place / distance_m, atol=1e-6)
    np.testing.assert_allclose(about.intensities[3], (NEAR_M / distance_m) ** 2, rtol=1e-5)


def test_a_sphere_is_found_by_a_part_of_it() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    points = 1600 * points / np.linalg.norm(points, axis=1, keepdims=True) + [640, 1700, 500]
    np.testing.assert_allclose(sphere_centre(points[points[:, 1] > 1500]), [640, 1700, 500], atol=1e-6)


def test_a_point_is_seen_where_metashape_sees_it(tmp_path: Path) -> None:
    (tmp_path / "lens.xml").write_text(LENS)
    (camera,) = read_metashape(tmp_path / "lens.xml").values()
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    aside = x * radial + 0.004 * (r2 + 2 * x * x) + 2 * -0.005 * x * y
    down = y * radial + -0.005 * (r2 + 2 * y * y) + 2 * 0.004 * x * y
    there = 100 + 3 + 180 * aside + 0.5 * aside, 50 - 2 + 180 * down
    moved = distorted(torch.tensor([x, y], dtype=torch.float64), tuple(camera["distortion"])).numpy()
    seen = np.array(camera["K"]) @ [*moved, 1]
    np.testing.assert_allclose(seen[:2], there, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("colorcalib.mat", "1 2 3", "is not a matrix of 3 x 4 numbers"),
        ("colorcalib.mat", None, "no such file"),
        ("lights/light_pattern_per_frame.json", [[0, 0], [1, 14]], "is not a frame and one of 12 lights"),
        ("lights/light_pattern_metadata.json", {"light_positions": [[0, 0]]}, "light_positions"),
    ],
)
def test_what_is_wrong_in_its_files_is_said(
    given: Given, tmp_path: Path, name: str, text: object, said: str
) -> None:
    folder = tmp_path / "faceolat"
    for path in given[1].rglob("*"):
        if path.is_file() and (path.suffix != ".exr" or path.name.endswith("000001.exr")):
            (folder / path.relative_to(given[1])).parent.mkdir(parents=True, exist_ok=True)
            (folder / path.relative_to(given[1])).symlink_to(path)
    (folder / name).unlink()
    if text is not None:
        (folder / name).write_text(text if isinstance(text, str) else json.dumps(text))
    refused(InputError, said, read_capture, folder, ReadSettings("faceolat"))
