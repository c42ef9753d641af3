"""The light of the Python API, and the arrays that it takes: numpy's or torch's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.envmap import MapKeys, check_envmap, envmap_weights, without_keys
from facerf_cli.light.picture import FOV_DEG, light_of_picture
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.light.studio_points import Lights, far_samples

Array = np.ndarray | Tensor
Rgb = tuple[float, float, float]
_UNIT = 1e-3  # how far the length of a unit direction may be from 1


@dataclass(frozen=True, eq=False)
class Light:
    """Single lights that shine together: unit directions toward them [L, 3], rgb weights [L, 3].

    Directions are in camera space. Lights add and scale: `2 * key + sum(rims)`. Either may be a tensor, to
    which gradients then flow. `own_rgb` [3], if not None, is the share of the photo's own light. `keys` are
    the numbers of lights whose shadows have edges, as those of `Light.single` have.
    """

    directions: Array
    weights: Array
    own_rgb: Array | None = None
    keys: tuple[int, ...] = ()
    __array_ufunc__ = None  # so that numpy leaves `array * light` to the light

    def __post_init__(self) -> None:
        """Raise ValueError for arrays of other shapes."""
        directions, weights = list(np.shape(self.directions)), list(np.shape(self.weights))
        if directions != weights or directions[1:] != [3]:
            shapes = f"shapes {directions} and {weights}; give [L, 3] and [L, 3] (r, g, b of each light)"
            raise ValueError(f"directions and weights have {shapes}")

    @staticmethod
    def single(azimuth_deg: float, elevation_deg: float, rgb: Rgb = (1.0, 1.0, 1.0)) -> "Light":
        """One light; azimuth > 0 is the image's right, elevation > 0 above.

        Raises ValueError for an elevation beyond 90 degrees, a negative colour or what is no number.
        """
        if not (np.isfinite((azimuth_deg, *rgb)).all() and abs(elevation_deg) <= 90 and min(rgb) >= 0):
            raise ValueError(f"no light from {azimuth_deg}, {elevation_deg} degrees of {rgb}")
        direction = azel_to_direction(azimuth_deg, elevation_deg)
        return Light(direction.numpy()[None], np.array([rgb], np.float32), keys=(0,))

    @staticmethod
    def around(rgb: Rgb = (1.0, 1.0, 1.0)) -> "Light":
        """Even light from all around, which sends a white surface as much as a single light that it faces."""
        directions, shares = far_samples(StudioLight())
        return Light(directions.numpy(), shares[:, None].numpy() * np.array(rgb, np.float32))

    @staticmethod
    def own(rgb: Rgb | Array = (1.0, 1.0, 1.0)) -> "Light":
        """The photo's own light, under which the person is as photographed; other lights add to it."""
        nothing = np.zeros((0, 3), np.float32)
        return Light(nothing, nothing, rgb if isinstance(rgb, Tensor) else np.array(rgb, np.float32))

    @staticmethod
    def from_envmap(envmap: Array, rotate_deg: float = 0.0, lights: int = 150, keys: bool = True) -> "Light":
        """A lat-long map [H, 2 H, 3] as a rig of lights; `rotate_deg` is added to every azimuth.

        With `keys` a sun of the map follows as a single light. Raises InputError for an array that is not
        such a map.
        """
        linear = linear_pixels("map", envmap)
        check_envmap(linear)
        found = without_keys(linear) if keys else MapKeys.none(linear)
        directions, suns = rig_directions(lights), found.turned(rotate_deg)
        weights = torch.cat([envmap_weights(found.rest, directions, rotate_deg), suns.weights])
        return Light(
            torch.cat([directions, suns.directions]).numpy(),
            weights if isinstance(envmap, Tensor) else weights.numpy(),
            keys=tuple(range(len(directions), len(weights))),
        )

    @staticmethod
    def from_picture(picture: Array, fov_deg: float = FOV_DEG, lights: int = 150) -> "Light":
        """The light in a picture [H, W, 3] behind the person, scene-linear: a guess, on the picture's scale.

        `fov_deg` is the angle of view across its width, 1 to 170 degrees. `light.picture.light_of_picture`
        also gives the map and its expected error. Raises ValueError for another picture or angle.
        """
        guess = light_of_picture(linear_pixels("picture", picture).detach(), fov_deg)
        return Light.from_envmap(guess.envmap.numpy(), lights=lights)

    def to_envmap(self, height: int = 256) -> np.ndarray:
        """A lat-long map [height, 2 height, 3] with these lights; UsageError for the photo's own."""
        if self.own_rgb is not None:
            raise UsageError("to_envmap: the photo's own light has no directions; take person.light")
        from facerf_cli.light.forms import rig_to_latlong

        light = self.on_cpu()
        return rig_to_latlong(RigLight(light.directions.detach(), light.weights.detach()), height).numpy()

    def __add__(self, other: "Light") -> "Light":
        if not isinstance(other, Light):
            return NotImplemented
        directions = _joined(self.directions, other.directions)
        one, two = self.own_rgb, other.own_rgb
        own = two if one is None else one if two is None else one + two
        keys = (*self.keys, *(len(self.directions) + key for key in other.keys))
        return Light(directions, _joined(self.weights, other.weights), own, keys)

    def __radd__(self, other: int) -> "Light":
        return self if other == 0 else NotImplemented  # where `sum` begins

    def __mul__(self, factor: float | Rgb | Array) -> "Light":
        """The same lights, so many times as bright: by a number, or by one for each colour."""

        def scaled(values: Array) -> Array:
            values = as_tensor(values).to(factor.device) if isinstance(factor, Tensor) else values
            return values * (np.array(factor, np.float32) if isinstance(factor, tuple) else factor)

        own = None if self.own_rgb is None else scaled(self.own_rgb)
        return Light(self.directions, scaled(self.weights), own, self.keys)

    __rmul__ = __mul__

    def on_cpu(self) -> RigLight:
        """The lights as float32 tensors on the CPU; raises ValueError for what is no light."""
        directions, weights = unit_directions(self.directions), as_tensor(self.weights)
        if not weights.isfinite().all():
            raise ValueError("weights are not all finite")
        return RigLight(directions, weights)


