"""All checks of a subject's frames, before a dataset is prepared from them."""

from collections.abc import Iterable
from dataclasses import replace

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.frames import (
    CameraFrames,
    check_black,
    check_clipped,
    check_fields,
    check_missing,
    check_other_cameras,
    check_readable,
    read_frames,
    same_frames,
)
from facerf_cli.capture.checks.motion import check_motion
from facerf_cli.capture.checks.shading import (
    Curve,
    RigFit,
    Stereo,
    check_duplicates,
    check_frames_order,
    check_gamma,
    check_rigs,
    check_unlit,
    fit_exponent,
    fit_stereo,
    measure_rig,
)
from facerf_cli.capture.findings import Finding


def check_subject(capture: Capture, subject: str, side_px: int = 96) -> list[Finding]:
    """Check a subject's frames; findings are sorted, errors first.

    Each frame is read once, and one camera is in memory at a time, with `side_px` squared values per light.
    Unreadable frames are findings, not exceptions; a missing frame that the capture marks as damaged is none.
    The checks see the frames without a colour chart's matrix, which would hide clipped channels.
    """
    checks = _Checks(replace(capture, charts=()), subject, side_px)
    found = [finding for camera in capture.cameras for finding in checks.of_camera(camera)]
    found += check_gamma(subject, checks.curves)
    found += check_rigs(subject, checks.rigs)
    marked = capture.marked.get(subject, frozenset())
    found = [finding for finding in found if finding.check != "missing" or finding.light not in marked]
    return sorted(found, key=lambda finding: (finding.severity != "error", finding.leaves_out))


class _Checks:
    """Checks of a subject's cameras in turn, and the results that are judged at the end."""

    def __init__(self, capture: Capture, subject: str, side_px: int) -> None:
        self.capture, self.subject, self.side_px = capture, subject, side_px
        self.curves: list[Curve] = []
        self.rigs: list[RigFit] = []
        self._digests: dict[str, str] = {}

    def of_camera(self, camera: str) -> list[Finding]:
        """Check the frames of a camera."""
        found = list(check_missing(self.capture, self.subject, camera))
        frames, unread = read_frames(self.capture, self.subject, camera, self.side_px)
        found += check_readable(frames, unread)
        for check in (check_black, check_clipped, check_fields):
            found += check(frames)
        found += check_other_cameras(frames, self._digests)
        names = (f"{camera}/{light}" for light in frames.light_ids)
        self._digests |= {of.digest: name for of, name in zip(frames.figures, names, strict=True)}
        doubles = {frames.light_ids[row] for rows in same_frames(frames) for row in rows}
        sound = frames.without(left_out(found) | doubles)
        stereo, fitted_to = fit_stereo(sound), sound.light_ids
        found += check_duplicates(frames, stereo)
        sound = frames.without(left_out(found))
        if stereo is None:
            return found
        found += check_unlit(sound, stereo)
        whole = frames.without(left_out(found))
        if whole.light_ids != fitted_to:
            stereo = fit_stereo(whole)
        of_shading = [] if stereo is None else self._check_shading(whole, stereo)
        if is_disordered(of_shading):  # then the expected brightness of frames is unknown
            found = [finding for finding in found if finding.check != "unlit"]
        return found + of_shading

    def _check_shading(self, frames: CameraFrames, stereo: Stereo) -> list[Finding]:
        """Check frames that are sound and lit against their photometric stereo."""
        found = list(check_frames_order(frames, stereo))
        if is_disordered(found):
            return found  # then the normals are wrong
        self.rigs.append(measure_rig(frames.camera, stereo))
        whole = frames.without(left_out(found))
        curve = fit_exponent(whole, stereo.lit)
        self.curves += [] if curve is None else [curve]
        return [*found, *check_motion(whole, stereo)]


def is_disordered(findings: Iterable[Finding]) -> bool:
    """Tell whether a camera's findings say that the list of lights is in another order."""
    return any(found.check == "order" and not found.leaves_out for found in findings)


def left_out(findings: Iterable[Finding]) -> set[str]:
    """Lights whose frames one camera's findings leave out."""
    return {found.light for found in findings if found.leaves_out}
