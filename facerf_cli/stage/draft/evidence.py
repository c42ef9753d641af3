"""What a folder of pictures tells of a capture: its names, its headers, and a list of lights beside them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from facerf_cli.errors import InputError, UsageError
from facerf_cli.stage.data.documents import Node
from facerf_cli.stage.data.patterns import require_pattern
from facerf_cli.stage.draft.cameras import Sight, look_at
from facerf_cli.stage.draft.frames import Frames, sort_frames
from facerf_cli.stage.draft.lamps import by_light, direction_in_name, read_lamps
from facerf_cli.stage.draft.naming import Naming, find_naming
from facerf_cli.stage.draft.scan import Scan, scan_folder

_LEAST_LIGHTS = 3  # fewer tell no normals


@dataclass(frozen=True)
class Rig:
    """Where lamps stand, by light, and which list says so."""

    directions: Mapping[str, list[float]]
    source: str = ""  # the list's path; empty where the directions are in the lights' names
    lengths: tuple[float, float] = (1.0, 1.0)  # least and greatest of the list's vectors
    unused: str = ""  # why a list that is there was not taken


@dataclass(frozen=True)
class Evidence:
    """All that a folder tells of its capture."""

    scan: Scan
    naming: Naming
    frames: Frames
    rig: Rig
    sights: Mapping[str, Sight]  # by camera; one of no name where the pattern has none

    @property
    def colour_space(self) -> str | None:
        """The one that all headers name; None where they differ, or do not tell."""
        spaces = {space for sight in self.sights.values() for space in sight.spaces}
        return spaces.pop() if len(spaces) == 1 else None


def look_into(folder: Path, suffixes: Collection[str]) -> Evidence:
    """What the pictures below a folder tell; a UsageError where they are no capture."""
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder")
    scan = scan_folder(folder, suffixes)
    if not scan.pictures:
        raise UsageError(f"{folder}: no pictures found (looked for {' '.join(sorted(suffixes))})")
    try:
        naming = find_naming(scan.pictures)
        require_pattern(Node("their pattern", naming.pattern), ["light"])
        frames = sort_frames(scan.pictures, naming)
        _require_lights(frames)
        sights = {
            camera: look_at([folder / path for path in frames.of_camera(camera)])
            for camera in frames.ids("camera")
        }
        _require_sizes(sights)
    except (UsageError, InputError) as error:
        raise UsageError(f"{folder}: {len(scan.pictures)} pictures, and no capture: {error}") from None
    return Evidence(scan, naming, frames, _find_rig(folder, scan, frames), sights)


def _require_lights(frames: Frames) -> None:
    lights = frames.ids("light")
    if len(lights) < _LEAST_LIGHTS:
        names = f" ({', '.join(lights)})" if lights else ""
        raise UsageError(
            f"by their names they are under {len(lights)} lights{names}, and {_LEAST_LIGHTS} are the least"
        )


def _require_sizes(sights: Mapping[str, Sight]) -> None:
    """A UsageError where no picture can be read, or a camera has no usual size."""
    if not any(sight.sizes for sight in sights.values()):
        raise UsageError(f"none of {sum(sight.unread for sight in sights.values())} looked at can be read")
    for camera, sight in sights.items():
        if sight.sizes and sight.sizes.most_common(1)[0][1] <= sight.sizes.total() / 2:
            of_camera = f" of camera {camera}" if camera else ""
            raise UsageError(
                f"{len(sight.sizes)} sizes among {sight.sizes.total()} of them{of_camera}; a camera has one"
            )


def _find_rig(folder: Path, scan: Scan, frames: Frames) -> Rig:
    """Directions from a list of lights, else from the lights' names."""
    lights, unused = frames.ids("light"), ""
    if scan.lists:
        name = scan.lists[0]
        stems = {PurePosixPath(path).stem: light for (_, _, light), path in frames.paths.items()}
        try:
            lamps = read_lamps(folder / name)
        except InputError as error:
            unused = str(error)
        else:
            if found := by_light(lamps, lights, stems):
                lengths = [lamp.length for lamp in lamps]
                return Rig(found, name, (min(lengths), max(lengths)))
            unused = f"{folder / name}: its {len(lamps)} lines name none of the {len(lights)} lights"
    named = {light: direction for light in lights if (direction := direction_in_name(light))}
    return Rig(named, unused=unused)
