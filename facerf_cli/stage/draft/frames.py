"""A capture's pictures sorted by subject, camera and light, and those that are none of its frames."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from facerf_cli.stage.checks.missing import other_end
from facerf_cli.stage.data.documents import is_name
from facerf_cli.stage.data.patterns import FIELDS
from facerf_cli.stage.draft.naming import Naming

Key = tuple[str, str, str]  # subject, camera and light, empty where the pattern does not name them


@dataclass(frozen=True)
class Frames:
    """The frames by what is in them, in the order of people, not of machines: 2 before 10."""

    paths: dict[Key, str]
    ambient: Counter[str]  # what stands in a light's place in pictures without lamps, and how many there are
    full: Counter[str]  # the same of pictures with all lamps on
    strays: list[str]  # pictures that do not fit
    unnameable: list[str]  # ids that no file of ours could bear

    def ids(self, field: str) -> list[str]:
        """The ids of all subjects, cameras or lights, each once."""
        return sorted({key[FIELDS.index(field)] for key in self.paths}, key=natural_order)

    def of_camera(self, camera: str) -> list[str]:
        """The paths of a camera's frames."""
        return [path for key, path in self.paths.items() if key[1] == camera]


def sort_frames(paths: Iterable[str], naming: Naming) -> Frames:
    """Which of the paths are frames, and of what."""
    frames = Frames({}, Counter(), Counter(), [], [])
    for path in sorted(paths):
        match, loose = naming.strict.fullmatch(path), naming.loose.fullmatch(path)
        if loose and (end := other_end(loose["light"])):
            (frames.full if end == "full" else frames.ambient)[loose["light"]] += 1
        elif match is None:
            frames.strays.append(path)
        else:
            named = match.groupdict()
            bad = [name for name in named.values() if not is_name(name)]
            frames.unnameable.extend(bad)
            if not bad:
                frames.paths[named.get("subject", ""), named.get("camera", ""), named["light"]] = path
    return frames


def alike(names: Iterable[str]) -> Iterator[list[str]]:
    """Names that are one but for zeros before their numbers or for case, as `cam3` and `cam03`."""
    groups: dict[object, list[str]] = {}
    for name in names:
        groups.setdefault(natural_key(name.casefold()), []).append(name)
    return (group for group in groups.values() if len(group) > 1)


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """What to sort by so that numbers are in the order of their values."""
    return tuple(
        (0, int(piece), "") if piece.isascii() and piece.isdigit() and len(piece) < 19 else (1, 0, piece)
        for piece in re.split("([0-9]+)", text)
    )


def natural_order(text: str) -> tuple[object, str]:
    """The same, with an order also of names that are alike in it."""
    return natural_key(text), text
