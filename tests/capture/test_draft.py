"""Drafts of stage.json from folders: what the files say, and null with a note for the rest."""

import json
import os
import re
import shutil
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.capture.draft import as_text, draft_stage, frames_by_pattern, match_lights
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.errors import InputError
from facerf_cli.files.texts import read_light_list
from facerf_cli.files.write import write_display, write_exr
from tests.refusals import refused

FOLDERS = "{subject}/{camera}/{light}.exr"
K = [[32, 0, 4], [0, 32, 3], [0, 0, 1]]
FACING = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]


def image(path: Path, height: int = 6, width: int = 8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write = write_exr if path.suffix == ".exr" else write_display
    write(path, np.full((height, width, 3), 0.25, np.float32))


def stage_at(folder: Path, cameras: int = 2, form: str = "s{}/cam{}/L{}.exr") -> Path:
    """Images of two subjects by some cameras under four lights."""
    for subject in (1, 2):
        for camera in range(cameras):
            for light in (1, 2, 3, 10):
                image(folder / form.format(subject, camera, light), width=8 + camera)
    return folder


def noted(stage: dict[str, object], words: str) -> bool:
    notes = stage["draft"]
    assert isinstance(notes, list)
    return any(words in note for note in notes)


def test_the_draft_has_what_files_say_and_null_for_the_rest(tmp_path: Path) -> None:
    stage = draft_stage(stage_at(tmp_path), FOLDERS)
    assert [light["id"] for light in stage["lights"]] == ["L1", "L2", "L3", "L10"]
    assert all(light["direction"] is None for light in stage["lights"])
    sizes = [(camera["id"], camera["width"], camera["height"]) for camera in stage["cameras"]]
    assert sizes == [("cam0", 8, 6), ("cam1", 9, 6)] and stage["colour_space"] is None
    assert all(camera["world_to_camera"] is camera["K"] is None for camera in stage["cameras"])
    assert noted(stage, "2 subjects, 2 cameras, 4 lights; all 16 frames exist") and "subjects" not in stage


def test_a_draft_is_refused_until_it_is_filled_in(tmp_path: Path) -> None:
    stage = draft_stage(stage_at(tmp_path), FOLDERS)
    assert json.loads(as_text(stage)) == stage and as_text(stage).count('"direction"') == 4
    (tmp_path / "stage.json").write_text(as_text(stage))
    refused(InputError, "colour_space: is null; fill it in (and 8 more)", read_capture, tmp_path)
    for light in stage["lights"]:
        light["direction"] = [0, 0, 1]
    for camera in stage["cameras"]:
        camera |= {"world_to_camera": FACING, "K": K}
    stage["colour_space"] = "linear"
    (tmp_path / "stage.json").write_text(as_text(stage))
    capture = read_capture(tmp_path)
    assert list(capture.subjects) == ["s1", "s2"] and capture.frame("s2", "cam1", 3).shape == (6, 9, 3)


@pytest.mark.parametrize(
    ("form", "pattern", "subjects"),
    [
        ("s{}/L{2}.exr", "{subject}/{light}.exr", ["s1", "s2"]),
        ("anna/L{2}.exr", "{subject}/{light}.exr", ["anna"]),
        ("L{2}.exr", "{light}.exr", ["folder"]),
        ("raw/s{}_L{2}.exr", "raw/{subject}_{light}.exr", ["s1", "s2"]),
        ("raw/L{2}.exr", "raw/{light}.exr", ["folder"]),
    ],
)
def test_one_camera_is_the_world(tmp_path: Path, form: str, pattern: str, subjects: list[str]) -> None:
    """Its directions are camera space."""
    folder = stage_at(tmp_path / "folder", 1, form.replace("{}", "{0}"))
    (folder / "scene.lp").write_text("4\nL1.jpg 0.6 0 0.8\nL2.jpg 0 1 0\nL3.jpg -1 0 0\nL10.jpg 0 0 2\n")
    stage = draft_stage(folder, pattern)
    assert stage["cameras"][0]["world_to_camera"] == FACING and noted(stage, "directions from scene.lp")
    (to_fill_in,) = (note for note in stage["draft"] if note.startswith("fill in"))
    assert re.findall(r"(\w+) \(", to_fill_in) == ["colour_space", "K"]
    stage["cameras"][0]["K"], stage["colour_space"] = K, "linear"
    (folder / "stage.json").write_text(as_text(stage))
    capture = read_capture(folder)
    assert list(capture.subjects) == subjects and list(capture.cameras) == ["C0"]
    in_camera = capture.directions_world @ capture.cameras["C0"].rotation.numpy().T
    assert in_camera == pytest.approx(np.array([[0.6, 0, 0.8], [0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    assert capture.frame(subjects[0], "C0", 1).shape == (6, 8, 3)


def test_a_pattern_may_repeat_the_subject(tmp_path: Path) -> None:
    for name in ("A+030E+00", "A-030E+00", "A+000E+45", "_Ambient"):
        image(tmp_path / f"b01/b01_P00{name}.png")
        image(tmp_path / f"b02/b02_P00{name}.png")
    (tmp_path / "lights.txt").write_text("A+030E+00 0.5 0 0.866025\n")
    stage = draft_stage(tmp_path, "{subject}/{subject}_P00{light}.png")
    (none,) = (light for light in stage["lights"] if light["id"] == "_Ambient")
    stage["lights"].remove(none)
    directions = {light["id"]: light["direction"] for light in stage["lights"]}
    assert directions == {"A+000E+45": None, "A+030E+00": [0.5, 0, 0.866025], "A-030E+00": None}
    stage["ambient"] = "{subject}/{subject}_P00_Ambient.png"
    for light in stage["lights"]:
        light["direction"] = [0, 0, 1]
    stage["cameras"][0]["K"], stage["colour_space"] = K, "sRGB"
    (tmp_path / "stage.json").write_text(as_text(stage))
    capture = read_capture(tmp_path, ReadSettings(subtract_ambient=True))
    assert capture.frame("b02", "C0", 0) == pytest.approx(0)


def test_a_list_that_is_of_other_images_is_said(tmp_path: Path) -> None:
    folder = stage_at(tmp_path)
    (folder / "lights.txt").write_text("K1 0 0 1\n")
    assert noted(draft_stage(folder, FOLDERS), "names none of the 4 lights")
    (folder / "lights.txt").write_text("0 0 1\n")
    assert noted(draft_stage(folder, FOLDERS), "1 direction for 4 lights")
    (folder / "lights.txt").write_text("K1 0 0\n")
    stage = draft_stage(folder, FOLDERS)
    assert noted(stage, "line 1") and stage["lights"][0]["direction"] is None


def test_faults_of_the_files_are_noted(tmp_path: Path) -> None:
    folder = stage_at(tmp_path)
    (folder / "s2/cam1/L3.exr").unlink()
    (folder / "s1/cam0/L1.exr").write_bytes(b"torn")
    stage = draft_stage(folder, "{subject}/{camera}/{light}.exr")
    assert noted(stage, "1 of 16 frames are missing") and stage["cameras"][0]["width"] is None


def test_links_odd_names_and_pipes(tmp_path: Path) -> None:
    folder = stage_at(tmp_path / "a", 1)
    (folder / "loop").symlink_to(folder)
    (folder / "itself").symlink_to(folder / "itself")
    (folder / "s3").symlink_to(stage_at(tmp_path / "b", 1) / "s1")
    for name in ("line\nbreak", "\u202eback", os.fsdecode(b"\xff")):
        shutil.copytree(folder / "s1", folder / name)
    os.mkfifo(folder / "lights.txt")
    os.mkfifo(folder / "s1/cam0/L4.exr")
    stage = draft_stage(folder, FOLDERS)
    assert noted(stage, "3 subjects, 1 camera") and noted(stage, "ids with other characters")
    assert all(note.isprintable() for note in stage["draft"])


PEOPLE, CAMERAS, LIGHTS = range(1, 5), range(1, 4), range(1, 13)


def crossed(
    form: str, subjects: object = PEOPLE, cameras: object = CAMERAS, lights: object = LIGHTS
) -> list[str]:
    """The paths of every subject, camera and light, by a format string of s, c and l."""
    return [form.format(s=s, c=c, l=light) for s, c, light in product(subjects, cameras, lights)]  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("paths", "pattern", "first"),
    [
        (crossed("{s:04}_C{c}_L{l:03}.png"), "{subject}_{camera}_{light}.png", ("0001", "C1", "L001")),
        (
            crossed("{s:02}/{s:02}_cam{c}_{l:03}.jpg"),
            "{subject}/{subject}_{camera}_{light}.jpg",
            ("01", "cam1", "001"),
        ),
        (
            crossed("{s}_C{c}_L{l:03}.exr", ["anna", "mary_jane", "zoe", "eve"]),
            "{subject}_{camera}_{light}.exr",
            ("anna", "C1", "L001"),
        ),
        (crossed("{s}/take (1)/L{l}.exr", cameras=[1]), "{subject}/take (1)/{light}.exr", ("1", "", "L1")),
    ],
)
def test_a_given_pattern_names_subject_camera_and_light(
    paths: list[str], pattern: str, first: tuple[str, ...]
) -> None:
    frames = frames_by_pattern(paths, pattern)
    assert sorted(frames.paths.values()) == sorted(paths) and not frames.odd
    assert tuple(frames.ids(field)[0] for field in ("subject", "camera", "light")) == first
    for (subject, camera, light), path in frames.paths.items():
        assert pattern.format(subject=subject, camera=camera, light=light) == path


def listed(folder: Path, text: str) -> Path:
    (folder / "lights.lp").write_text(text)
    return folder / "lights.lp"


def test_lists_are_read_by_the_images_names_or_by_order(tmp_path: Path) -> None:
    path = listed(tmp_path, "3\r\nC:\\rti\\a 1.jpg 0 0 2\r\nrti/L2.jpg 0.6 0 .8\r\nL9.jpg 1 0 0\r\n")
    lights = read_light_list(path)
    assert [name for name, _ in lights] == ["C:\\rti\\a 1.jpg", "rti/L2.jpg", "L9.jpg"]
    assert match_lights(lights, ["L1", "L2"], {"a 1": "L1"}) == {"L1": [0, 0, 2], "L2": [0.6, 0, 0.8]}
    lights = read_light_list(listed(tmp_path, "# x y z\n\n0 0 1\n0, 1, 0\n-1e0 0 0\n"))
    expected = {"2": [0, 0, 1], "10": [0, 1, 0], "11": [-1, 0, 0]}
    assert match_lights(lights, ["2", "10", "11"], {}) == expected
    assert match_lights(lights, ["2", "10"], {}) == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1\nL1 0 0", "line 2 is invalid"),
        ("L1 0 0 1\nL2 a b c", "line 2 is invalid"),
        ("3\nL1 0 0 1\nL2 0 1 0", "states 3 lights and has 2"),
        ("1\nL1 0 0 1\nL2 0 1 0", "states 1 lights and has 2"),
        ("a.jpg 0.1 0.2 0.9 1.0", "line 1 is invalid"),
        ("0.1 0.2 0.9 1.0", "line 1 is invalid"),
        ("0,5 0,3 0,8", "line 1 is invalid"),
        ("L1 0 0 0", "line 1 has no direction"),
        ("L1 nan 0 0", "no direction"),
        ("L1 inf 0 0", "no direction"),
        ("\0\1\2", "line 1 is invalid"),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, text: str, said: str) -> None:
    refused(InputError, said, read_light_list, listed(tmp_path, text))
