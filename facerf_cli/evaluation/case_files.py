"""An item's figures as a file, so that an interrupted evaluation can continue; and all images' as CSV."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict

from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import Row
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import Document, read_document
from facerf_cli.logs import json_line

Format = Literal["facerf-evaluation-2"]
FORMAT: Format = "facerf-evaluation-2"


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


def _with_nan(row: Any) -> Any:
    """A row whose figures are null where they are NaN."""
    if isinstance(row, dict) and isinstance(values := row.get("values"), dict):
        return row | {"values": {name: math.nan if v is None else v for name, v in values.items()}}
    return row


class _FiguresDocument(Document):
    model_config = ConfigDict(strict=False)  # lists become tuples

    format: Format
    key: str
    rows: tuple[Annotated[Row, BeforeValidator(_with_nan)], ...]
    strips: tuple[KeptStrip, ...]
    pictures: tuple[str, ...]


def read_figures(path: Path) -> ItemFigures:
    """Read an item's figures; null becomes NaN. Raises InputError for any other file."""
    advice = "no figures of an evaluation; remove it, or give --overwrite always"
    try:
        content = read_document(path, _FiguresDocument, advice)
    except InputError as error:
        raise InputError(str(error) if advice in str(error) else f"{error}; {advice}") from None
    return ItemFigures(content.key, content.rows, content.strips, content.pictures)


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
