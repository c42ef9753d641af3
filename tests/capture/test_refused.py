"""Captures and their descriptions that are refused: the file and the fault are named in one line."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facerf_cli.capture.draft import draft_stage, frames_by_pattern
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.metashape import read_metashape
from facerf_cli.capture.settings import ReadSettings
from facerf_cli.capture.yale_b import read_shifts, read_yale_b
from facerf_cli.errors import FacerfError, InputError
from facerf_cli.files.write import write_display, write_exr
from tests.capture.yale_fixture import write_pgm, write_yale_b
from tests.refusals import refused
from tests.worlds import FLAT, LENS, write_flat_stage

LIGHT, CAMERA = FLAT["lights"][0], FLAT["cameras"][0]


def light(**changes: Any) -> dict[str, Any]:
    return {"lights": [LIGHT | changes, FLAT["lights"][1]]}


def camera(**changes: Any) -> dict[str, Any]:
    return {"cameras": [CAMERA | changes]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "facerf-stage-9"}, "facerf-stage-1"),
        ({"axes": "opengl"}, "opencv"),
        ({"unit": "mm"}, "'m'"),
        ({"colour_space": "mauve"}, "'mauve'"),
        ({"colour_space": None}, "colour_space: is null; fill it in"),
        ({"lights": []}, "at least 1"),
        (light(direction=[0, 0, 2]), "length 1"),
        (light(direction=[0, 1]), "finite"),
        (light(intensity=[1, 0, 1]), "lights[0]: intensity"),
        (light(id="L1"), "'L1'"),
        (light(id="../L0"), "a name"),
        (light(position=[0, 0, 1]), "direction"),
        ({"lights": [{"id": "L0", "position": [0, 0, 0], "intensity": [1, 1, 1]}]}, "L0"),
        (camera(width=10**9), "cameras[0]: width"),
        (camera(K=[[1, 0], [0, 1]]), "3 x 3"),
        (camera(K=[[500, 3, 32], [0, 500, 30], [0, 0, 1]]), "fx, 0, cx"),
        (camera(K=[[500, 0, 32], [0, 600, 30], [0, 0, 1]]), "square"),
        (camera(world_to_camera=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]]), "rotation"),
        (camera(world_to_camera=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2]]), "rotation"),
        (camera(world_to_camera=[*CAMERA["world_to_camera"], [0, 0, 1, 1]]), "last row"),
        (camera(world_to_camera="eye"), "3 x 4"),
        ({"cameras": [CAMERA, {k: CAMERA[k] for k in ("width", "height", "K")} | {"id": "C1"}]}, "camera C1"),
        (light(direction=None) | camera(K=[None, 3]), "direction: is null; fill it in (and 1 more"),
        (camera(distortion=[0.1]), "k1, k2, p1, p2, k3 of OpenCV"),
        (camera(distortion=[0.1, 0, 0, "x"]), "k1, k2, p1, p2, k3 of OpenCV"),
        (camera(distortion=[0.1] * 8), "undistort"),
        (camera(distortion=[-5.0, 0, 0, 0], K=[[60, 0, 32], [0, 60, 30], [0, 0, 1]]), "distortion"),
        ({"pattern": "../{subject}/{camera}/{light}.exr"}, "below the capture"),
        ({"pattern": "{camera}/{light}.exr"}, "{subject} and {light}"),
        ({"pattern": "{subject}/{light}.exr", "cameras": [CAMERA, CAMERA | {"id": "C1"}]}, "{camera}"),
        ({"pattern": "{subject}/{camera}/{light}{gain}.exr"}, "without '{' '}' elsewhere"),
        ({"pattern": "{subject}/{camera}/\n/{light}.exr"}, r"without '\n'"),
        ({"ambient": "{subject}/{light}.exr"}, "{subject}"),
        ({"ambient": "dark.exr"}, "{subject}"),
        ({"subjects": ["0000"]}, "an object"),
        ({"subjects": {"0000.json": {}}}, "a name"),  # fits/0000.json is the record of 0000
        ({"subjects": {"0000": 3}}, "an object"),
        ({"black_level": [0, 1]}, "a number, or one for each of three channels"),
        ({"black_level": True}, "a number"),
        ({"colour_matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "colour_matrix"),
        ({"exposure_stops": {"0000": 40}}, "exposure_stops"),
        ({"exposure_stops": {"1": 1}, "subjects": {"0000": {}}}, "no subject 1"),
    ],
)
def test_a_description(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    refused(InputError, f"stage.json ... {said}", read_capture, write_flat_stage(tmp_path, **changes))


@pytest.mark.parametrize("missing", ["unit", "cameras"])
def test_a_description_without_a_key(tmp_path: Path, missing: str) -> None:
    path = write_flat_stage(tmp_path) / "stage.json"
    path.write_text(path.read_text().replace(f'"{missing}"', '"other"'))
    refused(InputError, f"stage.json: {missing}: is missing", read_capture, tmp_path)


def test_a_frame(tmp_path: Path) -> None:
    capture = read_capture(write_flat_stage(tmp_path))
    path = capture.frame_path("0000", "C0", "L1")
    for content, words in (
        (np.zeros((60, 60, 3), np.float32), "L1.exr ... 60 x 60 ... C0 ... 64 x 60"),
        (b"torn", "L1.exr"),
        (None, "L1.exr ... no such file"),
    ):
        path.unlink()
        if content is not None:
            write_exr(path, content) if isinstance(content, np.ndarray) else path.write_bytes(content)
        refused(InputError, words, capture.frame, "0000", "C0", 1)


def draft(pattern: str, *names: str) -> Callable[[Path], Any]:
    """Draft a folder of images."""

    def call(folder: Path) -> Any:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_display(folder / name, np.full((6, 8, 3), 0.25, np.float32))
        return draft_stage(folder, pattern)

    return call


def frames(pattern: str) -> Callable[[Path], Any]:
    return lambda _: frames_by_pattern(["1/1/1.exr"], pattern)


def lens(old: str, new: str) -> Callable[[Path], Any]:
    """Read Metashape's calibration with a fault."""

    def call(folder: Path) -> Any:
        (folder / "lens.xml").write_text(re.sub(old, new, LENS))
        return read_metashape(folder / "lens.xml")

    return call


