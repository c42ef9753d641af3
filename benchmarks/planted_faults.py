"""Faults planted in a sound capture, one at a time and at several strengths: which do the checks find?

    python benchmarks/planted_faults.py CAPTURE --subjects 2 --untouched 8

CAPTURE has a stage.json, as `facerf synth-stage` writes it. A subject's frames of one camera (of two, where
cameras are swapped) are copied for each fault, the fault is planted and the copy checked. A row a fault and
strength says how many of the frames that it touched are found (or whether the subject is), as what, and how
many findings are of anything else; what is found without any fault is counted first.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from capture_copy import Copy
from capture_faults import FAULTS, Fault

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.layouts import read_capture


@dataclass(frozen=True)
class Outcome:
    """Of one fault on one subject."""

    touched: int  # frames; 0 where the fault is of the subject
    hit: int  # of these, or 1 where the subject's is found
    said: Sequence[Finding]  # the findings that are the fault's
    besides: Sequence[Finding]


def try_fault(fault: Fault, source: Path, subject: str) -> Outcome:
    with tempfile.TemporaryDirectory() as name:
        copy = Copy(source, Path(name), subject, fault.cameras)
        touched = set(fault.plant(copy))
        found = copy.found()
    said = [one for one in found if one.check in fault.checks and (not touched or one.light in touched)]
    besides = [one for one in found if one not in said and not (touched and one.light in touched)]
    hit = len({one.light for one in said}) if touched else bool(said)
    return Outcome(len(touched), hit, said, besides)


def told(findings: Iterable[Finding]) -> str:
    return (
        ", ".join(f"{name} {count}" for name, count in Counter(one.check for one in findings).items()) or "-"
    )


def row_of(fault: Fault, outcomes: Sequence[Outcome]) -> str:
    """A row of the table."""
    said = [finding for outcome in outcomes for finding in outcome.said]
    besides = [finding for outcome in outcomes for finding in outcome.besides]
    wanted = sum(max(outcome.touched, 1) for outcome in outcomes)
    what = ", ".join(sorted({f"{one.check} ({one.severity})" for one in said})) or "-"
    words = said[0].words if said else ""
    hit = sum(outcome.hit for outcome in outcomes)
    return f"| {fault.name} | {fault.strength} | {hit} of {wanted} | {what} | {told(besides)} | {words} |"


def untouched(source: Path, subjects: Sequence[str]) -> None:
    """Print what is found where nothing is planted."""
    begun_s, found = time.perf_counter(), []
    for subject in subjects:
        with tempfile.TemporaryDirectory() as name:
            found += Copy(source, Path(name), subject, 2).found()
    seconds = (time.perf_counter() - begun_s) / max(len(subjects), 1)
    print(f"untouched, {len(subjects)} subjects, two cameras each, {seconds:.1f} s a subject: {told(found)}")
    for finding in found:
        print(f"  {finding.place}: {finding.check}: {finding.words}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("capture", type=Path, help="a sound capture with a stage.json")
    parser.add_argument("--subjects", type=int, default=2, help="that each fault is planted in")
    parser.add_argument("--untouched", type=int, default=8, help="subjects that are checked as they are")
    parser.add_argument("--only", default="", help="faults whose name has this in it")
    given = parser.parse_args()
    subjects = list(read_capture(given.capture).subjects)
    untouched(given.capture, subjects[: given.untouched])
    print("| fault | strength | found | as | besides | words |\n|---|---|---|---|---|---|")
    for fault in FAULTS:
        if given.only in fault.name:
            outcomes = [try_fault(fault, given.capture, subject) for subject in subjects[: given.subjects]]
            print(row_of(fault, outcomes), flush=True)


if __name__ == "__main__":
    main()
