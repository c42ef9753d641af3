"""The checks of a capture on Extended Yale B: do they find the pictures that are broken without a mark?

    python benchmarks/capture_checks.py ../shared/data/extended_yale_b

Truth is the list of broken pictures in `facerf_cli/capture/yale_b.py`, which the checks never see.
Thresholds were reasoned on subjects 05, 15 and 22 and on synthetic faces, and the others are counted apart;
but they are no blind test. Seen once as a whole, they had 9 of 10 broken pictures found and 15 false alarms,
all of lamps overhead that hair hides: since then an unlit lamp is judged by the places that it reaches best,
and lamps straight above are not judged. What else is found (clipped pictures, heads that move) has no truth
to be held against, and is counted.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.yale_b import UNMARKED_DAMAGE
from facerf_cli.evaluation.protocols.yale_b_cases import SETTINGS_SUBJECTS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="the database, a folder a subject")
    capture = read_capture(parser.parse_args().data, "extended-yale-b")
    begun_s = time.perf_counter()
    found = {subject: check_subject(capture, subject) for subject in capture.subjects}
    seconds = time.perf_counter() - begun_s
    settings = [subject for subject in found if subject in SETTINGS_SUBJECTS]
    others = [subject for subject in found if subject not in SETTINGS_SUBJECTS]
    print(f"{len(found)} subjects in {seconds:.0f} s, {seconds / len(found):.1f} s a subject")
    for name, subjects in (("settings", settings), ("others", others)):
        print(f"{name}: {counted(capture, {subject: found[subject] for subject in subjects})}")
    checks = Counter(finding.check for findings in found.values() for finding in findings)
    print("findings by check:", dict(checks))


def counted(capture: Capture, found: dict[str, list[Finding]]) -> str:
    """How many of the broken pictures are found, and what is found besides, of subjects' findings."""
    truth, said, images = set(), set(), 0
    for subject, findings in found.items():
        there = set(images_of(capture, subject))
        images += len(there)
        truth |= {(subject, flash.name) for flash in UNMARKED_DAMAGE.get(subject, ())} & there
        said |= {(subject, finding.light) for finding in findings if finding.leaves_out} & there
    missed = ", ".join("/".join(place) for place in sorted(truth - said)) or "none"
    false = ", ".join("/".join(place) for place in sorted(said - truth)) or "none"
    stopped = [subject for subject, findings in found.items() if any(map(stops, findings))]
    return (
        f"{len(truth & said)} of {len(truth)} broken pictures found (missed: {missed}); "
        f"{len(said - truth)} false alarms of {images} pictures ({false}); {len(stopped)} subjects stopped"
    )


def stops(finding: Finding) -> bool:
    return finding.severity == "error" and not finding.leaves_out


def images_of(capture: Capture, subject: str) -> Iterable[tuple[str, str]]:
    camera = next(iter(capture.cameras))
    for light in capture.light_ids:
        if capture.frame_path(subject, camera, light).is_file():
            yield subject, light


if __name__ == "__main__":
    main()
