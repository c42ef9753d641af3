"""Memory of a photo's work (docs/memory.md): what is refused, how many lights are held, what goes to disk.

Readers ask, by a file's header, for what they decode; what work makes of a photo is asked for here alone.
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

# Bytes of a pixel beside the photo that is read.
# An 8-bit copy, the matte, the view of a face, the grain; of a stack's photo an image for several formats.
KEPT_PX = 22
KEPT_OF_SEGMENTS_PX = 26  # an 8-bit copy, the matte, the colours, a class
# Bytes of a pixel that is held.
_PHOTO_PX = 12
_PERSON_PX = 24  # photo, matte and the view of a face
_STACK_PX = 130
_SEGMENTS_PX = _PHOTO_PX + KEPT_OF_SEGMENTS_PX
_IMAGE_PX = 12
_FACE_PX, _BESIDE_FACE_PX = 32, 16  # of a face drawn in its photo, and of the photo with its matte around it
# Of a person of a group: transport, and maps of the light that is shown; matte and grain.
_COMPOSED_BYTES, _COMPOSED_PX = 80 << 20, 12
_STRIP_BYTES, _BETWEEN = 32 << 20, 6  # of a strip of the image, and a sixth of all for what lies between
_WEB_PX = 9  # of an image for web viewers: half floats, then bytes
# Layers that are not only written as half floats.
_FLOATS = ("rgb", "A", "person.A", "position", "depth", "uv")


def beside_photo(size_px: tuple[int, ...]) -> AbstractContextManager[None]:
    """Count a photo [H, W] with what is read meanwhile."""
    return memory.holding(_PHOTO_PX * math.prod(size_px))


def beside_person(size_px: tuple[int, ...], images: int = 0) -> AbstractContextManager[None]:
    """Count a photo [H, W], its person and further images of its size with what is read meanwhile."""
    return memory.holding((_PERSON_PX + images * _IMAGE_PX) * math.prod(size_px))


def beside_stack(size_px: tuple[int, ...]) -> AbstractContextManager[None]:
    """Count a stack of images [H, W] with what is read meanwhile."""
    return memory.holding(_STACK_PX * math.prod(size_px))


def prediction_bytes() -> int:
    """Bytes that a network's prediction may take."""
    return memory.limit_bytes()


def require_face(model: MorphableModel, fit: FaceFit, size_px: tuple[int, ...]) -> None:
    """Raise InputError where a face, drawn in its photo [H, W], does not fit."""
    height, width = size_px
    window = face_window(fit.vertices_camera(model), photo_camera(fit.crop, height, width))[2]
    needed = height * width * _BESIDE_FACE_PX + window.height_px * window.width_px * _FACE_PX
    needed += needed // _BETWEEN + _STRIP_BYTES
    memory.require(f"a face of {window.width_px} x {window.height_px} pixels", needed, "a smaller photo")


def require_people(count: int, size_px: tuple[int, ...]) -> None:
    """Raise InputError where so many people of a photo [H, W], composed into one image, do not fit."""
    what = f"{count} people in one image"
    memory.require(what, _people_bytes(count, size_px), "--composite face or --face INDEX")


def beside_people(count: int, size_px: tuple[int, ...]) -> AbstractContextManager[None]:
    """Count so many people of a photo [H, W], composed into one image, with what is made meanwhile."""
    return memory.holding(_people_bytes(count, size_px))


def _people_bytes(count: int, size_px: tuple[int, ...]) -> int:
    return count * (_COMPOSED_BYTES + _COMPOSED_PX * math.prod(size_px)) if count > 1 else 0


def require_web_images(lights: int, size_px: tuple[int, int]) -> None:
    """Raise InputError where images [H, W] of all lights do not fit."""
    needed = _WEB_PX * lights * math.prod(size_px)
    memory.require(f"--format relight of {lights} lights", needed, "fewer --lights or a smaller --size")


def image_canvas(path: Path, size_px: tuple[int, int], formats: int) -> AbstractContextManager[Empty]:
    """`canvas` of a relit image; the writer of each format may hold as much as an image."""
    return canvas(path, formats * _IMAGE_PX * math.prod(size_px))


def segments_canvas(path: Path, size_px: tuple[int, int]) -> AbstractContextManager[Empty]:
    """`canvas` of the classes of a photo."""
    return canvas(path, _SEGMENTS_PX * math.prod(size_px))


@contextmanager
def canvas(path: Path, held_bytes: int) -> Iterator[Empty]:
    """Yield a function that makes arrays for the layers of an output.

    Arrays that do not fit the budget, with what is held already, are mapped to files in a hidden folder of
    the output: the parts of an EXR are written one after the other. There layers that an EXR holds in half
    floats are half floats.
    """
    with ExitStack() as stack:
        left, folders = memory.left_bytes() - held_bytes, list[Path]()

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
