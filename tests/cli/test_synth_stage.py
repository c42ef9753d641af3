"""`facerf synth-stage` from the command line: two built-in people, few lights, small images."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.capture.layouts import read_capture
from facerf_cli.files.image_metadata import COMPUTER_GRAPHICS_SOURCE_TYPE
from facerf_cli.files.read import read_image
from facerf_cli.light.transport import BakeSettings
from facerf_cli.main import main
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth import stage
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.person import draw_person
from facerf_cli.synth.stage_settings import Frame
from facerf_cli.synth.views import layers_of, stage_cameras, surface_samples
from tests.folders import tree

LIGHTS, CAMERAS = 6, 3
Said = pytest.CaptureFixture[str]


def photograph(folder: Path, *line: str) -> int:
    size = ["--size", "64", "--lights", str(LIGHTS), "--cameras", str(CAMERAS)]
    return main(["synth-stage", "-o", str(folder), *size, *line])


@pytest.fixture(scope="module", autouse=True)
def _few_rays() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "_BAKE", BakeSettings(light_samples=1, bounce_samples=2))
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synth") / "capture"
    assert photograph(folder, "--subjects", "2") == 0
    return folder


def lit(folder: Path, subject: str, camera: int, light: int) -> np.ndarray:
    return read_image(folder / subject / f"C{camera}" / f"L{light:03d}.exr").pixels


def test_it_is_a_capture_like_any_other(capture: Path) -> None:
    found = read_capture(capture)
    assert list(found.subjects) == ["0000", "0001"] and len(found.cameras) == CAMERAS
    described = json.loads((capture / "stage.json").read_text())
    assert described["provenance"]["synthetic"] and -90 < described["subjects"]["0001"]["ita_deg"] < 90
    frames = np.stack([found.frame("0001", "C2", light) for light in range(LIGHTS)])
    assert np.isfinite(frames).all() and 0.02 < frames.mean() < 1
    image = read_image(capture / "0001" / "C0" / "L000.exr")
    assert image.pixels.shape == (64, 64, 3)
    assert image.metadata["facerf:face_model"] == "builtin" and image.metadata["facerf:synthetic"] == 1
    assert image.metadata["IPTC:DigitalSourceType"] == COMPUTER_GRAPHICS_SOURCE_TYPE
    record = json.loads((capture / "0000" / "subject.json").read_text(encoding="utf-8"))
    assert np.array(record["head_to_world"]).shape == (3, 3)
    assert {"left iris", "right ear lobe"} < set(record["more_landmarks_world"])


def test_other_threads_shards_and_one_more_person_change_no_byte(capture: Path, tmp_path: Path) -> None:
    """The second person alone, by a shard, beside a first who is finished: the last shard writes the sum."""
    shutil.copytree(capture / "0000", tmp_path / "0000")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.exr")}
    assert photograph(tmp_path, "--subjects", "1") == 0
    threads = torch.get_num_threads()
    torch.set_num_threads(1 + threads % 2)  # workers of --jobs have another number of them
    assert photograph(tmp_path, "--subjects", "2", "--shard", "2/2") == 0
    torch.set_num_threads(threads)
    assert photograph(tmp_path, "--subjects", "2", "--shard", "1/2") == 0
    assert tree(tmp_path) == tree(capture)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.glob("0000/**/*.exr")}


def test_lights_and_calibration_agree_with_the_images(capture: Path) -> None:
    found = read_capture(capture)
    across = found.directions_world[:, 0]
    right = lit(capture, "0000", 0, int(across.argmax())).sum((0, 2))
    left = lit(capture, "0000", 0, int(across.argmin())).sum((0, 2))
    columns = np.arange(64)
    assert (right * columns).sum() / right.sum() > (left * columns).sum() / left.sum() + 4
    record = json.loads((capture / "0000" / "subject.json").read_text())
    nose_world = torch.tensor(record["landmarks_world"][30])
    nose_px = [found.cameras[f"C{camera}"].project(nose_world).numpy() for camera in range(CAMERAS)]
    assert (np.abs(np.array(nose_px) - 32) < 16).all()
    # The second camera stands on the first one's left; the nose, before the head's axis, is further right.
    assert nose_px[1][0] > nose_px[0][0] + 2 > nose_px[2][0] + 4


def test_other_settings_need_another_folder(capture: Path, capsys: Said) -> None:
    before = tree(capture)
    assert photograph(capture, "--subjects", "2", "--seed", "1") == 2
    error = capsys.readouterr().err.strip()
    assert "another -o" in error and error.count(os.linesep) == 0
    assert tree(capture) == before


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: Said) -> None:
    assert photograph(tmp_path / "none", "--subjects", "3", "--dry-run") == 0
    assert capsys.readouterr().out.count("->") == 3 and not (tmp_path / "none").exists()


def test_a_bust_shows_more_of_the_garment() -> None:
    subject = draw_person(cached_face_model("builtin"), 0, 0, 64)
    frames: tuple[Frame, Frame] = ("head", "bust")
    head, bust = (
        layers_of(subject.mesh, surface_samples(subject.mesh, camera), camera)[0]
        for camera in (stage_cameras(64, frame)[0] for frame in frames)
    )
    garment, skin = class_index("garment"), class_index("skin")
    assert bust[..., garment].sum() > 2 * head[..., garment].sum()
    assert 0.3 < bust[..., skin].sum() / head[..., skin].sum() < 0.55  # (0.36 / 0.56)^2 is 0.41
