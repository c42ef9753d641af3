"""The findings of a capture's checks as people read them: a table, like findings put together."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.records import STDERR, counted, one_line

_ALIKE = 3  # findings of one check in a camera that are shown; the rest are counted
_STYLES = {"error": "red", "warning": "yellow"}
_PLAIN_WIDTH = 160  # of a log file, which has no width of its own

Row = Mapping[str, Any]  # as `Finding.row` makes it


def show_findings(rows: Sequence[Row], strict: bool = False, console: Console = STDERR) -> None:
    """Print the rows as a table, if there are any; findings.jsonl has all of them, here like ones are cut.

    With `strict` each of them stops its subject.
    """
    if strict:
        rows = [{**row, "severity": "error", "leaves_out": False} for row in rows]
    if rows:
        wide = console if console.is_terminal else Console(file=console.file, width=_PLAIN_WIDTH)
        wide.print(findings_table(rows))


def findings_table(rows: Sequence[Row]) -> Table:
    """Errors first, then by subject; of many alike the first few, and how many more."""
    table = Table(title=summary(rows), title_justify="left", title_style="bold", expand=False)
    for name in ("where", "check", "what follows"):
        table.add_column(name, no_wrap=name != "what follows", overflow="fold")
    table.add_column("finding", overflow="fold")
    for row, more in _shortened(rows):
        words = one_line(str(row["words"])) + (f" (and {more} more like it)" if more else "")
        where = "/".join(str(row[key]) for key in ("subject", "camera", "light") if row.get(key))
        style = _STYLES.get(str(row["severity"]), "")
        table.add_row(Text(where), Text(str(row["check"])), Text(follows(row), style), Text(words))
    return table


def follows(row: Row) -> str:
    """What a finding means for the subject."""
    if row["leaves_out"]:
        return "frame left out"
    return "subject stopped" if row["severity"] == "error" else "warning"


def summary(rows: Sequence[Row]) -> str:
    """One line over the table."""
    subjects = len({row["subject"] for row in rows})
    kinds = [follows(row) for row in rows]
    counts = ((kinds.count(kind), kind) for kind in ("subject stopped", "frame left out", "warning"))
    words = ", ".join(f"{count} x {kind}" for count, kind in counts if count)
    return f"Findings about {counted(subjects, 'subject')}: {words}"


def _shortened(rows: Sequence[Row]) -> Iterator[tuple[Row, int]]:
    """The first few rows of each check in a camera, the last of them with how many were left away."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (follows(row) == "warning", row["leaves_out"], row["subject"], row.get("camera"), row["check"])
        groups.setdefault((*key[:3], key[3] or "", key[4]), []).append(row)
    for key in sorted(groups):
        group = groups[key]
        for place, row in enumerate(group[:_ALIKE], start=1):
            yield row, len(group) - _ALIKE if place == _ALIKE else 0
