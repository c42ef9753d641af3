"""What the headers of a capture's pictures say of its cameras: sizes, and a colour space if it is plain."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from facerf_cli.colour import LINEAR, find_space
from facerf_cli.files.headers import Header, read_header

_HEADERS = 12  # that are read a camera, of pictures all over the capture
_FOCAL = 4  # times the longer side: DESIGN's crop camera, and about what stages use
_DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")  # of 8 bits a value, these are sRGB but for a profile

# To OpenCV's axes (y down, z forward) from DESIGN's camera space (y up, z toward the camera).
FACING = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]


@dataclass(frozen=True)
class Sight:
    """What the headers of a camera's pictures have, and how many: sizes (width, height), colour spaces."""

    sizes: Counter[tuple[int, int]]
    spaces: Counter[str | None]  # None where the header does not tell
    nameless: int  # that have primaries of no space known here
    unread: int


def look_at(paths: Sequence[Path]) -> Sight:
    """Read some of the headers of a camera's pictures."""
    step = max(len(paths) // _HEADERS, 1)
    headers = [(path, read_header(path)) for path in paths[::step][:_HEADERS]]
    read = [(path, header) for path, header in headers if header is not None]
    return Sight(
        Counter((header.width_px, header.height_px) for _, header in read),
        Counter(_space_name(path, header) for path, header in read),
        sum(find_space(header.space.name) is None for _, header in read),
        len(headers) - len(read),
    )


def _space_name(path: Path, header: Header) -> str | None:
    """The name that `stage.json` has for it; None for a space without one, and where it would be a guess."""
    if not header.is_floating and (header.bits > 8 or path.suffix.lower() not in _DISPLAY_SUFFIXES):
        return None
    if header.space == LINEAR:
        return "lin_rec709"
    return header.space.name if find_space(header.space.name) == header.space else None


def describe_camera(name: str, sight: Sight, alone: bool) -> dict[str, object]:
    """A camera's entry in stage.json: a K that is a guess; where it is `alone`, it is the world."""
    width, height = sight.sizes.most_common(1)[0][0] if sight.sizes else (None, None)
    k = None
    if width and height:
        focal = float(_FOCAL * max(width, height))
        k = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    pose = FACING if alone else None
    return {"id": name, "width": width, "height": height, "K": k, "world_to_camera": pose}
