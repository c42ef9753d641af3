"""Folders of predictions against a folder of truths, matched by name; any images can be measured.

Trees are mirrored; a name is the path without its suffix, so a truth .exr may have a .png prediction. Every
image of every folder must have its counterparts: without failed ones a mean improves.
"""

import csv
import io
import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tokenize import TokenError

import numpy as np

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.options import Chosen, EvaluateOptions, folder_name
from facerf_cli.files.read import PHOTO_LIMIT_PX, LinearImage, read_image
from facerf_cli.files.texts import read_text, require_regular
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import find_faces

SUFFIXES = PHOTO_SUFFIXES | {".npy"}
_PARTS = 64  # most items
_NAMED_AT_MOST = 3  # names of files in an error
_LARGEST_BYTES = 64 * 2**20  # of a CSV file
_CSV_ADVICE = "begin with a header such as name,person,..."
PREDICTION_SUFFIXES = (".exr", ".png", ".npy")  # of `--compare`
_LARGEST_NUMBER_BYTES, _HEADER_BYTES = 8, 1 << 16  # limits of a .npy file


@dataclass(frozen=True)
class ImagePair:
    """The files of a case's truth, of its predictions by method, and of its mask."""

    case: Case
    truth: Path
    predictions: Mapping[str, Path]
    mask: Path | None


def choose_images(options: EvaluateOptions, inputs: Sequence[str]) -> Chosen:
    """Choose all images of folders of predictions, with their truths, in parts."""
    assert options.truth is not None
    pairs = collect_pairs(options.predictions, options.truth, options.masks, options.facts)
    size = math.ceil(len(pairs) / _PARTS)
    parts = [pairs[start : start + size] for start in range(0, len(pairs), size)]
    return Chosen({options.item(options.truth, f"part-{n:02d}"): part for n, part in enumerate(parts)})


def collect_pairs(
    predictions: Sequence[Path], truths: Path, masks: Path | None = None, facts: Path | None = None
) -> list[ImagePair]:
    """Match the images of folders, sorted by name; a folder of predictions is a method with its name.

    `masks` mirrors the truths; `facts` is a CSV file (`read_facts`). Raises UsageError for folders that
    cannot be used, InputError for names that do not match: it names the first few and counts all.
    """
    folders = [truths, *predictions, *([] if masks is None else [masks])]
    if not predictions:
        raise UsageError("pairs: no folder of predictions; give at least one")
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; check the path")
    resolved = [folder.resolve() for folder in folders]
    if again := [folder for folder in folders if resolved.count(folder.resolve()) > 1]:
        raise UsageError(f"{again[0]}: given twice; give separate folders of predictions, truths and masks")
    images = {folder: _images_in(folder, resolved) for folder in folders}
    described = {} if facts is None else read_facts(facts)
    found = images.pop(truths)
    others: dict[Path, Mapping[str, object]] = {**images, **({} if facts is None else {facts: described})}
    if wrong := [words for place, names in others.items() if (words := _mismatch(found, names, place))]:
        raise InputError(
            f"{'; '.join(wrong)}; give the names of {truths}, with its subfolders; suffixes may differ"
        )
    return [
        ImagePair(
            case_of(name, described),
            found[name],
            {folder_name(folder): images[folder][name] for folder in predictions},
            images[masks][name] if masks else None,
        )
        for name in sorted(found)
    ]


def case_of(name: str, described: Mapping[str, Case]) -> Case:
    """The case of an image; its person is the described one, else its topmost folder, else '': not known."""
    known = described.get(name, Case(name, ""))
    folder, slash, _ = name.partition("/")
    return replace(known, person=known.person or (folder if slash else ""))


def compare_pair(pair: ImagePair, finder: PeopleNetworks | None = None) -> Comparison:
    """Read a pair. EXR, HDR and .npy are scene-linear, other images are decoded by their colour space.

    The mask is the mask's image (its values as they are, the mean of its channels), else the truth's alpha,
    else everything. `finder` detects the truth's face, for Face dis, and raises InputError where
    there is none.
    """
    truth = _read(pair.truth)
    mask = truth.alpha
    if pair.mask is not None:
        mask = _read(pair.mask, "linear").pixels.mean(-1).clip(0, 1)
    if mask is None:
        mask = np.ones(truth.pixels.shape[:2], np.float32)
    landmarks_px = find_faces(finder, truth.pixels, str(pair.truth))[0].landmarks_px if finder else None
    predictions = {method: _read(path).pixels for method, path in pair.predictions.items()}
    return Comparison(pair.case, truth.pixels, mask, predictions, landmarks_px=landmarks_px)


def _images_in(folder: Path, elsewhere: Collection[Path]) -> dict[str, Path]:
    """The images of a folder by name, without hidden ones and without those of the folders `elsewhere`."""
    found: dict[str, Path] = {}
    for here, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f[0] != "." and (Path(here) / f).resolve() not in elsewhere]
        for file in sorted(files):
            path = Path(here) / file
            if file[0] == "." or path.suffix.lower() not in SUFFIXES:
                continue
            name = path.relative_to(folder).with_suffix("").as_posix()
            if name in found:
                raise InputError(f"{folder}: {name} has the files {found[name].name} and {file}; remove one")
            found[name] = path
    if not found:
        raise UsageError(f"{folder}: no images; give a folder of {' '.join(sorted(SUFFIXES))}")
    return found


