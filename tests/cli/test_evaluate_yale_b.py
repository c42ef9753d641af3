"""The verb: people of Extended Yale B measured from the command line, and bad input in words."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli.capture.yale_b import Flash
from facerf_cli.evaluation import people, run, yale_b
from facerf_cli.evaluation.measure import SOURCE
from facerf_cli.evaluation.people import Bench
from facerf_cli.face.morphable import load_face_model
from facerf_cli.main import main
from facerf_cli.relighting.models import Sides
from tests.capture.yale_fixture import write_pgm, write_yale_b
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.evaluation.method_doubles import FaceModelOnly, Lambert, someone
from tests.kinds import Patch, Said

FEW = (Flash(0, 0), Flash(-25, 0), Flash(35, 40), Flash(-110, 15))


def bench(*methods: Any) -> Bench:
    return Bench(methods[0].models, Sides(256, 512), "landmarks", methods=methods)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_yale_b(tmp_path / "yale", flashes=FEW)


@pytest.fixture
def toys(monkeypatch: Patch) -> None:
    """A face in every image, and methods without networks."""
    models: Any = FaceModelOnly(load_face_model("builtin"))
    monkeypatch.setattr(run, "bench_of", lambda *_: bench(Lambert("field", models=models)))
    monkeypatch.setattr(yale_b, "SOFT_SOURCES", ("overhead",))
    monkeypatch.setattr(yale_b, "ENVIRONMENT_SOURCES", ("frontal",))
    monkeypatch.setattr(yale_b, "ENVIRONMENTS", ("env_sky",))
    monkeypatch.setattr(people, "find_faces", lambda *_: [someone()])


@pytest.mark.slow
@pytest.mark.usefixtures("toys")
def test_tables_of_two_people(folder: Path, tmp_path: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    assert main(["evaluate", "yale-b", str(folder), "-o", str(out), "--pictures"]) == 0
    said = capsys.readouterr().out
    assert "of 2 people" in said and "not aligned" in said
    with (out / "images.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    # yaleB05 lacks one flash, which is known to be damaged: from the front, and from the soft light
    assert len(rows) == (2 + 3 + 1) + (1 + 2 + 1)
    assert {row["person"]: row["subjects"] for row in rows} == {"yaleB05": "settings", "yaleB07": "test"}
    summary = json.loads((out / "summary.json").read_text())
    counts = {
        (group["fact"], group["value"]): group["metrics"]["si_mse"]["field"]["pictures"]
        for group in summary["groups"][1:]
    }
    assert counts["column", "frontal"] == 3 and counts["column", "environment"] == 2
    assert sum(count for (fact, _), count in counts.items() if fact == "angle") == 3
    for kind in ("source", "truth", "mask", "field"):
        assert (out / "pictures" / kind / "yaleB07" / "overhead" / "A+035E+40.exr").is_file()
    assert "Face dis" not in said
    assert main(["evaluate", "yale-b", str(folder), "-o", str(out), "--face-distance"]) == 0
    figures = json.loads((out / "summary.json").read_text())["groups"][0]["metrics"]["face_distance"]
    assert figures[SOURCE]["pictures"] == figures["field"]["pictures"] == 10
    assert "Face dis" in capsys.readouterr().out


def test_yale_b_measures_the_portrait_field_unless_another_is_chosen(
    folder: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    save_toy_checkpoint(mine / "best.safetensors")
    models: Any = FaceModelOnly(load_face_model("builtin"))
    named = people.methods_of

    def toys(*options: Any) -> Bench:
        return bench(*(Lambert(method.name, models=models) for method in named(*options)))

    monkeypatch.setattr(run, "bench_of", toys)
    monkeypatch.setattr(yale_b, "SOFT_SOURCES", ())
    monkeypatch.setattr(yale_b, "ENVIRONMENT_SOURCES", ())
    monkeypatch.setattr(people, "find_faces", lambda *_: [someone()])
    line = ["evaluate", "yale-b", str(folder), "-o", str(tmp_path / "out"), "--subjects", "yaleB07"]
    for options, names in (
        ([], ["portrait"]),
        (["--checkpoint", str(mine), "--reflectance", "field"], ["field"]),
        (["--against", str(mine)], ["portrait", "mine"]),
    ):
        assert main([*line, *options]) == 0
        assert json.loads((tmp_path / "out/summary.json").read_text())["methods"] == names


@pytest.mark.usefixtures("toys")
def test_no_table_without_a_subject(folder: Path, tmp_path: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    write_pgm(folder / "yaleB05" / f"yaleB05_P00{FEW[1].name}.pgm", np.zeros((96, 84)))
    assert main(["evaluate", "yale-b", str(folder), "-o", str(out)]) == 1
    said = capsys.readouterr()
    assert "84 x 96 pixels, not 168 x 192" in said.err and "Traceback" not in said.err
    assert (out / "cases" / "yaleB07.json").is_file() and not (out / "summary.json").exists()
