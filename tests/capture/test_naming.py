"""From names alone: which part of the paths is the subject, the camera, the light."""

import re
from itertools import product

import pytest

from facerf_cli.capture import draft_names as parts
from facerf_cli.capture.draft import Frames, alike, sort_frames
from facerf_cli.capture.draft_names import Naming, find_naming
from facerf_cli.errors import UsageError

PEOPLE, CAMERAS, LIGHTS = range(1, 5), range(1, 4), range(1, 13)
ANGLES = [f"A{azimuth:+04}E{elevation:+03}" for azimuth in (-110, -5, 20, 35) for elevation in (-20, 0, 65)]


def crossed(
    form: str, subjects: object = PEOPLE, cameras: object = CAMERAS, lights: object = LIGHTS
) -> list[str]:
    """The paths of every subject, camera and light, by a format string of s, c and l."""
    return [form.format(s=s, c=c, l=light) for s, c, light in product(subjects, cameras, lights)]  # type: ignore[call-overload]


def read(paths: list[str]) -> tuple[Naming, Frames]:
    naming = find_naming(paths)
    return naming, sort_frames(paths, naming)


# Format of the paths; the pattern; a subject, a camera and a light; fields that may be others.
NAMES: dict[str, tuple[list[str], str, tuple[str, str, str], str]] = {
    "folders": (
        crossed("s{s:02}/cam{c}/light_{l:03}.exr"),
        "{subject}/{camera}/{light}.exr",
        ("s01", "cam1", "light_001"),
        "",
    ),
    "one folder": (
        crossed("{s:04}_C{c}_L{l:03}.png"),
        "{subject}_{camera}_{light}.png",
        ("0001", "C1", "L001"),
        "",
    ),
    "one camera": (
        crossed("{s}/L{l:03}.exr", ["anna", "bob", "zoe"], [1]),
        "{subject}/{light}.exr",
        ("anna", "", "L001"),
        "subject",
    ),
    "one camera, in the file's name": (
        crossed("{s}/cam01_L{l:03}.exr", ["anna", "bob"], [1]),
        "{subject}/{camera}_{light}.exr",
        ("anna", "cam01", "L001"),
        "subject",
    ),
    "its number alone": (
        crossed("s{s}/cam01_{l:03}.exr", cameras=[1]),
        "{subject}/{camera}_{light}.exr",
        ("s1", "cam01", "001"),
        "light",
    ),
    "a light's word apart": (
        crossed("{s}/view0_led_{l}.png", ["anna", "bob"], [1]),
        "{subject}/{camera}_led_{light}.png",
        ("anna", "view0", "1"),
        "subject",
    ),
    "a word before the light's": (
        crossed("{s}/scan_light_{l}.png", ["anna", "bob"], [1]),
        "{subject}/{light}.png",
        ("anna", "", "scan_light_1"),
        "subject",
    ),
    "a fixed number that says nothing": (
        crossed("{s}/face01_2021_light{l}.png", ["anna", "bob"], [1]),
        "{subject}/face01_2021_{light}.png",
        ("anna", "", "light1"),
        "subject",
    ),
    **{
        f"files of {word}": (
            crossed(f"{{s}}/{word}{{l:03}}.png", ["anna", "bob", "carl"], [1]),
            "{subject}/{light}.png",
            ("anna", "", f"{word}001"),
            "subject light",
        )
        for word in ("face_", "s_", "C_", "c")
    },
    "people's names unlike each other": (
        crossed("{s}_cam01_L{l:03}.png", ["anna", "anna2", "bob-x", "zoe 3"], [1]),
        "{subject}_{camera}_{light}.png",
        ("anna", "cam01", "L001"),
        "subject",
    ),
    "faces by cameras": (
        crossed("{s}/cam{c}/face_{l:03}.png", ["anna", "bob", "carl"]),
        "{subject}/{camera}/{light}.png",
        ("anna", "cam1", "face_001"),
        "subject light",
    ),
    "its name stands": (
        crossed("{s}/C0/L{l}.exr", cameras=[0]),
        "{subject}/{camera}/{light}.exr",
        ("1", "C0", "L1"),
        "subject",
    ),
    "one subject": (
        crossed("anna/C{c}/L{l}.exr", [1]),
        "{subject}/{camera}/{light}.exr",
        ("anna", "C1", "L1"),
        "",
    ),
    "cameras and lights": (
        crossed("cam{c}/light{l}.exr", [1]),
        "{camera}/{light}.exr",
        ("", "cam1", "light1"),
        "",
    ),
    "lights alone": (crossed("{l:03}.png", [1], [1]), "{light}.png", ("", "", "001"), ""),
    "names of people": (
        crossed("{s}_C{c}_L{l:03}.exr", ["anna", "mary_jane", "zoe", "eve"]),
        "{subject}_{camera}_{light}.exr",
        ("anna", "C1", "L001"),
        "",
    ),
    "folders of any name": (
        crossed("{s}/C{c}/L{l}.exr", ["anna", "bob_2", "s-03"]),
        "{subject}/{camera}/{light}.exr",
        ("anna", "C1", "L1"),
        "",
    ),
    "no separators": (
        crossed("S{s}C{c}L{l:03}.exr"),
        "S{subject}C{camera}L{light}.exr",
        ("1", "1", "001"),
        "",
    ),
    "light first": (
        crossed("{s:04}/L{l:03}/C{c}.exr"),
        "{subject}/{light}/{camera}.exr",
        ("0001", "C1", "L001"),
        "",
    ),
    "said twice": (
        crossed("{s:02}/{s:02}_cam{c}_{l:03}.jpg"),
        "{subject}/{subject}_{camera}_{light}.jpg",
        ("01", "cam1", "001"),
        "subject light",
    ),
    "said twice otherwise": (
        crossed("s{s:02}/{s:02}_cam{c}_{l:03}.jpg"),
        "s{subject}/{subject}_{camera}_{light}.jpg",
        ("01", "cam1", "001"),
        "",
    ),
    "a constant folder": (
        crossed("images/session_1/{s}/{c}/{l:03}.tif"),
        "images/session_1/{subject}/{camera}/{light}.tif",
        ("1", "1", "001"),
        "subject camera light",
    ),
    "dates": (
        crossed("2021-03-0{s}_x{s}/cam{c}/{l:03}.tif"),
        "{subject}/{camera}/{light}.tif",
        ("2021-03-01_x1", "cam1", "001"),
        "subject light",
    ),
    "angles": (
        crossed("b{s:02}/b{s:02}_P00{l}.pgm", cameras=[0], lights=ANGLES),
        "{subject}/{subject}_P00{light}.pgm",
        ("b01", "", "A+020E+00"),
        "subject",
    ),
    "angles in words": (
        crossed("{s}/az{l:+04}_el-20.png", cameras=[0], lights=range(-90, 91, 10)),
        "{subject}/{light}.png",
        ("1", "", "az+000_el-20"),
        "subject",
    ),
    "spaces": (
        crossed("subject {s}/camera {c}/light {l}.exr"),
        "{subject}/{camera}/{light}.exr",
        ("subject 1", "camera 1", "light 1"),
        "",
    ),
}


