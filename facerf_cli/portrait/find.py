"""Detect the people in a photo: their faces, with landmarks and the Parsing Network's view.

The whole photo is searched, then parts of it and rotated copies. MediaPipe's two detectors (Bazarevsky et
al., *BlazeFace*, 2019) process its squares. Around each proposed face a network predicts a mesh (Grishchenko
et al., *Attention Mesh*, 2020), twice, and the probability of a face. The Parsing Network then processes each
face.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import PASS_LANDMARKS, Box, box_of, check_in_photo, from_landmarks
from facerf_cli.face.head import OtherHead
from facerf_cli.face.topology import MIRROR_68, OUTER_EYE_CORNERS
from facerf_cli.image.colour import to_display
from facerf_cli.network.stored_graph import PeopleNetworks, StoredGraph
from facerf_cli.portrait.confidence import check_seen, lie_on_one
from facerf_cli.portrait.parse import LEAST_PRESENCE, Square, SquareView, look, unit_centres, whole_photo
from facerf_cli.run.logs import LOGGER_NAME, step
from facerf_cli.run.threads import in_threads

_IRISES = [range(468, 473), range(473, 478)]  # points of each
_LIDS = [  # points around the opening of each eye
    [33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246],
    [263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466],
]
_AROUND_68 = 1.8  # side of the square around the 68 landmarks, in their extents
_MESH_SIDES = 1.5  # side of the square for a mesh, in sides of the face's box
_MESH_PX = 192
_AFAR = 2.5  # side of the square that shows a photo from afar, in sides of the photo
_OVERLAP = 1.5  # number of parts along a side, relative to the least number that covers the photo
_LEAST_MESH_SCORE, _LEAST_PX = 0.5, 8.0  # of a face; noise has smaller ones
_SAME = 0.5  # largest distance of the middles of two boxes of one face, in sides of the larger
_EYES = (33, 263)  # outer corners, the image's left one first
# MediaPipe's points at the 68 landmarks (Multi-PIE order).
_OF_68 = np.array(
    [
        *(127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356),  # jaw
        *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300),  # brows
        *(168, 197, 5, 4, 75, 97, 2, 326, 305),  # nose
        *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # eyes
        *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
        *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
    ]
)
log = logging.getLogger(LOGGER_NAME)

_NO_FACE = "no face found; try a larger or brighter image that shows the whole face"
_FACE_SIDES = 1.7  # side of the square for the Parsing Network, in extents of the landmarks
_TURNS = (math.pi / 2, -math.pi / 2, math.pi)
_DARK = 100  # of 255: photos whose 99th percentile is below it are brightened
_UNCLEAR = 0.05  # relative error of a user's landmarks above which they may lie off the face
_FINEST_PX = 500.0  # side of a part of the photo in which a face of 24 pixels is detected


@dataclass(frozen=True)
class _Detector:
    """Detector: side of its input, (cells per side, anchors per cell) of its scales, and least score."""

    side_px: int
    scales: tuple[tuple[int, int], ...]
    least_score: float

    def anchors(self) -> np.ndarray:
        """Return the middles [N, 2] of the anchors, in fractions of the input's side."""
        grids = (np.repeat(unit_centres(cells).reshape(-1, 2), each, 0) for cells, each in self.scales)
        return np.concatenate([*grids])


_NEAR = _Detector(128, ((16, 2), (8, 6)), 0.5)
_FAR = _Detector(192, ((48, 1),), 0.6)


@dataclass(frozen=True, eq=False)
class FaceMesh:
    """Mesh of a face: points [478, 3] in the photo's pixels (z on the same scale, smaller toward the camera).

    `score` in 0..1 is the probability of a face; `square` is the input that the mesh was predicted from.
    """

    points_px: np.ndarray
    score: float
    square: Square

    @property
    def landmarks_px(self) -> np.ndarray:
        """68 landmarks [68, 2]."""
        return self.points_px[_OF_68, :2]


