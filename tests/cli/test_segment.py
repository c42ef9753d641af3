"""`facerf segment` from the command line: layers that sum to the matte, and a person to put elsewhere."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.main import main
from facerf_cli.portrait.confidence import SCALES
from facerf_cli.portrait.parse import CLASSES
from tests.exr_layers import exr_layers
from tests.folders import only_row
from tests.kinds import Folders, Patch, Said

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"
ENDINGS = ("_segment.exr", "_person.png", "_overlay.jpg", "_landmarks.json")


@pytest.fixture(scope="module")
def cut(tmp_path_factory: Folders) -> Path:
    output = tmp_path_factory.mktemp("cut")
    assert main(["segment", str(PHOTO), "-o", str(output)]) == 0
    return output


@pytest.fixture(scope="module")
def layers(cut: Path) -> dict[str, np.ndarray]:
    return exr_layers(cut / "astronaut_segment.exr")


def test_every_file_is_there_and_its_landmarks_serve_as_input(cut: Path, tmp_path: Path) -> None:
    row = only_row(cut)
    assert row["outputs"] == [f"astronaut{ending}" for ending in ENDINGS]
    assert all((cut / name).is_file() for name in row["outputs"])
    assert 0 < row["confidence"] <= 1 and row["certainty"] in ("sure", "unsure", "doubtful")
    assert set(row["factors"]) == set(SCALES) - {"masked"}  # which judges a given matte
    document = json.loads((cut / "astronaut_landmarks.json").read_text())
    assert len(document["landmarks"]) == len(document["expected_error_px"]) == 68
    assert "left iris" in document["more"]
    given = str(cut / "astronaut_landmarks.json")
    assert main(["segment", str(PHOTO), "-o", str(tmp_path), "--landmarks", given]) == 0
    again = only_row(tmp_path)
    assert again["certainty"] == row["certainty"]
    assert again["confidence"] == pytest.approx(row["confidence"], abs=0.02)


def test_landmarks_of_the_photo_at_half_size_fail_and_the_cause_is_named(
    cut: Path, tmp_path: Path, capsys: Said
) -> None:
    points = read_landmarks(cut / "astronaut_landmarks.json")
    for name, wrong, cause in (
        ("half", points / 2, "0.50"),
        ("swapped", points[:, ::-1], "x and y"),
        ("outside", 3 * points, "3.00"),
    ):
        (tmp_path / f"{name}.json").write_text(json.dumps(wrong.tolist()))
        line = ["segment", str(PHOTO), "--landmarks", str(tmp_path / f"{name}.json")]
        assert main([*line, "-o", str(tmp_path / "out")]) == 1
        said = " ".join(capsys.readouterr().err.split())
        assert f"{name}.json" in said and cause in said
    assert not list((tmp_path / "out").glob("*.png"))


def test_no_empty_cut_out_is_written(tmp_path: Path, capsys: Said) -> None:
    """The photo's own alpha hides the person."""
    photo = read_image(PHOTO).pixels
    alpha = np.zeros(photo.shape[:2], np.float32)
    alpha[:20, -20:] = 1
    write_display(tmp_path / "hidden.png", photo, 0.0, alpha)
    assert main(["segment", str(tmp_path / "hidden.png"), "-o", str(tmp_path / "out")]) == 1
    assert "hidden.png" in (said := capsys.readouterr().err) and "--person" in said
    assert not list((tmp_path / "out").glob("*.png"))


@pytest.mark.slow
def test_all_commands_rate_a_person_alike(two_people: Path, tmp_path: Path) -> None:
    rows = {}
    for verb, *line in (
        ("segment",),
        ("fit-geometry",),
        ("view",),
        ("predict-olat", "--lights", "4", "--frame", "uv"),
        ("relight", "--light", "40,10", "--composite", "face", "--reflectance", "field"),
    ):
        output = tmp_path / verb
        assert main([verb, str(two_people), "--face", "1", *line, "-o", str(output)]) == 0
        rows[verb] = only_row(output)
    for verb, row in rows.items():
        assert row["certainty"] == rows["segment"]["certainty"], verb
        for name, factor in rows["segment"]["factors"].items():
            assert row["factors"][name] == pytest.approx(factor, abs=0.02), (verb, name)


def test_one_file_is_that_of_the_folder(cut: Path, tmp_path: Path, capsys: Said) -> None:
    target = tmp_path / "me.png"
    target.write_bytes(b"another image")
    line = ["segment", str(PHOTO), "-o", str(target)]
    assert main([*line, "--overwrite", "never"]) == 0 and target.read_bytes() == b"another image"
    assert main(line) == 1 and target.read_bytes() == b"another image"
    assert f"{target}: was not written by facerf" in capsys.readouterr().err
    target.unlink()
    assert main(line) == 0
    assert np.array_equal(*(np.asarray(Image.open(one)) for one in (target, cut / "astronaut_person.png")))
    assert main(line) == 0 and "1 of 1 results are finished" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [target]
    target.write_bytes(b"by hand")
    assert main(line) == 0 and target.read_bytes() == b"by hand"
    assert main(["segment", str(tmp_path / "none.png"), "-o", str(target)]) == 1
    assert list(tmp_path.iterdir()) == [target]
    assert main([*line, "--report"]) == 0 and target.read_bytes() == b"by hand"
    assert {path.name for path in tmp_path.iterdir()} == {"me.png", "report.jsonl"}


