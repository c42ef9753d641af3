"""No output is a file that the run reads: it is refused before anything runs, and the file stays as it is."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from facerf_cli.main import main
from tests.kinds import Patch, Said

RIG = '[key]\nfrom = "40,20"\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    """Files that a run may read; of each only its name counts, since nothing is to be run."""
    monkeypatch.chdir(tmp_path)
    for name in ("me.png", "other.png", "mattes/me.png", "mattes/me_person.png", "balls/sky.exr", "sky.exr"):
        Path(name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (5, 4)).save(tmp_path / name, "png")
    for name, text in (("rig.toml", RIG), ("rig.txt", "0,0\n"), ("me.pts", ""), ("model.npz", "")):
        Path(name).write_text(text)
    return tmp_path


READ = [
    ("relight me.png --light 60,30 --person other.png -o {}", "other.png"),
    ("relight me.png --light 60,30 --background other.png -o {}", "other.png"),
    ("relight me.png --light 60,30 --matte other.png -o {}", "other.png"),
    ("relight me.png --light 60,30 --landmarks me.pts -o {}", "me.pts"),
    ("relight me.png --light-from other.png -o {}", "other.png"),
    ("relight me.png --envmap sky.exr -o {}", "sky.exr"),
    ("relight me.png --light key=40,20 --envmap fill=sky.exr -o {}", "sky.exr"),
    ("relight me.png --light map=sky.exr -o {}", "sky.exr"),
    ("relight me.png --light 60,30 --ambient sky.exr -o {}", "sky.exr"),
    ("relight me.png --light rig.toml -o {}", "rig.toml"),
    ("relight me.png --light 60,30 --lights rig.txt -o {}", "rig.txt"),
    ("relight me.png --light 60,30 --face-model model.npz -o {}", "model.npz"),
    ("segment me.png --person other.png -o {}", "other.png"),
    ("segment me.png --landmarks me.pts -o {}", "me.pts"),
    ("segment me.png -o {}", "me.png"),
]


@pytest.mark.parametrize(
    ("line", "read", "link"),
    [(*one, link) for one in READ for link in (os.link, os.symlink)]
    + [(*one, None) for one in READ if one[1].endswith(".png")],
)
@pytest.mark.parametrize("dry", [True, False])
def test_a_file_that_is_read_is_no_output(
    folder: Path, line: str, read: str, link: Callable[..., None] | None, dry: bool, capsys: Said
) -> None:
    """A hard link of another case is what a file system without case has: one file, two names."""
    output = Path(read)
    if link:
        output = Path("OTHER.png")
        link(folder / read, output)
    before = (folder / read).read_bytes()
    assert main([*line.format(output).split(), *(["--dry-run"] if dry else [])]) == 2
    assert f"-o {output}: is the input {read}; use another name or folder" in capsys.readouterr().err
    assert (folder / read).read_bytes() == output.read_bytes() == before
    assert not list(folder.glob("*.jsonl")) and not list(folder.glob(".*"))


@pytest.mark.parametrize(
    ("line", "planned"),
    [
        ("segment me.png --person mattes/{stem}_person.png -o mattes", "mattes/me_person.png"),
        ("relight me.png --light 60,30 --person mattes -o mattes --name {stem}", "mattes/me.png"),
        ("relight me.png --light-from other.png -o . --name other", "other.png"),
        ("segment me.png mattes/me_person.png -o mattes", "mattes/me_person.png"),
        ("face-model import model.npz -o model.npz --overwrite", "model.npz"),
    ],
)
def test_an_output_in_a_folder_is_no_input(folder: Path, line: str, planned: str, capsys: Said) -> None:
    before = Path(planned).read_bytes()
    assert main(line.split()) == 2
    assert f"-o {planned}: is the input {planned}" in capsys.readouterr().err
    assert Path(planned).read_bytes() == before


def test_outputs_beside_what_is_read_are_made(folder: Path, capsys: Said) -> None:
    """A rerun finds its own results in the folder of the mattes, and another matte there; none is read."""
    Path("mattes/other_person.png").write_bytes(b"")
    for name in ("me_segment.exr", "me_person.png"):
        (folder / "mattes" / name).write_bytes(b"made")
    line = ["segment", "me.png", "--person", "mattes", "-o", "mattes", "--dry-run", "--overwrite", "always"]
    assert main(line) == 0
    assert "me.png -> mattes/me_person.png" in capsys.readouterr().out
