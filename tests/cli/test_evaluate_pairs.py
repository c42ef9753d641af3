"""`facerf evaluate pairs` from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.evaluation.options import NamedCheckpoint
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.main import main
from tests.evaluation.toy_protocol import NOISE, PEOPLE, comparison
from tests.kinds import Patch, Said


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """truth/PERSON/NUMBER.exr, good/, and bad/ as PNG; masks/."""
    for person in PEOPLE:
        for number in range(2):
            own = comparison(person, number)
            good, bad = (np.clip(own.predictions[name], 0, 1) for name in NOISE)
            write_exr(tmp_path / f"truth/{person}/{number}.exr", own.truth)
            write_exr(tmp_path / f"good/{person}/{number}.exr", good)
            write_display(tmp_path / f"bad/{person}/{number}.png", bad)
            mask = np.repeat(own.mask[..., None], 3, 2)
            write_exr(tmp_path / f"masks/{person}/{number}.exr", mask)
    return tmp_path


def pairs(folders: Path, *more: str) -> int:
    names = [str(folders / name) for name in ("good", "bad")]
    line = ["--truth", str(folders / "truth"), "--masks", str(folders / "masks"), "-o", str(folders / "out")]
    return main(["evaluate", "pairs", *names, *line, *more])


def test_folders_are_measured(folders: Path, capsys: Said) -> None:
    facts = folders / "facts.csv"
    rows = [f"{person}/{n},{person},{tone}" for person in PEOPLE for n, tone in enumerate(("light", "dark"))]
    facts.write_text("\n".join(["name,person,tone", *rows]) + "\n")
    assert pairs(folders, "--facts", str(facts)) == 0
    assert "tone: dark" in capsys.readouterr().out
    summary = json.loads((folders / "out/summary.json").read_text())
    assert summary["methods"] == ["good", "bad"] and (summary["pictures"], summary["persons"]) == (6, 3)
    first = summary["groups"][0]["metrics"]
    assert first["si_mse"]["good"]["mean"] < first["si_mse"]["bad"]["mean"]
    assert first["ssim"]["bad"]["less_the_first"]["won"] == 0
    assert not any(name.startswith("checkpoint") for name in summary)  # no network had a part in it


def test_what_is_missing_or_of_another_size_makes_no_table(folders: Path, capsys: Said) -> None:
    (folders / "bad/bea/1.png").rename(folders / "bad/bea/2.png")
    assert pairs(folders) == 1
    said = capsys.readouterr()
    assert "1 of 6 missing (bea/1)" in said.err and "1 without a truth (bea/2)" in said.err
    assert len(said.err.splitlines()) == 1 and not (folders / "out").exists()
    (folders / "bad/bea/2.png").rename(folders / "bad/bea/1.png")
    write_exr(folders / "good/anna/0.exr", np.zeros((4, 5, 3), np.float32))
    assert pairs(folders) == 1
    assert "anna/0: good has 5 x 4 pixels, the truth 48 x 36" in capsys.readouterr().err
    assert not (folders / "out/summary.json").exists()


def test_a_folder_may_be_given_from_inside(folders: Path, capsys: Said, monkeypatch: Patch) -> None:
    monkeypatch.chdir(folders / "good")
    line = ["evaluate", "pairs", ".", "../bad", "--truth", "../truth", "-o", "../out"]
    assert main(line) == 0
    summary = json.loads((folders / "out/summary.json").read_text())
    assert summary["methods"] == ["good", "bad"] and summary["title"].endswith("truth")
    assert "finished" not in capsys.readouterr().err
    monkeypatch.chdir(folders)  # the same run by another way
    absolute = [str(folders / name) for name in ("good", "bad", "truth", "out")]
    assert main(["evaluate", "pairs", *absolute[:2], "--truth", absolute[2], "-o", absolute[3]]) == 0
    assert "6 of 6 already finished" in capsys.readouterr().err


def test_a_link_is_a_method_of_its_own_name(folders: Path) -> None:
    (folders / "link").symlink_to("good")
    truth, out = str(folders / "truth"), str(folders / "out")
    line = ["evaluate", "pairs", str(folders / "link"), "--truth", truth, "-o", out]
    assert main(line) == 0
    assert json.loads((folders / "out/summary.json").read_text())["methods"] == ["link"]
    (folders / "link").unlink()
    (folders / "link").symlink_to("bad")  # as PNG: other files, so they are measured again
    before = json.loads((folders / "out/summary.json").read_text())["groups"]
    assert main([*line, "--overwrite", "never"]) == 2
    assert main(line) == 0
    assert json.loads((folders / "out/summary.json").read_text())["groups"] != before


@pytest.mark.parametrize(
    ("given", "name"),
    [("other.safetensors", "other"), ("runs/b/best.safetensors", "b"), ("a=runs/b/last.safetensors", "a")],
)
def test_a_checkpoint_has_its_name_or_that_of_its_run(given: str, name: str) -> None:
    assert NamedCheckpoint.parse(given).name == name
