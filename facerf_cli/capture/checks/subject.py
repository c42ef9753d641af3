"""All checks of a subject's frames, before any work is put into it."""

from collections.abc import Iterable
from dataclasses import dataclass

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, Stereo, check_missing, fit_stereo, read_frames
from facerf_cli.capture.checks.motion import check_motion
from facerf_cli.capture.checks.rig import Rig, check_rig_roughly, check_rigs, find_face_normals, measure_rig
from facerf_cli.capture.checks.shading import (
    Curve,
    added_exponent,
    check_frames_order,
    check_gamma,
    check_too_bright,
    check_unlit,
    fit_exponent,
)
from facerf_cli.capture.checks.single_frames import (
    check_black,
    check_clipped,
    check_duplicates,
    check_fields,
    check_readable,
    same_frames,
    seen_before,
)

_FACE_TRIES = 3  # cameras without a face that are searched for one; each costs a second or more


@dataclass(frozen=True)
class CheckSettings:
    """What the checks go by."""

    side_px: int = 96  # the longer side of the small frames that the checks share


_USUAL = CheckSettings()


def check_subject(capture: Capture, subject: str, settings: CheckSettings = _USUAL) -> list[Finding]:
    """Findings about a subject's frames, errors first; each frame is read once, one camera is held at a time.

    Held are `settings.side_px` squared values a light. Raises nothing that a user can cause: what cannot be
    read is a finding.
    """
    checks = _Checks(capture, subject, settings)
    found = [finding for camera in capture.cameras for finding in checks.of_camera(camera)]
    found += check_gamma(subject, checks.curves)
    found += check_rigs(subject, checks.rigs) if checks.rigs else checks.rough
    return sorted(found, key=lambda finding: (finding.severity != "error", finding.leaves_out))


class _Checks:
    """What the checks of a subject's cameras carry from one to the next."""

    def __init__(self, capture: Capture, subject: str, settings: CheckSettings) -> None:
        self.capture, self.subject, self.settings = capture, subject, settings
        self.curves: list[Curve] = []
        self.rough: list[Finding] = []  # of the rig, without a face to compare
        self.rigs: list[Rig] = []
        self._digests: dict[str, str] = {}
        self._face_tries = _FACE_TRIES

    def of_camera(self, camera: str) -> list[Finding]:
        """All findings about a camera."""
        found = list(check_missing(self.capture, self.subject, camera))
        frames, unread = read_frames(self.capture, self.subject, camera, self.settings.side_px)
        found += check_readable(frames, unread)
        for check in (check_black, check_clipped, check_fields):
            found += check(frames)
        found += seen_before(frames, self._digests)
        names = (f"{camera}/{light}" for light in frames.light_ids)
        self._digests |= {of.digest: name for of, name in zip(frames.figures, names, strict=True)}
        doubles = {frames.light_ids[row] for rows in same_frames(frames) for row in rows}
        sound = frames.less(left_out(found) | doubles)
        stereo, fitted_to = fit_stereo(sound), sound.light_ids
        found += check_duplicates(frames, stereo)
        sound = frames.less(left_out(found))
        if stereo is None:
            return found
        found += check_unlit(sound, stereo)
        whole = frames.less(left_out(found))
        if whole.light_ids != fitted_to:
            stereo = fit_stereo(whole)
        by_shading = [] if stereo is None else self._of_shading(whole, stereo)
        if is_disordered(by_shading):  # then nobody knows how bright a frame should be
            found = [finding for finding in found if finding.check != "unlit"]
        return found + by_shading

    def _of_shading(self, frames: CameraFrames, stereo: Stereo) -> list[Finding]:
        """Findings about frames that are whole and lit, as far as shading tells; `stereo` is theirs."""
        found = list(check_frames_order(frames, stereo))
        if is_disordered(found):
            return found  # no normals are to be trusted
        found += check_too_bright(frames, stereo)
        self._look_at_rig(frames, stereo)
        found += check_motion(frames.less(left_out(found)), stereo)
        curve = added_exponent(self.capture, frames)
        curve = curve or fit_exponent(frames.less(left_out(found)), stereo.lit)
        self.curves += [] if curve is None else [curve]
        return found

    def _look_at_rig(self, frames: CameraFrames, stereo: Stereo) -> None:
        """Hold the rig against the face, if the camera shows one."""
        if not self.rigs:
            self.rough += check_rig_roughly(frames, stereo)
        if self._face_tries:
            face = find_face_normals(frames, self.capture.cameras[frames.camera])
            rig = None if face is None else measure_rig(frames, stereo, face, self.capture.cameras)
            self.rigs += [] if rig is None else [rig]
            self._face_tries -= face is None


def is_disordered(findings: Iterable[Finding]) -> bool:
    """Whether the lights as a whole are in another order, as far as the camera's frames tell."""
    return any(found.check == "order" and not found.leaves_out for found in findings)


def left_out(findings: Iterable[Finding]) -> set[str]:
    """The lights whose frames are broken, of one camera's findings."""
    return {found.light for found in findings if found.leaves_out}
