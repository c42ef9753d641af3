"""The example photo, fitted once a process."""

from functools import cache
from pathlib import Path

import numpy as np

from facerf_cli.face.head import Head
from facerf_cli.files.read import read_image
from facerf_cli.person import Person, fit
from facerf_cli.portrait.find import Face, find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models
from facerf_cli.relighting.portrait_field import PortraitField

PATH = Path(__file__).parents[1] / "examples/astronaut.jpg"
TEXTURE = 128  # texels


@cache
def models() -> Models:
    return load_models()


@cache
def photo() -> np.ndarray:
    return read_image(PATH).pixels


@cache
def face() -> Face:
    return find_faces(SHIPPED_NETWORKS.people, photo(), "astronaut")[0]


@cache
def person() -> Person:
    """The astronaut with her portrait field."""
    return fit(models(), photo(), face=face(), texture_side=TEXTURE, white_balance=None)


def head() -> Head:
    return person().head


def field() -> PortraitField:
    found = person().reflectance
    assert isinstance(found, PortraitField)
    return found
