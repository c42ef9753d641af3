"""Lines of `facerf evaluate` that are refused in one line, before anything is written: line -> words."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from tests.capture.yale_fixture import write_yale_b
from tests.dataset.dataset_fixture import write_small_dataset

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"
Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data/, two photos and a link, facts, folders of images and a database."""
    folder = tmp_path_factory.mktemp("place")
    write_small_dataset(folder / "data", counts=(1, 0, 1), lights=12, crop_px=32)
    assert main(["relight-dataset", str(folder / "data"), "--envmaps", "procedural:2", "--lazy"]) == 0
    for name in ("a.jpg", "b.jpg", "one/c.jpg"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(PHOTO, folder / name)
    (folder / "link.jpg").symlink_to("a.jpg")
    (folder / "who.csv").write_text("name,person\nastronot,Eileen\n")
    for name in ("good", "truth"):
        write_exr(folder / name / "0.exr", np.ones((4, 5, 3), np.float32))
    write_yale_b(folder / "yale")
    return folder


WRONG = {
    "olat data --preset paper --every 2": "exclude each other",
    "olat data --pairs x.json --every 2": "--pairs: is a list of its own",
    "olat data --split validation": "no pairs in the split validation",
    "olat data --reflectance phong": "give portrait, field, diffuse-sh",
    "olat data --reflectance prt --network-alone": "is for the field",
    "olat data --against none.safetensors": "no such file",
    "olat data --against field.safetensors": "two methods have the name 'field'",
    "olat data --compare good -o good/out": "lies in good, which is read",
    "olat data --compare nowhere": "no such folder",
    "geometry data a.jpg": "one dataset among several inputs",
    "geometry a.jpg --against a.jpg": "--mean-checkpoint",
    "geometry a.jpg --reflectance prt --mean-checkpoint x": "is for the field",
    "geometry a.jpg --every 2": "--every is for a prepared dataset",
    "geometry data --facts who.csv": "--facts is for photos",
    "reconstruction a.jpg --every 1": "--every is for a prepared dataset",
    "reconstruction a.jpg --split all": "--split is for a prepared dataset",
    "reconstruction a.jpg --joint-fit": "--joint-fit is for a prepared dataset",
    "reconstruction data --face all": "--face is for photos",
    "transfer a.jpg": "give --photos",
    "transfer data --landmarks .": "--landmarks is for photos",
    "transfer data --reflectance prt --held-to-photo": "is for the field",
    "transfer --photos a.jpg b.jpg --joint-fit": "--joint-fit is for a prepared dataset",
    "transfer --photos a.jpg": "two of each person",
    "transfer --photos one": "two of each person",
    "transfer --photos a.jpg a.jpg": "given twice",
    "transfer --photos a.jpg link.jpg": "given twice",
    "transfer --photos a.jpg one/../a.jpg": "given twice",
    "transfer --photos a.jpg b.jpg b.jpg a.jpg": "given twice",
    "pairs good": "--truth",
    "pairs none --truth truth": "no such folder",
    "pairs good --truth truth -o truth": "give another folder",
    "pairs good --truth truth -o truth/here": "lies in truth, which is read",
    "pairs good --truth truth -o good/here": "lies in good, which is read",
    "pairs good --truth truth --lpips y": "--vgg-weights",
    "pairs good --truth truth --preset paper": "--preset",
    "pairs good good --truth truth": "two methods have the name 'good'",
    "yale-b yale --subjects yaleB07,yaleB99": "--subjects yaleB99: not in",
    "yale-b yale --keep-eyes": "--keep-eyes",
}
FAILING = {
    "reconstruction a.jpg --facts who.csv": "astronot is no photo of this run; give names such as a",
    "yale-b nowhere": "no such folder",
    "yale-b .": "no folders yaleB01",
    "yale-b yale --shifts shifts.csv": "shifts.csv: no such file",
    "olat data --against a.jpg": "a.jpg",
    "geometry a.jpg --mean-checkpoint b.jpg": "b.jpg",
}


@pytest.mark.parametrize(
    ("line", "words", "code"),
    [*((*one, 2) for one in WRONG.items()), *((*one, 1) for one in FAILING.items())],
)
def test_a_line(
    place: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch, line: str, words: str, code: int
) -> None:
    monkeypatch.chdir(place)
    output = [] if " -o " in line else ["-o", "out"]
    assert main(["--device", "cpu", "evaluate", *line.split(), *output]) == code
    said = [x for x in capsys.readouterr().err.splitlines() if words in x]
    assert len(said) == 1 and not list(place.rglob("summary.json"))


@pytest.mark.parametrize("name", ["olat", "reconstruction", "transfer", "geometry", "yale-b", "pairs"])
def test_every_protocol_has_help_and_the_shared_options(name: str, capsys: Said) -> None:
    assert main(["evaluate", name, "--help"]) == 0
    out = capsys.readouterr().out
    assert "--output" in out and "--space" in out and "{options}" not in out
    assert ("--reflectance" in out) == (name != "pairs") and ("--keep-eyes" in out) == (name[0] not in "yp")
