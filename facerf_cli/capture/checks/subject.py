"""Run all checks of a subject's frames before a dataset is prepared."""

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
    """Results of a subject's cameras, judged together at the end."""

    rigs: list[RigFit] = field(default_factory=list)
    frame_of: dict[str, str] = field(default_factory=dict)  # camera/light by the digest of its pixels


def check_subject(capture: Capture, subject: str, side_px: int = 96) -> list[Finding]:
    """Check a subject's frames; return the findings, errors first.

    Each frame is read once, and one camera is in memory at a time, with `side_px` squared values per light.
    Unreadable frames are findings, not exceptions. A missing frame that the capture marks as damaged is not a
    finding. A colour chart's matrix is not applied, because it would hide clipped channels.
    """
    plain, cameras, findings = replace(capture, charts=()), _Cameras(), list[Finding]()
    for camera in plain.cameras:
        findings += _check_camera(plain, subject, camera, side_px, cameras)
    findings += check_rigs(subject, cameras.rigs)
    return sorted(findings, key=lambda finding: (finding.severity != "error", finding.leaves_out))


def _check_camera(
    capture: Capture, subject: str, camera: str, side_px: int, cameras: _Cameras
) -> list[Finding]:
    """Check the frames of a camera, first one by one, then the shading of the undamaged ones."""
    frames, unread = read_frames(capture, subject, camera, side_px)
    findings = [
        *check_missing(capture, subject, camera),
        *check_readable(frames, unread),
        *check_black(frames),
        *check_clipped(frames),
        *check_other_cameras(frames, cameras.frame_of),
    ]
    places = (f"{camera}/{light}" for light in frames.light_ids)
    cameras.frame_of |= zip(frames.measured["digest"], places, strict=True)
    doubles = {frames.light_ids[row] for rows in same_frames(frames) for row in rows}
    fitted = frames.without(_left_out(findings) | doubles)
    stereo = fit_stereo(fitted)
    findings += check_duplicates(frames, stereo)
    sound = frames.without(_left_out(findings))
    if stereo is not None and sound.light_ids != fitted.light_ids:
        stereo = fit_stereo(sound)
    if stereo is None:
        return findings
    disorder = list(check_frames_order(sound, stereo))
    findings += disorder
    if all(finding.leaves_out for finding in disorder):  # else normals and brightness are unknown
        cameras.rigs.append(measure_rig(camera, stereo))
        findings += check_motion(sound.without(_left_out(disorder)), stereo)
    return findings


def _left_out(findings: Iterable[Finding]) -> set[str]:
    return {finding.light for finding in findings if finding.light and finding.leaves_out}
