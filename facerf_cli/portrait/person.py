"""A person in the Portrait Network's square: image, classes, and the geometry of the proxy.

Its normals may come from another method, such as DAViD or Sapiens (`with_normals`). In their camera space x
is to the image's right. y is up and z toward the camera, as here (OpenGL), or y is down and z away from it
(OpenCV), which few methods document. So each axis gets the sign for which the normals agree with the fitted
face.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import OtherHead
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.image.colour import to_display, without_fireflies
from facerf_cli.image.strips import Window, resized
from facerf_cli.network.portrait import SKIN, PortraitInputs, PortraitMaps, reached_by, skin_exposure
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import SeenEyes, eyes_of
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.proxy import (
    Proxy,
    ProxyMaps,
    Shadows,
    own_shading,
    proxy_maps,
    proxy_of,
    square_camera,
)
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera
from facerf_cli.run.logs import LOGGER_NAME, step

SIDE_PX = 192  # pixels of the square around head and shoulders in the Portrait Network's training
SEEN_PX = 224  # and in use, which improves face and hair and makes ears and neck slightly worse
SIDES = 3.0  # side of the square in extents of the landmarks: the larger side of their bounds
_WIDEST = 7.0  # largest side of the square around the whole person, in these extents
_NEAR_IRIS = 1.5  # radius around an iris whose light the iris reflects, in its radii
_FINEST = 3  # largest number of shadow samples along a pixel of the maps
PATTERN_PX = 3  # side of the squares of pixels of which each has other rays; windows start between them
_BARE = [class_index(name) for name in ("skin", "lips", "beard", "ears", "neck")]
_LEAST_BARE = 0.1  # coverage below which shadows are not worth their time
_OVERHANG = 0.03  # tolerated overhang of a person over the square, in its sides; and its margin
_LENGTHS = (0.5, 1.5)  # range of the length of valid normals; black in a PNG is longer
_SURE = 0.5  # least fraction of skin of the pixels that determine the axes
_AGREED = 0.7  # least mean cosine between the photo's normals and the fitted face

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class SeenPerson:
    """Person in a photo: image [3, S, S] scene-linear and classes [C, S, S] in a square, and the proxy.

    `normals` [H, W, 3] of the photo come from the user (`with_normals`), 0 where unknown.
    """

    square: Crop
    image: Tensor
    classes: Tensor
    proxy: Proxy
    maps: ProxyMaps
    fit: FaceFit
    segmentation: Segmentation
    eyes: SeenEyes
    normals: np.ndarray | None = None

    @property
    def exposure(self) -> float:
        """Radiance of the photo over that of the network's input."""
        return float(skin_exposure(self.image[None], self.classes[None]))

    @property
    def exposed(self) -> Tensor:
        """Image [3, S, S] in the units of the network's input."""
        return self.image / self.exposure

    @property
    def own_pixels(self) -> Tensor:
        """1 where the person covers most of a pixel [S, S], otherwise 0."""
        return (1 - self.classes[0] > 0.5).float()

    def around_iris(self, number: int) -> tuple[Shadows, Tensor]:
        """Return the visibility around an iris, and the positions [h, w, 2] of its pixels in -1..1."""
        x_px, y_px, radius_px = self.eyes.irises_px[number]
        reach, last = max(1, round(_NEAR_IRIS * radius_px * self.square.scale)), self.square.size_px - 1
        at = self.square.to_crop(np.array([[x_px, y_px]]))[0].clip(0, last).astype(int)
        columns, rows = (slice(max(0, middle - reach), middle + reach + 1) for middle in at)
        fields = (self.maps.normals, self.maps.positions_m, self.maps.covered)
        maps = ProxyMaps(*(field[..., rows, columns] for field in fields))
        at_pixels = 2 * (torch.arange(last + 1) + PIXEL_CENTRE) / (last + 1) - 1
        y, x = torch.meshgrid(at_pixels[rows], at_pixels[columns], indexing="ij")
        shadows = Shadows(self.proxy, replace(maps, covered=torch.ones_like(maps.covered)))
        return shadows, torch.stack([x, y], -1)

    @property
    def sides(self) -> float:
        """Side of the square relative to the face: the larger side of the bounds of landmarks."""
        extents_px = np.ptp(self.fit.crop.to_photo(self.fit.landmarks_px.numpy()), axis=0)
        return self.square.side_px / float(extents_px.max())

    def within(self, square: Crop, photo: np.ndarray) -> "SeenPerson":
        """Return the same person in another square of the photo [H, W, 3]."""
        return replace(
            self,
            square=square,
            image=_image_in(photo, square),
            classes=_classes_in(self.segmentation, square),
            maps=proxy_maps(self.proxy, square_camera(self.fit, square)),
        )

    @cached_property
    def shadows(self) -> Shadows:
        """Visibility of lights from each pixel, at half the square's side."""
        half = replace(self.square, size_px=self.square.size_px // 2)
        return Shadows(self.proxy, proxy_maps(self.proxy, square_camera(self.fit, half)))

    @cached_property
    def bare(self) -> Tensor:
        """Coverage [S, S] of bare skin; 0 where it is hardly any."""
        coverage = self.classes[_BARE].sum(0)
        return coverage * (coverage > _LEAST_BARE)

    @property
    def finer_size_px(self) -> int:
        """Side of the square in the pixels of `finer`."""
        return self.square.size_px * min(_FINEST, math.ceil(1 / self.square.scale))

    @cached_property
    def finer(self) -> tuple[ProxyMaps, Window]:
        """Proxy, not filled, around bare skin at the photo's resolution, and this window of the square.

        A pixel of the maps has at most `_FINEST` pixels along each side.
        """
        whole = square_camera(self.fit, replace(self.square, size_px=self.finer_size_px))
        times, bare = self.finer_size_px // self.square.size_px, self.bare.numpy()
        used = [np.flatnonzero(bare.any(axis)) if bare.any() else np.arange(len(bare)) for axis in (1, 0)]
        window = Window(*(slice((at[0] - at[0] % PATTERN_PX) * times, (at[-1] + 1) * times) for at in used))
        (height_px, width_px), (top, left) = window.shape, (part.start for part in window)
        camera = Camera(whole.focal_px, width_px, height_px, whole.cx_px - left, whole.cy_px - top)
        return proxy_maps(self.proxy, camera, filled=False), window

    def inputs(self, rig: Tensor) -> PortraitInputs:
        """Return the network's inputs [1, ...], with the visibility of a rig [L, 3]."""
        visible = self.shadows.along(rig)
        own = own_shading(self.image, self.classes, self.maps.normals, rig, visible, self.sides)
        reached = reached_by(rig, visible, self.square.size_px)
        surface = surface_of(self.maps)
        return PortraitInputs(self.exposed[None], self.classes[None], *surface, reached[None], own[None])


def surface_of(maps: ProxyMaps) -> tuple[Tensor, Tensor, Tensor]:
    """Return a proxy's normals [1, 3, S, S], depth [1, 1, S, S] in decimetres from its mean, and coverage."""
    z, covered = maps.positions_m[2], maps.covered
    depth = (z - (z * covered).sum() / covered.sum()) / 0.1
    return maps.normals[None], depth.clamp(-3, 3)[None, None], covered[None, None]


def portrait_square(landmarks_px: np.ndarray) -> Crop:
    """Return the square of a photo around landmarks [68, 2] in its pixels."""
    low, high = landmarks_px.min(0), landmarks_px.max(0)
    side_px = SIDES * float((high - low).max())
    x_px, y_px = (low + high) / 2
    return Crop(float(x_px) - side_px / 2, float(y_px) - side_px / 2, side_px, SEEN_PX)


def wider_square(square: Crop, matte: np.ndarray) -> Crop | None:
    """Return a square that also contains a person's matte [H, W], or None if the given square does.

    It is at most as large as `_WIDEST` faces; then it is moved toward most of the person.
    """
    covered = matte > 0.5
    if not covered.any():
        return None
    columns, rows = (np.flatnonzero(covered.any(axis)) for axis in (0, 1))
    start_px, end_px = np.array([square.x0_px, square.y0_px]), square.side_px
    low = np.minimum([columns[0], rows[0]], start_px)
    high = np.maximum([columns[-1] + 1, rows[-1] + 1], start_px + end_px)
    beyond_px = max(float((start_px - low).max()), float((high - start_px - end_px).max()))
    if beyond_px < _OVERHANG * square.side_px:
        return None
    side_px = min(float((high - low).max()) * (1 + 2 * _OVERHANG), _WIDEST / SIDES * square.side_px)
    # as close to the middle of the person as the head's square allows
    least, most = start_px + square.side_px - side_px, start_px
    x_px, y_px = np.clip((low + high) / 2 - side_px / 2, least, most)
    return Crop(float(x_px), float(y_px), side_px, SEEN_PX)


@step("look")
def look_at_person(
    people: PeopleNetworks,
    model: MorphableModel,
    photo: np.ndarray,
    fit: FaceFit,
    segmentation: Segmentation | None = None,
    matte: np.ndarray | None = None,
    others: Sequence[OtherHead] | None = None,
    eyes: SeenEyes | None = None,
) -> SeenPerson:
    """Segment a person in a photo and fit the proxy of the face, in the square around the landmarks.

    Args:
        people: The networks that find and cut out people.
        model: The face model of the fit.
        photo: Scene-linear [H, W, 3].
        fit: The fitted face.
        segmentation: The person's segmentation; None computes it.
        matte: The person's matte [H, W] from the user.
        others: The photo's other heads; None detects them.
        eyes: The person's eyes; None detects them.

    Raises:
        InputError: No skin is visible, so the exposure is unknown.
    """
    landmarks_px = fit.crop.to_photo(fit.landmarks_px.numpy())
    square = portrait_square(landmarks_px)
    display = to_display(photo)
    segmentation = segmentation or segment(people, display, landmarks_px, matte, others)
    classes = _classes_in(segmentation, square)
    if classes[class_index("skin")].sum() < 1:
        raise InputError("no skin is visible around the landmarks; check them, or use --reflectance field")
    proxy = proxy_of(model, fit, classes, square)
    maps = proxy_maps(proxy, square_camera(fit, square))
    eyes = eyes or eyes_of(people, display, landmarks_px)
    return SeenPerson(square, _image_in(photo, square), classes, proxy, maps, fit, segmentation, eyes)


def _image_in(photo: np.ndarray, square: Crop) -> Tensor:
    """Return a square [3, S, S] of a photo [H, W, 3]."""
    return torch.from_numpy(without_fireflies(square.apply(photo))).permute(2, 0, 1)


def _classes_in(segmentation: Segmentation, square: Crop) -> Tensor:
    """Return the classes [C, S, S] in a square; outside the photo there is background."""
    height, width = segmentation.matte.shape
    at = (np.arange(square.size_px) + PIXEL_CENTRE) / square.size_px
    x, y = np.meshgrid(*square.to_photo(np.stack([at, at], -1) * square.size_px).T)
    grid = torch.from_numpy(np.stack([2 * x / width - 1, 2 * y / height - 1], -1)).float()[None]
    classes = F.grid_sample(segmentation.classes[None], grid, align_corners=False)[0]
    classes[0] += (1 - classes.sum(0)).clamp_min(0)
    return classes


def unit_normals(normals: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Resize normals [h, w, 3] to a photo's size and normalize them [H, W, 3]; 0 where unknown."""
    (height, width), (rows, columns) = size_px, normals.shape[:2]
    if abs(width - height / rows * columns) > 2 * max(1.0, height / rows):  # sides were rounded
        sizes = f"{columns} x {rows} pixels, the photo {width} x {height}"
        raise InputError(f"the normals have {sizes}; use normals of this photo")
    if (rows, columns) != size_px:
        normals = resized(normals, height, width)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (length > _LENGTHS[0]) & (length < _LENGTHS[1])
    return np.where(known, normals / np.maximum(length, _LENGTHS[0]), 0).astype(np.float32)


def with_normals(person: SeenPerson, normals: np.ndarray) -> SeenPerson:
    """Use unit normals [H, W, 3] of the person's photo; the fitted face determines the sign of each axis.

    Raises InputError if they do not agree with the face.
    """
    in_square = _in_square(person, normals)
    known = in_square.norm(dim=0) > _LENGTHS[0]
    sure = (person.classes[SKIN] > _SURE) & (person.maps.covered > 0) & known
    products = (in_square * person.maps.normals)[:, sure].sum(1)
    cosine = float(products.abs().sum() / max(1, int(sure.sum())))
    if cosine < _AGREED:
        raise InputError(
            f"the normals do not match the face (mean cosine {cosine:.2f}); use normals of this photo in "
            "camera space, with x in the red channel"
        )
    if flipped := [name for name, product in zip("xyz", products, strict=True) if product < 0]:
        log.info("normals: flipped %s to match the fitted face", " and ".join(flipped))
    return replace(person, normals=normals * np.where(products.numpy() < 0, -1, 1).astype(np.float32))


def maps_with_normals(maps: PortraitMaps, person: SeenPerson) -> PortraitMaps:
    """Blend the user's normals, if any, into the maps where the person is visible."""
    if person.normals is None:
        return maps
    normals = _in_square(person, person.normals)
    weight = (1 - person.classes[0]) * (normals.norm(dim=0) > _LENGTHS[0])
    return maps._replace(normals=F.normalize(torch.lerp(maps.normals, normals[None], weight), dim=1))


def _in_square(person: SeenPerson, normals: np.ndarray) -> Tensor:
    """Average normals of the photo over the pixels [3, S, S] of the person's square."""
    return torch.from_numpy(person.square.apply(normals)).permute(2, 0, 1)
