"""No verb writes images of NaN: such a photo is refused in one line, and no output of it stays."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import all_or_none
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.main import main
from tests.astronaut import PATH as PHOTO


@pytest.fixture(scope="module")
def landmarks(given: Path) -> Path:
    return given / "astronaut.json"


def refused(photo: Path, landmarks: Path, output: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that says why a photo is not relit."""
    line = ["relight", str(photo), "--landmarks", str(landmarks), "--light", "40,10", "-o", str(output)]
    assert main(line) == 1
    assert not [path for path in output.rglob("*") if path.suffix in (".exr", ".png")]
    said = capsys.readouterr().err.strip().splitlines()
    return said[-1]


def test_a_photo_of_one_colour_with_landmarks_is_refused(
    landmarks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = tmp_path / "flat.png"
    write_display(flat, np.full(read_image(PHOTO).pixels.shape, 0.2, np.float32))
    said = refused(flat, landmarks, tmp_path / "out", capsys)
    assert str(landmarks) in said and "not on a face" in said


def test_a_photo_with_one_pixel_without_bounds_is_refused(
    landmarks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import OpenImageIO as oiio

    pixels, hot = read_image(PHOTO).pixels.copy(), tmp_path / "hot.exr"
    pixels[5, 5] = 1e25
    stream = oiio.ImageOutput.create(str(hot))
    stream.open(str(hot), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float"))
    stream.write_image(pixels)
    stream.close()
    said = refused(hot, landmarks, tmp_path / "out", capsys)
    assert str(hot) in said and "1e+25" in said


@pytest.mark.parametrize("suffix", ["exr", "png", "jpg", "tif"])
def test_no_format_holds_nan(tmp_path: Path, suffix: str) -> None:
    pixels, path = np.ones((8, 12, 3), np.float32), tmp_path / f"image.{suffix}"
    pixels[3, 4, 1] = np.nan
    write = {"exr": write_exr, "tif": write_tiff}.get(suffix, write_display)
    with pytest.raises(InputError, match="1 values are NaN"):
        write(path, pixels)
    assert not path.exists()


def test_what_was_written_goes_when_the_rest_fails(tmp_path: Path) -> None:
    good = np.ones((8, 12, 3), np.float32)
    write_exr(tmp_path / "before.exr", good)
    with pytest.raises(InputError), all_or_none():
        write_exr(tmp_path / "first.exr", good)
        write_exr(tmp_path / "second.exr", good * np.nan)
    assert [path.name for path in tmp_path.iterdir()] == ["before.exr"]
    with pytest.raises(KeyboardInterrupt), all_or_none():
        write_exr(tmp_path / "third.exr", good)
        raise KeyboardInterrupt
    assert (tmp_path / "third.exr").exists()
