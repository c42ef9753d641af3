"""What every protocol yields, a picture at a time: the question, the truth, and the methods' answers.

What a user knows of pictures, as a CSV file: who is in them, and what breaks tables down.

What a folder of pictures is called: a method's name in tables, from whatever path the user gave.

Other methods' predictions, looked up by case: none may be missing, for a smaller mean is a better one.
"""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.evaluation import folder_name
from facerf_cli.files.images import PHOTO_LIMIT_PX, read_image


@dataclass(frozen=True)
class Case:
    """One picture to be measured.

    `name` is a path without suffix, unique in its run: predictions of other methods are looked up by it.
    `person` is whose face it is: intervals draw persons anew. Facts that are text break the tables down
    ('pose': 'same pose'); numbers go to the list of pictures only.
    """

    name: str
    person: str
    facts: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A case with its pictures, all scene-linear Rec.709 [H, W, 3] of one frame.

    mask [H, W] in 0..1 is where they are compared. `source` is what the methods saw, in its own frame.
    landmarks_px [68, 2] are the truth's, for the face-recognition distance; None leaves that out. `extra`
    holds figures of each method that only the protocol can take ('light_error_deg'). `grey_as_given` says
    how files of other methods are read (`others.py`).
    """

    case: Case
    truth: np.ndarray
    mask: np.ndarray
    predictions: Mapping[str, np.ndarray]  # by method
    source: np.ndarray | None = None
    landmarks_px: np.ndarray | None = None
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by method
    grey_as_given: bool = False


_LARGEST_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Facts:
    """One picture's person ('' where not said) and facts by column."""

    person: str = ""
    values: Mapping[str, str | float] = field(default_factory=dict)


def read_facts(path: Path) -> dict[str, Facts]:
    """Facts by the picture's name, from a CSV with a header: `name`, perhaps `person`, and any other columns.

    A column whose cells are all numbers is one of numbers; empty cells say nothing.
    """
    header, rows = _read_rows(path)
    if "name" not in header:
        raise InputError(f"{path}: no column 'name'; its first line names the columns: name,person,...")
    others = [column for column in header if column not in ("name", "person")]
    numbers = {column for column in others if all(_is_number(row[column]) for row in rows if row[column])}
    found: dict[str, Facts] = {}
    for row in rows:
        if row["name"] in found:
            raise InputError(f"{path}: {row['name']} stands there twice; leave one line")
        values: dict[str, str | float] = {
            column: float(row[column]) if column in numbers else row[column]
            for column in others
            if row[column]
        }
        found[row["name"]] = Facts(row.get("person", ""), values)
    return found


def _read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """The header and the rows, cells stripped."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > _LARGEST_BYTES:
        raise InputError(f"{path}: larger than {_LARGEST_BYTES / 2**20:.0f} MiB; is it a list of pictures?")
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [[cell.strip() for cell in line] for line in csv.reader(stream) if any(line)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not CSV in UTF-8 ({error})") from None
    if not lines:
        raise InputError(f"{path}: empty; its first line names the columns: name,person,...")
    header, *body = lines
    if len(set(header)) < len(header) or not all(header):
        raise InputError(f"{path}: columns without a name, or two of one name: {', '.join(header)}")
    if ragged := [line for line in body if len(line) != len(header)]:
        raise InputError(f"{path}: {len(ragged)} lines have not {len(header)} cells, such as {ragged[0]}")
    return header, [dict(zip(header, line, strict=True)) for line in body]


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


SUFFIXES = (".exr", ".png", ".npy")
_LARGEST_NUMBER_BYTES, _HEADER_BYTES = 8, 1 << 16


@dataclass(frozen=True)
class Others:
    """Folders of predictions FOLDER/CASE.exr, .png or .npy; a folder's name is its method's.

    `grey_as_given`: PNGs hold linear values too, and the mean of the channels is what is compared.
    """

    folders: tuple[Path, ...]
    grey_as_given: bool = False

    def predictions(self, case: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """The case's predictions [H, W, 3] by method, linear Rec.709, each of the truth's shape [H, W, ...].

        Raises InputError that names every one that is missing or unfit, a sentence each.
        """
        found, wrong = {}, []
        for folder in self.folders:
            try:
                found[folder_name(folder)] = _prediction(folder, case, shape, self.grey_as_given)
            except InputError as error:
                wrong.append(str(error))
        if wrong:
            raise InputError("; ".join(wrong))
        return found


def _prediction(folder: Path, case: str, shape: tuple[int, ...], grey_as_given: bool) -> np.ndarray:
    candidates = [folder / f"{case}{suffix}" for suffix in SUFFIXES]
    there = [path for path in candidates if path.is_file()]
    if not there:
        raise InputError(f"{folder}: no prediction for case {case} ({', '.join(SUFFIXES)} looked for)")
    if len(there) > 1:
        raise InputError(f"{folder}: case {case} has {' and '.join(path.name for path in there)}; leave one")
    space = "linear" if grey_as_given else None
    pixels = read_array(there[0]) if there[0].suffix == ".npy" else read_image(there[0], space).pixels
    if grey_as_given:
        pixels = np.repeat(pixels.mean(-1, keepdims=True), 3, -1)
    if pixels.shape[:2] != tuple(shape[:2]):
        have, wanted = (f"{size[1]} x {size[0]}" for size in (pixels.shape, shape))
        raise InputError(
            f"{there[0]}: {have} pixels, the truth has {wanted}; predictions are to have its frame"
        )
    return pixels


def read_array(path: Path) -> np.ndarray:
    """A picture [H, W, 3] float32 from a .npy of numbers [H, W, 3] or [H, W], taken for linear Rec.709."""
    try:
        if path.stat().st_size > PHOTO_LIMIT_PX * 3 * _LARGEST_NUMBER_BYTES + _HEADER_BYTES:
            raise InputError(f"{path}: larger than any picture that is read; is it one picture?")
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may promise more than is there
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not an array of numbers by numpy.save ({error})") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: an array {list(values.shape)}; a picture is [height, width, 3]")
    if values.dtype.kind != "f":
        raise InputError(
            f"{path}: numbers of type {values.dtype}; linear light is floats, and PNG is for bytes"
        )
    image = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: holds values that are NaN or infinite")
    return image
