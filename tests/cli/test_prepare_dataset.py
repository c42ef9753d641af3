"""`facerf prepare-dataset` from the command line, on a small capture of two built-in heads."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.capture.layouts import read_capture
from facerf_cli.dataset.dataset import Dataset, DatasetFolder, read_dataset
from facerf_cli.dataset.prepare import Preparation, _Subject
from facerf_cli.face.fit import load_fit
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.image_metadata import COMPUTER_GRAPHICS_SOURCE_TYPE
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.main import main
from facerf_cli.network.checkpoint import load_networks, save_networks
from facerf_cli.network.files import SHIPPED
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.cli.lines import prepare
from tests.folders import rows as rows_of
from tests.folders import tree
from tests.stacks import read_olat_stack
from tests.worlds import Truth, write_capture

LIGHTS = 12
Given = tuple[Path, dict[str, Truth]]
Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    folder = tmp_path_factory.mktemp("stage") / "capture"
    return folder, write_capture(folder, subjects=2, lights=LIGHTS)


@pytest.fixture(scope="module")
def prepared(given: Given, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    output = tmp_path_factory.mktemp("prepared") / "dataset"
    assert prepare(given[0], output) == 0
    return read_dataset(output)


def test_every_camera_of_every_subject_is_there(prepared: Dataset) -> None:
    assert prepared.subjects == ("0000", "0001") and len(prepared.light_ids) == LIGHTS
    assert sum(map(len, prepared.splits.values())) == 2 and prepared.crop_px == 96
    for subject in prepared.subjects:
        assert prepared.cameras[subject] == ("C0", "C1", "C2")
        for camera in prepared.cameras[subject]:
            stack = read_olat_stack(prepared.stack_path(subject, camera))
            assert stack.header.kind == "image" and stack.olats.shape == (LIGHTS, 3, 96, 96)
            assert (stack.olats >= 0).all() and 0.1 < stack.header.seen.mean() < 0.7
    rows = list(rows_of(prepared.folder).values())
    assert [row["status"] for row in rows] == ["done", "done"]
    assert all(row["faces_found"] == 3 and row["cameras"] == 3 for row in rows)
    assert all(row["error_iod"] < 0.05 and row["worst_crop_off_iod"] < 0.005 for row in rows)


def test_what_is_made_names_the_face_model_and_says_what_is_synthetic(
    prepared: Dataset, given: Given
) -> None:
    licence = load_face_model().licence
    stack = read_olat_stack(prepared.stack_path("0000", "C1")).header.metadata
    assert (stack["facerf:face_model"], stack["facerf:face_model_licence"]) == ("builtin", licence)
    assert "facerf:synthetic" not in stack  # of a capture that does not say so
    with np.load(prepared.fit_path("0000", "C1")) as fit:
        assert {name: fit[name].item() for name in stack} == stack
    sheet = (prepared.folder / "sheets" / "0000.jpg").read_bytes()
    assert b'facerf:face_model="builtin"' in sheet and b"facerf:face_model_licence" in sheet
    capture = replace(read_capture(given[0]), provenance={"synthetic": True})
    how = Preparation(load_face_model(), SHIPPED_NETWORKS, DatasetFolder(folder=given[0]), None, {})
    made = _Subject(capture, "0000", (), how).provenance("C1")
    assert made["facerf:input"] == "0000/C1" and made["facerf:synthetic"] == 1
    assert made["IPTC:DigitalSourceType"] == COMPUTER_GRAPHICS_SOURCE_TYPE


def test_the_fit_lies_on_the_true_face_in_every_camera(given: Given, prepared: Dataset) -> None:
    """Also in the one that saw no face: the calibration knows where it is."""
    model, capture = load_face_model(), read_capture(given[0])
    for subject, truth in given[1].items():
        true_landmarks = model.landmarks(truth.vertices_world[None].float())[0]
        for camera, posed in capture.cameras.items():
            fit = load_fit(prepared.fit_path(subject, camera))
            fitted = model.landmarks(fit.vertices_camera(model)[None])[0]
            scale = fit.camera.focal_px / -fitted[:, 2].mean()
            fitted_px = fit.camera.focal_px * fitted[:, :2] / -fitted[:, 2:] * torch.tensor([1, -1]) + 48
            off_px = fitted_px - torch.from_numpy(fit.crop.to_crop(posed.project(true_landmarks).numpy()))
            assert off_px[17:].norm(dim=-1).mean() < 0.09 * 0.089 * scale


def test_light_normals_and_skin_agree(given: Given, prepared: Dataset) -> None:
    """Lambert's law holds in the crop: albedo x max(n.l, 0), with the fit's normals, the stack's lights."""
    stack = read_olat_stack(prepared.stack_path("0000", "C1"))
    normals, seen = stack.header.normals, stack.header.seen > 0
    cosine = np.einsum("lc,hwc->lhw", stack.header.directions, normals).clip(min=0)[:, seen]
    green = stack.olats[:, 1].float().numpy()[:, seen]
    albedo = (green * cosine).sum(0) / (cosine**2).sum(0).clip(min=0.1)
    left = np.abs(green - albedo * cosine).mean() / green.mean()
    assert left < 0.2
    turned = stack.header.directions * [-1, 1, 1]  # mirrored lights would not do
    mirrored = np.einsum("lc,hwc->lhw", turned, normals).clip(min=0)[:, seen]
    albedo = (green * mirrored).sum(0) / (mirrored**2).sum(0).clip(min=0.1)
    assert np.abs(green - albedo * mirrored).mean() / green.mean() > 3 * left


