"""`facerf evaluate compare` on folders of images, from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.evaluation.options import NamedPath
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


def compare(folders: Path, *more: str) -> int:
    line = [f"--method={folders / name}" for name in ("good", "bad")]
    line += ["--masks", str(folders / "masks"), "-o", str(folders / "out")]
    return main(["evaluate", "compare", str(folders / "truth"), *line, *more])


def test_folders_are_measured(folders: Path, capsys: Said) -> None:
    facts = folders / "facts.csv"
    rows = [f"{person}/{n},{person},{tone}" for person in PEOPLE for n, tone in enumerate(("light", "dark"))]
    facts.write_text("\n".join(["name,person,tone", *rows]) + "\n")
    assert compare(folders, "--facts", str(facts)) == 0
    assert "tone: dark" in capsys.readouterr().out
    summary = json.loads((folders / "out/summary.json").read_text())
    assert summary["methods"] == ["good", "bad"] and (summary["pictures"], summary["persons"]) == (6, 3)
    first = summary["groups"][0]["metrics"]
    assert first["si_mse"]["good"]["mean"] < first["si_mse"]["bad"]["mean"]
    assert first["ssim"]["bad"]["less_the_first"]["won"] == 0
    assert not any(name.startswith("checkpoint") for name in summary)  # no network had a part in it


def test_a_folder_may_be_given_from_inside_and_a_link_has_its_own_name(
    folders: Path, capsys: Said, monkeypatch: Patch
) -> None:
    (folders / "link").symlink_to("bad")
    monkeypatch.chdir(folders / "good")
    line = ["evaluate", "compare", "../truth", "--method", ".", "--method=../link", "-o", "../out"]
    assert main(line) == 0
    summary = json.loads((folders / "out/summary.json").read_text())
    assert summary["methods"] == ["good", "link"] and summary["title"].endswith("truth")
    assert "finished" not in capsys.readouterr().err
    monkeypatch.chdir(folders)  # the same run by another way
    line = [f"--method={folders / name}" for name in ("good", "link")]
    assert main(["evaluate", "compare", str(folders / "truth"), *line, "-o", str(folders / "out")]) == 0
    assert "results are finished and kept" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "name"),
    [("other.safetensors", "other"), ("runs/b/best.safetensors", "b"), ("a=runs/b/last.safetensors", "a")],
)
def test_a_checkpoint_has_its_name_or_that_of_its_run(given: str, name: str) -> None:
    assert NamedPath.parse(given).name == name
