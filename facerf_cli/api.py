"""The Python API: what a notebook calls (docs/python.md). numpy in, numpy out; the pipeline does the work.

Images are scene-linear Rec.709, float32 [H, W, 3]; angles in degrees; the units of light are those of the
command line (docs/design.md).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from facerf_cli import pipeline
from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import check_landmarks
from facerf_cli.face.fit import FaceFit, Geometry
from facerf_cli.face.head import Head
from facerf_cli.face.landmarks import to_display
from facerf_cli.files import images
from facerf_cli.image.strips import filled
from facerf_cli.light.envmap import check_envmap, envmap_weights
from facerf_cli.light.forms import rig_to_latlong
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.network.files import checkpoint_file
from facerf_cli.pipeline import Person, reflectance_of
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.segment import segment as segment_image
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.composition import Target
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models
from facerf_cli.relighting.models import load_models as load

Pose = tuple[float, float, float]  # yaw, pitch, roll in degrees (docs/design.md)
Background = Literal["photo", "none"]
_UNIT = 1e-3  # how far the length of a unit direction may be from 1
_ALIKE = 1e-3  # difference of two crops of one photo, of its brightest value


@dataclass(frozen=True, eq=False)
class Light:
    """Single lights that shine together: unit directions toward them [L, 3], rgb weights [L, 3].

    Directions are in camera space. Lights add: `Light.single(40, 20) + Light.single(-90, 0, (1, 0, 0))`.
    """

    directions: np.ndarray
    weights: np.ndarray

    @staticmethod
    def single(
        azimuth_deg: float, elevation_deg: float, rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> "Light":
        """One light; azimuth > 0 is the image's right, elevation > 0 above.

        Raises ValueError for an elevation beyond 90 degrees, a negative colour or what is no number.
        """
        if not (np.isfinite((azimuth_deg, *rgb)).all() and abs(elevation_deg) <= 90 and min(rgb) >= 0):
            raise ValueError(f"no light from {azimuth_deg}, {elevation_deg} degrees of {rgb}")
        direction = azel_to_direction(azimuth_deg, elevation_deg)
        return Light(direction.numpy()[None], np.array([rgb], np.float32))

    @staticmethod
    def from_envmap(envmap: np.ndarray, rotate_deg: float = 0.0, lights: int = 150) -> "Light":
        """A lat-long map [H, 2 H, 3] as a rig of lights; `rotate_deg` is added to every azimuth.

        Raises InputError for an array that is not such a map.
        """
        linear = torch.from_numpy(np.ascontiguousarray(envmap, np.float32))
        check_envmap(linear)
        directions = rig_directions(lights)
        return Light(directions.numpy(), envmap_weights(linear, directions, rotate_deg).numpy())

    def to_envmap(self, height: int = 256) -> np.ndarray:
        """A lat-long map [height, 2 height, 3] with these lights."""
        return rig_to_latlong(self._rig(), height).numpy()

    def __add__(self, other: "Light") -> "Light":
        directions = np.concatenate([self.directions, other.directions])
        return Light(directions, np.concatenate([self.weights, other.weights]))

    def _rig(self) -> RigLight:
        weights = torch.from_numpy(np.ascontiguousarray(self.weights, np.float32))
        if np.shape(self.directions) != weights.shape:
            shapes = f"{list(np.shape(self.directions))} and {list(weights.shape)}"
            raise ValueError(f"directions and weights have shapes {shapes}, not [L, 3]")
        if not weights.isfinite().all():
            raise ValueError("weights are not all finite")
        return RigLight(_directions(self.directions), weights)


def read_image(path: str | Path, colourspace: str | None = None) -> np.ndarray:
    """Read an image or a map as scene-linear Rec.709 [H, W, 3]; `colourspace` overrides the file's."""
    return images.read_image(Path(path), colourspace).pixels


def write_image(path: str | Path, pixels: np.ndarray, exposure: float | Literal["auto"] = 0.0) -> None:
    """Write [H, W, 3] or [H, W, 4] as EXR, or at an exposure in EV as 8-bit PNG or JPEG, by the suffix."""
    path, colour = Path(path), np.ascontiguousarray(pixels[..., :3], np.float32)
    alpha = pixels[..., 3] if pixels.shape[-1] == 4 else None
    if path.suffix.lower() == ".exr":
        images.write_exr(path, colour, alpha)
    else:
        images.write_display(path, colour, exposure, alpha)


def load_models(
    checkpoint: str | Path | Sequence[str | Path] | None = None,
    face_model: str | Path = "builtin",
    device: str = "cpu",
) -> Models:
    """Load networks (None: the shipped ones) and a face model; `device` is cpu, cuda or mps.

    Of several checkpoints, or runs' folders, each serves the networks that its last training trained.
    """
    given = [checkpoint] if isinstance(checkpoint, (str, Path)) else checkpoint or ()
    return load([checkpoint_file(Path(path)) for path in given], face_model, torch.device(device))


def segment(
    photo: np.ndarray, landmarks_px: np.ndarray | None = None, models: Models | None = None
) -> dict[str, np.ndarray]:
    """Segment the person with the largest face of a photo [H, W, 3], or the one with landmarks [68, 2].

    Returns layers [H, W] in 0..1: 'person.A', the matte, and 'class.hair', 'class.skin' and so on, which sum
    to it. Raises InputError where no face is found.
    """
    photo = _checked(photo)
    people = (models.networks if models else SHIPPED_NETWORKS).people
    if landmarks_px is None:
        landmarks_px = find_faces(people, photo, "photo")[0].landmarks_px
    found = segment_image(people, to_display(photo), check_landmarks(landmarks_px))
    return {"person.A": found.matte, **filled(found.layers(), *found.matte.shape)}


