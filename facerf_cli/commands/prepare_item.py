"""What `facerf prepare-dataset` does with one subject of a capture: check, choose, prepare."""

import logging
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from facerf_cli.commands.batch import Outcome
from facerf_cli.commands.inputs import Item
from facerf_cli.commands.prepare_findings import check, require_sound, write_findings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.records import LOGGER_NAME

if TYPE_CHECKING:
    from facerf_cli.face.morphable import MorphableModel
    from facerf_cli.stage.chart.correction import ChartCorrection
    from facerf_cli.stage.data.capture import Capture
    from facerf_cli.stage.data.selection import Selection

Checks = Literal["on", "off", "only"]
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Given:
    """Which capture, and how it is read; settings only."""

    folder: Path
    layout: str
    subtract_ambient: bool
    align: bool
    charts: "tuple[ChartCorrection, ...]" = ()

    def opened(self) -> "Capture":
        """The capture's description, read once a process; it is an input of the whole run."""
        capture = _capture(self.folder, self.layout, self.subtract_ambient, self.align)
        return replace(capture, charts=self.charts)


@dataclass(frozen=True)
class Prepare:
    """Prepares one subject; settings only."""

    given: Given
    checks: Checks
    strict: bool
    face_model: str
    crop_px: int
    folder: Path
    key: str

    def outputs_of(self, item: Item) -> list[Path]:
        """A subject's files."""
        from facerf_cli.stage.data.prepare import subject_outputs

        return subject_outputs(self.given.opened(), item.name, self.folder)

    def __call__(self, item: Item) -> Outcome:
        """Prepare a subject, on one thread, so that its bytes do not depend on how many there are."""
        from facerf_cli.stage.data.prepare import prepare_subject
        from facerf_cli.stage.threads import one_thread

        model = face_model_of(self.face_model)
        with one_thread():
            capture, chosen = self._choose(item.name)
            record = prepare_subject(
                capture, item.name, chosen, model, self.folder, self.crop_px, self.key, self.strict
            )
        if record["quality"] == "poor":
            log.warning("%s: the fit is poor; look at sheets/%s.jpg", item.input_path, item.name)
        worst = max(entry["crop_off_iod"] for entry in record["cameras"].values())
        facts = {name: record[name] for name in ("error_iod", "quality", "faces_found")}
        facts |= {"cameras": len(record["cameras"]), "worst_crop_off_iod": worst}
        facts |= {"lights": len(chosen.lights)}
        return Outcome(self.outputs_of(item), facts)

    def _choose(self, subject: str) -> "tuple[Capture, Selection]":
        """The capture, aligned on request, and its sound frames; an InputError where those are too few."""
        from facerf_cli.stage.checks.align import with_alignment
        from facerf_cli.stage.checks.findings import frames_left_out
        from facerf_cli.stage.data.selection import select_frames

        capture = self.given.opened()
        findings = check(capture, subject) if self.checks == "on" else []
        write_findings(self.folder, subject, findings)
        require_sound(subject, findings, self.strict)
        chosen = select_frames(capture, subject, findings, self.strict)
        if capture.align:
            capture = with_alignment(capture, subject, frames_left_out(findings))
        return capture, chosen


@cache
def _capture(folder: Path, layout: str, subtract_ambient: bool, align: bool) -> "Capture":
    from facerf_cli.stage.data.layouts import read_capture

    try:
        return read_capture(folder, layout, subtract_ambient, align)
    except InputError as error:
        raise UsageError(str(error)) from None


@cache
def face_model_of(name: str) -> "MorphableModel":
    """The face model, once a process."""
    from facerf_cli.face.morphable import load_face_model

    return load_face_model(name)
