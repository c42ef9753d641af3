"""Folders of images that are measured: the truths of cases, and a folder of images for each method.

A folder of cases, as `evaluate cases` and `--pictures` write it, has

    cases.csv         a row a case: name, person, and facts (docs/evaluation.md)
    source/NAME.exr   the image that methods are given
    truth/NAME.exr, mask/NAME.exr

Any other folder holds the truths themselves. Trees are mirrored; a name is the path without its suffix, so a
truth .exr may have a .png prediction. Every image must have its counterparts: without failed ones a mean
improves.
"""

import csv
import io
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facerf_cli.batch.inputs import PHOTO_SUFFIXES
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Case
from facerf_cli.evaluation.options import Chosen, CompareOptions
from facerf_cli.files.arrays import read_array
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.read import LinearImage, read_image
from facerf_cli.files.texts import read_text

CASES, SOURCE, TRUTH, MASK, LIGHT = "cases.csv", "source", "truth", "mask", "light"
SUFFIXES = PHOTO_SUFFIXES | {".npy"}
_PARTS = 64  # most items
_NAMED_AT_MOST = 3  # names of files in an error
_CSV_ADVICE = "begin with a header such as name,person,..."


@dataclass(frozen=True)
class CaseFiles:
    """The files of a case: its truth, the predictions by method, the mask, and what methods are given."""

    case: Case
    truth: Path
    predictions: Mapping[str, Path]
    mask: Path | None
    source: Path | None


def choose_cases(options: CompareOptions, inputs: Sequence[str]) -> Chosen:
    """Choose all cases of a folder with the images of each method, in parts."""
    cases = match_cases(options)
    size = math.ceil(len(cases) / _PARTS)
    parts = [cases[start : start + size] for start in range(0, len(cases), size)]
    return Chosen({options.item(options.truth, f"part-{n:02d}"): part for n, part in enumerate(parts)})


def match_cases(options: CompareOptions) -> list[CaseFiles]:
    """Match the images of folders with their truths, sorted by name.

    Raises UsageError for folders that cannot be used, InputError for names that do not match: it names the
    first few and counts all.
    """
    root = options.truth
    frozen = (root / CASES).is_file()
    truths, facts = (root / TRUTH, options.facts or root / CASES) if frozen else (root, options.facts)
    mask = root / MASK if frozen and options.masks is None else options.masks
    methods = {one.name: one.path for one in options.methods}
    given = [truths, *([mask] if mask else []), *methods.values()]
    resolved = [folder.resolve() for folder in given]
    if again := [folder for folder in given if resolved.count(folder.resolve()) > 1]:
        raise UsageError(f"{again[0]}: given twice; give separate folders of methods, truths and masks")
    images = {folder: _images_in(folder, resolved) for folder in given}
    described = {} if facts is None else read_facts(facts)
    found = images.pop(truths)
    others: dict[Path, Mapping[str, object]] = {**images, **({} if facts is None else {facts: described})}
    if wrong := [words for place, names in others.items() if (words := _mismatch(found, names, place))]:
        raise InputError(
            f"{'; '.join(wrong)}; give the names of {truths}, with its subfolders; suffixes may differ"
        )
    return [
        CaseFiles(
            case_of(name, described),
            found[name],
            {method: images[folder][name] for method, folder in methods.items()},
            images[mask][name] if mask else None,
            root / SOURCE / f"{name}.exr" if frozen else None,
        )
        for name in sorted(found)
    ]


def case_of(name: str, described: Mapping[str, Case]) -> Case:
    """The case of an image; its person is the described one, else its topmost folder, else '': not known."""
    known = described.get(name, Case(name, ""))
    folder, slash, _ = name.partition("/")
    return replace(known, person=known.person or (folder if slash else ""))


def write_cases(path: Path, cases: Iterable[Case]) -> None:
    """Write the list of a folder of cases, as `read_facts` reads it."""
    rows = {
        case.name: {"name": case.name, "person": case.person}
        | {fact: value if isinstance(value, str) else f"{value:.7g}" for fact, value in case.facts.items()}
        for case in cases
    }
    stream = io.StringIO()
    columns = dict.fromkeys(column for row in rows.values() for column in row)
    writer = csv.DictWriter(stream, list(columns), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows.values())
    with atomic_path(path) as temporary:
        temporary.write_text(stream.getvalue(), encoding="utf-8", errors="backslashreplace")


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


def _mismatch(truths: Mapping[str, object], others: Mapping[str, object], where: Path) -> str:
    """Describe names that do not match the truths'; empty if all do."""
    missing, strangers = sorted(truths.keys() - others.keys()), sorted(others.keys() - truths.keys())
    parts = [f"{len(missing)} of {len(truths)} missing ({_few(missing)})"] if missing else []
    parts += [f"{len(strangers)} without a truth ({_few(strangers)})"] if strangers else []
    return f"{where}: {', '.join(parts)}" if parts else ""


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED_AT_MOST]) + (", ..." if len(names) > _NAMED_AT_MOST else "")


def read_pixels(path: Path, colourspace: str | None = None) -> LinearImage:
    """Read an image. EXR, HDR and .npy are scene-linear, others are decoded by their own or a given space."""
    if path.suffix.lower() == ".npy":
        return LinearImage(read_array(path))
    return read_image(path, colourspace)


def read_facts(path: Path) -> dict[str, Case]:
    """Read cases by the image's name from a CSV with a header: `name`, optionally `person`, other columns.

    A column whose cells are all numbers holds numbers; an empty cell is no fact.
    """
    try:
        text = read_text(path, _CSV_ADVICE)
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