def test_the_stack_is_relit_like_any_other_and_the_page_shows_everybody(
    prepared: Dataset, tmp_path: Path
) -> None:
    write_exr(tmp_path / "white.exr", np.ones((32, 64, 3), np.float32))
    stack = prepared.stack_path("0001", "C2")
    line = ["relight", str(stack), "--envmap", str(tmp_path / "white.exr"), "-o", str(tmp_path / "out")]
    assert main(line) == 0
    header = read_olat_stack(stack).header
    seen = header.seen > 0
    relit = read_image(tmp_path / "out/C2_white.exr")
    assert np.abs(relit.pixels - header.source)[seen].max() < 2e-3 * header.source.max()
    assert relit.metadata["facerf:synthetic"] == 1 and relit.metadata["facerf:input"] == "0001/C2"
    assert relit.metadata["IPTC:DigitalSourceType"].endswith("/compositeCapture")  # of photographs
    assert relit.metadata["facerf:face_model_licence"] == load_face_model().licence
    page = (prepared.folder / "index.html").read_text()
    for subject in prepared.subjects:
        assert f'src="sheets/{subject}.jpg"' in page and prepared.split_of(subject) in page
        sheet = read_image(prepared.folder / f"sheets/{subject}.jpg").pixels
        assert sheet.shape == (3 * 194 - 2, 6 * 194 - 2, 3) and sheet.max() > 0.5
    assert all((prepared.folder / link).is_file() for link in re.findall(r'(?:href|src)="([^"]+)"', page))
    assert "http" not in page and "<script" not in page


