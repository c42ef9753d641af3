"""Faults planted in a sound capture, one at a time: which do the checks find?

    facerf synth-stage -o CAPTURE --subjects 8
    python benchmarks/capture_faults.py --capture CAPTURE [--subjects 2] [--only rig]

A subject's frames of one camera (of more where cameras are at fault) are copied, the fault is planted, and
the copy is checked. A row is a fault and its strength: how many of the faulty frames are found (or whether
the subject is), by which check, and what else is reported. The naive twin is the sound copy: whatever is
reported in it is a false alarm.
"""

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from _common import arguments, print_header, print_row, required
from scipy import ndimage

from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import Finding
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.stage_json import STAGE_FILE
from facerf_cli.files.read import read_image

_IN_FRONT = 0.7  # cosine to the first camera's axis of the lights whose frames get faults
_PLACE = 3  # of the faulty light among those in front


class Copy:
    """A subject's frames of the first cameras of a capture, copied with their description."""

    def __init__(self, source: Path, folder: Path, subject: str, cameras: int) -> None:
        text = json.loads((source / STAGE_FILE).read_text())
        text |= {"cameras": text["cameras"][:cameras], "subjects": {subject: {}}}
        self.folder, self.subject = folder, subject
        self.description: dict[str, Any] = text
        self.cameras = [camera["id"] for camera in text["cameras"]]
        self.ids = [light["id"] for light in text["lights"]]
        self.save()
        capture = read_capture(source)
        self._source_path = capture.frame_path
        turn = capture.cameras[self.cameras[0]].rotation.numpy()
        self.directions = capture.directions_world @ turn.T  # [L, 3], of the first camera
        for camera in self.cameras:
            for light in self.ids:
                to = self.path(light, camera)
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self._source_path(subject, camera, light), to)

    def save(self) -> None:
        """Write the description as it is now."""
        (self.folder / STAGE_FILE).write_text(json.dumps(self.description))

    def path(self, light: str, camera: str = "") -> Path:
        """A frame of the copy, by default of the first camera."""
        names = {"subject": self.subject, "camera": camera or self.cameras[0], "light": light}
        return self.folder / str(self.description["pattern"]).format(**names)

    def read(self, light: str) -> np.ndarray:
        """The sound frame [H, W, 3] of the first camera."""
        return read_image(self._source_path(self.subject, self.cameras[0], light), "linear").pixels

    def write(self, light: str, pixels: np.ndarray) -> None:
        """Write a half float EXR whatever it holds; `write_exr` refuses NaN."""
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
        buffer.set_write_format("half")
        buffer.write(str(self.path(light)))

    def in_front(self) -> list[str]:
        """Lights in front of the first camera, the most frontal first."""
        order = np.argsort(-self.directions[:, 2])
        return [self.ids[row] for row in order if self.directions[row, 2] > _IN_FRONT]

    @property
    def faulty(self) -> str:
        """The light whose frame gets a fault."""
        return self.in_front()[_PLACE]

    def far(self, light: str) -> str:
        """The light in front that is furthest from another."""
        return min(self.in_front(), key=lambda other: self._cosine(light, other))

    def near(self, light: str) -> str:
        """The light nearest to another."""
        others = [other for other in self.ids if other != light]
        return max(others, key=lambda other: self._cosine(light, other))

    def _cosine(self, light: str, other: str) -> float:
        first, second = (self.directions[self.ids.index(name)] for name in (light, other))
        return float(first @ second)

    def findings(self) -> list[Finding]:
        """Check the copy."""
        self.save()
        return check_subject(read_capture(self.folder), self.subject)


Plant = Callable[[Copy], Sequence[str]]
Change = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Fault:
    """A fault, and the checks that may find it.

    `plant` returns the lights with faulty frames; none where the whole subject is faulty.
    """

    name: str
    strength: str
    checks: tuple[str, ...]
    plant: Plant
    cameras: int = 1


