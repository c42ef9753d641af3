"""Heads that moved between frames, found in pixels and taken back while the frames are read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from facerf_cli.capture.capture import shift_image
from facerf_cli.capture.checks.motion import align_shifts, head_path, peak, with_alignment
from facerf_cli.capture.layouts import read_capture
from tests.worlds import EGG, EGG_CAMERA, EGG_LIGHTS, egg_directions, egg_images, write_egg_stage

PLANTED = {2: (3.0, -4.0), 5: (0.0, 1.5), 7: (-2.25, 0.5)}  # frames and how far they moved, down and right


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = egg_images(egg_directions())
    for row, by in PLANTED.items():
        frames[row] = ndimage.shift(frames[row], by, order=3, mode="nearest")
    return write_egg_stage(tmp_path_factory.mktemp("moved") / "s", frames)


def test_shifts_undo_the_motion_frame_by_frame(stage: Path) -> None:
    shifts = align_shifts(read_capture(stage), EGG, EGG_CAMERA, set())
    for row, (down, right) in PLANTED.items():
        assert shifts[EGG_LIGHTS[row]] == pytest.approx((-down, -right), abs=0.7)  # of a few lamps, far apart
    front = [light for light, way in zip(EGG_LIGHTS, egg_directions(), strict=True) if way[2] > 0.5]
    still = set(front) - {EGG_LIGHTS[row] for row in PLANTED}
    assert not any(np.hypot(*shifts.get(light, (0, 0))) > 0.7 for light in still)
    capture = read_capture(stage)
    aligned = with_alignment(capture, EGG, {EGG_CAMERA: {EGG_LIGHTS[7]}})
    truth = egg_images(egg_directions())[2]
    inside = np.s_[12:-12, 12:-12]
    before, after = (
        np.abs(source.frame(EGG, EGG_CAMERA, 2)[..., 0] - truth)[inside].mean()
        for source in (capture, aligned)
    )
    assert after < 0.4 * before
    assert (EGG, EGG_CAMERA, EGG_LIGHTS[7]) not in aligned.shifts  # a broken frame is not looked at
    shifted = replace(capture, shifts={(EGG, EGG_CAMERA, EGG_LIGHTS[1]): (2.0, 0.0)})
    assert (shifted.frame(EGG, EGG_CAMERA, 1)[2:] == capture.frame(EGG, EGG_CAMERA, 1)[:-2]).all()
    assert (shifted.frame(EGG, EGG_CAMERA, 0) == capture.frame(EGG, EGG_CAMERA, 0)).all()


def test_whole_shifts_move_pixels_and_parts_of_them_share() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    assert (shift_image(image, 1, 0)[1:] == image[:-1]).all() and (
        shift_image(image, 1, 0)[0] == image[0]
    ).all()
    assert (shift_image(image, 0, -1)[:, :-1] == image[:, 1:]).all()
    ramp = np.repeat(np.arange(8, dtype=np.float32)[None, :, None], 2, 0)
    assert shift_image(ramp, 0, 0.25)[:, 2:-2, 0] == pytest.approx(
        ramp[:, 2:-2, 0] - 0.25
    )  # with the border away
    there_and_back = shift_image(shift_image(ramp**2, 0, 0.5), 0, -0.5)
    assert there_and_back[:, 4, 0] == pytest.approx(ramp[:, 4, 0] ** 2)  # parabolas come back, too
    assert shift_image(image, 0, 0) is image


def test_a_still_head_is_left_alone(tmp_path: Path) -> None:
    assert not align_shifts(read_capture(write_egg_stage(tmp_path / "s")), EGG, EGG_CAMERA, set())


@pytest.mark.filterwarnings("error")
def test_a_camera_that_sees_no_lamp_in_front_is_left_alone(tmp_path: Path) -> None:
    capture = read_capture(write_egg_stage(tmp_path / "s"))
    behind = replace(capture, directions_world=capture.directions_world * [1, 1, -1])
    assert not align_shifts(behind, EGG, EGG_CAMERA, set(EGG_LIGHTS[35:]))


def test_paths_are_told_from_errors_and_jumps_by_sampled_parabolas() -> None:
    values = 3 - (np.arange(5.0) - 1.8) ** 2
    assert peak(values, 2) == pytest.approx(1.8)
    assert peak(values, 0) == 0.0 and peak(values, 4) == 4.0 and peak(np.ones(4), 2) == 2.0
    # Errors are the same under neighbouring lamps, a path bends slowly in the order of the list.
    generator, turn = np.random.default_rng(0), np.arange(120) * 2.399963
    front = np.linspace(0.95, -0.9, 120)
    flat = np.sqrt(1 - front**2)
    lamps = np.stack([flat * np.cos(turn), flat * np.sin(turn), front], 1)
    shading = 0.5 * lamps[:, :2] + generator.normal(size=(120, 2)) * 0.2
    path = 2 * np.stack([np.sin(np.arange(120) / 20), np.cos(np.arange(120) / 25)], 1)
    jumps = np.zeros((120, 2))
    jumps[::9] = 5 * generator.normal(size=(14, 2))
    told = lamps[:, 2] > -0.2
    assert not head_path(shading, told, lamps).any()
    assert not head_path(shading + jumps, told, lamps).any()
    listed = np.argsort(lamps[:, 0])  # then errors of shading bend slowly, too
    assert not head_path(shading[listed], told[listed], lamps[listed]).any()
    off = np.hypot(*(head_path(shading + path, told, lamps) - path).T)
    assert off[told].mean() < 0.4 < np.hypot(*path.T).mean() and off[~told][:10].max() < 1.0
