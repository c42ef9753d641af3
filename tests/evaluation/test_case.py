"""Other methods' predictions are found by case; a missing one is an error."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.errors import InputError
from facerf_cli.evaluation.pairs import read_predictions
from facerf_cli.files.images import write_display, write_exr

SHAPE = (6, 9, 3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "theirs"
    write_exr(folder / "a/00.exr", np.full(SHAPE, 0.25, np.float32))
    write_display(folder / "a/01.png", np.full(SHAPE, 0.25, np.float32))
    np.save(folder / "a/02.npy", np.full(SHAPE[:2], 0.25))
    return folder


@pytest.mark.parametrize("case", ["a/00", "a/01", "a/02"])
def test_every_kind_of_file_is_linear_light(folder: Path, case: str) -> None:
    (found,) = read_predictions((folder,), case, SHAPE).items()
    assert found[0] == "theirs" and found[1].shape == SHAPE
    np.testing.assert_allclose(found[1], 0.25, atol=2e-3)


def test_all_that_is_missing_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError) as error:
        read_predictions((folder, tmp_path / "empty"), "a/03", SHAPE)
    assert all(part in str(error.value) for part in (str(folder), "empty", "case a/03", ".npy"))


def test_a_wrong_size_and_two_files_of_a_case(folder: Path) -> None:
    with pytest.raises(InputError, match="9 x 6 pixels, the truth has 6 x 9"):
        read_predictions((folder,), "a/00", (9, 6, 3))
    write_exr(folder / "a/02.exr", np.zeros(SHAPE, np.float32))
    with pytest.raises(InputError, match=r"02.exr and 02.npy; remove all but one"):
        read_predictions((folder,), "a/02", SHAPE)
