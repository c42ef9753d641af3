"""Heads that moved between frames, found in pixels and taken back while the frames are read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from facerf_cli.stage.checks.align import align_shifts, with_alignment
from facerf_cli.stage.data.layouts import read_capture
from facerf_cli.stage.data.moved import moved
from tests.stage.checks.egg_stage import CAMERA, IDS, SUBJECT, directions, pictures, write_stage

PLANTED = {2: (3.0, -4.0), 5: (0.0, 1.5), 7: (-2.25, 0.5)}  # frames and how far they moved, down and right


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = pictures(directions())
    for row, by in PLANTED.items():
        frames[row] = ndimage.shift(frames[row], by, order=3, mode="nearest")
    return write_stage(tmp_path_factory.mktemp("moved") / "s", frames)


def test_shifts_undo_the_motion(stage: Path) -> None:
    shifts = align_shifts(read_capture(stage), SUBJECT, CAMERA, set())
    for row, (down, right) in PLANTED.items():
        assert shifts[IDS[row]] == pytest.approx((-down, -right), abs=0.35)
    front = [light for light, way in zip(IDS, directions(), strict=True) if way[2] > 0.5]
    still = set(front) - {IDS[row] for row in PLANTED}
    assert not any(np.hypot(*shifts.get(light, (0, 0))) > 0.5 for light in still)


def test_frames_are_read_where_the_head_was(stage: Path) -> None:
    capture = read_capture(stage)
    aligned = with_alignment(capture, SUBJECT, {CAMERA: {IDS[7]}})
    truth = pictures(directions())[2]
    inside = np.s_[12:-12, 12:-12]
    before, after = (
        np.abs(source.frame(SUBJECT, CAMERA, 2)[..., 0] - truth)[inside].mean()
        for source in (capture, aligned)
    )
    assert after < 0.4 * before
    assert (SUBJECT, CAMERA, IDS[7]) not in aligned.shifts  # a broken frame is not looked at


def test_whole_shifts_move_pixels_and_parts_of_them_share() -> None:
    picture = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    assert (moved(picture, 1, 0)[1:] == picture[:-1]).all() and (moved(picture, 1, 0)[0] == picture[0]).all()
    assert (moved(picture, 0, -1)[:, :-1] == picture[:, 1:]).all()
    assert moved(picture, 0, 0.25)[0, 1, 0] == pytest.approx(0.75)
    assert moved(picture, 0, 0) is picture


def test_a_shift_in_the_capture_moves_its_frame_alone(stage: Path) -> None:
    capture = read_capture(stage)
    shifted = replace(capture, shifts={(SUBJECT, CAMERA, IDS[1]): (2.0, 0.0)})
    assert (shifted.frame(SUBJECT, CAMERA, 1)[2:] == capture.frame(SUBJECT, CAMERA, 1)[:-2]).all()
    assert (shifted.frame(SUBJECT, CAMERA, 0) == capture.frame(SUBJECT, CAMERA, 0)).all()
