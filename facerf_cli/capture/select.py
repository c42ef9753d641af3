"""Which of a subject's cameras and frames go into its stacks: those that are there and sound.

A subject's stacks hold the same lights in every camera, for pairs weigh a map once for all of them. So a
light whose frame is missing or broken in one camera is left out for the subject, and a camera that lacks most
of its frames is left out itself, rather than cost the others their lights.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.errors import InputError
from facerf_cli.logs import counted

LEAST_LIGHTS, LEAST_SHARE = 10, 0.5  # of the rig's: with fewer, what is left is no OLAT stack of the stage
MISSING, MARKED = "missing", "marked as damaged"
_NAMED = 6  # of what is left out, in a line


@dataclass(frozen=True)
class Selection:
    """The lights (places in the capture's, ascending) and cameras of a subject's stacks, and what is not."""

    lights: tuple[int, ...]
    cameras: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)  # why, by the light's id
    dropped: dict[str, str] = field(default_factory=dict)  # why, by the camera's id
    missing: tuple[str, ...] = ()  # camera/light of the frames that are not there

    def in_words(self) -> str:
        """What is left out without being marked, for a line; empty where nothing is."""
        parts = []
        if lights := {light: why for light, why in self.left_out.items() if MARKED not in why}:
            parts.append(f"{counted(len(lights), 'light')} left out ({_some(lights)})")
        if self.dropped:
            parts.append(f"{counted(len(self.dropped), 'camera')} left out ({_some(self.dropped)})")
        return ", ".join(parts)


def select_frames(
    capture: Capture, subject: str, findings: Iterable[Finding] = (), strict: bool = False
) -> Selection:
    """What of a subject is there and, by the findings, sound; an InputError where it is too little.

    With `strict` a frame that is missing without being marked is too much.
    """
    broken = {camera: _absent(capture, subject, camera) for camera in capture.cameras}
    missing = [(camera, light) for camera, lights in broken.items() for light in lights]
    if strict and (unmarked := [name for name in missing if broken[name[0]][name[1]] == MISSING]):
        first = "/".join((subject, *unmarked[0]))
        raise InputError(f"{first}: missing ({len(unmarked)} such frames); without --strict it is left out")
    for found in findings:
        if found.leaves_out and found.camera in broken:
            broken[found.camera].setdefault(found.light, found.check)
    rig = len(capture.light_ids)
    dropped = {
        camera: f"only {rig - len(lights)} of {rig} frames are there and sound"
        for camera, lights in broken.items()
        if len(lights) > (1 - LEAST_SHARE) * rig
    }
    cameras = tuple(camera for camera in capture.cameras if camera not in dropped)
    if not cameras:
        raise InputError(f"{subject}: no camera has enough frames ({_some(dropped)})")
    left_out = _reasons(capture, {camera: broken[camera] for camera in cameras})
    kept = tuple(place for place, light in enumerate(capture.light_ids) if light not in left_out)
    if left_out and len(kept) < max(LEAST_SHARE * rig, min(LEAST_LIGHTS, rig)):
        raise InputError(
            f"{subject}: {len(kept)} of {rig} lights have a sound frame in every camera, which is too few "
            f"({_some(left_out)}); add the frames, or take a camera out of the capture"
        )
    return Selection(kept, cameras, left_out, dropped, tuple(map("/".join, missing)))


def _absent(capture: Capture, subject: str, camera: str) -> dict[str, str]:
    """The lights whose frame is not there, and why."""
    marked = capture.marked.get(subject, frozenset())
    return {
        light: MARKED if light in marked else MISSING
        for light in capture.light_ids
        if not capture.frame_path(subject, camera, light).is_file()
    }


def _reasons(capture: Capture, broken: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Why lights are left out, by id in the capture's order, from the cameras' lights and reasons."""
    return {
        light: ", ".join(f"{camera}: {lights[light]}" for camera, lights in broken.items() if light in lights)
        for light in capture.light_ids
        if any(light in lights for lights in broken.values())
    }


def is_mended(capture: Capture, subject: str, missing: Iterable[str]) -> bool:
    """Whether any of the frames, as in `Selection.missing`, has come since."""
    frames = (name.split("/") for name in missing)
    return any(capture.frame_path(subject, camera, light).is_file() for camera, light in frames)


def _some(reasons: Mapping[str, str]) -> str:
    """The first of the reasons, and how many there are besides."""
    words = [f"{name}: {why}" for name, why in list(reasons.items())[:_NAMED]]
    more = len(reasons) - len(words)
    return "; ".join([*words, f"and {more} more"] if more else words)
