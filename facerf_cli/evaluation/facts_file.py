"""What a user knows of pictures, as a CSV file: who is in them, and what breaks tables down."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facerf_cli.errors import InputError

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
