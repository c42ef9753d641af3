"""Each fault planted in a small stage and found, and nothing found where there is none."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.checks.shading import RigFit, check_rigs
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import Finding, stopping
from facerf_cli.capture.layouts import read_capture
from facerf_cli.files.write import write_exr
from tests.worlds import (
    EGG,
    EGG_CAMERA,
    EGG_HEIGHT,
    EGG_LIGHTS,
    EGG_WIDTH,
    egg_camera,
    egg_directions,
    egg_images,
    egg_lights,
    grey,
    write_egg_stage,
)

FRONT = 3  # a lamp in front of the egg


@pytest.fixture(scope="module")
def sound() -> np.ndarray:
    frames = egg_images(egg_directions())
    frames.setflags(write=False)
    return frames


def findings(folder: Path) -> list[Finding]:
    return check_subject(read_capture(folder), EGG)


def only(found: list[Finding]) -> Finding:
    assert len(found) == 1, [(one.check, one.words) for one in found]
    return found[0]


def about_y(angle_rad: float) -> np.ndarray:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def pose(turn: np.ndarray) -> list[list[float]]:
    """World to camera of one that is turned."""
    return np.c_[np.diag([1, -1, -1]) @ turn, [0, 0, 1.2]].tolist()


def frame(folder: Path, light: int) -> Path:
    return folder / EGG / EGG_CAMERA / f"{EGG_LIGHTS[light]}.exr"


def test_a_sound_stage_has_no_findings(tmp_path: Path, sound: np.ndarray) -> None:
    assert not findings(write_egg_stage(tmp_path / "s", sound))


def test_a_missing_frame_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_egg_stage(tmp_path / "s", sound)
    frame(folder, FRONT).unlink()
    found = only(findings(folder))
    assert (found.check, found.camera, found.light) == ("missing", EGG_CAMERA, EGG_LIGHTS[FRONT])
    assert found.leaves_out and not stopping([found])


def test_a_camera_without_frames_is_one_finding(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_egg_stage(tmp_path / "s", sound, cameras=[egg_camera(EGG_CAMERA), egg_camera("C1")])
    found = only(findings(folder))
    assert (found.check, found.camera, found.light) == ("missing", "C1", None)


def test_a_frame_of_another_size_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_egg_stage(tmp_path / "s", sound)
    write_exr(frame(folder, FRONT), grey(sound[FRONT, ::2, ::2]))
    found = only(findings(folder))
    assert (
        found.check == "resolution"
        and found.leaves_out
        and f"{EGG_WIDTH // 2} x {EGG_HEIGHT // 2}" in found.words
    )


def test_a_camera_of_another_size_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    found = findings(write_egg_stage(tmp_path / "s", sound, cameras=[egg_camera(EGG_CAMERA, EGG_WIDTH * 2)]))
    assert only(found).check == "resolution" and stopping(found)


def test_a_damaged_file_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_egg_stage(tmp_path / "s", sound)
    path = frame(folder, FRONT)
    path.write_bytes(path.read_bytes()[:400])
    assert only(findings(folder)).check == "unreadable"


def changed(change: Callable[[np.ndarray], None], sound: np.ndarray, folder: Path) -> list[Finding]:
    frames = sound.copy()
    change(frames)
    return findings(write_egg_stage(folder, frames))


def test_black_and_flat_frames(tmp_path: Path, sound: np.ndarray) -> None:
    def blacken(frames: np.ndarray) -> None:
        frames[FRONT], frames[FRONT + 4] = 0, 0.25

    found = changed(blacken, sound, tmp_path / "s")
    assert [(one.check, one.light) for one in found] == [
        ("black", EGG_LIGHTS[FRONT]),
        ("black", EGG_LIGHTS[FRONT + 4]),
    ]
    assert all(one.leaves_out for one in found)


def test_of_the_same_image_twice_the_one_that_fits_its_lamp_stays(tmp_path: Path, sound: np.ndarray) -> None:
    def double(frames: np.ndarray) -> None:
        frames[FRONT + 6] = frames[FRONT]

    found = only(changed(double, sound, tmp_path / "s"))
    assert (found.check, found.light, found.leaves_out) == ("duplicate", EGG_LIGHTS[FRONT + 6], True)


def test_another_cameras_frames_stop_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_egg_stage(tmp_path / "s", sound, cameras=[egg_camera(EGG_CAMERA), egg_camera("C1")])
    (folder / EGG / "C1").symlink_to(folder / EGG / EGG_CAMERA)
    found = only(findings(folder))
    assert found.check == "duplicate" and found.figures["frames"] == len(EGG_LIGHTS) and stopping([found])


def test_clipped_frames_are_counted(tmp_path: Path, sound: np.ndarray) -> None:
    def clip(frames: np.ndarray) -> None:
        np.minimum(frames, 0.6 * frames.max(), out=frames)

    found = only(changed(clip, sound, tmp_path / "s"))
    assert found.check == "clipped" and found.severity == "warning" and found.figures["frames"] > 3


def test_a_lamp_that_did_not_fire_leaves_the_light_of_the_room(tmp_path: Path, sound: np.ndarray) -> None:
    """In all frames, a twentieth of a lamp from the front."""

    def put_out(frames: np.ndarray) -> None:
        frames += 0.05 * sound[0]
        frames[FRONT] = 0.05 * sound[0]

    found = only(changed(put_out, sound, tmp_path / "s"))
    assert (found.check, found.light, found.leaves_out) == ("order", EGG_LIGHTS[FRONT], True)


def test_two_frames_under_each_others_names(tmp_path: Path, sound: np.ndarray) -> None:
    def swap(frames: np.ndarray) -> None:
        frames[[FRONT, FRONT + 9]] = frames[[FRONT + 9, FRONT]]

    found = changed(swap, sound, tmp_path / "s")
    assert {(one.check, one.light) for one in found} == {
        ("order", EGG_LIGHTS[FRONT]),
        ("order", EGG_LIGHTS[FRONT + 9]),
    }
    assert all(one.leaves_out for one in found) and EGG_LIGHTS[FRONT + 9] in found[0].words


def test_lights_in_another_order_stop_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    order = np.random.default_rng(1).permutation(len(EGG_LIGHTS))
    found = only(findings(write_egg_stage(tmp_path / "s", sound, lights=egg_lights(egg_directions()[order]))))
    assert found.check == "order" and stopping([found]) and float(found.figures["median_off_deg"]) > 30


def test_a_mirrored_rig_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    found = only(
        findings(write_egg_stage(tmp_path / "s", sound, lights=egg_lights(egg_directions() * [-1, 1, 1])))
    )
    assert found.check == "rig" and "mirrored" in found.words and stopping([found])


def test_a_turned_rig_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    turned = egg_directions() @ about_y(np.radians(40)).T
    found = findings(write_egg_stage(tmp_path / "s", sound, lights=egg_lights(turned)))
    assert found[0].check == "rig" and float(found[0].figures["right_deg"]) == pytest.approx(40, abs=6)


@pytest.mark.parametrize(("first", "second"), [("C0", "C1"), ("C1", "C0")])
def test_two_cameras_under_each_others_names(tmp_path: Path, first: str, second: str) -> None:
    """The egg turns with the camera; the lamps do not, and tell one from the other."""
    turn = about_y(0.4)
    aside = egg_camera("C1") | {"world_to_camera": pose(turn)}
    folder = write_egg_stage(tmp_path / "s", cameras=[egg_camera("C0"), aside])
    (folder / EGG / EGG_CAMERA).rename(folder / EGG / "front")
    (folder / EGG / second).mkdir()
    for light, image in zip(EGG_LIGHTS, egg_images(egg_directions() @ turn.T), strict=True):
        write_exr(folder / EGG / second / f"{light}.exr", grey(image))
    (folder / EGG / "front").rename(folder / EGG / first)
    found = findings(folder)
    assert [(one.check, one.camera) for one in found] == (
        [] if first == "C0" else [("camera", "C0"), ("camera", "C1")]
    )
    assert not found or stopping(found)


def test_motion_is_measured_in_pixels(tmp_path: Path, sound: np.ndarray) -> None:
    def move(frames: np.ndarray) -> None:
        frames[FRONT] = np.roll(frames[FRONT], (3, -4), (0, 1))

    found = only(changed(move, sound, tmp_path / "s"))
    assert (found.check, found.severity) == ("motion", "warning")
    assert float(found.figures["worst_px"]) == pytest.approx(5, abs=0.7) and EGG_LIGHTS[FRONT] in found.words


def rig(camera: str, right_deg: float = 0.0, mirrored: bool = False, up_deg: float = 20.0) -> RigFit:
    return RigFit(camera, mirrored, right_deg, up_deg)


@pytest.mark.parametrize(
    ("rigs", "named"),
    [
        ([rig("C0"), rig("C1", 15), rig("C2")], []),
        ([rig("C0"), rig("C1", 60), rig("C2")], [("camera", "C1")]),
        ([rig("C0"), rig("C1", 30), rig("C2", -30)], [("camera", "C1"), ("camera", "C2")]),  # swapped
        ([rig("C0"), rig("C1", mirrored=True), rig("C2")], [("camera", "C1")]),
        ([rig("C0", 35), rig("C1", 35), rig("C2")], [("rig", "C0")]),
        ([rig("C0"), rig("C1", mirrored=True), rig("C2", mirrored=True)], [("rig", "C1")]),
        ([rig("C0", 25)], [("rig", "C0")]),
        ([rig("C0", up_deg=-60)], [("rig", "C0")]),
        ([], []),
    ],
)
def test_the_rig_is_at_fault_where_most_cameras_agree(
    rigs: list[RigFit], named: list[tuple[str, str]]
) -> None:
    assert [(found.check, found.camera) for found in check_rigs("s", rigs)] == named
