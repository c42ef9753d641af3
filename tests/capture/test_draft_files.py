"""Frames of a capture without stage.json, by a given pattern or by the depth of the folders."""

from itertools import product

import pytest

from facerf_cli.capture.draft_files import frames_by_depth, frames_by_pattern, sort_frames
from facerf_cli.capture.pattern import fill_pattern
from facerf_cli.errors import UsageError

PEOPLE, CAMERAS, LIGHTS = range(1, 5), range(1, 4), range(1, 13)
FOLDERS = "{subject}/{camera}/{light}.exr"


def crossed(
    form: str, subjects: object = PEOPLE, cameras: object = CAMERAS, lights: object = LIGHTS
) -> list[str]:
    """The paths of every subject, camera and light, by a format string of s, c and l."""
    return [form.format(s=s, c=c, l=light) for s, c, light in product(subjects, cameras, lights)]  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("paths", "pattern", "first"),
    [
        (crossed("s{s:02}/cam{c}/light_{l:03}.exr"), FOLDERS, ("s01", "cam1", "light_001")),
        (crossed("{s}/{c}/{l}.png"), "{subject}/{camera}/{light}.png", ("1", "1", "1")),
        (crossed("{s}/{l}.EXR", cameras=[1]), "{subject}/{light}.EXR", ("1", "", "1")),
        (crossed("{l:03}.png", [1], [1]), "{light}.png", ("", "", "001")),
    ],
)
def test_a_layout_for_each_folder_depth(paths: list[str], pattern: str, first: tuple[str, ...]) -> None:
    frames, found = frames_by_depth(paths)
    assert found == pattern and sorted(frames.paths.values()) == sorted(paths) and not frames.strays
    assert tuple(frames.ids(field)[0] for field in ("subject", "camera", "light")) == first
    assert frames.expected == len(paths)


@pytest.mark.parametrize(
    ("paths", "said"),
    [
        (crossed("images/{s}/{c}/{l}.exr"), "images lie in 3 folders"),
        ([*crossed("{s}/{c}/{l}.exr"), "chart.exr"], "images lie in 0 and 2 folders"),
        ([*crossed("{s}/{c}/{l}.exr"), "1/1/1.png"], r"images end in \.exr and \.png"),
        (crossed("yaleB{s:02}/yaleB{s:02}_P00{l}.pgm", cameras=[1]), "48 of 192 frames exist"),
        ([f"C{c}/IMG_{100 * c + n:04}.jpg" for c in range(3) for n in range(50)], "150 of 450 frames exist"),
    ],
)
def test_another_layout_needs_a_pattern(paths: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said) as raised:
        frames_by_depth(paths)
    assert "give --pattern, such as '{subject}/{camera}/{light}.exr'" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("paths", "pattern", "first"),
    [
        (crossed("{s:04}_C{c}_L{l:03}.png"), "{subject}_{camera}_{light}.png", ("0001", "C1", "L001")),
        (crossed("S{s}C{c}L{l:03}.exr"), "S{subject}C{camera}L{light}.exr", ("1", "1", "001")),
        (crossed("{s:04}/L{l:03}/C{c}.exr"), "{subject}/{light}/{camera}.exr", ("0001", "C1", "L001")),
        (
            crossed("{s:02}/{s:02}_cam{c}_{l:03}.jpg"),
            "{subject}/{subject}_{camera}_{light}.jpg",
            ("01", "cam1", "001"),
        ),
        (crossed("cam{c}/light{l}.exr", [1]), "{camera}/{light}.exr", ("", "cam1", "light1")),
        (
            crossed("{s}_C{c}_L{l:03}.exr", ["anna", "mary_jane", "zoe", "eve"]),
            "{subject}_{camera}_{light}.exr",
            ("anna", "C1", "L001"),
        ),
        (crossed("images/{s}/{c}/{l:03}.tif"), "images/{subject}/{camera}/{light}.tif", ("1", "1", "001")),
        (crossed("{s}/take (1)/L{l}.exr", cameras=[1]), "{subject}/take (1)/{light}.exr", ("1", "", "L1")),
    ],
)
def test_a_given_pattern_names_subject_camera_and_light(
    paths: list[str], pattern: str, first: tuple[str, ...]
) -> None:
    frames = frames_by_pattern(paths, pattern)
    assert sorted(frames.paths.values()) == sorted(paths) and not frames.strays
    assert tuple(frames.ids(field)[0] for field in ("subject", "camera", "light")) == first
    for (subject, camera, light), path in frames.paths.items():
        assert fill_pattern(pattern, subject=subject, camera=camera, light=light) == path


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("{subject}/{camera}.exr", "names {light} is needed"),
        ("../{light}.exr", "below the capture"),
        ("{subject}/{lamp}/{light}.exr", "without '{' '}' elsewhere"),
        ("{subject}/{light}.exr", r"no image matches, not even 1/1/1\.exr"),
    ],
)
def test_a_wrong_pattern_is_refused(pattern: str, said: str) -> None:
    with pytest.raises(UsageError, match=said) as raised:
        frames_by_pattern(crossed("{s}/{c}/{l}.exr"), pattern)
    assert str(raised.value).startswith("--pattern") and "\n" not in str(raised.value)


def test_images_that_do_not_match_are_strays() -> None:
    frames = sort_frames([*crossed("{l:03}.png", [1], [1]), "readme.jpg", "thumbs/001.png"], "{light}.png")
    assert len(frames.paths) == len(LIGHTS) and frames.strays == ["readme.jpg", "thumbs/001.png"]


def test_images_without_lights_and_with_all_are_no_frames() -> None:
    extra = ["0001/C1/ambient.exr", "0002/C1/ambient.exr", "0001/C1/dark.exr", "0001/C2/all_on.exr"]
    frames = sort_frames([*crossed("{s:04}/C{c}/L{l:03}.exr"), *extra], FOLDERS)
    assert frames.ambient.most_common() == [("ambient", 2), ("dark", 1)]
    assert len(frames.ids("light")) == len(LIGHTS) and not frames.strays


def test_ids_come_in_the_order_of_their_numbers() -> None:
    frames = sort_frames(crossed("{s}/{c}/L{l}.exr"), FOLDERS)
    assert frames.ids("light")[:3] == ["L1", "L2", "L3"] and frames.ids("light")[-1] == "L12"


def test_ids_that_no_file_could_bear_are_left_out() -> None:
    paths = crossed("{s}/C{c}/L{l}.exr", ["ann\n", "b\udcff", "\u0627\u062d", "ok"])
    frames = sort_frames(paths, FOLDERS)
    assert frames.ids("subject") == ["ok"] and set(frames.unnameable) == {"ann\n", "b\udcff", "\u0627\u062d"}