def one(change: Change) -> Plant:
    """Change one frame."""

    def plant(copy: Copy) -> list[str]:
        copy.write(copy.faulty, change(copy.read(copy.faulty)))
        return [copy.faulty]

    return plant


def every(change: Change) -> Plant:
    """Change all frames."""

    def plant(copy: Copy) -> list[str]:
        for light in copy.ids:
            copy.write(light, change(copy.read(light)))
        return []

    return plant


def missing(copy: Copy) -> list[str]:
    """Remove a frame."""
    copy.path(copy.faulty).unlink()
    return [copy.faulty]


def extra(copy: Copy) -> list[str]:
    """Add a frame of a light that the description does not list."""
    copy.write("L900", copy.read(copy.faulty) * 0.9)
    return []


def truncated(share: float) -> Plant:
    """Keep only the beginning of a file."""

    def plant(copy: Copy) -> list[str]:
        path = copy.path(copy.faulty)
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        return [copy.faulty]

    return plant


def duplicate(copy: Copy) -> list[str]:
    """Write another light's frame in the place of one."""
    shutil.copyfile(copy.path(copy.far(copy.faulty)), copy.path(copy.faulty))
    return [copy.faulty]


def nans(share: float) -> Change:
    """Set random pixels to NaN."""

    def change(pixels: np.ndarray) -> np.ndarray:
        spoiled = np.random.default_rng(0).random(pixels.shape[:2]) < share
        return np.where(spoiled[..., None], np.float32(np.nan), pixels)

    return change


def unfired(copy: Copy) -> list[str]:
    """Leave of a frame the light of the room, that of the light overhead in all frames."""
    room = 0.02 * copy.read(max(copy.ids, key=lambda light: copy.directions[copy.ids.index(light), 1]))
    for light in copy.ids:
        copy.write(light, room + (0 if light == copy.faulty else copy.read(light)))
    return [copy.faulty]


def swapped(other_of: Callable[[Copy, str], str]) -> Plant:
    """Swap the frames of two lights."""

    def plant(copy: Copy) -> list[str]:
        light = copy.faulty
        other = other_of(copy, light)
        first, second = copy.read(light), copy.read(other)
        copy.write(light, second)
        copy.write(other, first)
        return [light, other]

    return plant


def rolled(copy: Copy) -> list[str]:
    """Give each light the direction of the next one."""
    lights = copy.description["lights"]
    directions = [light["direction"] for light in lights]
    for light, direction in zip(lights, [*directions[1:], directions[0]], strict=True):
        light["direction"] = direction
    return []


def rig(matrix: np.ndarray) -> Plant:
    """Transform the directions of all lights."""

    def plant(copy: Copy) -> list[str]:
        for light in copy.description["lights"]:
            light["direction"] = (matrix @ np.array(light["direction"])).tolist()
        return []

    return plant


def about_y(angle_deg: float) -> np.ndarray:
    """A rotation about the vertical axis."""
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def misplaced(angle_deg: float) -> Plant:
    """Turn the second camera's pose about the head."""

    def plant(copy: Copy) -> list[str]:
        camera = copy.description["cameras"][1]
        pose = np.array(camera["world_to_camera"])[:3]
        pose[:, :3] = pose[:, :3] @ about_y(angle_deg)
        camera["world_to_camera"] = pose.tolist()
        return []

    return plant


def cameras_swapped(copy: Copy) -> list[str]:
    """Swap the folders of the first and the last camera."""
    first, second = (copy.path("", camera).parent for camera in (copy.cameras[0], copy.cameras[-1]))
    aside = first.with_name("aside")
    for old, new in ((first, aside), (second, first), (aside, second)):
        old.rename(new)
    return []


def clipped(share: float) -> Plant:
    """Clip all frames where the most frontal one has a share of its pixels above."""

    def plant(copy: Copy) -> Sequence[str]:
        ceiling = np.quantile(copy.read(copy.in_front()[0]).max(-1), 1 - share)
        return every(lambda pixels: np.minimum(pixels, np.float32(ceiling)))(copy)

    return plant