@dataclass(frozen=True, eq=False)
class SeenEyes:
    """N eyes in a photo's pixels: centres and radii of irises [N, 3], and lids around them [N, 16, 2]."""

    irises_px: np.ndarray
    lids_px: np.ndarray

    def scaled(self, scale: float) -> "SeenEyes":
        """Return the eyes in the resized photo."""
        return SeenEyes(self.irises_px * scale, self.lids_px * scale)


@dataclass(frozen=True, eq=False)
class _Box:
    """Proposed face: its square, level with the eyes, and score."""

    square: Square
    score: float


_Proposed = TypeVar("_Proposed", _Box, FaceMesh)


def first_squares(image_srgb: np.ndarray) -> list[Square]:
    """Return squares of an image [H, W, 3] to search first: all of it, from afar, and parts of two thirds.

    A face that fills the photo is detected only from afar; from nearby its eyes look like faces.
    """
    side_px = float(max(image_srgb.shape[:2]))
    whole = whole_photo(image_srgb)
    return [whole, replace(whole, side_px=_AFAR * side_px), *parts_of(image_srgb, side_px / 1.5)]


def parts_of(image: np.ndarray, side_px: float) -> list[Square]:
    """Return overlapping squares that cover the photo."""
    rows, columns = (
        np.linspace(
            min(side_px, length) / 2,
            length - min(side_px, length) / 2,
            max(1, math.ceil(_OVERLAP * length / side_px - 0.5)) if length > side_px else 1,
        )
        for length in image.shape[:2]
    )
    return [Square(float(x), float(y), side_px) for y in rows for x in columns]


def find_meshes(people: PeopleNetworks, image_srgb: np.ndarray, squares: Sequence[Square]) -> list[FaceMesh]:
    """Find faces in squares of an sRGB uint8 image [H, W, 3], in descending order of score."""
    boxes = distinct(detected(people, image_srgb, squares))
    return distinct([mesh for box in boxes if (mesh := mesh_near(people, image_srgb, box.square))])


def mesh_near(people: PeopleNetworks, image_srgb: np.ndarray, square: Square) -> FaceMesh | None:
    """Return the mesh of a face that is expected in a square, or None."""
    mesh = mesh_in(people.face_mesh, image_srgb, square)
    if mesh.score > _LEAST_MESH_SCORE:
        mesh = mesh_in(people.face_mesh, image_srgb, face_square(mesh.points_px))
    extent_px = float(np.ptp(mesh.landmarks_px, axis=0).max())
    return mesh if mesh.score > _LEAST_MESH_SCORE and extent_px > _LEAST_PX else None


