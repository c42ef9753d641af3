"""A light basis whose images are known in closed form: a white hemisphere, lit by Lambert's cosine."""

from functools import cache

import numpy as np
from scipy.spatial import ConvexHull

from facerf_cli.face.crop import Crop
from facerf_cli.light.sphere import rig_directions
from facerf_cli.viewer.basis import ExposureSamples, LightBasis, brightness_of, factored
from facerf_cli.viewer.frame import PersonBox

WIDTH_PX, HEIGHT_PX = 120, 96
BOX = PersonBox(20, 8, 80, 80)
ALBEDO = np.array([0.8, 0.5, 0.3], np.float32)


def normals() -> np.ndarray:
    """[80, 80, 3] of a hemisphere that fills the box; flat outside of its outline."""
    x, y = np.meshgrid((np.arange(80) + 0.5) / 40 - 1, 1 - (np.arange(80) + 0.5) / 40)
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0.05))
    found = np.stack([x, y, z], -1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def radiance(toward: np.ndarray) -> np.ndarray:
    """Radiance [80, 80, 3] of the hemisphere under a light of rgb 1, without shadows: never quite 0."""
    return ALBEDO * (0.55 + 0.45 * normals() @ toward)[..., None].astype(np.float32)


def photo() -> np.ndarray:
    rows = np.linspace(0.1, 0.4, HEIGHT_PX)[:, None, None]
    return np.broadcast_to(rows, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)


def matte() -> np.ndarray:
    found = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
    BOX.of(found)[:] = (np.hypot(*normals()[..., :2].transpose(2, 0, 1)) < 0.9).astype(np.float32)
    return found


def samples(rig: np.ndarray) -> ExposureSamples:
    points = [(30, 30), (40, 40), (20, 50), (55, 35), (40, 22), (60, 60), (33, 48), (48, 58)]
    rows, columns = np.array(points).T
    images = np.stack([radiance(toward)[rows, columns] for toward in rig])
    plate = np.full((len(points), 3), 0.25, np.float32)
    return ExposureSamples(images, images, plate, plate)


@cache
def basis(lights: int = 120, rank: int = 12) -> LightBasis:
    rig = rig_directions(lights)
    directions = rig.numpy()
    detail = np.ones((HEIGHT_PX, WIDTH_PX, 3), np.float32)
    BOX.of(detail)[:] = ALBEDO
    images = np.stack([radiance(toward) / ALBEDO for toward in directions])
    known = samples(directions)
    brightness = brightness_of(known)[:, None]
    maps, coefficients = factored(images / brightness[..., None, None], np.ones((80, 80, 1)), rank)
    return LightBasis(
        photo=photo(),
        background=photo() * (1 - matte()[..., None]),
        matte=matte(),
        detail=detail,
        box=BOX,
        crop=Crop(30.0, 20.0, 60.0, 60),
        maps=maps,
        directions=directions,
        triangles=ConvexHull(rig.double().numpy()).simplices.astype(np.uint16),
        coefficients=coefficients * brightness,
        samples=known,
    )


def truth(lights: list[tuple[np.ndarray, np.ndarray]], ev: float) -> np.ndarray:
    """The scene-linear image [H, W, 3] of lights, exposed."""
    person = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.float32)
    for toward, rgb in lights:
        BOX.of(person)[:] += radiance(toward) * rgb
    share = matte()[..., None]
    return photo() * (1 - share) + share * person * 2.0**ev
