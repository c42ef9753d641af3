"""An item's figures as a file, so that an interrupted evaluation can continue; and all images' as CSV."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import Row
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.regular import require_regular
from facerf_cli.logs import json_line

FORMAT = "facerf-evaluation-2"


@dataclass(frozen=True)
class KeptStrip:
    """A strip (`strips.Strip`) as a JPEG; `file` is relative to the evaluation's folder."""

    case: str
    file: str
    methods: tuple[str, ...]
    ev: float
    scales: tuple[float, ...]
    has_source: bool
    size_px: tuple[int, int]  # width, height


@dataclass(frozen=True)
class ItemFigures:
    """The figures of a finished item: the key of how it was evaluated, its rows and its strips.

    `pictures` are images kept for other methods. Paths are relative to the evaluation's folder.
    """

    key: str
    rows: tuple[Row, ...]
    strips: tuple[KeptStrip, ...]
    pictures: tuple[str, ...]

    @property
    def files(self) -> tuple[str, ...]:
        """All other files that the item wrote."""
        return (*(strip.file for strip in self.strips), *self.pictures)


def write_figures(path: Path, figures: ItemFigures) -> None:
    """Write an item's figures as one line of JSON, atomically; NaN and infinity become null."""
    content = {"format": FORMAT, **asdict(figures)}
    with atomic_path(path) as temporary:
        temporary.write_text(json_line(content) + "\n", encoding="utf-8", errors="backslashreplace")


def read_figures(path: Path) -> ItemFigures:
    """Read an item's figures; null becomes NaN. Raises InputError for any other file."""
    require_regular(path, "give --overwrite always")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"its format is {content['format']!r}")
        rows = tuple(_row(entry) for entry in content["rows"])
        strips = tuple(_strip(entry) for entry in content["strips"])
        return ItemFigures(content["key"], rows, strips, tuple(map(str, content["pictures"])))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(
            f"{path}: no figures of an evaluation ({error}); remove it, or give --overwrite always"
        ) from None


def _row(entry: Mapping[str, Any]) -> Row:
    values = {name: math.nan if value is None else float(value) for name, value in entry["values"].items()}
    facts = entry["facts"].items() if isinstance(entry["facts"], dict) else ()
    if len(facts) != len(entry["facts"]) or not all(isinstance(fact, str | int | float) for _, fact in facts):
        raise ValueError("its facts are not names and values")
    return Row(**{**entry, "values": values})


def _strip(entry: Mapping[str, Any]) -> KeptStrip:
    lists = {name: tuple(entry[name]) for name in ("methods", "scales", "size_px")}
    return KeptStrip(**{**entry, **lists})


def images_csv(rows: Sequence[Row]) -> str:
    """Format a line for each image and method: its names, facts and figures; a missing figure is empty."""
    facts = dict.fromkeys(name for row in rows for name in row.facts)
    values = dict.fromkeys(name for row in rows for name in row.values)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["case", "person", "method", *facts, *values])
    for row in rows:
        figures = [f"{row.values[name]:.9g}" if name in row.values else "" for name in values]
        writer.writerow([row.case, row.person, row.method, *(row.facts.get(n, "") for n in facts), *figures])
    return stream.getvalue()
