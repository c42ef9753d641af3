"""`facerf view`: where pages go, and what is refused. No network is loaded."""

from pathlib import Path

import pytest
from PIL import Image

from facerf_cli.cli.values import parse_exposure
from facerf_cli.main import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.jpg", "b/c.png"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (32, 24), (90, 80, 70)).save(path)
    return tmp_path


def test_one_page_takes_the_name_that_is_given(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder / "in" / "a.jpg"), "-o", str(folder / "me.html"), "--dry-run"]) == 0
    assert capsys.readouterr().out.strip().endswith(f"-> {folder / 'me.html'}")


def test_pages_of_a_folder_mirror_its_tree(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder / "in"), "-o", str(folder / "out"), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" -> ")[1] for line in lines] == [
        str(folder / "out" / "a.html"),
        str(folder / "out" / "b" / "c.html"),
    ]


def test_several_photos_are_not_one_page(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder / "in"), "-o", str(folder / "me.html")]) == 2
    assert "is one page" in capsys.readouterr().err


def test_a_photo_named_index_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "in" / "a.jpg").rename(folder / "in" / "index.jpg")
    assert main(["view", str(folder / "in"), "-o", str(folder / "out")]) == 2
    assert "rename the photo" in capsys.readouterr().err


def test_the_exposure_of_a_page_s_command_is_understood() -> None:
    assert parse_exposure("1.37") == 1.37 and parse_exposure("auto") == "auto"
