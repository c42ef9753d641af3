"""What a run leaves in a folder."""

import hashlib
import json
from pathlib import Path


def tree(folder: Path) -> dict[str, str]:
    """Every file but the reports and indexes, which hold times, by the digest of its bytes."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(("report", ".facerf-index"))
    }


def rows(folder: Path, report: str = "report.jsonl") -> dict[str, dict]:
    """The rows of a report by item, one each."""
    found = [json.loads(row) for row in (folder / report).read_text().split("\n") if row]
    table = {row["item"]: row for row in found}
    assert len(table) == len(found), "an item has two rows"
    return table
