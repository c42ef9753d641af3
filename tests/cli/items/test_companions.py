"""Files that go with a photo: one file, a folder, or a pattern."""

from pathlib import Path, PurePosixPath

import pytest

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError, UsageError
from facerf_cli.work.photo_options import check_companion
from facerf_cli.work.photos import companion


@pytest.fixture
def item(tmp_path: Path) -> Item:
    return Item(
        tmp_path / "in" / "x" / "me.jpg", tmp_path / "out" / "x" / "me", "x/me", PurePosixPath("x/me.jpg")
    )


def touched(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_a_file_a_folder_and_a_pattern_are_companions(item: Item, tmp_path: Path) -> None:
    assert companion(item, tmp_path / "all.pts", "--landmarks") == tmp_path / "all.pts"
    flat = touched(tmp_path / "points" / "me.json")
    assert companion(item, tmp_path / "points", "--landmarks") == flat
    mirrored = touched(tmp_path / "points" / "x" / "me.pts")
    assert companion(item, tmp_path / "points", "--landmarks") == mirrored
    there = touched(tmp_path / "mattes" / "x" / "me_matte.png")
    pattern = tmp_path / "mattes" / "{dir}" / "{stem}_matte.png"
    assert companion(item, pattern, "--matte") == there
    there.unlink()
    with pytest.raises(InputError, match=r"me.jpg: --matte has no .*me_matte.png; add it there"):
        companion(item, pattern, "--matte")


def test_what_does_not_exist_is_refused_before_the_first_photo(tmp_path: Path) -> None:
    check_companion(None, "--matte")
    check_companion(tmp_path / "{stem}.png", "--matte")
    for wrong in (tmp_path / "none.png", tmp_path / "{light}.png"):
        with pytest.raises(UsageError, match="--matte"):
            check_companion(wrong, "--matte")