def as_light(given: Any, room: float = 0.0) -> Light:
    """A light, or a map's; of lights a white room may send the share `room` back.

    Raises TypeError for what is neither.
    """
    if not (isinstance(room, (int, float)) and 0 <= room <= 1):
        raise ValueError(f"room is {room!r}, not a share from 0 to 1")
    if isinstance(given, Light):
        return given + Light.around() * (room * given.weights.sum(0)) if room else given
    if isinstance(given, np.ndarray | Tensor) and given.ndim == 3:
        return Light.from_envmap(given)
    what = f"has shape {list(given.shape)}" if hasattr(given, "shape") else f"is {type(given).__name__}"
    raise TypeError(f"light {what}, not a facerf.Light or a map [H, 2 H, 3]; read a file by read_image")


def sums_of(lights: Sequence[Light]) -> Lights:
    """Each of M lights as one sum; directions that they share are one light."""
    rigs, own = [light.on_cpu() for light in lights], None
    if any(light.own_rgb is not None for light in lights):
        owns = [np.zeros(3) if light.own_rgb is None else light.own_rgb for light in lights]
        own = torch.stack([as_tensor(one) for one in owns])
        dark = RigLight(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3))
        rigs = [rig if len(rig.directions) else dark for rig in rigs]
    if len(rigs) == 1:
        keys = tuple(slice(key, key + 1) for key in lights[0].keys)
        return replace(Lights.of_rig(rigs[0]), own=own, keys=keys)
    directions = torch.cat([rig.directions for rig in rigs])
    places = torch.arange(len(directions))
    if not directions.requires_grad:
        directions, places = torch.unique(directions, dim=0, return_inverse=True)
    each = list(zip(rigs, torch.split(places, [len(rig.directions) for rig in rigs]), strict=True))
    sharp = {int(at[key]) for light, (_, at) in zip(lights, each, strict=True) for key in light.keys}
    nothing = torch.zeros(len(directions), 3)
    weights = torch.stack([nothing.index_add(0, at, rig.weights) for rig, at in each])
    return Lights(directions, weights, own=own, keys=tuple(slice(key, key + 1) for key in sorted(sharp)))


def rig(lights: int = 150) -> np.ndarray:
    """Unit directions [L, 3] of a uniform rig of so many lights, camera space."""
    return rig_directions(lights).numpy()


def directions_of(lights: int | Array) -> Tensor:
    """Unit directions [L, 3] that are given, or of a rig of so many lights."""
    if isinstance(lights, Light):
        raise TypeError("lights is a Light, not directions [L, 3] or their number")
    return rig_directions(int(lights)) if np.ndim(lights) == 0 else unit_directions(lights)


def unit_directions(values: Any) -> Tensor:
    """Directions [L, 3] on the CPU; raises ValueError unless they are of length 1."""
    directions = as_tensor(values)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions have shape {list(directions.shape)}, not [L, 3]")
    if not ((directions.norm(dim=1) - 1).abs() < _UNIT).all():
        raise ValueError("directions are not all of length 1")
    return directions


def linear_pixels(name: str, pixels: Any, shape: str = "[H, W, 3]") -> Tensor:
    """Scene-linear pixels [H, W, 3] or [H, W] on the CPU; raises ValueError for others, with their name."""
    check_kind(name, pixels, shape)
    linear = as_tensor(pixels)
    check_finite(name, linear.detach().numpy())
    return linear


def check_kind(name: str, pixels: Any, shape: str = "[H, W, 3]") -> None:
    """Raise an error, with their name, for what is no array [H, W, 3] or [H, W] of floats."""
    if not isinstance(pixels, np.ndarray | Tensor):
        raise TypeError(f"{name} is {type(pixels).__name__}, not an array {shape}; read a file by read_image")
    if pixels.ndim != shape.count(",") + 1 or (shape.endswith("3]") and pixels.shape[2] != 3):
        raise ValueError(f"{name} has shape {list(pixels.shape)}, not {shape}")
    if not (pixels.is_floating_point() if isinstance(pixels, Tensor) else pixels.dtype.kind == "f"):
        raise ValueError(f"{name} holds {pixels.dtype}; give scene-linear floats, as read_image does")


def check_finite(name: str, values: np.ndarray) -> None:
    """Raise ValueError for pixels that are no numbers."""
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")


def as_tensor(values: Any) -> Tensor:
    """Values as a float32 tensor on the CPU, to which gradients flow if it was a tensor."""
    return (
        (values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, np.float32)))
        .float()
        .cpu()
    )


def _joined(one: Array, two: Array) -> Array:
    """Arrays one after the other; tensors where either is one."""
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        return np.concatenate([one, two])
    return torch.cat([as_tensor(one), as_tensor(two)])
