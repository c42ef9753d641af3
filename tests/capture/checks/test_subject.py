"""Each fault planted in a small stage and found, and nothing found where there is none."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.checks import subject as module
from facerf_cli.capture.checks.frames import CameraFrames
from facerf_cli.capture.checks.rig import FaceNormals
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import Finding, frames_left_out, stopping
from facerf_cli.capture.stage_json import read_capture
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.capture.checks.egg_stage import (
    CAMERA,
    HEIGHT,
    IDS,
    LIGHTS,
    SUBJECT,
    WIDTH,
    camera_of,
    directions,
    images,
    lights_of,
    normals,
    write_frame,
    write_stage,
)

FRONT = 3  # a lamp in front of the egg


@pytest.fixture(autouse=True)
def the_egg_is_the_face(monkeypatch: pytest.MonkeyPatch) -> None:
    """The normals that a face would have, known from the egg: it has no face to be found."""
    field, inside = normals()

    def known(frames: CameraFrames, posed: object, networks: object) -> FaceNormals:
        step = frames.scale
        height, width = frames.grey.shape[1:]
        rows, columns = np.mgrid[:height, :width]
        at = ((rows + 0.5) * step).astype(int).clip(0, HEIGHT - 1), ((columns + 0.5) * step).astype(int)
        seen = inside[at[0], at[1].clip(0, WIDTH - 1)]
        return FaceNormals(np.flatnonzero(seen), field[at[0], at[1].clip(0, WIDTH - 1)][seen])

    monkeypatch.setattr(module, "find_face_normals", known)


@pytest.fixture(scope="module")
def sound() -> np.ndarray:
    frames = images(directions())
    frames.setflags(write=False)
    return frames


def findings(folder: Path) -> list[Finding]:
    return check_subject(read_capture(folder), SUBJECT, SHIPPED_NETWORKS)


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
    return folder / SUBJECT / CAMERA / f"{IDS[light]}.exr"


def test_a_sound_stage_has_no_findings(tmp_path: Path, sound: np.ndarray) -> None:
    assert not findings(write_stage(tmp_path / "s", sound))


def test_a_missing_frame_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound)
    frame(folder, FRONT).unlink()
    found = only(findings(folder))
    assert (found.check, found.camera, found.light) == ("missing", CAMERA, IDS[FRONT])
    assert frames_left_out([found]) == {CAMERA: {IDS[FRONT]}} and not stopping([found])


def test_a_camera_without_frames_is_one_finding(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound, cameras=[camera_of(CAMERA), camera_of("C1")])
    found = only(findings(folder))
    assert (found.check, found.camera, found.light) == ("missing", "C1", "")


def test_files_of_no_lamp_are_counted_but_not_the_ambient_one(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound)
    for name in ("L900", "ambient"):
        write_frame(frame(folder, 0).with_stem(name), sound[0] * 0.9)
    found = only(findings(folder))
    assert found.check == "extra" and found.figures["files"] == 1 and "L900" in found.words


def test_a_frame_of_another_size_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound)
    write_frame(frame(folder, FRONT), sound[FRONT, ::2, ::2])
    found = only(findings(folder))
    assert found.check == "resolution" and found.leaves_out and f"{WIDTH // 2} x {HEIGHT // 2}" in found.words


def test_a_camera_of_another_size_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    found = findings(write_stage(tmp_path / "s", sound, cameras=[camera_of(CAMERA, WIDTH * 2)]))
    assert only(found).check == "resolution" and stopping(found)


def test_a_damaged_file_is_left_out(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound)
    path = frame(folder, FRONT)
    path.write_bytes(path.read_bytes()[:400])
    assert only(findings(folder)).check == "unreadable"


def changed(change: Callable[[np.ndarray], None], sound: np.ndarray, folder: Path) -> list[Finding]:
    frames = sound.copy()
    change(frames)
    return findings(write_stage(folder, frames))


def test_black_and_flat_frames(tmp_path: Path, sound: np.ndarray) -> None:
    def blacken(frames: np.ndarray) -> None:
        frames[FRONT], frames[FRONT + 4] = 0, 0.25

    found = changed(blacken, sound, tmp_path / "s")
    assert [(one.check, one.light) for one in found] == [("black", IDS[FRONT]), ("black", IDS[FRONT + 4])]
    assert all(one.leaves_out for one in found)


def test_of_the_same_image_twice_the_one_that_fits_its_lamp_stays(tmp_path: Path, sound: np.ndarray) -> None:
    def double(frames: np.ndarray) -> None:
        frames[FRONT + 6] = frames[FRONT]

    found = only(changed(double, sound, tmp_path / "s"))
    assert (found.check, found.light, found.leaves_out) == ("duplicate", IDS[FRONT + 6], True)


def test_another_cameras_frames_stop_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound, cameras=[camera_of(CAMERA), camera_of("C1")])
    (folder / SUBJECT / "C1").symlink_to(folder / SUBJECT / CAMERA)
    found = only(findings(folder))
    assert found.check == "duplicate" and found.figures["frames"] == LIGHTS and stopping([found])


def test_clipped_frames_are_counted(tmp_path: Path, sound: np.ndarray) -> None:
    def clip(frames: np.ndarray) -> None:
        np.minimum(frames, 0.6 * frames.max(), out=frames)

    found = only(changed(clip, sound, tmp_path / "s"))
    assert found.check == "clipped" and found.severity == "warning" and found.figures["frames"] > 3


@pytest.mark.parametrize("strength", [1.0, 0.1])
def test_two_fields_under_two_lamps(tmp_path: Path, sound: np.ndarray, strength: float) -> None:
    def weave(frames: np.ndarray) -> None:
        frames[FRONT, ::2] += strength * (frames[FRONT + 6, ::2] - frames[FRONT, ::2])

    found = only(changed(weave, sound, tmp_path / "s"))
    assert (found.check, found.light, found.leaves_out) == ("fields", IDS[FRONT], True)


@pytest.mark.parametrize("left", [0.0, 0.1])
def test_a_lamp_that_did_not_fire(tmp_path: Path, sound: np.ndarray, left: float) -> None:
    """With the light of the room, a twentieth of a lamp from the front, in all frames."""

    def put_out(frames: np.ndarray) -> None:
        frames += 0.05 * sound[0]
        frames[FRONT] = 0.05 * sound[0] + left * sound[FRONT]

    found = only(changed(put_out, sound, tmp_path / "s"))
    assert (found.check, found.light, found.leaves_out) == ("unlit", IDS[FRONT], True)
    assert float(found.figures["share"]) == pytest.approx(left, abs=0.05)


def test_a_dim_lamp_is_no_unlit_one(tmp_path: Path, sound: np.ndarray) -> None:
    def dim(frames: np.ndarray) -> None:
        frames[FRONT] *= 0.5

    assert not changed(dim, sound, tmp_path / "s")


def test_two_frames_under_each_others_names(tmp_path: Path, sound: np.ndarray) -> None:
    def swap(frames: np.ndarray) -> None:
        frames[[FRONT, FRONT + 9]] = frames[[FRONT + 9, FRONT]]

    found = changed(swap, sound, tmp_path / "s")
    assert {(one.check, one.light) for one in found} == {("order", IDS[FRONT]), ("order", IDS[FRONT + 9])}
    assert all(one.leaves_out for one in found) and IDS[FRONT + 9] in found[0].words


def test_a_frame_behind_that_is_as_bright_as_one_in_front(tmp_path: Path, sound: np.ndarray) -> None:
    def brighten(frames: np.ndarray) -> None:
        frames[-1] = 1.2 * frames[FRONT]

    found = only(changed(brighten, sound, tmp_path / "s"))
    assert found.check == "order" and found.light == IDS[-1] and found.leaves_out
    assert "times as bright" in found.words


def test_lights_in_another_order_stop_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    order = np.random.default_rng(1).permutation(LIGHTS)
    found = only(findings(write_stage(tmp_path / "s", sound, lights=lights_of(directions()[order]))))
    assert found.check == "order" and stopping([found]) and float(found.figures["median_off_deg"]) > 30


def test_a_spiral_told_one_off_is_a_turned_rig(tmp_path: Path, sound: np.ndarray) -> None:
    """Each lamp of the spiral is 137.5 degrees on from the one before."""
    found = findings(write_stage(tmp_path / "s", sound, lights=lights_of(np.roll(directions(), 1, 0))))
    rig = next(one for one in found if one.check == "rig")
    assert float(rig.figures["turned_deg"]) == pytest.approx(137.5, abs=10) and stopping(found)


def test_a_mirrored_rig_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    found = only(findings(write_stage(tmp_path / "s", sound, lights=lights_of(directions() * [-1, 1, 1]))))
    assert found.check == "rig" and "mirrored" in found.words and stopping([found])


def test_a_turned_rig_stops_the_subject(tmp_path: Path, sound: np.ndarray) -> None:
    turned = directions() @ about_y(np.radians(40)).T
    found = findings(write_stage(tmp_path / "s", sound, lights=lights_of(turned)))
    assert found[0].check == "rig" and float(found[0].figures["turned_deg"]) == pytest.approx(40, abs=6)


@pytest.mark.parametrize(("first", "second"), [("C0", "C1"), ("C1", "C0")])
def test_two_cameras_under_each_others_names(tmp_path: Path, first: str, second: str) -> None:
    """The egg turns with the camera; the lamps do not, and tell one from the other."""
    turn = about_y(0.4)
    aside = camera_of("C1") | {"world_to_camera": pose(turn)}
    folder = write_stage(tmp_path / "s", cameras=[camera_of("C0"), aside])
    (folder / SUBJECT / CAMERA).rename(folder / SUBJECT / "front")
    (folder / SUBJECT / second).mkdir()
    for light, image in zip(IDS, images(directions() @ turn.T), strict=True):
        write_frame(folder / SUBJECT / second / f"{light}.exr", image)
    (folder / SUBJECT / "front").rename(folder / SUBJECT / first)
    found = findings(folder)
    assert [(one.check, one.camera) for one in found] == (
        [] if first == "C0" else [("camera", "C0"), ("camera", "C1")]
    )
    assert not found or ("C1" in found[0].words and stopping(found))


@pytest.mark.parametrize(("misplaced", "check", "camera"), [((1,), "camera", "C1"), ((0, 1, 2), "rig", "C0")])
def test_a_camera_whose_pose_is_wrong_is_named_and_that_of_all_is_the_rigs(
    tmp_path: Path, misplaced: tuple[int, ...], check: str, camera: str
) -> None:
    true_rad = (0.0, 0.4, -0.4)
    told_rad = [true + (1.0 if place in misplaced else 0.0) for place, true in enumerate(true_rad)]
    cameras = [
        camera_of(f"C{place}") | {"world_to_camera": pose(about_y(angle))}
        for place, angle in enumerate(told_rad)
    ]
    folder = write_stage(tmp_path / "s", cameras=cameras)
    for place, angle in enumerate(true_rad[1:], 1):
        (folder / SUBJECT / f"C{place}").mkdir()
        for light, image in zip(IDS, images(directions() @ about_y(angle).T), strict=True):
            write_frame(folder / SUBJECT / f"C{place}" / f"{light}.exr", image)
    found = only(findings(folder))
    assert (found.check, found.camera) == (check, camera) and stopping([found])
    assert float(found.figures["turned_deg"]) == pytest.approx(57, abs=6) and "world_to_camera" in found.words


def test_without_a_face_a_mirrored_rig_shows_in_the_shape(
    tmp_path: Path, sound: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "find_face_normals", lambda frames, posed, networks: None)
    found = findings(write_stage(tmp_path / "s", sound, lights=lights_of(directions() * [-1, 1, 1])))
    assert only(found).check == "rig" and "hollow" in found[0].words
    assert not findings(write_stage(tmp_path / "sound", sound))


def test_a_display_curve_is_named_by_its_exponent(tmp_path: Path, sound: np.ndarray) -> None:
    found = findings(write_stage(tmp_path / "s", np.maximum(sound, 0) ** (1 / 2.2)))
    gamma = next(one for one in found if one.check == "gamma")
    assert float(gamma.figures["exponent"]) == pytest.approx(2.2, abs=0.3) and stopping([gamma])


@pytest.mark.parametrize("exponent", [1.2, 1.8])
def test_a_frame_of_all_lamps_tells_the_exponent_exactly(
    tmp_path: Path, sound: np.ndarray, exponent: float
) -> None:
    folder = write_stage(tmp_path / "s", np.maximum(sound, 0) ** (1 / exponent))
    write_frame(frame(folder, 0).with_stem("full"), np.maximum(sound, 0).sum(0) ** (1 / exponent))
    gamma = next(one for one in findings(folder) if one.check == "gamma")
    assert float(gamma.figures["exponent"]) == pytest.approx(exponent, abs=0.05)
    assert float(gamma.figures["times_better"]) > 20


def test_a_linear_frame_of_all_lamps_is_no_finding(tmp_path: Path, sound: np.ndarray) -> None:
    folder = write_stage(tmp_path / "s", sound)
    write_frame(frame(folder, 0).with_stem("full"), sound.sum(0))
    assert not findings(folder)


def test_motion_is_measured_in_pixels(tmp_path: Path, sound: np.ndarray) -> None:
    def move(frames: np.ndarray) -> None:
        frames[FRONT] = np.roll(frames[FRONT], (3, -4), (0, 1))

    found = only(changed(move, sound, tmp_path / "s"))
    assert (found.check, found.severity) == ("motion", "warning")
    assert float(found.figures["worst_px"]) == pytest.approx(5, abs=0.7) and IDS[FRONT] in found.words
