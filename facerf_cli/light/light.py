"""Lights, as the Python API and all renderers take them, and arrays: numpy's or torch's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.image.colour import luminance
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.envmap import (
    NO_KEYS,
    check_envmap,
    envmap_weights,
    rig_to_latlong,
    turned,
    without_keys,
)
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.light.studio_points import KeyLight, PointLights, far_samples, has_edges

Array = np.ndarray | Tensor
Rgb = tuple[float, float, float]
_UNIT = 1e-3  # how far the length of a unit direction may be from 1


@dataclass(frozen=True, eq=False)
class Light:
    """Lights that shine together: unit directions toward far ones [L, 3], camera space, rgb weights [L, 3].

    A light of weight 1 gives a white Lambertian surface that faces it radiance 1. Lights add and scale:
    `2 * key + sum(rims)`. Either array may be a tensor, to which gradients then flow. `own_rgb` [3], if not
    None, is the share of the photo's own light. `keys` are ranges of the lights: each holds the samples of
    one whose shadows have edges, as those of `Light.single` have. `near` lights, if any, have rgb weights
    `near_weights` [J, 3] at the face's centre.

    Renderers take M sums of the same lights in tensors (`stacked`): weights [M, L, 3], own_rgb [M, 3],
    near_weights [M, J, 3].
    """

    directions: Any
    weights: Any
    own_rgb: Any = None
    keys: tuple[slice, ...] = ()
    near: tuple[StudioLight, ...] = ()
    near_weights: Any = None
    __array_ufunc__ = None  # so that numpy leaves `array * light` to the light

    def __post_init__(self) -> None:
        """Raise ValueError for arrays of other shapes."""
        directions, weights = list(np.shape(self.directions)), list(np.shape(self.weights))
        if directions[1:] != [3] or weights[-2:] != directions or len(weights) > 3:
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
        return Light(direction.numpy()[None], np.array([rgb], np.float32), keys=(slice(0, 1),))

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
    def each(directions: Tensor, keys: tuple[slice, ...] = ()) -> "Light":
        """Each light [L, 3] alone, of rgb 1: L sums."""
        return Light(directions, torch.eye(len(directions))[..., None].expand(-1, -1, 3), keys=keys)

    @staticmethod
    def from_envmap(envmap: Array, rotate_deg: float = 0.0, lights: int = 150, keys: bool = True) -> "Light":
        """A lat-long map [H, 2 H, 3] as a rig of lights; `rotate_deg` is added to every azimuth.

        With `keys` a sun of the map follows as a single light. Raises InputError for an array that is not
        such a map.
        """
        linear = linear_pixels("map", envmap)
        check_envmap(linear)
        rest, found = without_keys(linear) if keys else (linear, NO_KEYS)
        directions, suns = rig_directions(lights), turned(found, rotate_deg)
        weights = torch.cat([envmap_weights(rest, directions, rotate_deg), suns.weights])
        return Light(
            torch.cat([directions, suns.directions]).numpy(),
            weights if isinstance(envmap, Tensor) else weights.numpy(),
            keys=tuple(slice(key, key + 1) for key in range(len(directions), len(weights))),
        )

    @staticmethod
    def from_picture(picture: Array, fov_deg: float = 60.0, lights: int = 150) -> "Light":
        """The light in a picture [H, W, 3] behind the person, scene-linear: a guess, on the picture's scale.

        `fov_deg` is the angle of view across its width, 1 to 170 degrees. `light.picture.light_of_picture`
        also gives the map and its expected error. Raises ValueError for another picture or angle.
        """
        from facerf_cli.light.picture import light_of_picture  # a network of its own

        guess = light_of_picture(linear_pixels("picture", picture).detach(), fov_deg)
        return Light.from_envmap(guess.envmap.numpy(), lights=lights)

    def to_envmap(self, height: int = 256) -> np.ndarray:
        """A lat-long map [height, 2 height, 3] with these lights; UsageError for the photo's own."""
        if self.own_rgb is not None:
            raise UsageError("to_envmap: the photo's own light has no directions; take person.light")
        light = RigLight(*(values.detach() for values in self._tensors()))
        return rig_to_latlong(light, height).numpy()

    def __add__(self, other: "Light") -> "Light":
        if not isinstance(other, Light):
            return NotImplemented
        first = len(self.directions)
        return Light(
            _joined(self.directions, other.directions),
            _joined(self.weights, other.weights),
            _either(self.own_rgb, other.own_rgb, lambda one, two: one + two),
            self.keys + tuple(slice(first + key.start, first + key.stop) for key in other.keys),
            self.near + other.near,
            _either(self.near_weights, other.near_weights, _joined),
        )

    def __radd__(self, other: int) -> "Light":
        return self if other == 0 else NotImplemented  # where `sum` begins

    def __mul__(self, factor: float | Rgb | Array) -> "Light":
        """The same lights, so many times as bright: by a number, or by one for each colour."""

        def scaled(values: Array | None) -> Any:
            if values is None:
                return None
            values = as_tensor(values).to(factor.device) if isinstance(factor, Tensor) else values
            return values * (np.array(factor, np.float32) if isinstance(factor, tuple) else factor)

        own, near = scaled(self.own_rgb), scaled(self.near_weights)
        return Light(self.directions, scaled(self.weights), own, self.keys, self.near, near)

    __rmul__ = __mul__

    def _tensors(self) -> tuple[Tensor, Tensor]:
        """Directions and weights as float32 tensors on the CPU; raises ValueError for what is no light."""
        directions, weights = unit_directions(self.directions), as_tensor(self.weights)
        if weights.ndim != 2:
            raise ValueError(f"weights have shape {list(weights.shape)}, not [L, 3]")
        if not weights.isfinite().all():
            raise ValueError("weights are not all finite")
        return directions, weights

    def some(self, sums: slice) -> "Light":
        """Some of the sums, without the near lights that shine in none of them."""
        own = None if self.own_rgb is None else self.own_rgb[sums]
        if self.near_weights is None:
            return Light(self.directions, self.weights[sums], own, self.keys)
        near_weights = self.near_weights[sums]
        used = (near_weights != 0).any(0).any(1)
        near = tuple(light for light, shines in zip(self.near, used, strict=True) if shines)
        return Light(self.directions, self.weights[sums], own, self.keys, near, near_weights[:, used])

    @property
    def owns(self) -> Sequence[Tensor | None]:
        """The share [3] of the photo's own light in each sum; None where it shines in none."""
        return [None] * len(self.weights) if self.own_rgb is None else list(self.own_rgb)

    def with_keys_alone(self) -> tuple["Light", list[KeyLight]]:
        """These sums, then each key light alone that shines in one of them with others; and the keys.

        Key lights are those of `keys`, and near ones that are not wide.
        """
        count = len(self.weights)
        near = torch.zeros(count, 0, 3) if self.near_weights is None else self.near_weights
        sums = [[far, near] for far, near in zip(self.weights, near, strict=True)]
        narrow = [at for at, light in enumerate(self.near) if has_edges(light)]
        kinds = [(0, samples) for samples in self.keys] + [(1, slice(at, at + 1)) for at in narrow]
        keys: list[KeyLight] = []
        for number, (kind, samples) in product(range(count), kinds):
            alone = [torch.zeros_like(weights) for weights in sums[number]]
            alone[kind][samples] = sums[number][kind][samples]
            if not alone[kind].any():
                continue
            same = (at for at, one in enumerate(sums[:count]) if all(map(torch.equal, alone, one)))
            at = next(same, len(sums))
            keys.append(KeyLight(number, at, kind == 1, samples))
            if at == len(sums):
                sums.append(alone)
        far, near = (torch.stack(weights) for weights in zip(*sums, strict=True))
        return Light(self.directions, far, near=self.near, near_weights=near if self.near else None), keys

    def near_points(self, centre_m: Tensor) -> list[tuple[PointLights, Tensor]]:
        """The near lights about a face's centre [3], camera space, each with its rgb weights [M, 3]."""
        weights = () if self.near_weights is None else self.near_weights.unbind(1)
        return [(PointLights.of(light, centre_m), rgb) for light, rgb in zip(self.near, weights, strict=True)]

    def arriving(self, place_m: Tensor, centre_m: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions [N, 3] and rgb weights [M, N, 3] of all light at a place [3] of a face.

        Near lights are about the face's centre [3].
        """
        directions, weights = [self.directions], [self.weights]
        for points, rgb in self.near_points(centre_m):
            toward, irradiance = points.arriving(place_m[:, None, None])
            directions.append(toward[:, 0, 0])
            weights.append(rgb[:, None] * irradiance[:, 0, 0, None])
        return torch.cat(directions), torch.cat(weights, 1)

    def strengths(self) -> list[float]:
        """Luminance of all light of each sum, from wherever it comes.

        Of a light of rgb 1 it is 1, of a map of radiance 1 all around 4.
        """
        total = self.weights.sum(1)
        if self.near_weights is not None:
            total = total + self.near_weights.sum(1)
        if self.own_rgb is not None:
            total = total + self.own_rgb
        return [float(value) for value in luminance(total.numpy())]


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


def stacked(lights: Sequence[Light]) -> Light:
    """Lights of far directions as sums of one; directions that they share are one light."""
    assert not any(light.near for light in lights)
    own, each = None, [light._tensors() for light in lights]
    if any(light.own_rgb is not None for light in lights):
        own = torch.stack([as_tensor(np.zeros(3) if one.own_rgb is None else one.own_rgb) for one in lights])
        dark = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
        each = [one if len(one[0]) else dark for one in each]
    if len(each) == 1:
        return Light(each[0][0], each[0][1][None], own, lights[0].keys)
    counts = [len(directions) for directions, _ in each]
    directions = torch.cat([directions for directions, _ in each])
    places = torch.arange(len(directions))
    if not directions.requires_grad:
        directions, places = torch.unique(directions, dim=0, return_inverse=True)
    at = torch.split(places, counts)
    nothing = torch.zeros(len(directions), 3)
    weights = torch.stack([nothing.index_add(0, some, rgb) for some, (_, rgb) in zip(at, each, strict=True)])
    pairs = zip(lights, at, strict=True)
    sharp = {int(number) for light, some in pairs for key in light.keys for number in some[key]}
    return Light(directions, weights, own, tuple(slice(key, key + 1) for key in sorted(sharp)))


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


def uncopied_pixels(name: str, photo: Array) -> np.ndarray:
    """A photo's pixels [H, W, 3], which are not copied; raises ValueError for others."""
    check_kind(name, photo)
    pixels = np.asarray(photo.detach().cpu() if isinstance(photo, Tensor) else photo, np.float32)
    check_finite(name, pixels)
    return pixels


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


def one_of(choices: Any, name: str, value: str) -> None:
    """Raise ValueError for a word that is not one of a Literal's."""
    if value not in get_args(choices):
        raise ValueError(f"{name} is {value!r}, not one of {', '.join(get_args(choices))}")


def as_tensor(values: Any) -> Tensor:
    """Values as a float32 tensor on the CPU, to which gradients flow if it was a tensor."""
    return (
        (values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, np.float32)))
        .float()
        .cpu()
    )


def _joined(one: Array, two: Array) -> Array:
    """Arrays [..., L, 3] one after the other; tensors where either is one."""
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        return np.concatenate([one, two], -2)
    return torch.cat([as_tensor(one), as_tensor(two)], -2)


def _either(one: Any, two: Any, join: Callable[[Any, Any], Any]) -> Any:
    """Both values joined, or the one that is not None."""
    return two if one is None else one if two is None else join(one, two)
