"""All checks of a subject's frames, before a dataset is prepared from them."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.frames import (
    check_black,
    check_clipped,
    check_missing,
    check_other_cameras,
    check_readable,
    read_frames,
    same_frames,
)
from facerf_cli.capture.checks.motion import check_motion
from facerf_cli.capture.checks.shading import (
    RigFit,
    check_duplicates,
    check_frames_order,
    check_rigs,
    fit_stereo,
    measure_rig,
)
from facerf_cli.capture.findings import Finding


@dataclass
class _Cameras:
    """Results of a subject's cameras, which are judged together at the end."""

    rigs: list[RigFit] = field(default_factory=list)
    frame_of: dict[str, str] = field(default_factory=dict)  # camera/light by the digest of its pixels


def check_subject(capture: Capture, subject: str, side_px: int = 96) -> list[Finding]:
    """Check a subject's frames; findings are sorted, errors first.

    Each frame is read once, and one camera is in memory at a time, with `side_px` squared values per light.
    Unreadable frames are findings, not exceptions; a missing frame that the capture marks as damaged is none.
    The checks see the frames without a colour chart's matrix, which would hide clipped channels.
    """
    plain, cameras = replace(capture, charts=()), _Cameras()
    found = [
        one for camera in plain.cameras for one in _check_camera(plain, subject, camera, side_px, cameras)
    ]
    found += check_rigs(subject, cameras.rigs)
    return sorted(found, key=lambda finding: (finding.severity != "error", finding.leaves_out))


def _check_camera(
    capture: Capture, subject: str, camera: str, side_px: int, cameras: _Cameras
) -> list[Finding]:
    """Check the frames of a camera, first one by one, then those that are sound by their shading."""
    frames, unread = read_frames(capture, subject, camera, side_px)
    found = [*check_missing(capture, subject, camera), *check_readable(frames, unread)]
    for check in (check_black, check_clipped):
        found += check(frames)
    found += check_other_cameras(frames, cameras.frame_of)
    places = (f"{camera}/{light}" for light in frames.light_ids)
    cameras.frame_of |= zip(frames.measured["digest"], places, strict=True)
    doubles = {frames.light_ids[row] for rows in same_frames(frames) for row in rows}
    fitted = frames.without(_left_out(found) | doubles)
    stereo = fit_stereo(fitted)
    found += check_duplicates(frames, stereo)
    if stereo is None:
        return found
    sound = frames.without(_left_out(found))
    if sound.light_ids != fitted.light_ids:
        stereo = fit_stereo(sound)
    if stereo is None:
        return found
    disorder = list(check_frames_order(sound, stereo))
    if any(not one.leaves_out for one in disorder):  # then neither normals nor expected brightness are known
        return [*found, *disorder]
    cameras.rigs.append(measure_rig(camera, stereo))
    ordered = sound.without(_left_out(disorder))
    return [*found, *disorder, *check_motion(ordered, stereo)]


def _left_out(findings: Iterable[Finding]) -> set[str]:
    """Lights whose frames one camera's findings leave out."""
    return {found.light for found in findings if found.leaves_out}
