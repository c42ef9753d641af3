"""The scripts of benchmarks/ import and name the data they lack; the arithmetic behind their figures."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from _common import ROOT, best_s, required
from held_out_heads import RelitTexture, drift_of, groups, print_tables

from tests.kinds import Patch, Said

PAGES = "\n".join(page.read_text() for page in (*(ROOT / "docs").glob("*.md"), ROOT / "MODEL_CARD.md"))


def options_in_docs(script: str) -> set[str]:
    """The options that the documents give a script."""
    spans = re.findall(rf"\b{script}\.py([^`;|&]*)`", PAGES)
    return {option for span in spans for option in re.findall(r"--[a-z][\w-]*", span)}


@pytest.mark.parametrize("script", sorted(path.stem for path in (ROOT / "benchmarks").glob("[a-z]*.py")))
def test_every_script_imports_and_has_help(script: str, monkeypatch: Patch, capsys: Said) -> None:
    module = importlib.import_module(script)
    monkeypatch.setattr(sys, "argv", [f"{script}.py", "--help"])
    with pytest.raises(SystemExit) as end:
        module.main()
    said = capsys.readouterr().out
    assert end.value.code == 0 and module.__doc__.splitlines()[0] in said
    assert options_in_docs(script) <= set(re.findall(r"--[a-z][\w-]*", said.split("options:")[1]))


DATA = {
    "capture_faults": "--capture",
    "held_out_heads": "--bank",
    "emily_normals": "--emily",
    "portrait": "--data",
    "skin_tones": "--bank",
    "training_data": "--dataset",
    "training_speed": "--bank",
    "whole_heads": "--data",
}


@pytest.mark.parametrize("script", DATA)
def test_a_script_without_its_data_says_so_and_succeeds(
    script: str, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    module = importlib.import_module(script)
    for name in {"WHOLE_YALE_B", "SHARED"} & vars(module).keys():
        monkeypatch.setattr(module, name, tmp_path / "absent")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{script}.py"])
    with pytest.raises(SystemExit) as end:
        module.main()
    (line,) = capsys.readouterr().out.splitlines()
    assert end.value.code == 0
    assert line.startswith(f"{script}: skipped: needs ") and line.endswith(f"; give {DATA[script]}")


def test_ways_take_turns() -> None:
    calls: list[str] = []
    seconds, results = best_s({"a": lambda: calls.append("a"), "b": lambda: len(calls)}, 3)
    assert calls == ["a"] * 3 and results == {"a": None, "b": 3}
    assert all(0 <= value < 1 for value in seconds.values())


def test_a_wrong_path_is_an_error_and_a_missing_default_is_not(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no such file or folder; correct --bank"):
        required(tmp_path / "absent", "a bank", "--bank", tmp_path)
    with pytest.raises(SystemExit) as end:
        required(None, "a bank", "--bank", tmp_path / "absent")
    assert end.value.code == 0
    assert required(None, "a bank", "--bank", tmp_path) == tmp_path


def test_drift_is_of_the_relit_skin_not_of_its_exposure() -> None:
    albedo = np.array([0.45, 0.30, 0.22])
    truth = torch.from_numpy(albedo).float().view(3, 1, 1).expand(3, 32, 32)
    weight = torch.ones(32, 32)
    for exposure in (0.2, 1.0, 5.0):  # the exposure of an image says nothing about the skin
        assert drift_of(exposure * truth, exposure * truth, weight, albedo) == pytest.approx(0, abs=1e-3)
    darker = drift_of(0.6 * truth, truth, weight, albedo)
    redder = drift_of(truth * torch.tensor([1.1, 0.95, 1.0]).view(3, 1, 1), truth, weight, albedo)
    assert darker is not None and darker < -5
    assert redder is not None and abs(redder) < 5  # the angle is of lightness and blue to yellow
    assert drift_of(truth, truth.mean(0, keepdim=True).expand(3, -1, -1), weight, albedo) is None


def test_tables_of_held_out_heads(capsys: Said) -> None:
    textures = [
        RelitTexture(head, same, angle_deg, tone, error, error, 2 * error, drift_deg)
        for head in (1, 2)
        for same, angle_deg, tone, error, drift_deg in (
            (True, 10.0, "tan", 0.001, -2.0),
            (False, 75.0, None, 0.003, None),
        )
    ]
    rows, tones = groups(textures)
    assert {name: len(chosen) for name, chosen in rows.items()} == {
        "same pose": 2,
        "different pose": 2,
        "0 to 30 deg": 2,
        "30 to 60 deg": 0,
        "60 to 90 deg": 2,
        "90 to 180 deg": 0,
    }
    assert [t.tone for t in tones["tan"]] == ["tan"] * 2 and len(tones["random colours"]) == 2
    print_tables(textures)
    tables = capsys.readouterr().out.strip().split("\n\n")
    assert [len({line.count("|") for line in table.splitlines()}) for table in tables] == [1, 1]
    assert "| same pose | 2 | 0.00100 [0.00100, 0.00100] | 0.00100 | 0.00000 | 0.00200 |" in tables[0]
    assert "| 60 to 90 deg | 2 | 0.00300 [0.00300, 0.00300] | 0.00300 | 0.00000 | 0.00600 |" in tables[0]
    assert "| -2.0 [-2.0, -2.0] | 2.0 |" in tables[1] and "dark" not in tables[1]
