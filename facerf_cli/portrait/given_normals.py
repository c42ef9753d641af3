"""Normals of a photo that another method estimated, such as DAViD or Sapiens, in place of the networks'.

In camera space x is to the image's right. y is up and z toward the camera, as here (OpenGL), or y is down and
z away from it (OpenCV), and few methods say which: each axis gets the sign by which the normals agree with
those of the fitted face.
"""

import logging
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.image.strips import resized
from facerf_cli.network.portrait import SKIN, PortraitMaps
from facerf_cli.portrait.person import SeenPerson
from facerf_cli.run.logs import LOGGER_NAME

_LENGTHS = (0.5, 1.5)  # of what is a normal; black in a PNG is longer
_SURE = 0.5  # share of skin from which on a pixel has a say in the axes
_AGREED = 0.7  # mean cosine to the fitted face from which on normals are the photo's

log = logging.getLogger(LOGGER_NAME)


def unit_normals(normals: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Unit normals [H, W, 3] of a photo's size, from those of its aspect [h, w, 3]; 0 where none are."""
    (height, width), (rows, columns) = size_px, normals.shape[:2]
    if abs(width - height / rows * columns) > 2 * max(1.0, height / rows):  # sides were rounded
        raise InputError(
            f"the normals have {columns} x {rows} pixels, the photo {width} x {height}; give its own"
        )
    if (rows, columns) != size_px:
        normals = resized(normals, height, width)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (length > _LENGTHS[0]) & (length < _LENGTHS[1])
    return np.where(known, normals / np.maximum(length, _LENGTHS[0]), 0).astype(np.float32)


def with_normals(person: SeenPerson, normals: np.ndarray) -> SeenPerson:
    """The person with unit normals [H, W, 3] of its photo, whose axes the fitted face tells.

    Raises InputError where they do not agree with it.
    """
    given = _in_square(person, normals)
    sure = (person.classes[SKIN] > _SURE) & (person.maps.covered > 0) & (given.norm(dim=0) > _LENGTHS[0])
    products = (given * person.maps.normals)[:, sure].sum(1)
    agreed = float(products.abs().sum() / max(1, int(sure.sum())))
    if agreed < _AGREED:
        raise InputError(
            f"the normals are not those of the face (mean cosine {agreed:.2f}); give the photo's own, in "
            "camera space, x in the red channel"
        )
    if turned := [name for name, product in zip("xyz", products, strict=True) if product < 0]:
        log.info("given normals: %s turned, by the fitted face", " and ".join(turned))
    return replace(person, normals=normals * np.where(products.numpy() < 0, -1, 1).astype(np.float32))


def maps_with_normals(maps: PortraitMaps, person: SeenPerson) -> PortraitMaps:
    """The maps of a person with its given normals, if there are any, as far as the person is seen."""
    if person.normals is None:
        return maps
    given = _in_square(person, person.normals)
    share = (1 - person.classes[0]) * (given.norm(dim=0) > _LENGTHS[0])
    return maps._replace(normals=F.normalize(torch.lerp(maps.normals, given[None], share), dim=1))


def _in_square(person: SeenPerson, normals: np.ndarray) -> Tensor:
    """Means [3, S, S] of normals of the photo over the pixels of the person's square."""
    return torch.from_numpy(person.square.apply(normals)).permute(2, 0, 1)
