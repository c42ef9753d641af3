"""Match folders of predictions with a folder of ground truths or cases.

A folder of cases, written by `evaluate cases` and `--pictures`, contains

    cases.csv                       one row per case: name, person and facts (docs/evaluation.md)
    source/NAME.exr                 the methods' input
    truth/NAME.exr, mask/NAME.exr

Any other folder contains only ground truths. NAME is the path below the folder without suffix, so a truth
.exr may have a .png prediction. Every image needs its counterparts, because leaving out failures would
improve a mean.
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
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.read import LinearImage, read_array, read_image
from facerf_cli.files.texts import read_text

CASES, SOURCE, TRUTH, MASK, LIGHT = "cases.csv", "source", "truth", "mask", "light"
SUFFIXES = PHOTO_SUFFIXES | {".npy"}
_MOST_ITEMS = 64
_MOST_NAMES = 3  # in an error
_CSV_ADVICE = "begin with a header such as name,person,..."


@dataclass(frozen=True)
class CaseFiles:
    """Files of a case."""

    case: Case
    truth: Path
    predictions: Mapping[str, Path]  # by method
    mask: Path | None
    source: Path | None


def choose_cases(options: CompareOptions, inputs: Sequence[str]) -> Chosen:
    """Divide the cases of a folder among at most `_MOST_ITEMS` items."""
    cases = match_cases(options)
    size = math.ceil(len(cases) / _MOST_ITEMS)
    parts = [cases[start : start + size] for start in range(0, len(cases), size)]
    return Chosen({options.item(options.truth, f"part-{n:02d}"): part for n, part in enumerate(parts)})


def match_cases(options: CompareOptions) -> list[CaseFiles]:
    """Match the images of folders with their ground truths, sorted by name.

    Raises UsageError for unusable folders, and InputError with a few of the names that do not match.
    """
    root = options.truth
    frozen = (root / CASES).is_file()
    truths, facts = (root / TRUTH, options.facts or root / CASES) if frozen else (root, options.facts)
    mask = root / MASK if frozen and options.masks is None else options.masks
    methods = {method.name: method.path for method in options.methods}
    folders = [truths, *([mask] if mask else []), *methods.values()]
    resolved = [folder.resolve() for folder in folders]
    if repeated := [folder for folder in folders if resolved.count(folder.resolve()) > 1]:
        raise UsageError(f"{repeated[0]}: passed twice; use separate folders for methods, truths and masks")
    images = {folder: _images_in(folder, resolved) for folder in folders}
    described = {} if facts is None else read_facts(facts)
    true = images.pop(truths)
    others: dict[Path, Mapping[str, object]] = {**images, **({} if facts is None else {facts: described})}
    if errors := [text for path, names in others.items() if (text := _mismatch(true, names, path))]:
        raise InputError(f"{'; '.join(errors)}; use the names and subfolders of {truths}, with any suffix")
    return [
        CaseFiles(
            case_of(name, described),
            true[name],
            {method: images[folder][name] for method, folder in methods.items()},
            images[mask][name] if mask else None,
            root / SOURCE / f"{name}.exr" if frozen else None,
        )
        for name in sorted(true)
    ]


def case_of(name: str, described: Mapping[str, Case]) -> Case:
    """Return the case of an image; by default its person is its topmost folder, or '' (unknown)."""
    case = described.get(name, Case(name, ""))
    folder, slash, _ = name.partition("/")
    return replace(case, person=case.person or (folder if slash else ""))


def write_cases(path: Path, cases: Iterable[Case]) -> None:
    """Write cases.csv in the form that `read_facts` reads."""
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


def _images_in(folder: Path, excluded: Collection[Path]) -> dict[str, Path]:
    """Return the images of a folder by name, except hidden files and the contents of `excluded` folders."""
    images: dict[str, Path] = {}
    for here, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f[0] != "." and (Path(here) / f).resolve() not in excluded]
        for file in sorted(files):
            path = Path(here) / file
            if file[0] == "." or path.suffix.lower() not in SUFFIXES:
                continue
            name = path.relative_to(folder).with_suffix("").as_posix()
            if name in images:
                raise InputError(f"{folder}: {name} has the files {images[name].name} and {file}; remove one")
            images[name] = path
    if not images:
        raise UsageError(f"{folder}: no images; use a folder of {' '.join(sorted(SUFFIXES))}")
    return images


def _mismatch(truths: Mapping[str, object], others: Mapping[str, object], where: Path) -> str:
    """Describe names that do not match the truths' names; return '' if all do."""
    missing, unknown = truths.keys() - others.keys(), others.keys() - truths.keys()
    parts = [f"{len(missing)} of {len(truths)} missing ({_first(missing)})"] if missing else []
    parts += [f"{len(unknown)} without a truth ({_first(unknown)})"] if unknown else []
    return f"{where}: {', '.join(parts)}" if parts else ""


def _first(names: Collection[str]) -> str:
    return ", ".join(sorted(names)[:_MOST_NAMES]) + (", ..." if len(names) > _MOST_NAMES else "")


def read_pixels(path: Path, colourspace: str | None = None) -> LinearImage:
    """Read an image. EXR, HDR and .npy are scene-linear; `colourspace` overrides the space of other files."""
    if path.suffix.lower() == ".npy":
        return LinearImage(read_array(path))
    return read_image(path, colourspace)


def read_facts(path: Path) -> dict[str, Case]:
    """Read cases by image name from a CSV with the columns `name`, optionally `person`, and facts.

    A column is numeric if all of its cells are numbers. Empty cells are ignored.
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
    columns = [column for column in header if column not in ("name", "person")]
    numbers = {column for column in columns if all(_is_number(row[column]) for row in rows if row[column])}
    cases: dict[str, Case] = {}
    for row in rows:
        if row["name"] in cases:
            raise InputError(f"{path}: {row['name']} has two lines; remove one")
        facts: dict[str, str | float] = {
            column: float(row[column]) if column in numbers else row[column]
            for column in columns
            if row[column]
        }
        cases[row["name"]] = Case(row["name"], row.get("person", ""), facts)
    return cases


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False