def moved(by_px: float) -> Plant:
    """Move a third of the frames in several directions."""

    def plant(copy: Copy) -> list[str]:
        for place, light in enumerate(copy.ids[::3]):
            angle = 2.4 * place
            copy.write(light, shifted(copy.read(light), (by_px * np.sin(angle), by_px * np.cos(angle))))
        return []

    return plant


def shifted(pixels: np.ndarray, by_px: Sequence[float]) -> np.ndarray:
    """A frame moved down and right."""
    return ndimage.shift(pixels, (*by_px, *[0] * (pixels.ndim - 2)), order=3, mode="nearest")


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
    Fault("light did not fire", "room's light of 2 %", ("order",), unfired),
    Fault("two swapped", "neighbours", ("order",), swapped(Copy.near)),
    Fault("two swapped", "far apart", ("order",), swapped(Copy.far)),
    Fault("all shifted by one", "", ("order", "rig"), rolled),
    Fault("rig mirrored", "", ("rig",), rig(np.diag([-1.0, 1, 1]))),
    *(Fault("rig turned", f"{deg} degrees", ("rig",), rig(about_y(deg))) for deg in (10, 25, 45)),
    *(Fault("camera turned", f"{deg} degrees, 1 of 3", ("camera",), misplaced(deg), 3) for deg in (40, 60)),
    *(Fault("cameras swapped", f"2 of {n}", ("camera", "rig"), cameras_swapped, n) for n in (2, 3)),
    *(Fault("head moves in a third", f"{px} px", ("motion",), moved(px)) for px in (1, 2, 3, 4)),
)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--capture", type=Path, help="a sound capture with a stage.json")
    parser.add_argument("--subjects", type=int, default=2, help="that each fault is planted in")
    parser.add_argument("--sound", type=int, default=8, help="subjects that are checked without a fault")
    parser.add_argument("--only", default="", help="only faults with this in their name")
    given = parser.parse_args()
    source = required(given.capture, "a sound capture of synth-stage", "--capture")
    subjects = list(read_capture(source).subjects)
    report_sound(source, subjects[: given.sound])
    print_header("fault", "strength", "found", "as", "also reported")
    for fault in FAULTS:
        if given.only in fault.name:
            report_fault(fault, source, subjects[: given.subjects])


def report_sound(source: Path, subjects: Sequence[str]) -> None:
    """Print what is found where nothing is planted."""
    found: list[Finding] = []
    for subject in subjects:
        with tempfile.TemporaryDirectory() as name:
            found += Copy(source, Path(name), subject, 2).findings()
    print(f"sound, {len(subjects)} subjects, two cameras each: {counted(found)}")
    for finding in found:
        print(f"  {finding.place}: {finding.check}: {finding.words}")


def counted(findings: Iterable[Finding]) -> str:
    """The number of findings by check."""
    counts = Counter(finding.check for finding in findings)
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "-"


def report_fault(fault: Fault, source: Path, subjects: Sequence[str]) -> None:
    """Print a row of the table."""
    hits, wanted = 0, 0
    right: list[Finding] = []
    others: list[Finding] = []
    for subject in subjects:
        with tempfile.TemporaryDirectory() as name:
            copy = Copy(source, Path(name), subject, fault.cameras)
            faulty = set(fault.plant(copy))
            found = copy.findings()
        said = [f for f in found if f.check in fault.checks and (not faulty or f.light in faulty)]
        others += [f for f in found if f not in said and not (faulty and f.light in faulty)]
        hits += len({f.light for f in said}) if faulty else bool(said)
        wanted += max(len(faulty), 1)
        right += said
    kinds = ", ".join(sorted({f"{f.check} ({f.severity})" for f in right})) or "-"
    print_row(fault.name, fault.strength, f"{hits} of {wanted}", kinds, counted(others))


if __name__ == "__main__":
    main()
