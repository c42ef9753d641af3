"""Faults planted in a sound capture, one at a time and at several strengths: which do the checks find?

    python benchmarks/planted_faults.py CAPTURE --subjects 2 --untouched 8

CAPTURE has a stage.json, as `facerf synth-stage` writes it. A subject's frames of one camera (of two, where
cameras are swapped) are copied for each fault, the fault is planted and the copy checked. A row a fault and
strength says how many of the frames that it touched are found (or whether the subject is), as what, and how
many findings are of anything else; what is found without any fault is counted first.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from scipy import ndimage

from facerf_cli.files.images import read_image
from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.subject import check_subject
from facerf_cli.stage.data.layouts import read_capture
from facerf_cli.stage.data.stage_file import STAGE_FILE

_IN_FRONT = 0.7  # cosine to the first camera's axis of the lamps whose frames are touched


class Copy:
    """A subject's frames of some cameras, copied, with their description; what is planted is planted here."""

    def __init__(self, source: Path, folder: Path, subject: str, cameras: int) -> None:
        text = json.loads((source / STAGE_FILE).read_text())
        text |= {"cameras": text["cameras"][:cameras], "subjects": {subject: {}}}
        self.folder, self.subject = folder, subject
        self.description: dict[str, Any] = text
        self.cameras = [camera["id"] for camera in text["cameras"]]
        self.ids = [light["id"] for light in text["lights"]]
        self.save()
        capture = read_capture(source)
        self._at = capture.frame_path
        turn = capture.cameras[self.cameras[0]].rotation.numpy()
        self.directions = capture.directions_world @ turn.T  # [L, 3], of the first camera
        for camera in self.cameras:
            for light in self.ids:
                to = self.path(light, camera)
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self._at(subject, camera, light), to)

    def save(self) -> None:
        """Write the description as it is now."""
        (self.folder / STAGE_FILE).write_text(json.dumps(self.description))

    def path(self, light: str, camera: str = "") -> Path:
        """A frame of the copy, of the first camera if none is named."""
        pattern: str = self.description["pattern"]
        names = {"subject": self.subject, "camera": camera or self.cameras[0], "light": light}
        return self.folder / pattern.format(**names)

    def read(self, light: str) -> np.ndarray:
        """A frame of the first camera [H, W, 3] as it was before anything was planted."""
        return read_image(self._at(self.subject, self.cameras[0], light), "linear").pixels

    def write(self, light: str, pixels: np.ndarray) -> None:
        """As a half float EXR, with whatever is in it; `write_exr` would refuse NaN."""
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
        buffer.set_write_format("half")
        buffer.write(str(self.path(light)))

    def front(self) -> list[str]:
        """Lights in front of the first camera, the most frontal first."""
        order = np.argsort(-self.directions[:, 2])
        return [self.ids[row] for row in order if self.directions[row, 2] > _IN_FRONT]

    def far(self, light: str) -> str:
        """The light in front that is furthest from another."""
        rows = [self.ids.index(other) for other in self.front()]
        return self.ids[
            min(rows, key=lambda row: self.directions[row] @ self.directions[self.ids.index(light)])
        ]

    def near(self, light: str) -> str:
        """The light nearest to another."""
        cosines = self.directions @ self.directions[self.ids.index(light)]
        return self.ids[int(np.argsort(-cosines)[1])]

    def found(self) -> list[Finding]:
        """What the checks say of the copy."""
        self.save()
        return check_subject(read_capture(self.folder), self.subject)


@dataclass(frozen=True)
class Fault:
    """What is planted, which gives the lights whose frames it touches: none if it is of the whole subject."""

    name: str
    strength: str
    checks: tuple[str, ...]  # under which it may be found
    plant: Callable[[Copy], Sequence[str]]
    cameras: int = 1


def one(change: Callable[[np.ndarray], np.ndarray], place: int = 3) -> Callable[[Copy], Sequence[str]]:
    """The frame of one light in front is changed."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[place]
        copy.write(light, change(copy.read(light)))
        return [light]

    return plant


def every(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Copy], Sequence[str]]:
    """All frames are changed."""

    def plant(copy: Copy) -> list[str]:
        for light in copy.ids:
            copy.write(light, change(copy.read(light)))
        return []

    return plant


def missing(copy: Copy) -> list[str]:
    light = copy.front()[3]
    copy.path(light).unlink()
    return [light]


def extra(copy: Copy) -> list[str]:
    copy.write("L900", copy.read(copy.front()[3]) * 0.9)
    return []


def truncated(share: float) -> Callable[[Copy], Sequence[str]]:
    def plant(copy: Copy) -> list[str]:
        path = copy.path(light := copy.front()[3])
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        return [light]

    return plant


def duplicate(copy: Copy) -> list[str]:
    light = copy.front()[3]
    shutil.copyfile(copy.path(copy.far(light)), copy.path(light))
    return [light]


def nans(share: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(pixels: np.ndarray) -> np.ndarray:
        spoiled = np.random.default_rng(0).random(pixels.shape[:2]) < share
        return np.where(spoiled[..., None], np.float32(np.nan), pixels)

    return change


def swapped(apart: str) -> Callable[[Copy], Sequence[str]]:
    """The frames of two lights under each other's names."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[3]
        other = {"near": copy.near, "far": copy.far}[apart](light)
        first, second = copy.read(light), copy.read(other)
        copy.write(light, second)
        copy.write(other, first)
        return [light, other]

    return plant