def test_jobs_and_a_second_run_change_no_byte(given: Given, prepared: Dataset, tmp_path: Path) -> None:
    assert prepare(given[0], tmp_path, "--jobs", "2") == 0
    before = tree(prepared.folder)
    assert tree(tmp_path) == before
    assert prepare(given[0], tmp_path) == 0  # nothing to do
    assert tree(tmp_path) == before


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bytes(given: Given, prepared: Dataset, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "facerf_cli", "prepare-dataset", str(given[0]), "-o", str(tmp_path)]
    run = subprocess.Popen(
        [*line, "--crop", "96", "--checks", "off"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while run.poll() is None and not (tmp_path / "olat").exists():
        time.sleep(0.02)
    time.sleep(random.Random(os.getpid()).uniform(0, 1.5))
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert prepare(given[0], tmp_path) == 0
    assert tree(tmp_path) == tree(prepared.folder)


def test_a_bad_subject_is_left_out_and_the_others_do_not_mind(
    given: Given, prepared: Dataset, tmp_path: Path, capsys: Said
) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(given[0], capture, copy_function=os.link)
    torn = capture / "0000/C1/L003.exr"
    torn.unlink()
    torn.write_bytes(b"no picture")
    output = tmp_path / "out"
    assert prepare(capture, output) == 1
    complaint = capsys.readouterr().err
    assert "0000/C1/L003.exr: " in complaint
    dataset, whole = read_dataset(output), tree(prepared.folder)
    assert dataset.subjects == ("0001",) and dataset.split_of("0001") == prepared.split_of("0001")
    content = json.loads((output / "dataset.json").read_text())
    assert content["subjects"]["0000"]["status"] == "failed"
    others = {name: digest for name, digest in tree(output).items() if "0001" in name}
    assert others and others.items() <= whole.items()
    torn.unlink()
    os.link(given[0] / "0000/C1/L003.exr", torn)
    assert prepare(capture, output) == 0  # mended: it is as if nothing had been
    assert tree(output) == whole


def test_a_missing_frame_costs_its_light_alone(
    given: Given, prepared: Dataset, tmp_path: Path, capsys: Said
) -> None:
    """In every camera of that subject, with a line; the others keep theirs; mended, nothing is left of it."""
    capture, output = tmp_path / "capture", tmp_path / "out"
    shutil.copytree(given[0], capture, copy_function=os.link)
    (capture / "0000/C1/L003.exr").unlink()
    assert prepare(capture, output) == 0
    assert "0000: 1 light left out (L003: C1: missing)" in capsys.readouterr().err
    dataset, whole = read_dataset(output), tree(prepared.folder)
    kept = (0, 1, 2, *range(4, LIGHTS))
    assert dataset.lights_of("0000") == kept and dataset.lights_of("0001") == tuple(range(LIGHTS))
    entry = json.loads((output / "dataset.json").read_text())["subjects"]["0000"]
    assert "L003" not in entry["lights"] and entry["left_out"] == {"L003": "C1: missing"}
    assert "L003 (C1: missing)" in (output / "index.html").read_text()
    for camera in dataset.cameras["0000"]:
        fewer = read_olat_stack(dataset.stack_path("0000", camera))
        all_of_them = read_olat_stack(prepared.stack_path("0000", camera))
        turned = np.linalg.lstsq(fewer.header.directions, all_of_them.header.directions[list(kept)])[0]
        assert np.abs(turned - np.eye(3)).max() < 0.02  # the fit may move a little
        shares = fewer.olats.float().mean((1, 2, 3)) / all_of_them.olats[list(kept)].float().mean((1, 2, 3))
        assert (shares[shares.isfinite()] - 1).abs().max() < 0.05
    os.link(given[0] / "0000/C1/L003.exr", capture / "0000/C1/L003.exr")
    assert prepare(capture, output) == 0
    assert tree(output) == whole


@pytest.mark.parametrize(
    ("gone", "line", "said"),
    [
        (["C1/L003"], ["--strict"], "0000/C1/L003: missing"),
        ([f"C{n}/L{n:03d}" for n in range(3)], [], "9 of 12 lights"),
        ([f"C{c}/L{n:03d}" for c in range(3) for n in range(8)], [], "no camera has enough frames"),
    ],
)
def test_too_few_frames_stop_a_subject(
    given: Given, tmp_path: Path, capsys: Said, gone: list[str], line: list[str], said: str
) -> None:
    capture = changed(given, tmp_path / "capture", subjects={"0000": {}})
    for name in gone:
        (capture / f"0000/{name}.exr").unlink()
    assert prepare(capture, tmp_path / "out", "--split", "1/0/0", *line) == 1
    assert said in (complaint := capsys.readouterr().err) and complaint.count("\n") == 1


def test_a_camera_without_most_of_its_frames_goes_alone(given: Given, tmp_path: Path, capsys: Said) -> None:
    capture = changed(given, tmp_path / "capture", subjects={"0000": {}})
    for number in range(7):
        (capture / f"0000/C2/L{number:03d}.exr").unlink()
    assert prepare(capture, tmp_path / "out", "--split", "1/0/0") == 0
    assert "1 camera left out (C2: only 5 of 12 frames" in capsys.readouterr().err
    dataset = read_dataset(tmp_path / "out")
    assert dataset.cameras["0000"] == ("C0", "C1") and len(dataset.lights_of("0000")) == LIGHTS
    assert not dataset.stack_path("0000", "C2").exists()


def test_black_images_have_no_face_nor_a_network_that_sees_none(
    given: Given, tmp_path: Path, capsys: Said
) -> None:
    content = json.loads((given[0] / "stage.json").read_text())
    content["lights"] = content["lights"][:1]
    capture = tmp_path / "capture"
    for camera in content["cameras"]:
        (capture / "0000" / camera["id"]).mkdir(parents=True)
        write_exr(capture / "0000" / camera["id"] / "L000.exr", np.zeros((160, 160, 3), np.float32))
    (capture / "stage.json").write_text(json.dumps(content))
    assert prepare(capture, tmp_path / "out") == 1
    assert "0000: no camera shows a face" in capsys.readouterr().err
    assert not (tmp_path / "out/dataset.json").exists()
    networks, _ = load_networks(SHIPPED["parsing"], LAYOUT_VERSION)
    with torch.no_grad():
        networks["parsing"].judge[-1].bias[0] = -100  # nobody is there
    blind = tmp_path / "blind.safetensors"
    save_networks(blind, networks, {"layout_version": LAYOUT_VERSION})
    cameras = json.loads((given[0] / "stage.json").read_text())["cameras"][:1]
    capture = changed(given, tmp_path / "seen", subjects={"0000": {}}, cameras=cameras)
    assert prepare(capture, tmp_path / "out", "--checkpoint", str(blind)) == 1
    assert "0000: no camera shows a face" in capsys.readouterr().err


def test_other_options_do_not_mix_and_a_dry_run_writes_nothing(
    given: Given, prepared: Dataset, capsys: Said, tmp_path: Path
) -> None:
    line = ["prepare-dataset", str(given[0]), "-o", str(prepared.folder), "--crop", "128"]
    assert main(line) == 2
    assert "other crop; pass --overwrite always" in capsys.readouterr().err
    assert prepare(given[0], tmp_path / "out", "--dry-run") == 0
    assert "olat/0001/C2.exr" in capsys.readouterr().out and not (tmp_path / "out").exists()


def changed(given: Given, capture: Path, **changes: object) -> Path:
    """The capture with changes to its description, its pictures linked."""
    shutil.copytree(given[0], capture, copy_function=os.link)
    content = json.loads((capture / "stage.json").read_text())
    (capture / "stage.json").unlink()
    (capture / "stage.json").write_text(json.dumps(content | changes))
    return capture


def test_a_new_split_says_that_old_pairs_are_of_another(
    given: Given, prepared: Dataset, tmp_path: Path, capsys: Said
) -> None:
    """And a dataset of old stages is not prepared again: only its description is written."""
    out = Path(shutil.copytree(prepared.folder, tmp_path / "out"))
    assert (
        main(["relight-dataset", str(out), "--envmaps", "procedural:2", "--per-subject", "1", "--lazy"]) == 0
    )
    assert prepare(given[0], out) == 0
    assert "another split" not in capsys.readouterr().err
    assert prepare(given[0], out, "--split", "0/0/2") == 0
    said, relit = capsys.readouterr().err, out / "relit"
    assert "pairs of 2 subjects belong to another split" in said and "--overwrite" not in said
    line = ["relight-dataset", str(out), "--envmaps", "procedural:2", "--per-subject", "1", "--lazy"]
    assert main(line) == 1 and "move the folder relit elsewhere" in capsys.readouterr().err
    relit.rename(tmp_path / "kept")  # the advice
    assert main(line) == 0 and (relit / "pairs.jsonl").is_file()


def test_a_camera_behind_the_head_is_left_out(given: Given, tmp_path: Path, capsys: Said) -> None:
    cameras = json.loads((given[0] / "stage.json").read_text())["cameras"]
    pose, head = np.array(cameras[1]["world_to_camera"]), np.array([0.01, 1.3, 0.02])
    turn = np.diag([-1.0, 1, -1])  # about the head
    cameras[1]["world_to_camera"] = np.c_[
        pose[:, :3] @ turn, pose[:, :3] @ (head - turn @ head) + pose[:, 3]
    ].tolist()
    capture = changed(given, tmp_path / "capture", cameras=cameras, subjects={"0000": {}})
    assert prepare(capture, tmp_path / "out", "--split", "1/0/0") == 0
    assert "0000: 1 camera left out (C1: " in (said := capsys.readouterr().err) and said.count("\n") == 1
    dataset = read_dataset(tmp_path / "out")
    assert dataset.cameras["0000"] == ("C0", "C2")
    entry = json.loads((tmp_path / "out/dataset.json").read_text())["subjects"]["0000"]
    assert list(entry["dropped"]) == ["C1"]
    assert prepare(capture, tmp_path / "strict", "--split", "1/0/0", "--strict") == 1
    assert "0000: C1: " in capsys.readouterr().err


@pytest.mark.parametrize(("intensity", "said"), [(1e-6, "65504 and were clipped"), (1e6, "too large")])
def test_intensities_of_another_unit_and_odd_texts_of_the_capture(
    given: Given, tmp_path: Path, capsys: Said, intensity: float, said: str
) -> None:
    content = json.loads((given[0] / "stage.json").read_text())
    lights = [light | {"intensity": [intensity] * 3} for light in content["lights"]]
    subjects = {"0000": {"name": "\ud800"}}
    capture = changed(given, tmp_path / "capture", lights=lights, subjects=subjects)
    assert prepare(capture, tmp_path / "out", "--split", "1/0/0") == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(said in line and "lights' intensities" in line for line in lines)
    dataset = json.loads((tmp_path / "out/dataset.json").read_text())
    assert dataset["subjects"]["0000"]["traits"] == subjects["0000"]


def test_images_for_the_eye_are_taken_by_their_curve(given: Given, prepared: Dataset, tmp_path: Path) -> None:
    """sRGB PNG, whose curve is undone; grey frames give grey stacks."""
    content = json.loads((given[0] / "stage.json").read_text())
    lights = [light | {"intensity": [1, 1, 1]} for light in content["lights"]]
    pattern = "{subject}/{camera}/{light}.png"
    capture = tmp_path / "capture"
    there = read_capture(given[0])
    for camera in there.cameras:
        for number, light in enumerate(there.light_ids):
            path = capture / "0000" / camera / f"{light}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_display(path, np.repeat(there.frame("0000", camera, number)[..., 1:2], 3, -1))
    changes = {"lights": lights, "pattern": pattern, "colour_space": "sRGB", "black_level": 0.0}
    (capture / "stage.json").write_text(json.dumps(content | changes))
    assert prepare(capture, tmp_path / "out", "--split", "1/0/0") == 0
    olats = read_olat_stack(tmp_path / "out/olat/0000/C0.exr").olats.float()
    whole = read_olat_stack(prepared.stack_path("0000", "C0")).olats.float()
    assert torch.equal(olats[:, 0], olats[:, 2])
    assert olats.mean() == pytest.approx(float(whole[:, 1].mean()), rel=0.05)


def test_records_of_another_run_stay_out_of_the_dataset(
    given: Given, prepared: Dataset, tmp_path: Path
) -> None:
    """As when a run with --overwrite and other options dies before it comes to a subject."""
    output = Path(shutil.copytree(prepared.folder, tmp_path / "out"))
    torn = given[0] / "0001" / "C0" / "L000.exr"
    torn.rename(tmp_path / "hidden.exr")
    torn.write_bytes(b"no picture")
    try:
        unlink = Path.unlink
        with pytest.MonkeyPatch.context() as patch:  # it dies first of all
            patch.setattr(
                Path, "unlink", lambda path, **k: None if path.name == "0001.json" else unlink(path, **k)
            )
            assert prepare(given[0], output, "--crop", "64", "--overwrite", "always") == 1
    finally:
        (tmp_path / "hidden.exr").rename(torn)
    dataset = read_dataset(output)
    assert dataset.subjects == ("0000",) and dataset.crop_px == 64


def test_a_small_capture_is_not_enlarged(given: Given, tmp_path: Path) -> None:
    """Without --crop no stack has more pixels than its face has in the frames, at most 256 a side."""
    capture = changed(given, tmp_path / "capture", subjects={"0000": {}})
    line = ["prepare-dataset", str(capture), "-o", str(tmp_path / "own"), "--checks", "off"]
    assert main([*line, "--split", "1/0/0"]) == 0
    dataset = read_dataset(tmp_path / "own")
    sides = []
    for subject in dataset.subjects:
        for camera in dataset.cameras[subject]:
            crop = load_fit(dataset.fit_path(subject, camera)).crop
            assert crop.size_px <= crop.side_px and crop.size_px % 8 == 0
            assert read_olat_stack(dataset.stack_path(subject, camera)).olats.shape[-1] == crop.size_px
            sides.append(crop.size_px)
    assert dataset.crop_px == max(sides) < 256
