"""Damaged inputs at every door: how many are refused in a clean line, accepted, uncaught, crash or hang.

    python -m benchmarks.faults.inputs --cases 200000 --seed 1 --findings DIR [--door images]

The same seed gives the same cases. A case runs in a child process with limits of memory and time
(`children.py`); its file is a sound sample with faults of bytes or structure (`mutations.py`). Of each kind
of finding the first file is kept, and made smaller while it still fails alike. Exits 1 if anything was
uncaught, crashed or hung.
"""

import os
import re
import sys
import time
from collections import Counter
from pathlib import Path

from benchmarks._common import arguments
from benchmarks.faults.children import Ended, damaged, lay_out, outcome_of, run_door
from benchmarks.faults.doors import DOORS, Door

_SLOW_S = 2.0
_ROUNDS = 300  # attempts at making a finding smaller


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--cases", type=int, default=20_000, help="of all doors together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--door", action="append", choices=sorted(DOORS), help="these only; may be repeated")
    parser.add_argument("--findings", type=Path, help="folder for files that were uncaught, crashed or hung")
    given = parser.parse_args()
    names = given.door or list(DOORS)
    total = sum(door.weight for door in DOORS.values())  # so that a door alone has the same cases
    print("| door | cases | refused | accepted | uncaught | crashes | hangs | slow | worst MiB | minutes |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    sums: Counter[str] = Counter()
    begin = time.monotonic()
    for name in names:
        cases = max(1, round(given.cases * DOORS[name].weight / total))
        sums += _table_row(name, given.seed, cases, given.findings)
    figures = " | ".join(
        str(sums[key]) for key in ("cases", "refused", "accepted", "uncaught", "crash", "hang")
    )
    minutes = (time.monotonic() - begin) / 60
    print(f"| all | {figures} | {sums['slow']} | | {minutes:.1f} |", flush=True)
    sys.exit(int(sums["uncaught"] + sums["crash"] + sums["hang"] > 0))


def _table_row(name: str, seed: int, cases: int, findings: Path | None) -> Counter[str]:
    """Run a door's cases, print their row, and keep what was found."""
    counts: Counter[str] = Counter()
    kinds: dict[str, Ended] = {}
    worst_mib, begin = 0.0, time.monotonic()
    for ended in run_door(name, seed, range(cases)):
        counts[ended.outcome] += 1
        counts["slow"] += ended.seconds > _SLOW_S
        worst_mib = max(worst_mib, ended.grown_mib)
        if ended.outcome in ("uncaught", "crash", "hang"):
            kind = f"{ended.outcome} {ended.said.split(': ')[0]}"
            counts[f"of kind {kind}"] += 1
            kinds.setdefault(kind, ended)
    figures = " | ".join(
        str(counts[key]) for key in ("refused", "accepted", "uncaught", "crash", "hang", "slow")
    )
    minutes = (time.monotonic() - begin) / 60
    print(f"| {name} | {cases} | {figures} | {worst_mib:.0f} | {minutes:.1f} |", flush=True)
    for kind, ended in kinds.items():
        print(f"  {name} {ended.number}: {kind} ({counts[f'of kind {kind}']}): {ended.said}", file=sys.stderr)
        if findings:
            _keep(findings, name, seed, kind, ended)
    counts["cases"] = cases
    return Counter({key: value for key, value in counts.items() if not key.startswith("of kind")})


def _keep(folder: Path, name: str, seed: int, kind: str, ended: Ended) -> None:
    """Write a finding's file, smaller where it can be and is safe to try: not of crashes and hangs."""
    door = DOORS[name]
    file, content = damaged(door, name, seed, ended.number)
    place = folder / re.sub(r"\W+", "_", name) / re.sub(r"\W+", "_", kind)[:60]
    place.mkdir(parents=True, exist_ok=True)
    if ended.outcome == "uncaught" and "Memory" not in kind:
        content = _smaller(door, place / file, content, ended.said.split(": ")[0])
    lay_out(door, place / file, content)


def _smaller(door: Door, path: Path, content: bytes, kind: str) -> bytes:
    """Leave out parts while the file fails alike: halves, quarters and so on."""

    def fails(attempt: bytes) -> bool:
        lay_out(door, path, attempt)
        return outcome_of(door, path)[1].split(": ")[0] == kind

    step, attempts = len(content) // 2, 0
    while step and attempts < _ROUNDS:
        at = 0
        while at < len(content) and attempts < _ROUNDS:
            attempts += 1
            shorter = content[:at] + content[at + step :]
            if fails(shorter):
                content = shorter
            else:
                at += step
        step //= 2
    return content


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
