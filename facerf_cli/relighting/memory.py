"""Memory of a photo's work (docs/reliability.md): photos that are rejected, and layers that are kept on disk.

All sizes are multiples of an image of `IMAGE_PX` bytes per pixel, on top of what a reader decodes. Images are
rendered by strips; a slow test measures the peak (tests/run/test_memory.py).
"""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import numpy as np

from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.view import face_window, photo_camera
from facerf_cli.files.atomic import hidden_folder
from facerf_cli.image.strips import Empty
from facerf_cli.run import memory

IMAGE_PX = 12  # bytes per pixel of a float image
KEPT_PX = 18  # bytes per pixel of work on a photo: an 8-bit copy, the matte, the view of a face
_MATTE_PX = 4
_PERSON_BYTES = 80 << 20  # per person of a group: transport, and maps under the current light
_STRIPS_BYTES = 32 << 20
_FLOATS = ("rgb", "A", "person.A", "position", "depth", "uv")  # layers that need full floats


def beside(size_px: tuple[int, ...], images: int) -> AbstractContextManager[None]:
    """Reserve memory for a number of images [H, W] while others are read: 1 per photo, 2 with its person."""
    return memory.holding(images * IMAGE_PX * math.prod(size_px))


def require_face(model: MorphableModel, fit: FaceFit, size_px: tuple[int, ...]) -> None:
    """Raise InputError if rendering a face in its photo [H, W] needs too much memory."""
    height, width = size_px
    window = face_window(fit.vertices_camera(model), photo_camera(fit.crop, height, width))[2]
    needed = height * width * (IMAGE_PX + _MATTE_PX) + window.height_px * window.width_px * 3 * IMAGE_PX
    what = f"a face of {window.width_px} x {window.height_px} pixels"
    memory.require(what, needed * 7 // 6 + _STRIPS_BYTES, "a smaller photo")  # a sixth lies between blocks


def require_people(count: int, size_px: tuple[int, ...]) -> None:
    """Raise InputError if composing a number of people of a photo [H, W] needs too much memory."""
    what = f"{count} people in one image"
    memory.require(what, _people_bytes(count, size_px), "--composite face or --face INDEX")


def beside_people(count: int, size_px: tuple[int, ...]) -> AbstractContextManager[None]:
    """Reserve memory for a number of people of a photo [H, W] that are composed into one image."""
    return memory.holding(_people_bytes(count, size_px))


def _people_bytes(count: int, size_px: tuple[int, ...]) -> int:
    return count * (_PERSON_BYTES + IMAGE_PX * math.prod(size_px)) if count > 1 else 0


@contextmanager
def canvas(path: Path, size_px: tuple[int, int], images: int) -> Iterator[Empty]:
    """Yield a function that allocates the layers of an output, whose writers hold a number of `images`.

    Arrays that exceed the memory budget are mapped to files in a hidden folder of the output. These are half
    floats if the EXR stores the layer as half floats.
    """
    with ExitStack() as stack:
        left, folders = memory.left_bytes() - images * IMAGE_PX * math.prod(size_px), list[Path]()

        def empty(name: str, shape: tuple[int, ...]) -> np.ndarray:
            nonlocal left
            needed = 4 * math.prod(shape)
            if left > needed:
                left -= needed
                return np.empty(shape, np.float32)
            folders[:] = folders or [stack.enter_context(hidden_folder(path))]
            kind = np.float32 if name in _FLOATS else np.float16
            return np.memmap(folders[0] / f"{name}.values", kind, "w+", shape=shape)

        yield empty
