"""Reader for FaceOLAT as unpacked by its authors' tools: 139 people, 40 cameras, 331 lights, one at a time.

The data of 3DPR (SIGGRAPH Asia 2025) are available on request, for research.

Frames are `Cam06/ID20003/ID20003.000001.avif`, or `.exr` before conversion: camera, take, frame; the last
three digits of a take are the person's number. `lights/light_pattern_per_frame.json` pairs frames, counted
from 0, with lights: 0 stands for all lights, used for tracking; other numbers count from 1 in the positions
of `lights/light_pattern_metadata.json`, in millimetres. `calibration/cameras/*.xml` are written by Metashape.
Two assumptions are unverified: that they have the same axes and unit (`_UNIT_M`), and that the lowest number
of all files is frame 0 (`_frames`).

World space is the stage's, in metres, with its origin at the centre of the lights' sphere, where the near
lights are equal, with unknown intensity. EXR files, and AVIF files converted without colour calibration
(layout `faceolat-linear`), are linear, and `colorcalib.mat` is applied. Other AVIF files already include it,
and have a gamma of 2.2.
"""

import re
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
_TAKE, _FRAME = re.compile(r"ID\w*?(\d{3})"), re.compile(r"ID\w+\.(\d+)(\.\w+)")
_DARK_TAKES, _DARK_PEOPLE, _DARK_STOPS = "ID2", range(88, 117), -1.0  # one stop darker than the others
_FARTHEST_M = 10.0  # of a camera from the lights' centre, if both have the same axes and unit
_MOST_FRAMES = 4096
_GAMMA = "Gamma 2.2 Encoded Rec.709"
_LICENCE = "FaceOLAT: academic use, on request (B R et al. 2025)"


class _Positions(Document):
    light_positions: Annotated[list[Three], Field(min_length=4, max_length=MOST_LIGHTS)]


def read_faceolat(folder: Path, is_linear: bool) -> Capture:
    """Read the data set as a capture; no images are decoded yet.

    `is_linear` is true for images converted without colour calibration. Raises InputError for missing or
    invalid files.
    """
    calibration = sorted(folder.glob("calibration/cameras/*.xml"))
    if not calibration:
        raise InputError(
            f"{folder}: no calibration/cameras/*.xml; use the folder that contains Cam01, lights, ..."
        )
    images = [_FRAME.fullmatch(path.name) for path in sorted(folder.glob("Cam*/ID*/ID*.*"))]
    frames = [image.groups() for image in images if image]
    if not frames:
        raise InputError(f"{folder}: no images such as Cam06/ID20003/ID20003.000001.avif; copy them there")
    number, suffix = frames[0]
    first = min(int(frame) for frame, _ in frames)  # files may be missing in some takes
    is_linear = is_linear or suffix.lower() == ".exr"
    places = np.stack(
        read_document(folder / "lights/light_pattern_metadata.json", _Positions, "copy it").light_positions
    )
    centre = sphere_centre(places)
    names = _frames(folder, len(places), first, len(number))
    numbers = sorted(names)
    pattern = f"{{camera}}/{{subject}}/{{subject}}.{{light}}{suffix}"
    cameras = {}
    for path in calibration:
        for name, entry in read_metashape(path, _UNIT_M).items():
            posed = np.array(entry["world_to_camera"])
            posed[:, 3] += posed[:, :3] @ centre * _UNIT_M
            if not np.linalg.norm(posed[:, 3]) < _FARTHEST_M:
                far = f"{name} is {np.linalg.norm(posed[:, 3]):.0f} m from the lights' centre"
                raise InputError(f"{path}: {far}; use the axes and the unit of the lights")
            cameras[name] = checked(CameraEntry, {**entry, "world_to_camera": posed.tolist()}, str(path))
    lights = [names[number] for number in numbers]
    subjects, stops = {}, {}
    for take in find_subjects(folder, pattern, [*cameras], lights):
        person = match[1] if (match := _TAKE.fullmatch(take)) else take
        subjects[take] = {"person": person}
        if take.startswith(_DARK_TAKES) and person.isdecimal() and int(person) in _DARK_PEOPLE:
            stops[take] = _DARK_STOPS
    matrix, black = _colours(folder / "colorcalib.mat") if is_linear else (None, 0.0)
    near = (places[numbers] - centre) * _UNIT_M
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
        stops=stops,
    )
    return capture.about(np.zeros(3))


def _frames(folder: Path, lights: int, first: int, width: int) -> dict[int, str]:
    """Return the names of frames of one light, by light; frame 0 has the number `first`."""
    path = folder / "lights/light_pattern_per_frame.json"
    names = {}
    for pair in read_document(path, list[list[int]], "copy it"):
        if len(pair) != 2 or not (0 <= pair[0] <= _MOST_FRAMES and 0 <= pair[1] <= lights):
            raise InputError(f"{path}: {pair} is not a frame and one of {lights} lights; copy it again")
        if pair[1]:
            names[pair[1] - 1] = f"{pair[0] + first:0{width}d}"
    return names


def _colours(path: Path) -> tuple[np.ndarray, BlackLevel]:
    """Read the matrix [3, 3] and the black level of each channel from a text of 3 x 4 numbers."""
    advice = "copy it, or use images that were converted with colour calibration"
    try:
        numbers = np.array(read_text(path, advice).replace(",", " ").split(), np.float64)
        matrix = numbers.reshape(3, 4)
    except ValueError:
        matrix = np.full((3, 4), np.nan)
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix[:, :3]) < 3:
        raise InputError(f"{path}: is not a matrix of 3 x 4 numbers; {advice}")
    red, green, blue = matrix[:, 3].tolist()
    return matrix[:, :3], (red, green, blue)


def sphere_centre(points: np.ndarray) -> np.ndarray:
    """Fit a sphere to points [N, 3] by linear least squares, and return its centre [3]."""
    terms = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(terms, (points**2).sum(1), rcond=None)[0][:3])