def shifts(*rows: str, head: str = "subject,light,dy,dx") -> Callable[[Path], Any]:
    def call(folder: Path) -> Any:
        (folder / "shifts.csv").write_text("".join(f"{row}\n" for row in (head, *rows)))
        return read_shifts(folder / "shifts.csv")

    return call


def yale(folder: Path, name: str = "") -> Any:
    """Read an Extended Yale B with a person without images, or a folder of it."""
    (write_yale_b(folder / "yale") / "yaleB09").mkdir()
    return read_yale_b(folder / "yale" / name)


def small_image(folder: Path) -> Any:
    write_pgm(write_yale_b(folder) / "yaleB05/yaleB05_P00A+070E+00.pgm", np.zeros((96, 84)))
    return read_yale_b(folder).images("yaleB05")


ROWS: dict[str, Callable[[Path], Any]] = {
    "stage.json ... no such file": read_capture,
    "nowhere ... no such folder": lambda folder: read_capture(folder / "nowhere"),
    "multipie ... faceolat, ": lambda folder: read_capture(folder, ReadSettings("multipie")),
    "stage.json ... 'ambient'": lambda folder: read_capture(
        write_flat_stage(folder), ReadSettings(subtract_ambient=True)
    ),
    "here: no such folder": lambda folder: draft("")(folder / "here"),
    "matches no image": draft("{light}.png"),
    "2 lights": draft("{light}.png", "a.png", "b.png"),
    "--pattern: missing ... {light}": draft("", "L1.png"),
    "--pattern ... {light}": frames("{subject}/{camera}.exr"),
    "--pattern ... below the capture": frames("../{light}.exr"),
    "--pattern ... '{' '}'": frames("{subject}/{lamp}/{light}.exr"),
    "--pattern ... matches no image": frames("{subject}/{light}.exr"),
    "lens.xml ... camera A has b2": lens("<k1>", "<b2>0.1</b2><k1>"),
    "lens.xml ... camera A has b2 or k4": lens("<k1>", "<k4>0.1</k4><k1>"),
    "lens.xml ... camera A ... frame camera": lens('class="adjusted"', 'type="fisheye"'),
    "lens.xml ... 16 finite numbers": lens("<transform>1", "<transform>"),
    "lens.xml ... aligned": lens("<transform>.*</transform>", ""),
    "lens.xml ... entities": lens("<document>", '<!DOCTYPE a [<!ENTITY b "c">]><document>'),
    "lens.xml ... not a calibration": lens("</chunk>", ""),
    "lens.xml ... not a calibration of cameras": lens('sensor_id="0"', 'sensor_id="7"'),
    "shifts.csv ... no shifts": shifts(),
    "shifts.csv ... line 3": shifts("yaleB01,A+000E+00,1,1", "yaleB01,front,1,1"),
    "shifts.csv ... line 2": shifts("yaleB01,A+000E+00,1.5,1"),
    "shifts.csv ... line 2 ": shifts("yaleB01,A+000E+00,1"),
    "shifts.csv: line 2": shifts("yaleB01,A+000E+00,400,1"),
    "shifts.csv ...  line 2": shifts("A+000E+00,1,1", head="light,dy,dx"),
    "none: no such folder": lambda folder: read_yale_b(folder / "none"),
    "yaleB05 ... yaleB01": lambda folder: yale(folder, "yaleB05"),
    "yaleB09 ... no images": yale,
    "A+070E+00.pgm ... 84 x 96 ... 168 x 192": small_image,
}


@pytest.mark.parametrize("words", ROWS)
def test_refused(words: str, tmp_path: Path) -> None:
    refused(FacerfError, words, ROWS[words], tmp_path)