@pytest.mark.parametrize("name", ["me.png", "me.exr"])
def test_one_file_is_recognised_without_its_index(
    cut: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said, name: str
) -> None:
    """As in a fresh container; made from other options it is another file, which stays."""
    target, other = tmp_path / name, ["--landmarks", str(cut / "astronaut_landmarks.json")]
    line = ["segment", str(PHOTO), "-o", str(target)]
    assert main(line) == 0
    before, header = target.read_bytes(), read_header(target)
    assert header is not None and len(header.metadata["facerf:key"]) == 33
    monkeypatch.setattr("facerf_cli.batch.journal._in_cache", lambda file: tmp_path / "fresh/index.jsonl")
    capsys.readouterr()
    assert main(line) == 0 and "1 of 1 results are finished" in capsys.readouterr().err
    for more in (["--dry-run"], []):
        assert main([*line, *other, *more]) == 1
        assert f"{target}: was not written by facerf" in capsys.readouterr().err
    assert target.read_bytes() == before


def test_one_file_is_written_where_no_cache_can_be(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("facerf_cli.batch.journal._in_cache", lambda file: PHOTO / "index.jsonl")
    for _ in range(2):
        assert main(["segment", str(PHOTO), "-o", str(tmp_path / "me.png")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["me.png"]


def test_classes_sum_to_the_matte_and_lie_where_face_hair_and_garment_are(
    layers: dict[str, np.ndarray], cut: Path
) -> None:
    matte = layers["person.A"]
    photo = read_image(PHOTO).pixels
    assert matte.shape == photo.shape[:2] and matte.min() >= 0 and matte.max() <= 1
    names = [f"class.{name}" for name in CLASSES[1:]]
    assert np.abs(sum(layers[name] for name in names) - matte).max() < 0.01  # half floats
    assert {"R", "G", "B", "A", "person.A", *names} == set(layers)
    own = np.stack([layers[letter] for letter in "RGB"], -1)
    inside = layers["person.A"] == 1
    assert inside.mean() > 0.1 and np.abs(own - photo)[inside].max() < 0.02
    assert (own[layers["A"] == 0] == 0).all()
    points = read_landmarks(cut / "astronaut_landmarks.json")
    nose, brow = points[30].astype(int), points[19:25].mean(0)
    up = int(brow[1] - 0.55 * (points[8, 1] - brow[1]))
    assert layers["class.skin"][nose[1], nose[0]] > 0.5
    assert layers["class.hair"][up, int(brow[0])] > 0.5
    assert layers["class.garment"][-20, int(nose[0])] > 0.5
    assert layers["person.A"][5, -5] < 0.5  # the flag behind her is no part of her


@pytest.fixture
def two_people(tmp_path: Path) -> Path:
    """The same photo twice, one over the other: the second head touches the first's."""
    photo = read_image(PHOTO).pixels
    right = np.roll(photo, 80, 1)
    write_display(tmp_path / "both.png", np.where(np.arange(photo.shape[1])[:, None] < 225, photo, right))
    return tmp_path / "both.png"


def test_a_person_before_another_is_not_sure_and_the_line_says_why(
    two_people: Path, tmp_path: Path, capsys: Said
) -> None:
    assert main(["segment", str(two_people), "-o", str(tmp_path), "--face", "0"]) == 0
    row = only_row(tmp_path)
    assert row["certainty"] != "sure" and row["factors"]["disputed"] < 0.6
    line = capsys.readouterr().err
    assert f"detection is {row['certainty']}" in line
    assert "unclear outline" in line


def test_a_photos_own_alpha_cuts_its_person_out(layers: dict[str, np.ndarray], tmp_path: Path) -> None:
    photo = read_image(PHOTO).pixels
    alpha = np.ones(photo.shape[:2], np.float32)
    alpha[:, : photo.shape[1] // 2] = 0.25
    write_display(tmp_path / "astronaut.png", photo, 0.0, alpha)
    assert main(["segment", str(tmp_path / "astronaut.png"), "-o", str(tmp_path / "out")]) == 0
    found = exr_layers(tmp_path / "out/astronaut_segment.exr")["person.A"]
    assert np.abs(found - layers["person.A"] * alpha).mean() < 0.01  # the photo passed through 8 bits


def test_a_photo_without_a_face_is_named(tmp_path: Path, capsys: Said) -> None:
    noise = np.random.default_rng(0).random((64, 80, 3)).astype(np.float32)
    buffer = oiio.ImageBuf(oiio.ImageSpec(80, 64, 3, "uint8"))
    buffer.set_pixels(oiio.ROI(), noise)
    buffer.write(str(tmp_path / "noise.png"))
    assert main(["segment", str(tmp_path / "noise.png"), "-o", str(tmp_path / "out")]) == 1
    assert "no face found" in " ".join(capsys.readouterr().err.split())