def _mismatch(truths: Mapping[str, Path], others: Mapping[str, object], where: Path) -> str:
    """Describe names that do not match the truths'; empty if all do."""
    missing, strangers = sorted(truths.keys() - others.keys()), sorted(others.keys() - truths.keys())
    parts = [f"{len(missing)} of {len(truths)} missing ({_few(missing)})"] if missing else []
    parts += [f"{len(strangers)} without a truth ({_few(strangers)})"] if strangers else []
    return f"{where}: {', '.join(parts)}" if parts else ""


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED_AT_MOST]) + (", ..." if len(names) > _NAMED_AT_MOST else "")


def _read(path: Path, colourspace: str | None = None) -> LinearImage:
    if path.suffix.lower() == ".npy":
        return LinearImage(read_array(path))
    return read_image(path, colourspace)


def read_facts(path: Path) -> dict[str, Case]:
    """Read cases by the image's name from a CSV with a header: `name`, optionally `person`, other columns.

    A column whose cells are all numbers holds numbers; an empty cell is no fact.
    """
    try:
        text = read_text(path, _LARGEST_BYTES, _CSV_ADVICE)
        lines = [[cell.strip() for cell in line] for line in csv.reader(io.StringIO(text)) if any(line)]
    except csv.Error as error:
        raise InputError(f"{path}: not CSV ({error}); save it in that format") from None
    header = lines[0] if lines else []
    if "name" not in header or len(set(header)) < len(header) or not all(header):
        raise InputError(f"{path}: no column 'name', or two columns of one name; {_CSV_ADVICE}")
    if ragged := [line for line in lines if len(line) != len(header)]:
        raise InputError(
            f"{path}: {len(ragged)} lines do not have {len(header)} cells; correct {','.join(ragged[0])}"
        )
    rows = [dict(zip(header, line, strict=True)) for line in lines[1:]]
    others = [column for column in header if column not in ("name", "person")]
    numbers = {column for column in others if all(_is_number(row[column]) for row in rows if row[column])}
    found: dict[str, Case] = {}
    for row in rows:
        if row["name"] in found:
            raise InputError(f"{path}: {row['name']} has two lines; remove one")
        values: dict[str, str | float] = {
            column: float(row[column]) if column in numbers else row[column]
            for column in others
            if row[column]
        }
        found[row["name"]] = Case(row["name"], row.get("person", ""), values)
    return found


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def read_predictions(
    folders: Sequence[Path], case: str, shape: tuple[int, ...], grey_as_given: bool = False
) -> dict[str, np.ndarray]:
    """Read a case's predictions FOLDER/CASE.exr, .png or .npy by method, which is the folder's name.

    They are linear Rec.709 [H, W, 3] of the truth's `shape`. With `grey_as_given` PNGs are read as linear
    values, too, and the mean of the channels is compared. Raises InputError that lists all that are missing
    or unfit: without its failures a method's mean improves.
    """
    found, wrong = {}, []
    for folder in folders:
        try:
            found[folder_name(folder)] = _prediction(folder, case, shape, grey_as_given)
        except InputError as error:
            wrong.append(str(error))
    if wrong:
        raise InputError("; ".join(wrong))
    return found


def _prediction(folder: Path, case: str, shape: tuple[int, ...], grey_as_given: bool) -> np.ndarray:
    there = [path for suffix in PREDICTION_SUFFIXES if (path := folder / f"{case}{suffix}").is_file()]
    if not there:
        raise InputError(
            f"{folder}: no prediction for case {case}; add it as {', '.join(PREDICTION_SUFFIXES)}"
        )
    if len(there) > 1:
        names = " and ".join(path.name for path in there)
        raise InputError(f"{folder}: case {case} has the files {names}; remove all but one")
    pixels = _read(there[0], "linear" if grey_as_given else None).pixels
    if grey_as_given:
        pixels = np.repeat(pixels.mean(-1, keepdims=True), 3, -1)
    if pixels.shape[:2] != tuple(shape[:2]):
        have, wanted = (f"{size[1]} x {size[0]}" for size in (pixels.shape, shape))
        raise InputError(f"{there[0]}: {have} pixels, the truth has {wanted}; give an image in its frame")
    return pixels


def read_array(path: Path) -> np.ndarray:
    """Read an image [H, W, 3] float32 from a .npy of floats [H, W, 3] or [H, W], taken as linear Rec.709."""
    require_regular(path, "give an image as .npy")
    try:
        if path.stat().st_size > PHOTO_LIMIT_PX * 3 * _LARGEST_NUMBER_BYTES + _HEADER_BYTES:
            raise InputError(f"{path}: larger than any image that is read; give one image in a file")
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may promise more than there is
    except (OSError, ValueError, EOFError, SyntaxError, TokenError, OverflowError, TypeError) as error:
        raise InputError(f"{path}: not an array of numbers ({error}); write one by numpy.save") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: an array of shape {list(values.shape)}; give [height, width, 3]")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: values of type {values.dtype}; give floats of linear light, or a PNG")
    image = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: holds values that are NaN or infinite; give finite ones")
    return image