def fit_photo(
    models: Models,
    photo: np.ndarray,
    landmarks_px: np.ndarray | None = None,
    texture_side: int | None = None,
    geometry: Geometry | None = None,
) -> Head:
    """Fit the face model to the largest face of a photo, or to given landmarks [68, 2] in its pixels.

    With `geometry` "network" the Geometry Network regresses it from the photo, without landmarks. By default
    geometry and side of the texture are those with which the networks were trained. Raises InputError where
    no face is found or the fit fails.
    """
    photo = _checked(photo)
    sides = models.sides(texture_side)
    if landmarks_px is not None:
        if geometry == "network":
            raise UsageError("geometry: 'network' uses no landmarks; leave one out")
        return pipeline.fit_photo(models, photo, landmarks_px, sides)
    face = pipeline.find_for(models.networks.people, geometry or models.default_geometry, photo, "photo")[0]
    return pipeline.head_of(models, photo, face, sides)


@dataclass(frozen=True)
class _KeyedPhoto:
    """A photo [H, W, 3] as a key of a cache; two are one by their values."""

    digest: bytes
    pixels: np.ndarray = field(compare=False)


@lru_cache(maxsize=1)
def _person(models: Models, photo: _KeyedPhoto, head: Head, kind: RelightKind, network_alone: bool) -> Person:
    """The person of the last call is kept, so that each further light costs what a light costs."""
    pixels = photo.pixels.copy()  # the caller may change its own
    return Person(models, pixels, head, reflectance_of(models, head, kind, network_alone, photo=pixels))


def _checked(photo: np.ndarray) -> np.ndarray:
    photo = np.asarray(photo)
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo has shape {list(photo.shape)}, not [H, W, 3]")
    if not np.issubdtype(photo.dtype, np.floating):
        raise ValueError(f"photo holds {photo.dtype}; give scene-linear floats, as read_image does")
    photo = np.ascontiguousarray(photo, np.float32)
    if not np.isfinite(photo).all():
        raise ValueError("photo holds values that are not finite")
    return photo


def _directions(values: np.ndarray) -> torch.Tensor:
    directions = torch.from_numpy(np.ascontiguousarray(values, np.float32))
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions have shape {list(directions.shape)}, not [L, 3]")
    if not ((directions.norm(dim=1) - 1).abs() < _UNIT).all():
        raise ValueError("directions are not all of length 1")
    return directions


def _one_of(choices: Any, name: str, value: str) -> None:
    if value not in get_args(choices):
        raise ValueError(f"{name} is {value!r}, not one of {', '.join(get_args(choices))}")


def relight(
    models: Models,
    photo: np.ndarray,
    head: Head,
    light: Light,
    pose: Pose | None = None,
    alone: bool = False,
    reflectance: RelightKind = "portrait",
    network_alone: bool = False,
    background: Background = "photo",
) -> np.ndarray:
    """Relight a photo's person: the photo [H, W, 3], or with `alone` the face with alpha [H, W, 4].

    `pose` turns the head, which shows the face alone. `network_alone` leaves out the correction by the photo.
    Without a background ("none") the person has alpha [H, W, 4]; colours are not multiplied by it. Raises
    ValueError for another photo than that of the head.
    """
    _one_of(RelightKind, "reflectance", reflectance)
    _one_of(Background, "background", background)
    if network_alone and reflectance not in ("field", "portrait"):
        raise UsageError("network_alone: is for the fields; leave it out, or use reflectance='field'")
    fit = _posed(head.fit, pose)
    target = Target(fit, "face" if alone or pose is not None else "photo", background=background)
    photo, rig = _checked(photo), light._rig()
    if not np.allclose(head.fit.crop.apply(photo), head.cropped, rtol=0, atol=_ALIKE * head.cropped.max()):
        raise ValueError("photo is not the one that the head was fitted in; fit it again")
    pixels = _KeyedPhoto(hashlib.blake2b(photo.data).digest(), photo)
    with torch.no_grad():
        image = _person(models, pixels, head, reflectance, network_alone).image(rig, target)
    return image.pixels if image.alpha is None else np.dstack([image.pixels, image.alpha])


def predict_olat(
    models: Models,
    head: Head,
    lights: int | np.ndarray = 150,
    pose: Pose | None = None,
    network_alone: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict one light at a time: directions [L, 3] and UV textures [L, T, T, 3].

    `lights` is the size of a uniform rig, or unit directions [L, 3] in camera space.
    """
    rig = np.asarray(lights)
    directions = _directions(rig) if rig.ndim else rig_directions(int(rig))
    fit = _posed(head.fit, pose)
    rotation = None if fit is None else fit.rotation
    batches = pipeline.predict_olat(models, head, directions, rotation, network_alone)
    olats = torch.cat(list(batches)).permute(0, 2, 3, 1).contiguous()
    return directions.numpy(), olats.numpy()


def estimate_light(models: Models, head: Head, lights: int = 150, reflectance: Kind = "field") -> Light:
    """Estimate the light of a head's photo over a rig of `lights`; baselines have a rig of their own.

    Raises InputError where too little of the face is visible.
    """
    _one_of(Kind, "reflectance", reflectance)
    with torch.no_grad():
        light = pipeline.estimate_light(models, head, reflectance, rig_directions(lights)).light
    return Light(light.directions.numpy(), light.weights.numpy())


def _posed(fit: FaceFit, pose: Pose | None) -> FaceFit | None:
    return None if pose is None else replace(fit, rotation=pose_to_rotation(*pose))