def eyes_of(people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> SeenEyes:
    """Return the eyes of a face with landmarks [68, 2]: both, or none."""
    mesh = mesh_near(people, image_srgb, Square.around(landmarks_px, _AROUND_68, above=0.1))
    if mesh is None:
        return SeenEyes(np.zeros((0, 3)), np.zeros((0, len(_LIDS[0]), 2)))
    return _eyes_in(mesh)


def _eyes_in(mesh: FaceMesh) -> SeenEyes:
    irises = mesh.points_px[_IRISES, :2]  # [2, 5, 2]: the middle, and four points of the outline
    radii = np.linalg.norm(irises[:, 1:] - irises[:, :1], axis=-1).mean(1)
    return SeenEyes(np.concatenate([irises[:, 0], radii[:, None]], 1), mesh.points_px[_LIDS, :2])


def unsteadiness(network: StoredGraph, image_srgb: np.ndarray, mesh: FaceMesh) -> float:
    """Return the mean distance of a mesh's landmarks from those in the mirrored image, in their extent."""
    square, width = mesh.square, image_srgb.shape[1]
    mirrored = replace(square, x_px=width - square.x_px, turn_rad=-square.turn_rad)
    other_px = mesh_in(network, image_srgb[:, ::-1], mirrored).landmarks_px[MIRROR_68]
    apart_px = np.linalg.norm(mesh.landmarks_px - other_px * (-1, 1) - (width, 0), axis=-1)
    return float(apart_px.mean() / np.ptp(mesh.landmarks_px, axis=0).max())


def detected(people: PeopleNetworks, image_srgb: np.ndarray, squares: Sequence[Square]) -> list[_Box]:
    """Return the boxes that the detectors propose in squares; one face has many."""
    detectors = (people.near_faces, _NEAR), (people.far_faces, _FAR)

    def run(pair: tuple[StoredGraph, _Detector]) -> dict[str, Tensor]:
        network, detector = pair
        images = [square.cut(image_srgb, detector.side_px, outside=0.0) for square in squares]
        out: dict[str, Tensor] = network(torch.stack(images) * 2 - 1)
        return out

    boxes: list[_Box] = []
    for (_, detector), out in zip(detectors, in_threads(run, detectors), strict=True):
        anchors = detector.anchors()
        scores = out["scores"][..., 0].sigmoid().numpy()
        all_values = out["boxes"].reshape(len(squares), -1, 8, 2).numpy() / detector.side_px
        for square, score, values in zip(squares, scores, all_values, strict=True):
            likely = score > detector.least_score
            for middle, size, eyes, its_score in zip(
                values[likely, 0] + anchors[likely],
                values[likely, 1],
                values[likely, 2:4] + anchors[likely, None],
                score[likely],
                strict=True,
            ):
                x_px, y_px = square.to_photo(middle)
                side_px = _MESH_SIDES * float(size.max()) * square.side_px
                level = Square(float(x_px), float(y_px), side_px, _turn_rad(square.to_photo(eyes)))
                boxes.append(_Box(level, float(its_score)))
    return boxes


def mesh_in(network: StoredGraph, image_srgb: np.ndarray, square: Square) -> FaceMesh:
    out = {
        name: value.reshape(-1).numpy()
        for name, value in network(square.cut(image_srgb, _MESH_PX, outside=0.0)[None]).items()
    }
    points = np.concatenate([out["mesh"].reshape(-1, 3), np.zeros((10, 3), np.float32)])
    for name, numbers in _REFINED.items():
        points[numbers, :2] = out[name].reshape(-1, 2)
    for name, first in (("left_iris", 468), ("right_iris", 473)):
        points[first : first + 5, :2] = out[name].reshape(-1, 2)
        points[first : first + 5, 2] = points[_REFINED[f"{name[:-5]}_eye"][:16], 2].mean()
    depth_px = points[:, 2:] * (square.side_px / _MESH_PX)
    placed = np.concatenate([square.to_photo(points[:, :2] / _MESH_PX), depth_px], 1)
    return FaceMesh(placed, float(1 / (1 + np.exp(-out["score"][0]))), square)


def face_square(points_px: np.ndarray) -> Square:
    """Return the square, level with the eyes, in which to predict a mesh again from its points [478, 3]."""
    turn_rad = _turn_rad(points_px[list(_EYES), :2])
    level = Square(0.0, 0.0, 1.0, turn_rad)
    along = level.to_unit_square(points_px[:468, :2])
    low, high = along.min(0), along.max(0)
    x_px, y_px = level.to_photo((low + high) / 2)
    return Square(float(x_px), float(y_px), _MESH_SIDES * float((high - low).max()), turn_rad)


def _turn_rad(eyes_px: np.ndarray) -> float:
    left, right = eyes_px
    return -math.atan2(right[1] - left[1], right[0] - left[0])


def distinct(proposed: list[_Proposed]) -> list[_Proposed]:
    """Keep only the box or mesh with the highest score among overlapping ones."""

    def apart(first: Square, second: Square) -> bool:
        side_px = max(first.side_px, second.side_px) / _MESH_SIDES
        return math.hypot(first.x_px - second.x_px, first.y_px - second.y_px) > _SAME * side_px

    kept: list[_Proposed] = []
    for face in sorted(proposed, key=lambda face: -face.score):
        if all(apart(face.square, other.square) for other in kept):
            kept.append(face)
    return kept


# Indices of the mesh's points that the network refines in a crop around lips and eyes.
_REFINED = {
    "lips": [
        *(61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 185, 40, 39, 37, 0, 267, 269, 270, 409),
        *(78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 191, 80, 81, 82, 13, 312, 311, 310, 415),
        *(76, 77, 90, 180, 85, 16, 315, 404, 320, 307, 306, 184, 74, 73, 72, 11, 302, 303, 304, 408),
        *(62, 96, 89, 179, 86, 15, 316, 403, 319, 325, 292, 183, 42, 41, 38, 12, 268, 271, 272, 407),
    ],
    "left_eye": [
        *(33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173),
        *(130, 25, 110, 24, 23, 22, 26, 112, 243, 247, 30, 29, 27, 28, 56, 190),
        *(226, 31, 228, 229, 230, 231, 232, 233, 244, 113, 225, 224, 223, 222, 221, 189),
        *(35, 124, 46, 53, 52, 65, 143, 111, 117, 118, 119, 120, 121, 128, 245),
        *(156, 70, 63, 105, 66, 107, 55, 193),
    ],
    "right_eye": [
        *(263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398),
        *(359, 255, 339, 254, 253, 252, 256, 341, 463, 467, 260, 259, 257, 258, 286, 414),
        *(446, 261, 448, 449, 450, 451, 452, 453, 464, 342, 445, 444, 443, 442, 441, 413),
        *(265, 353, 276, 283, 282, 295, 372, 340, 346, 347, 348, 349, 350, 357, 465),
        *(383, 300, 293, 334, 296, 336, 285, 417),
    ],
}


class NoFaceError(InputError):
    """No face was detected in an image."""


@dataclass(frozen=True, eq=False)
class Face:
    """Face in a photo: its box and its landmarks [68, 2] in the photo's pixels.

    `view` is the Parsing Network's view of it, with further landmarks and their errors, or None. `eyes` come
    from its mesh, if any. `others` are the photo's other heads; None if they were not detected. `number`
    is its index from the left.
    """

    box_px: Box
    score: float
    landmarks_px: np.ndarray = field(repr=False)
    view: SquareView | None = field(default=None, kw_only=True, repr=False)
    eyes: SeenEyes | None = field(default=None, kw_only=True, repr=False)
    others: Sequence[OtherHead] | None = field(default=None, kw_only=True, repr=False)
    number: int = field(default=0, kw_only=True)

    @property
    def area_px(self) -> float:
        left, top, right, bottom = self.box_px
        return (right - left) * (bottom - top)


def face_at(landmarks_px: np.ndarray) -> Face:
    """Return the face with the user's landmarks [68, 2], in their bounds."""
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    return Face((left, top, right, bottom), math.inf, landmarks_px)


def choose_face(faces: list[Face], which: str, name: str) -> list[Face]:
    """Choose among faces ordered from left to right: the largest, all, or the one at an index from 0.

    'largest' multiplies size by detector score, because a badge on a sleeve can be as large as the face above
    it.
    """
    if which == "all":
        return faces
    if which == "largest":
        if len(faces) > 1:
            log.info(
                "%s: using the largest of %d faces (--face all, or 0 for the leftmost)", name, len(faces)
            )
        return [max(faces, key=lambda face: face.area_px * face.score)]
    if not which.isdecimal():
        raise UsageError(f"--face {which}: invalid value; use largest, all or an index from 0")
    if int(which) >= len(faces):
        raise InputError(f"{name}: has {len(faces)} face(s); use --face 0 (leftmost) to {len(faces) - 1}")
    return [faces[int(which)]]


@step("find")
def find_faces(
    people: PeopleNetworks, pixels_linear: np.ndarray, name: str, which: str = "largest"
) -> list[Face]:
    """Find faces in a scene-linear image [H, W, 3]; `which` is largest, all or an index, see `choose_face`.

    Raises NoFaceError, with the image's name, if there is none.
    """
    faces = detect_faces(people, to_display(pixels_linear), everyone=which != "largest")
    if not faces:
        raise NoFaceError(f"{name}: {_NO_FACE}, or {PASS_LANDMARKS}")
    return choose_face(faces, which, name)


def detect_faces(people: PeopleNetworks, image_srgb: np.ndarray, everyone: bool = False) -> list[Face]:
    """Detect the faces in an sRGB uint8 image [H, W, 3], ordered from left to right.

    Rotated and small faces are searched only if no other is found, or for `everyone`.
    """
    image_srgb, side_px = _brightened(image_srgb), float(max(image_srgb.shape[:2]))
    attempts = [
        first_squares(image_srgb),
        [whole_photo(image_srgb, turn_rad) for turn_rad in _TURNS],
        parts_of(image_srgb, side_px / 3),
    ]
    if side_px / 3 > _FINEST_PX:
        attempts.append(parts_of(image_srgb, _FINEST_PX))
    meshes: list[FaceMesh] = []
    for squares in attempts:
        meshes = distinct([*meshes, *find_meshes(people, image_srgb, squares)])
        if meshes and not everyone:
            break
    faces = [face for mesh in meshes if (face := _face_of(people, image_srgb, mesh))]
    faces.sort(key=lambda face: face.box_px[0])
    heads = [OtherHead(face.landmarks_px) for face in faces]
    return [replace(face, others=heads[:n] + heads[n + 1 :], number=n) for n, face in enumerate(faces)]


def face_near(people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Face | None:
    """Find the face that had landmarks [68, 2] in the previous frame in an sRGB uint8 image [H, W, 3]."""
    mesh = mesh_near(people, image_srgb, _around(landmarks_px))
    return _face_of(people, image_srgb, mesh) if mesh else None


def face_with(people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Face:
    """Return the face with the user's landmarks [68, 2] in an sRGB uint8 image [H, W, 3].

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
    unclear = view.relative_error > _UNCLEAR and image.any()  # a black photo has no visible face anywhere
    if unclear and not lie_on_one(landmarks_px, detected(), size_px):
        check_seen(view)
    return face


def _brightened(image: np.ndarray) -> np.ndarray:
    """Brighten a dark image, because neither detectors nor meshes are trained on such photos."""
    stride = max(1, max(image.shape[:2]) // 512)
    brightest = float(np.percentile(image[::stride, ::stride], 99))
    if brightest >= _DARK:
        return image
    gain = 255 / max(brightest, 1.0)
    return np.asarray((image * gain).clip(0, 255).astype(np.uint8))


def _face_of(people: PeopleNetworks, image: np.ndarray, mesh: FaceMesh) -> Face | None:
    """Return the face of a mesh, or None if the Parsing Network finds no head there."""
    face, view = _looked_at(people, image, mesh.landmarks_px.astype(np.float64), mesh)
    return None if view.presence < LEAST_PRESENCE else replace(face, score=mesh.score)


def _looked_at(
    people: PeopleNetworks, image: np.ndarray, landmarks_px: np.ndarray, mesh: FaceMesh | None
) -> tuple[Face, SquareView]:
    """Return the face with landmarks [68, 2] and its view; a mesh measures how steady it is."""
    (view,) = look(people.parsing, image, [_around(landmarks_px)])
    apart_px = np.linalg.norm(view.landmarks_px[:68] - landmarks_px, axis=-1)
    view = replace(
        view,
        landmarks_px=np.concatenate([landmarks_px, view.landmarks_px[68:]]),
        error_px=np.concatenate([np.maximum(view.error_px[:68], apart_px / 2), view.error_px[68:]]),
        unsteadiness=unsteadiness(people.face_mesh, image, mesh) if mesh else 0.0,
    )
    eyes = _eyes_in(mesh) if mesh else None
    return Face(box_of(from_landmarks(landmarks_px, 1)), math.inf, landmarks_px, view=view, eyes=eyes), view


def _around(face: np.ndarray) -> Square:
    """Return the square in which a face with landmarks [68, 2] is large and upright."""
    square = Square.around(face, _FACE_SIDES)
    turn_rad = _turn_rad(face[list(OUTER_EYE_CORNERS)])
    return replace(square, side_px=max(square.side_px, 1.0), turn_rad=turn_rad)
