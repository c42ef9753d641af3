"""The scripts of examples/paper: from a capture to the tables and figures, as small as can be."""

import csv
import json
from pathlib import Path

import pytest

from tests.shell import run_shell
from tests.worlds import write_capture

SCRIPT = Path(__file__).parents[1] / "examples/paper/tables.sh"


@pytest.mark.slow
def test_from_a_capture_to_the_papers_tables_and_figures(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    write_capture(tmp_path / "capture", subjects=4, lights=12)
    run = tmp_path / "run"
    given = {"SCALE": "tiny", "CAPTURE": tmp_path / "capture", "SHOWN": "1"}
    (tmp_path / "test").mkdir()
    (tmp_path / "test/astronaut.jpg").symlink_to(SCRIPT.parents[1] / "astronaut.jpg")
    maps = {"TEST_PHOTOS": tmp_path / "test", "MAPS": "procedural:2", "TEST_MAPS": "procedural:2"}
    run_shell(tmp_path / "bin", SCRIPT, run, **given, **maps)
    for table, methods in {
        "1": ["field", "lambert", "composite"],
        "2-reconstruction": ["field", "diffuse-sh", "specular-sh", "prt"],
        "2-transfer": ["field", "diffuse-sh", "specular-sh", "prt"],
        "3": ["field", "without-normals", "lambert", "composite"],
        "4": ["all components", "mean face"],
    }.items():
        assert (
            json.loads((run / "tables" / table / "summary.json").read_text())["methods"][: len(methods)]
            == methods
        )
    assert list((run / "photos/.facerf-faces").glob("*.json")) and not (run / "mean-face/photos").exists()
    both = [
        csv.DictReader((run / "tables" / table / "images.csv").read_text().splitlines()) for table in "13"
    ]
    one, other = ({row["case"] for row in rows} for rows in both)
    assert one == other
    assert list((run / "figures").glob("olat-*.png")) and (run / "figures/transfer.png").exists()
