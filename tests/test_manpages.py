"""The man pages in man/ are those of the app."""

import shutil
import subprocess
from pathlib import Path

import pytest

from facerf_cli.cli import manual

MAN = Path(__file__).parents[1] / "man"


def test_man_is_in_step_with_the_app() -> None:
    assert {path.name: path.read_text() for path in MAN.glob("*.1")} == manual.pages(), "run `make man`"


def test_a_page_that_has_no_verb_any_more_is_removed(tmp_path: Path) -> None:
    (tmp_path / "facerf-gone.1").touch()
    manual.main(["man", str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == set(manual.pages())


def test_hyphens_and_backslashes_and_leading_dots_survive_troff() -> None:
    assert manual._text(".a-b\\c") == "\\&.a\\-b\\ec"


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
@pytest.mark.parametrize("name", sorted(path.name for path in MAN.glob("*.1")))
def test_groff_has_no_complaint(name: str) -> None:
    result = subprocess.run(
        ["groff", "-man", "-Tascii", "-ww", str(MAN / name)], capture_output=True, text=True, check=True
    )
    assert result.stderr == "" and "OPTIONS" in result.stdout
