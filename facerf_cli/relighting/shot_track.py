"""The track file of a shot: the face's landmarks in each frame, and the cuts."""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, starmap
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.files.atomic import atomic_path
from facerf_cli.relighting.tracking import Sighting, gaps, is_bridged
from facerf_cli.run.logs import LOGGER_NAME, json_line

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class ShotTrack:
    """The face and the cuts of a shot.

    In the file, the head also contains the SHA-256 of the rows, which shows if the user has edited them.

    Attributes:
        head: The inputs and options of the track; None if there is no track.
        rows: One record per frame.
        is_own: True if facerf wrote the file and nobody has edited it.
    """

    head: Any
    rows: Sequence[dict[str, Any]]
    is_own: bool = True

    @staticmethod
    def read(path: Path) -> "ShotTrack":
        """Read a track; return one without a head if the file is missing or not a track."""
        try:
            first, *lines = path.read_text(encoding="utf-8").splitlines()
            head = json.loads(first)
            is_own = head.pop("sha256") == _digest(lines)
            track = ShotTrack(head, [json.loads(line) for line in lines], is_own)
            return track if len(track.sightings) == head["frames"] else ShotTrack(None, (), False)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return ShotTrack(None, (), False)

    def write(self, path: Path) -> None:
        """Write the track."""
        lines = [json_line(row) for row in self.rows]
        head = json_line({**self.head, "sha256": _digest(lines)})
        with atomic_path(path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in (head, *lines)), encoding="utf-8")

    @cached_property
    def sightings(self) -> list[Sighting | None]:
        """The face in each frame; None if it is not visible."""
        return [
            Sighting(np.array(row["landmarks"], np.float64), float(row["expected_error"]))
            if row["landmarks"] is not None
            else None
            for row in self.rows
        ]

    @property
    def cuts(self) -> list[int]:
        """First frame of each take but the first."""
        return [number for number, row in enumerate(self.rows) if row.get("cut")]

    @property
    def takes(self) -> list[range]:
        """The frames of each take, in order."""
        return list(starmap(range, pairwise([0, *self.cuts, len(self.rows)])))

    @property
    def takes_with_face(self) -> list[range]:
        """The frames of each take that shows the face."""
        return [take for take in self.takes if any(self.sightings[take.start : take.stop])]

    def log_cuts_and_gaps(self, name: str) -> None:
        """Log where a shot cuts, and where its face is not visible."""
        if cuts := self.cuts:
            at = f"frame{'s' * (len(cuts) > 1)} {', '.join(map(str, cuts))}"
            log.warning("%s: cuts at %s: each part is a separate shot (--no-cuts: one shot)", name, at)
        for take in self.takes:
            inside = self.sightings[take.start : take.stop]
            for first, last in gaps(inside):
                bridged = is_bridged(first, last, len(inside))
                result = "interpolated from the frames around" if bridged else "not relit; cut them off"
                begin, end = take.start + first, take.start + last
                frames = f"frame {begin}" if begin == end else f"frames {begin} to {end}"
                log.warning("%s: %s: the face is not visible; %s", name, frames, result)


def _digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