@pytest.mark.parametrize(("paths", "pattern", "first", "by_place"), NAMES.values(), ids=NAMES)
def test_the_pattern_is_found(paths: list[str], pattern: str, first: tuple[str, ...], by_place: str) -> None:
    naming, frames = read(paths)
    assert naming.pattern == pattern
    assert tuple(frames.ids(field)[0] for field in ("subject", "camera", "light")) == first
    assert set(naming.by_place) == set(by_place.split())
    assert sorted(frames.paths.values()) == sorted(paths) and not frames.strays


def filled(pattern: str, names: dict[str, str]) -> str:
    return re.sub(r"\{(\w+)\}", lambda word: names[word[1]], pattern)


@pytest.mark.parametrize("paths", [paths for paths, *_ in NAMES.values()], ids=NAMES)
def test_the_pattern_gives_the_paths_again(paths: list[str]) -> None:
    naming, frames = read(paths)
    for (subject, camera, light), path in frames.paths.items():
        assert filled(naming.pattern, {"subject": subject, "camera": camera, "light": light}) == path


def test_of_many_names_some_tell_the_pattern(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known of each name takes memory: 20 kB of one of 250 letters."""
    monkeypatch.setattr(parts, "_MOST_PATHS", 100)
    naming, frames = read(crossed("s{s:02}/cam{c}/light_{l:03}.exr", range(40)))
    assert naming.pattern == "{subject}/{camera}/{light}.exr"
    assert len(frames.paths) == 40 * len(CAMERAS) * len(LIGHTS)


def test_images_that_do_not_fit_are_told_apart() -> None:
    paths = crossed("{l:03}.png", [1], [1], range(96))
    _, frames = read([*paths, "mask.png", "normal.png", "thumbs/001.png", "readme.jpg"])
    assert len(frames.paths) == 96 and sorted(frames.strays) == [
        "mask.png",
        "normal.png",
        "readme.jpg",
        "thumbs/001.png",
    ]


def test_images_without_lamps_and_with_all() -> None:
    paths = crossed("{s:04}/C{c}/L{l:03}.exr")
    _, frames = read(
        [*paths, "0001/C1/ambient.exr", "0002/C1/ambient.exr", "0001/C1/dark.exr", "0001/C2/all_on.exr"]
    )
    assert frames.ambient.most_common() == [("ambient", 2), ("dark", 1)] and list(frames.full) == ["all_on"]
    assert len(frames.ids("light")) == len(LIGHTS) and not frames.strays


def test_of_two_kinds_of_files_the_floating_ones_are_taken() -> None:
    both = crossed("{s}/C{c}/L{l}.jpg") + crossed("{s}/C{c}/L{l}.exr")
    naming, frames = read(both)
    assert naming.pattern.endswith(".exr") and len(frames.strays) == len(both) / 2


def test_ids_come_in_the_order_of_their_numbers_and_doubles_are_seen() -> None:
    _, frames = read(crossed("{s}/cam3/L{l}.exr") + crossed("{s}/cam03/L{l}.exr"))
    assert frames.ids("light")[:3] == ["L1", "L2", "L3"] and frames.ids("light")[-1] == "L12"
    assert list(alike(frames.ids("camera"))) == [["cam03", "cam3"]] and not list(alike(frames.ids("light")))


def test_ids_that_no_file_could_bear_are_left_out() -> None:
    _, frames = read(crossed("{s}/C{c}/L{l}.exr", ["ann\n", "b\udcff", "\u0627\u062d", "ok"]))
    assert frames.ids("subject") == ["ok"] and set(frames.unnameable) == {"ann\n", "b\udcff", "\u0627\u062d"}


@pytest.mark.parametrize(
    ("paths", "said"),
    [
        (["x.png"], "one picture"),
        ([f"IMG_{number:05}.jpg" for number in range(5000)], "4096 lights"),
        ([f"C{c}/IMG_{100 * c + n:04}.jpg" for c in range(3) for n in range(50)], "vary together"),
        (crossed("s{s}_C{c}_L{l}_2021{s}{c}{l:02}.exr"), "vary together"),
        ([f"{s}/{d}/C{c}/L{n}.exr" for s, d, c, n in product("abc", "12", "12", range(9))], "4 parts of"),
    ],
)
def test_what_is_no_capture_is_said(paths: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said) as raised:
        find_naming(paths)
    assert "\n" not in str(raised.value)
