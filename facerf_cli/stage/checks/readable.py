"""Frames that cannot be read, or whose size is not their camera's."""

from collections.abc import Iterator, Sequence

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames, Unread

_MOST = 0.5  # of a camera's frames: when more have another size, it is the description that is wrong


def check_readable(frames: CameraFrames, unread: Sequence[Unread]) -> Iterator[Finding]:
    """A finding a frame; one for the whole camera where most frames have another size than it."""
    wrong = [frame for frame in unread if frame.wrong_size]
    if len(wrong) > _MOST * (len(unread) + len(frames.light_ids)):
        advice = "mend the camera's width, height and K"
        words = f"{len(wrong)} frames have another size than the camera; {advice} ({wrong[0].reason})"
        yield Finding(
            "error", "resolution", frames.subject, words, frames.camera, figures={"frames": len(wrong)}
        )
        unread = [frame for frame in unread if not frame.wrong_size]
    for frame in unread:
        check = "resolution" if frame.wrong_size else "unreadable"
        yield Finding("error", check, frames.subject, frame.reason, frames.camera, frame.light, {}, True)
