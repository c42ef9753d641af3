from pathlib import Path

import pytest

from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.checkpoints import save_checkpoint
from facerf_cli.main import main


@pytest.mark.parametrize("time", ["soon", "5", "-3m", "2d"])
def test_a_bad_time_is_refused(tmp_path: Path, time: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "-o", str(tmp_path / "run"), f"--max-time={time}"]) == 2
    assert capsys.readouterr().err.strip().splitlines() == [
        f"facerf: error: --max-time {time}: write a number and s, m or h, such as 45m"
    ]
    assert not (tmp_path / "run").exists()


def test_a_missing_face_model_is_named_before_anything_is_baked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "-o", str(tmp_path / "run"), "--heads-from", "nobody.npz"]) == 1
    assert "nobody.npz: no such face model" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_bad_start_is_named_before_baking(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = tmp_path / "start.safetensors"
    start.write_text("nothing")
    assert main(["train", "-o", str(tmp_path / "run"), "--start-from", str(start)]) == 1
    assert "not a facerf checkpoint" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_start_whose_weights_do_not_fit_is_named_before_baking(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = tmp_path / "start.safetensors"
    save_checkpoint(start, {}, {"layout_version": LAYOUT_VERSION, "network": {"side": 64}})
    assert main(["train", "-o", str(tmp_path / "run"), "--start-from", str(start)]) == 1
    assert f"{start}: its weights do not fit" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("options", [["--heads", "20"], ["--bank", "bank"], ["--heads-from", "builtin"]])
def test_a_dataset_and_heads_exclude_each_other(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--dataset", str(tmp_path), "-o", str(tmp_path / "run"), *options]) == 2
    assert capsys.readouterr().err.strip().splitlines() == [
        f"facerf: error: {options[0]} is for synthetic heads, and --dataset takes their place; "
        "give one of them"
    ]
    assert not (tmp_path / "run").exists()


def test_a_folder_that_is_no_dataset_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--dataset", str(tmp_path), "-o", str(tmp_path / "run")]) == 1
    assert f"{tmp_path}/dataset.json: no such file" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_datasets_options_need_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "-o", str(tmp_path / "run"), "--texture-size", "64"]) == 2
    assert "--texture-size is for a prepared dataset; give --dataset" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
