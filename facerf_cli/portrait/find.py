"""People in a photo: their faces, each with landmarks, and what is seen around them.

The photo is searched as a whole, then in parts and turned (`mesh.py`). The Parsing Network looks at each
face that is found.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import GIVE_LANDMARKS, Box, box_of, check_in_photo, from_landmarks
from facerf_cli.face.head import OtherHead
from facerf_cli.face.landmarks import check_display, to_display
from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.given import check_seen, lie_on_one
from facerf_cli.portrait.mesh import (
    FaceMesh,
    distinct,
    find_meshes,
    first_squares,
    mesh_near,
    parts_of,
    unsteadiness,
)
from facerf_cli.portrait.parse import LEAST_PRESENCE, Square, SquareView, look, whole_photo
from facerf_cli.run.logs import LOGGER_NAME, step

log = logging.getLogger(LOGGER_NAME)

_NO_FACE = "no face found; try a larger or brighter image that shows the whole face"
_FACE_SIDES = 1.7  # side of the square that landmarks are read from, in extents of the landmarks
_TURNS = (math.pi / 2, -math.pi / 2, math.pi)
_DARK = 100  # of 255: brightest percentile of a photo that is brightened before it is searched
_UNCLEAR = 0.05  # relative error of given landmarks from which on they may lie off the face
_FINEST_PX = 500.0  # side of a part of the photo in which a face of 24 pixels is found


class NoFaceError(InputError):
    """No face is found in an image."""


@dataclass(frozen=True, eq=False)
class Face:
    """A face in a photo: its box and its landmarks [68, 2] in the photo's pixels.

    `view` is what the Parsing Network sees around it, also other landmarks and their errors; None where it
    has not looked. `others` are the photo's other heads; None where they were not searched. `number` counts
    the faces from the left, from 0.
    """

    box_px: Box
    score: float
    landmarks_px: np.ndarray = field(repr=False)
    view: SquareView | None = field(default=None, kw_only=True, repr=False)
    others: Sequence[OtherHead] | None = field(default=None, kw_only=True, repr=False)
    number: int = field(default=0, kw_only=True)

    @property
    def area_px(self) -> float:
        """The area of the box."""
        left, top, right, bottom = self.box_px
        return (right - left) * (bottom - top)


def face_at(landmarks_px: np.ndarray) -> Face:
    """The face of given landmarks [68, 2], in their bounds."""
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    return Face((left, top, right, bottom), math.inf, landmarks_px)


def choose_face(faces: list[Face], which: str, name: str) -> list[Face]:
    """Choose among faces ordered from left to right: the largest, all, or the one at an index from 0.

    'largest' multiplies size by detector score: a badge on a sleeve can be as large as the face above it.
    """
    if which == "all":
        return faces
    if which == "largest":
        if len(faces) > 1:
            log.info(
                "%s: has %d faces, of which the largest is taken (--face all, or 0 for the leftmost)",
                name,
                len(faces),
            )
        return [max(faces, key=lambda face: face.area_px * face.score)]
    if not which.isdecimal():
        raise UsageError(f"--face {which}: not a choice; give largest, all or a number from 0")
    if int(which) >= len(faces):
        raise InputError(f"{name}: has {len(faces)} face(s), and no --face {which}; the leftmost is 0")
    return [faces[int(which)]]


@step("find")
def find_faces(
    people: PeopleNetworks,
    pixels_linear: np.ndarray,
    name: str,
    which: str = "largest",
) -> list[Face]:
    """Find faces in a scene-linear image [H, W, 3]; `which` is largest, all or an index, see `choose_face`.

    Raises NoFaceError, with the image's name, where there is none.
    """
    faces = detect_faces(people, to_display(pixels_linear), everyone=which != "largest")
    if not faces:
        raise NoFaceError(f"{name}: {_NO_FACE}, or {GIVE_LANDMARKS}")
    return choose_face(faces, which, name)


def detect_faces(
    people: PeopleNetworks,
    image_srgb: np.ndarray,
    everyone: bool = False,
) -> list[Face]:
    """Find the faces in an sRGB uint8 image [H, W, 3], ordered from left to right; empty for none.

    Turned and small faces are looked for where no other is found, or for `everyone`.
    """
    check_display(image_srgb)
    image_srgb = _brightened(image_srgb)
    meshes: list[FaceMesh] = []
    for squares in _attempts(image_srgb):
        meshes = distinct([*meshes, *find_meshes(people, image_srgb, squares)])
        if meshes and not everyone:
            break
    faces = [face for mesh in meshes if (face := _face_of(people, image_srgb, mesh))]
    faces.sort(key=lambda face: face.box_px[0])
    heads = [OtherHead(face.landmarks_px) for face in faces]
    return [replace(one, others=heads[:n] + heads[n + 1 :], number=n) for n, one in enumerate(faces)]


def face_near(people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Face | None:
    """Find the face that was at landmarks [68, 2] a frame ago in an sRGB uint8 image [H, W, 3]; or None."""
    check_display(image_srgb)
    mesh = mesh_near(people, image_srgb, _around(landmarks_px))
    return _face_of(people, image_srgb, mesh) if mesh else None


def face_with(people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Face:
    """Look at the face of given landmarks [68, 2] in an sRGB uint8 image [H, W, 3].

    Raises InputError, with the likely cause, for landmarks that clearly lie off the face.
    """
    image, size_px = _brightened(image_srgb), image_srgb.shape[:2]

    def detected() -> list[np.ndarray]:
        return [face.landmarks_px for face in detect_faces(people, image_srgb, everyone=True)]

    try:
        check_in_photo(landmarks_px, *size_px)
    except InputError:
        lie_on_one(landmarks_px, detected(), size_px)  # raises one that names the cause
        raise
    face, view = _looked_at(people, image, landmarks_px, mesh_near(people, image, _around(landmarks_px)))
    unclear = view.relative_error > _UNCLEAR and image.any()  # in a black photo nothing is seen anywhere
    if unclear and not lie_on_one(landmarks_px, detected(), size_px):
        check_seen(view)
    return face


def _brightened(image: np.ndarray) -> np.ndarray:
    """A dark image, brighter: neither detectors nor meshes know such photos."""
    stride = max(1, max(image.shape[:2]) // 512)
    brightest = float(np.percentile(image[::stride, ::stride], 99))
    if brightest >= _DARK:
        return image
    gain = 255 / max(brightest, 1.0)
    return np.asarray((image * gain).clip(0, 255).astype(np.uint8))


def _attempts(image: np.ndarray) -> Iterator[list[Square]]:
    """Squares to search, the likeliest first: the whole photo, then ever smaller parts of it."""
    side_px = float(max(image.shape[:2]))
    yield first_squares(image)
    yield [whole_photo(image, turn_rad) for turn_rad in _TURNS]
    yield parts_of(image, side_px / 3)
    if side_px / 3 > _FINEST_PX:
        yield parts_of(image, _FINEST_PX)


def _face_of(people: PeopleNetworks, image: np.ndarray, mesh: FaceMesh) -> Face | None:
    """The face of a mesh; None where the Parsing Network sees no head there."""
    face, view = _looked_at(people, image, mesh.landmarks_px.astype(np.float64), mesh)
    return None if view.presence < LEAST_PRESENCE else replace(face, score=mesh.score)


def _looked_at(
    people: PeopleNetworks, image: np.ndarray, landmarks_px: np.ndarray, mesh: FaceMesh | None
) -> tuple[Face, SquareView]:
    """The face with landmarks [68, 2], and what is seen there; its mesh says how steady it is."""
    (view,) = look(people.parsing, image, [_around(landmarks_px)])
    apart_px = np.linalg.norm(view.landmarks_px[:68] - landmarks_px, axis=-1)
    view = replace(
        view,
        landmarks_px=np.concatenate([landmarks_px, view.landmarks_px[68:]]),
        error_px=np.concatenate([np.maximum(view.error_px[:68], apart_px / 2), view.error_px[68:]]),
        unsteadiness=unsteadiness(people.face_mesh, image, mesh) if mesh else 0.0,
    )
    return Face(box_of(from_landmarks(landmarks_px, 1)), math.inf, landmarks_px, view=view), view


def _around(face: np.ndarray) -> Square:
    """The square that shows a face with landmarks [68, 2] large and upright."""
    left, right = face[list(OUTER_EYE_CORNERS)]
    turn_rad = -math.atan2(right[1] - left[1], right[0] - left[0])
    upright = Square.around(face, _FACE_SIDES)
    return replace(upright, side_px=max(upright.side_px, 1.0), turn_rad=turn_rad)
