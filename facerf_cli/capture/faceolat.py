"""Reader of FaceOLAT as its authors' tools unpack it: 139 people, 40 cameras, 331 lights, one at a time.

The data of 3DPR (SIGGRAPH Asia 2025) are given on request, for research.

Frames are `Cam06/ID20003/ID20003.000001.avif`, or `.exr` before conversion: camera, take, frame; the last
three digits of a take are the person's number. `lights/light_pattern_per_frame.json` pairs frames, counted
from 0, with lights: 0 is all of them, for tracking, others count from 1 in the positions of
`lights/light_pattern_metadata.json`, in millimetres. `calibration/cameras/*.xml` are Metashape's. It is not
known that they have the same axes and unit (`_UNIT_M`), nor that the first file of a take is frame 0
(`_frames`): both are taken to be so.

The world is that of the stage in metres, with its origin in the middle of the lights' sphere, where the near
lights are equal, of unknown intensity. EXR files, and AVIF files that were made without colour calibration
(layout `faceolat-linear`), are linear, and `colorcalib.mat` is applied; other AVIF files have it already, and
a gamma of 2.2.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from facerf_cli.capture.capture import BlackLevel, Capture, find_subjects
from facerf_cli.capture.metashape import read_metashape
from facerf_cli.capture.stage_json import MOST_LIGHTS, CameraEntry
from facerf_cli.errors import InputError
from facerf_cli.files.documents import Document, Three, checked, read_document
from facerf_cli.files.texts import read_text

_UNIT_M = 1e-3
_TAKE = re.compile(r"ID\w*?(\d{3})")
_DARK_TAKES, _DARK_PEOPLE, _DARK_STOPS = "ID2", range(88, 117), -1.0  # one stop darker than the others
_FARTHEST_M = 10.0  # of a camera from the middle of the lights, if both have the same axes and unit
_MOST_FRAMES = 4096
_GAMMA = "Gamma 2.2 Encoded Rec.709"
_LICENCE = "FaceOLAT: academic use, on request (B R et al. 2025)"


class _Positions(Document):
    light_positions: Annotated[list[Three], Field(min_length=4, max_length=MOST_LIGHTS)]


@dataclass(frozen=True)
class _Frames:
    """Names of files by the light that they show, and those of files that show no single one."""

    of_lights: dict[int, str]
    others: frozenset[str]


def read_faceolat(folder: Path) -> Capture:
    """Read the data set, converted with colour calibration, as a capture; no images are decoded yet."""
    return _read(folder, is_linear=False)


def read_faceolat_linear(folder: Path) -> Capture:
    """Read the data set, converted without colour calibration, as a capture."""
    return _read(folder, is_linear=True)


def _read(folder: Path, is_linear: bool) -> Capture:
    calibration = sorted(folder.glob("calibration/cameras/*.xml"))
    if not calibration:
        raise InputError(
            f"{folder}: no calibration/cameras/*.xml; give the folder that holds Cam01, lights, ..."
        )
    first = next(iter(sorted(folder.glob("Cam*/ID*/ID*.*"))), None)
    if first is None:
        raise InputError(f"{folder}: no images such as Cam06/ID20003/ID20003.000001.avif; copy them there")
    suffix, width = first.suffix, len(first.name.split(".")[1])
    is_linear = is_linear or suffix.lower() == ".exr"
    places = np.stack(
        read_document(folder / "lights/light_pattern_metadata.json", _Positions, "copy it").light_positions
    )
    middle = sphere_middle(places)
    frames = _frames(folder, len(places), int(first.name.split(".")[1]), width)
    numbers = sorted(frames.of_lights)
    pattern = f"{{camera}}/{{subject}}/{{subject}}.{{light}}{suffix}"
    cameras = {}
    for path in calibration:
        for name, entry in read_metashape(path, _UNIT_M).items():
            posed = np.array(entry["world_to_camera"])
            posed[:, 3] += posed[:, :3] @ middle * _UNIT_M
            if not np.linalg.norm(posed[:, 3]) < _FARTHEST_M:
                far = f"{name} is {np.linalg.norm(posed[:, 3]):.0f} m from the lights' middle"
                raise InputError(f"{path}: {far}; its axes or unit are not those of the lights")
            cameras[name] = checked(CameraEntry, {**entry, "world_to_camera": posed.tolist()}, str(path))
    lights = [frames.of_lights[number] for number in numbers]
    subjects = {
        name: {"person": _person(name)} for name in find_subjects(folder, pattern, [*cameras], lights)
    }
    matrix, black = _colours(folder / "colorcalib.mat") if is_linear else (None, 0.0)
    near = (places[numbers] - middle) * _UNIT_M
    capture = Capture(
        folder=folder,
        pattern=pattern,
        colour_space="linear" if is_linear else _GAMMA,
        black_level=black,
        light_ids=tuple(lights),
        directions_world=np.full_like(near, np.nan),
        intensities=np.ones((len(lights), 3)),
        cameras={name: entry.posed() for name, entry in cameras.items()},
        subjects=subjects,
        provenance={
            "database": "FaceOLAT",
            "licence": _LICENCE,
            "synthetic": False,
            "calibration": "the stage's; equal lights of unknown intensity",
        },
        distortion={name: entry.distortion for name, entry in cameras.items() if any(entry.distortion)},
        colour_matrix=matrix,
        positions_m=near,
        stops={name: _DARK_STOPS for name in subjects if _is_dark(name)},
        ignored=frames.others,
    )
    return capture.about(np.zeros(3))


def _frames(folder: Path, lights: int, first: int, width: int) -> _Frames:
    """Sort the frames of a take, whose first file has the number `first`, in so many digits."""
    path = folder / "lights/light_pattern_per_frame.json"
    pairs = read_document(path, list[list[int]], "copy it")
    of_lights, others = {}, set()
    for pair in pairs:
        if len(pair) != 2 or not (0 <= pair[0] <= _MOST_FRAMES and 0 <= pair[1] <= lights):
            raise InputError(f"{path}: {pair} is not a frame and one of {lights} lights; copy it again")
        name = f"{pair[0] + first:0{width}d}"
        if pair[1]:
            of_lights[pair[1] - 1] = name
        else:
            others.add(name)
    return _Frames(of_lights, frozenset(others))


def _person(take: str) -> str:
    match = _TAKE.fullmatch(take)
    return match[1] if match else take


def _is_dark(take: str) -> bool:
    person = _person(take)
    return take.startswith(_DARK_TAKES) and person.isdecimal() and int(person) in _DARK_PEOPLE


def _colours(path: Path) -> tuple[np.ndarray, BlackLevel]:
    """The matrix [3, 3] and the black level of each channel, of a text of 3 x 4 numbers."""
    advice = "copy it, or give images that were converted with colour calibration"
    if not path.is_file():
        raise InputError(f"{path}: no such file; {advice}")
    try:
        numbers = np.array(read_text(path, advice).replace(",", " ").split(), np.float64)
        matrix = numbers.reshape(3, 4)
    except ValueError:
        matrix = np.full((3, 4), np.nan)
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix[:, :3]) < 3:
        raise InputError(f"{path}: is not a matrix of 3 x 4 numbers; {advice}")
    red, green, blue = matrix[:, 3].tolist()
    return matrix[:, :3], (red, green, blue)


def sphere_middle(points: np.ndarray) -> np.ndarray:
    """The middle [3] of the sphere nearest to points [N, 3], by linear least squares."""
    terms = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(terms, (points**2).sum(1), rcond=None)[0][:3])
