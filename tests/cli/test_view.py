"""`facerf view`: where pages go, and what is refused. No network is run."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.files.olat_stack import write_olat_stack
from facerf_cli.files.output_options import parse_exposure
from facerf_cli.light.sphere import rig_directions
from facerf_cli.main import main
from facerf_cli.work.photo_options import PhotoOptions, photo_words
from facerf_cli.work.view import write_index
from tests.kinds import Said
from tests.stacks import header_of

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.jpg", "b/c.png"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (32, 24), (90, 80, 70)).save(path)
    return tmp_path


def test_a_page_takes_the_name_that_is_given_and_a_folder_is_mirrored(folder: Path, capsys: Said) -> None:
    for given, output, pages in (
        ("in/a.jpg", "me.html", ["me.html"]), ("in", "out", ["out/a.html", "out/b/c.html"])
    ):  # fmt: skip
        assert main(["view", str(folder / given), "-o", str(folder / output), "--dry-run"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split(" -> ")[1] for line in lines] == [str(folder / page) for page in pages]
    assert parse_exposure("1.37") == 1.37 and parse_exposure("auto") == "auto"  # as a page's command says


def test_a_captured_stack_is_shown_by_its_own_lights(tmp_path: Path) -> None:
    seen = np.zeros((24, 32), np.float32)
    seen[4:20, 6:26] = 1
    olats = torch.rand(12, 3, 24, 32) * torch.from_numpy(seen)
    write_olat_stack(tmp_path / "captured.exr", header_of(rig_directions(12), seen, 0.2), [olats])
    assert main(["view", str(tmp_path / "captured.exr"), "-o", str(tmp_path / "page.html")]) == 0
    made = (tmp_path / "page.html").read_text()
    assert "<title>captured.exr · facerf</title>" in made  # the input's name, not that of the page
    data = json.loads(made.partition('id="data">')[2].partition("</script>")[0])
    assert len(data["ratios"]) == 12 and data["size"] == [32, 24] and not data["background"]
    assert "left" in data["words"] and "original" not in data["words"]  # it has no photo
    assert data["exposure"]["plate"] is None and data["source"].endswith("captured.exr")


@pytest.mark.slow
def test_a_page_of_1024_pixels_is_as_large_as_the_documents_say(
    shared_data: Path, tmp_path: Path, capsys: Said
) -> None:
    page = tmp_path / "page.html"
    assert main(["view", str(shared_data / "photos_look/ffhq_00104.png"), "-o", str(page)]) == 0
    assert main(["view", "--help"]) == 0
    for text in (capsys.readouterr().out, (ROOT / "docs/viewer.md").read_text()):
        (stated,) = re.findall(r"one file of about\s+(\d+)\s+MB", text)
        assert round(page.stat().st_size / 1e6) == int(stated)


def test_the_command_of_a_page_has_the_options_that_it_was_made_with() -> None:
    options = PhotoOptions(
        Settings(checkpoints=(Path("my net.safetensors"),)),
        colourspace="ACEScg",
        face="all",
        landmarks=Path("points"),
    )
    line = "--input-colourspace ACEScg --face 2 --landmarks points --checkpoint"
    assert photo_words(options, 2) == [*line.split(), "my net.safetensors"]
    alone = PhotoOptions(Settings(), face="1", person=Path("mattes"))
    assert photo_words(alone) == ["--face", "1", "--person", "mattes"]
    shipped = Settings(checkpoints=(Path("shipped"),), checkpoints_by_default=True)
    assert photo_words(PhotoOptions(shipped)) == []


def test_the_users_own_index_stays(tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "index.html").write_text("mine")
    line = ["view", str(Path(__file__).parents[2] / "examples/astronaut.jpg"), "-o", str(tmp_path)]
    for more in ([], ["--dry-run"]):
        assert main([*line, *more]) == 1
        assert f"{tmp_path / 'index.html'}: was not written by facerf" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    assert (tmp_path / "index.html").read_text() == "mine"


def test_links_of_an_index_are_addresses(tmp_path: Path) -> None:
    item = Item(tmp_path / "a.jpg", tmp_path / "50% #1?", "50% #1?")
    (tmp_path / "50% #1?.html").write_text('<meta name="facerf:strip" content="AA==">')
    write_index(tmp_path / "index.html", [item], PhotoOptions(Settings()))
    assert 'href="50%25%20%231%3F.html"' in (tmp_path / "index.html").read_text()