def rolled(copy: Copy) -> list[str]:
    """Each frame under the name of the next light."""
    lights = copy.description["lights"]
    directions = [light["direction"] for light in lights]
    for light, direction in zip(lights, [*directions[1:], directions[0]], strict=True):
        light["direction"] = direction
    return []


def rig(matrix: np.ndarray) -> Callable[[Copy], Sequence[str]]:
    def plant(copy: Copy) -> list[str]:
        for light in copy.description["lights"]:
            light["direction"] = (matrix @ np.array(light["direction"])).tolist()
        return []

    return plant


def about_y(angle_deg: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def cameras_swapped(copy: Copy) -> list[str]:
    first, second = (copy.path("", camera).parent for camera in (copy.cameras[0], copy.cameras[-1]))
    aside = first.with_name("aside")
    for old, new in ((first, aside), (second, first), (aside, second)):
        old.rename(new)
    return []


def woven(other: str) -> Callable[[Copy], Sequence[str]]:
    """Even rows of a frame are those of another light."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[3]
        pixels = copy.read(light)
        pixels[::2] = copy.read({"near": copy.near, "far": copy.far}[other](light))[::2]
        copy.write(light, pixels)
        return [light]

    return plant


def with_full(exponent: float) -> Callable[[Copy], Sequence[str]]:
    """A frame of all lamps beside the others, all of them encoded."""

    def plant(copy: Copy) -> Sequence[str]:
        copy.write("full", sum(copy.read(light) for light in copy.ids) ** (1 / exponent))
        return every(encoded(exponent))(copy)

    return plant


def encoded(exponent: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pixels: np.maximum(pixels, 0) ** (1 / exponent)


def clipped(share: float) -> Callable[[Copy], Sequence[str]]:
    """Cut off where the most frontal frame has a share of its pixels above."""

    def plant(copy: Copy) -> Sequence[str]:
        ceiling = np.quantile(copy.read(copy.front()[0]).max(-1), 1 - share)
        return every(lambda pixels: np.minimum(pixels, np.float32(ceiling)))(copy)

    return plant


def moved(by_px: float) -> Callable[[Copy], Sequence[str]]:
    """A third of the frames, moved in several directions."""

    def plant(copy: Copy) -> list[str]:
        for place, light in enumerate(copy.ids[::3]):
            angle = 2.4 * place
            shift = (by_px * np.sin(angle), by_px * np.cos(angle), 0)
            copy.write(light, ndimage.shift(copy.read(light), shift, order=3, mode="nearest"))
        return []

    return plant


MIRROR = np.diag([-1.0, 1, 1])
FAULTS = (
    Fault("missing frame", "1", ("missing",), missing),
    Fault("extra frame", "1", ("extra",), extra),
    Fault("wrong resolution", "half", ("resolution",), one(lambda pixels: pixels[::2, ::2])),
    Fault("file cut short", "at 5 %", ("unreadable",), truncated(0.05)),
    Fault("file cut short", "at 95 %", ("unreadable",), truncated(0.95)),
    Fault("NaN", "1 pixel in 1000", ("not finite",), one(nans(0.001))),
    Fault("NaN", "1 pixel in 10", ("not finite",), one(nans(0.1))),
    Fault("NaN", "all", ("not finite", "black"), one(nans(1.0))),
    Fault("black frame", "1", ("black",), one(np.zeros_like)),
    Fault("duplicate frame", "1", ("duplicate",), duplicate),
    Fault("clipped", "0.5 % of a frame", ("clipped",), clipped(0.005)),
    Fault("clipped", "2 %", ("clipped",), clipped(0.02)),
    Fault("clipped", "10 %", ("clipped",), clipped(0.1)),
    Fault("lamp dim", "at 50 %", ("unlit",), one(lambda pixels: pixels * 0.5)),
    Fault("lamp dim", "at 20 %", ("unlit",), one(lambda pixels: pixels * 0.2)),
    Fault("lamp did not fire", "at 2 %", ("unlit", "black"), one(lambda pixels: pixels * 0.02)),
    Fault("two swapped", "neighbours", ("order",), swapped("near")),
    Fault("two swapped", "far apart", ("order",), swapped("far")),
    Fault("all shifted by one", "", ("order", "rig"), rolled),
    Fault("rig mirrored", "", ("rig",), rig(MIRROR)),
    Fault("rig turned", "10 degrees", ("rig",), rig(about_y(10))),
    Fault("rig turned", "25 degrees", ("rig",), rig(about_y(25))),
    Fault("rig turned", "45 degrees", ("rig",), rig(about_y(45))),
    Fault("cameras swapped", "2 of 2", ("camera", "rig"), cameras_swapped, 2),
    Fault("cameras swapped", "2 of 3", ("camera", "rig"), cameras_swapped, 3),
    Fault("two fields", "of neighbours", ("fields",), woven("near")),
    Fault("two fields", "of lamps far apart", ("fields",), woven("far")),
    Fault("gamma", "1.4", ("gamma",), every(encoded(1.4))),
    Fault("gamma", "1.8", ("gamma",), every(encoded(1.8))),
    Fault("gamma", "2.2", ("gamma",), every(encoded(2.2))),
    Fault("gamma, with a full-on frame", "1.2", ("gamma",), with_full(1.2)),
    Fault("head moves in a third", "1 px", ("motion",), moved(1)),
    Fault("head moves in a third", "2 px", ("motion",), moved(2)),
    Fault("head moves in a third", "3 px", ("motion",), moved(3)),
    Fault("head moves in a third", "4 px", ("motion",), moved(4)),
)


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
