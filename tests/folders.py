"""What a run leaves in a folder."""

import hashlib
import json
from pathlib import Path


def tree(folder: Path) -> dict[str, str]:
    """Every file but reports and journals, which hold times, by the digest of its bytes."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(("report", ".facerf"))
    }


def rows(folder: Path, journal: str = ".facerf.jsonl") -> dict[str, dict]:
    """The last row of each item in a journal or a report."""
    found = [json.loads(row) for row in (folder / journal).read_text().split("\n") if row]
    return {row["item"]: row for row in found if "status" in row}


def only_row(folder: Path, journal: str = ".facerf.jsonl") -> dict:
    """The row of the one item."""
    (row,) = rows(folder, journal).values()
    return row
