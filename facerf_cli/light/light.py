"""Lights of the Python API and of all renderers: far, near and uniform lights, and their array checks.

Renderers see a near light as points; `_grid` samples its square panel, and that of a soft far light.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.image.colour import REC709_CHROMATICITIES, colour_science, luminance, rgb_to_xyz
from facerf_cli.light.entries import StudioLight, parse_lights
from facerf_cli.light.envmap import (
    NO_KEYS,
    check_envmap,
    envmap_weights,
    rig_to_latlong,
    turned,
    without_keys,
)
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions

Array = np.ndarray | Tensor
Rgb = tuple[float, float, float]
WHITE_K = 6504.0  # correlated colour temperature of D65
_UNIT = 1e-3  # tolerance of the length of a unit direction
_APART_DEG, _MOST_A_SIDE = 6.0, 6  # spacing and number of samples along a panel's side, seen from the face
UNIFORM_LIGHTS = 32  # samples of uniform light
_NEAREST_M = 0.05  # distance below which irradiance stops growing
_FULL_CONE = 0.8  # fraction of a spot's cone with full irradiance, which then falls to 0
_WIDEST_DEG = 36.0  # angular side of a light from which its shadows have no hard edges


@dataclass(frozen=True, eq=False)
class Light:
    """Far lights that shine together: unit directions [L, 3] toward them and rgb weights [L, 3].

    Directions are in camera space. A light of weight 1 gives a white Lambertian surface that faces it
    radiance 1. Lights add and scale: `2 * key + sum(rims)`. If an array is a tensor, gradients flow to it.
    `original_rgb` [3], if not None, is the factor of the photo's original light. `keys` are ranges of lights:
    each range holds the samples of a light whose shadows have hard edges. `near` lights have rgb weights
    `near_weights` [J, 3] at the face's centre.

    Renderers use M sums of the same lights as tensors (`stacked`): weights [M, L, 3], original_rgb [M, 3],
    near_weights [M, J, 3].
    """

    directions: Any
    weights: Any
    original_rgb: Any = None
    keys: tuple[slice, ...] = ()
    near: tuple[StudioLight, ...] = ()
    near_weights: Any = None
    __array_ufunc__ = None  # so that numpy leaves `array * light` to the light

    def __post_init__(self) -> None:
        directions, weights = list(np.shape(self.directions)), list(np.shape(self.weights))
        if directions[1:] != [3] or weights[-2:] != directions or len(weights) > 3:
            shapes = f"{directions} and {weights}; use [L, 3] and [L, 3] (r, g, b of each light)"
            raise ValueError(f"directions and weights have shapes {shapes}")

    @staticmethod
    def single(azimuth_deg: float, elevation_deg: float, rgb: Rgb = (1.0, 1.0, 1.0)) -> "Light":
        """Return one light; azimuth > 0 is to the image's right, elevation > 0 is above.

        Raises ValueError for an elevation beyond 90 degrees, a negative colour or a non-finite number.
        """
        if not (np.isfinite((azimuth_deg, *rgb)).all() and abs(elevation_deg) <= 90 and min(rgb) >= 0):
            raise ValueError(f"invalid light: azimuth {azimuth_deg}, elevation {elevation_deg}, rgb {rgb}")
        direction = azel_to_direction(azimuth_deg, elevation_deg)
        return Light(direction.numpy()[None], np.array([rgb], np.float32), keys=(slice(0, 1),))

    @staticmethod
    def uniform(rgb: Rgb = (1.0, 1.0, 1.0)) -> "Light":
        """Return uniform light; it lights a white surface as much as a single light that it faces."""
        directions, weights = far_samples(StudioLight())
        return Light(directions.numpy(), weights[:, None].numpy() * np.array(rgb, np.float32))

    @staticmethod
    def original(rgb: Rgb | Array = (1.0, 1.0, 1.0)) -> "Light":
        """Return the photo's original light, which reproduces the photo; other lights add to it."""
        nothing = np.zeros((0, 3), np.float32)
        return Light(nothing, nothing, rgb if isinstance(rgb, Tensor) else np.array(rgb, np.float32))

    @staticmethod
    def each(directions: Tensor, keys: tuple[slice, ...] = ()) -> "Light":
        """Return L sums, each with only one of the lights [L, 3], of rgb 1."""
        return Light(directions, torch.eye(len(directions))[..., None].expand(-1, -1, 3), keys=keys)

    @staticmethod
    def from_envmap(envmap: Array, rotate_deg: float = 0.0, lights: int = 150, keys: bool = True) -> "Light":
        """Convert a lat-long map [H, 2 H, 3] to a rig of lights; `rotate_deg` is added to every azimuth.

        With `keys`, a sun in the map becomes a separate single light. Raises InputError for another shape.
        """
        linear = linear_pixels("map", envmap)
        check_envmap(linear)
        rest, key_lights = without_keys(linear) if keys else (linear, NO_KEYS)
        directions, suns = rig_directions(lights), turned(key_lights, rotate_deg)
        weights = torch.cat([envmap_weights(rest, directions, rotate_deg), suns.weights])
        return Light(
            torch.cat([directions, suns.directions]).numpy(),
            weights if isinstance(envmap, Tensor) else weights.numpy(),
            keys=tuple(slice(key, key + 1) for key in range(len(directions), len(weights))),
        )

    @staticmethod
    def from_picture(picture: Array, fov_deg: float = 60.0, lights: int = 150) -> "Light":
        """Estimate the light from a background [H, W, 3], scene-linear, in the background's units.

        `fov_deg` is the horizontal angle of view, 1 to 170 degrees. `light.picture.light_of_picture` also
        returns the map and its expected error. Raises ValueError for another shape or angle.
        """
        from facerf_cli.light.picture import light_of_picture  # a network of its own

        guess = light_of_picture(linear_pixels("picture", picture).detach(), fov_deg)
        return Light.from_envmap(guess.envmap.numpy(), lights=lights)

    def to_envmap(self, height: int = 256) -> np.ndarray:
        """Convert to a lat-long map [height, 2 height, 3]; raises UsageError for the original light."""
        if self.original_rgb is not None:
            raise UsageError("to_envmap: the original light has no directions; use person.light")
        light = RigLight(*(values.detach() for values in self._tensors()))
        return rig_to_latlong(light, height).numpy()

    def __add__(self, other: "Light") -> "Light":
        if not isinstance(other, Light):
            return NotImplemented
        first = len(self.directions)
        return Light(
            _joined(self.directions, other.directions),
            _joined(self.weights, other.weights),
            _either(self.original_rgb, other.original_rgb, lambda one, two: one + two),
            self.keys + tuple(slice(first + key.start, first + key.stop) for key in other.keys),
            self.near + other.near,
            _either(self.near_weights, other.near_weights, _joined),
        )

    def __radd__(self, other: int) -> "Light":
        return self if other == 0 else NotImplemented  # the start value of `sum`

    def __mul__(self, factor: float | Rgb | Array) -> "Light":
        """Scale all lights by a number, or by one number per colour channel."""

        def scaled(values: Array | None) -> Any:
            if values is None:
                return None
            values = as_tensor(values).to(factor.device) if isinstance(factor, Tensor) else values
            return values * (np.array(factor, np.float32) if isinstance(factor, tuple) else factor)

        original, near = scaled(self.original_rgb), scaled(self.near_weights)
        return Light(self.directions, scaled(self.weights), original, self.keys, self.near, near)

    __rmul__ = __mul__

    def _tensors(self) -> tuple[Tensor, Tensor]:
        """Return directions and weights as float32 tensors on the CPU; raises ValueError for invalid ones."""
        directions, weights = unit_directions(self.directions), as_tensor(self.weights)
        if weights.ndim != 2:
            raise ValueError(f"weights have shape {list(weights.shape)}, not [L, 3]")
        if not weights.isfinite().all():
            raise ValueError("weights are not all finite")
        return directions, weights

    def some(self, sums: slice) -> "Light":
        """Select sums, with only the near lights that contribute to them."""
        original = None if self.original_rgb is None else self.original_rgb[sums]
        selected = replace(self, weights=self.weights[sums], original_rgb=original)
        if self.near_weights is None:
            return selected
        near_weights = self.near_weights[sums]
        used = (near_weights != 0).any(0).any(1)
        near = tuple(light for light, is_used in zip(self.near, used, strict=True) if is_used)
        return replace(selected, near=near, near_weights=near_weights[:, used])

    @property
    def original_rgbs(self) -> Sequence[Tensor | None]:
        """Rgb factor [3] of the photo's original light in each sum, or None."""
        return [None] * len(self.weights) if self.original_rgb is None else list(self.original_rgb)

    def with_keys_alone(self) -> tuple["Light", list["KeyLight"]]:
        """Append a sum for each key light that shines together with other lights; also return the keys.

        Key lights are those of `keys`, and near lights whose shadows have hard edges.
        """
        count = len(self.weights)
        near = torch.zeros(count, 0, 3) if self.near_weights is None else self.near_weights
        sums = [[far, near] for far, near in zip(self.weights, near, strict=True)]
        narrow = [at for at, light in enumerate(self.near) if _wide_deg(light) <= _WIDEST_DEG]
        kinds = [(0, samples) for samples in self.keys] + [(1, slice(at, at + 1)) for at in narrow]
        keys: list[KeyLight] = []
        for number, (kind, samples) in product(range(count), kinds):
            key = [torch.zeros_like(weights) for weights in sums[number]]
            key[kind][samples] = sums[number][kind][samples]
            if not key[kind].any():
                continue
            same = (at for at, one in enumerate(sums[:count]) if all(map(torch.equal, key, one)))
            at = next(same, len(sums))
            keys.append(KeyLight(number, at, kind == 1, samples))
            if at == len(sums):
                sums.append(key)
        far, near = (torch.stack(weights) for weights in zip(*sums, strict=True))
        return Light(self.directions, far, near=self.near, near_weights=near if self.near else None), keys

    def near_points(self, centre_m: Tensor) -> list[tuple["PointLights", Tensor]]:
        """Return the near lights around a face's centre [3], camera space, each with rgb weights [M, 3]."""
        weights = () if self.near_weights is None else self.near_weights.unbind(1)
        return [(PointLights.of(light, centre_m), rgb) for light, rgb in zip(self.near, weights, strict=True)]

    def arriving(self, place_m: Tensor, centre_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return unit directions [N, 3] and rgb weights [M, N, 3] of all light at a position [3] on a face.

        Near lights are relative to the face's centre [3].
        """
        directions, weights = [self.directions], [self.weights]
        for points, rgb in self.near_points(centre_m):
            toward, irradiance = points.arriving(place_m[:, None, None])
            directions.append(toward[:, 0, 0])
            weights.append(rgb[:, None] * irradiance[:, 0, 0, None])
        return torch.cat(directions), torch.cat(weights, 1)

    def strengths(self) -> list[float]:
        """Return each sum's luminance over all light: 1 for a light of rgb 1, 4 for a map of radiance 1."""
        total = self.weights.sum(1)
        if self.near_weights is not None:
            total = total + self.near_weights.sum(1)
        if self.original_rgb is not None:
            total = total + self.original_rgb
        return [float(value) for value in luminance(total.numpy())]


def as_light(light: Any, ambient: float = 0.0) -> Light:
    """Convert a light or a map [H, 2 H, 3]; `ambient` adds uniform light of this fraction of a light's sum.

    Raises TypeError for another type.
    """
    if not (isinstance(ambient, (int, float)) and 0 <= ambient <= 1):
        raise ValueError(f"ambient is {ambient!r}, not a fraction from 0 to 1")
    if isinstance(light, Light):
        return light + Light.uniform() * (ambient * light.weights.sum(0)) if ambient else light
    if isinstance(light, np.ndarray | Tensor) and light.ndim == 3:
        return Light.from_envmap(light)
    kind = f"has shape {list(light.shape)}" if hasattr(light, "shape") else f"is {type(light).__name__}"
    raise TypeError(f"light {kind}, not a facerf.Light or a map [H, 2 H, 3]; read a file with read_image")


def stacked(lights: Sequence[Light]) -> Light:
    """Combine far lights into M sums over the same directions; equal directions become one light."""
    assert not any(light.near for light in lights)
    original, each = None, [light._tensors() for light in lights]
    if any(light.original_rgb is not None for light in lights):
        factors = [np.zeros(3) if one.original_rgb is None else one.original_rgb for one in lights]
        original = torch.stack(list(map(as_tensor, factors)))
        dark = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
        each = [one if len(one[0]) else dark for one in each]
    if len(each) == 1:
        return Light(each[0][0], each[0][1][None], original, lights[0].keys)
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
    return Light(directions, weights, original, tuple(slice(key, key + 1) for key in sorted(sharp)))


class KeyLight(NamedTuple):
    """A light whose shadows have hard edges, by the index of its sum and of the sum with only this light.

    `samples` are its directions among the far lights, or its index among the near ones.
    """

    number: int
    alone: int
    is_near: bool
    samples: slice


@dataclass(frozen=True, eq=False)
class PointLights:
    """The sample points of one near light of rgb 1: positions [P, 3] in metres, camera space.

    `toward` [3] is the unit vector from the light's middle to the face's centre; `strength` is each point's
    irradiance times square metres. With `is_panel`, radiance falls with the cosine to `toward`, as for a
    softbox.
    """

    places_m: Tensor
    toward: Tensor
    strength: float
    is_panel: bool
    half_cone_deg: float | None = None

    @staticmethod
    def of(light: StudioLight, centre_m: Tensor) -> "PointLights":
        """Place a near light around a face's centre [3]; a surface there that faces it receives 1."""
        assert light.at_m is not None
        offset = torch.tensor(light.at_m)
        distance_m = float(offset.norm())
        away = offset / distance_m
        wide_deg = _wide_deg(light)
        places = centre_m + offset + light.size_m * _grid(away, wide_deg)
        half = None if light.spot_deg is None else light.spot_deg / 2
        unit = PointLights(places, -away, 1.0, light.size_m > 0, half)
        directions, irradiance = unit.arriving(centre_m[:, None, None])
        received = float((irradiance[:, 0, 0] * (directions[:, 0, 0] @ away)).sum())
        return replace(unit, strength=1 / received)

    def arriving(self, positions_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return unit directions [P, H, W, 3] from positions [3, H, W] to the points; irradiance [P, H, W].

        The irradiance is that of a surface that faces the point. It falls with the square of the distance.
        """
        offsets = self.places_m[:, None, None] - positions_m.permute(1, 2, 0)
        distances_m = offsets.norm(dim=-1).clamp_min(1e-6)
        directions = offsets / distances_m[..., None]
        aligned = (-directions @ self.toward).clamp(-1, 1)
        irradiance = self.strength / distances_m.clamp_min(_NEAREST_M).square()
        if self.is_panel:
            irradiance = irradiance * aligned.clamp_min(0)
        if self.half_cone_deg is not None:
            edge = (1 - torch.rad2deg(aligned.acos()) / self.half_cone_deg) / (1 - _FULL_CONE)
            inside = edge.clamp(0, 1)
            irradiance = irradiance * inside * inside * (3 - 2 * inside)
        return directions, irradiance


def far_samples(light: StudioLight) -> tuple[Tensor, Tensor]:
    """Return a far light's sample directions [n, 3] and weights [n]; a surface that faces it receives 1."""
    if light.azel_deg is None:
        weight = 4 / UNIFORM_LIGHTS  # the mean of a clamped cosine over the sphere is 1 / 4
        return rig_directions(UNIFORM_LIGHTS), torch.full((UNIFORM_LIGHTS,), weight)
    middle = azel_to_direction(*light.azel_deg)
    if light.size_deg == 0:  # equal to a single light to the last bit
        return middle[None], torch.ones(1)
    wide = 2 * math.tan(math.radians(light.size_deg / 2))
    directions = F.normalize(middle + wide * _grid(middle, light.size_deg), dim=1)
    return directions, torch.ones(len(directions)) / (directions @ middle).sum()


def _wide_deg(light: StudioLight) -> float:
    """Return the angle of a near light's side, seen from the face."""
    assert light.at_m is not None
    return math.degrees(2 * math.atan2(light.size_m / 2, math.hypot(*light.at_m)))


def _grid(axis: Tensor, wide_deg: float) -> Tensor:
    """Return offsets [n * n, 3] of cells of a unit square around an axis [3]; two sides are horizontal."""
    if wide_deg == 0:
        return torch.zeros(1, 3)
    side = min(max(2, math.ceil(wide_deg / _APART_DEG)), _MOST_A_SIDE)
    up = torch.tensor([0.0, 1.0, 0.0] if abs(float(axis[1])) < 0.99 else [0.0, 0.0, 1.0])
    across = F.normalize(torch.linalg.cross(up, axis), dim=0)
    along = torch.linalg.cross(axis, across)
    cells = (torch.arange(side) + 0.5) / side - 0.5
    v, u = torch.meshgrid(cells, cells, indexing="ij")
    return (u[..., None] * across + v[..., None] * along).view(-1, 3)


def is_narrow(directions: Tensor) -> bool:
    """Return True if a light's samples [n, 3] are close enough that its shadows have hard edges."""
    middle = F.normalize(directions.mean(0), dim=0)
    return bool((directions @ middle).min() > math.cos(math.radians(_WIDEST_DEG / 2**0.5)))


def is_of_rig(directions: Tensor, lights: int = UNIFORM_LIGHTS) -> Tensor:
    """Return which directions [N, 3] belong to a rig; by default to the samples of uniform light."""
    return (directions[:, None] == rig_directions(lights)).all(-1).any(-1)


def uniform_part(directions: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Find uniform light, of any rgb [M, 3], in M sums, rgb weights [M, L, 3], of lights [L, 3].

    Return a mask [L] of the other lights, and that rgb, which is 0 without uniform light.
    """
    rest = ~is_of_rig(directions)
    of_rig = weights[:, ~rest].detach()
    if of_rig.shape[1] != UNIFORM_LIGHTS or directions.requires_grad or (of_rig != of_rig[:, :1]).any():
        return torch.ones_like(rest), weights.new_zeros(len(weights), 3)
    return rest, weights[:, ~rest].sum(1) / 4


def intensity_of(light: StudioLight) -> Tensor:
    """Return the light's colour times its strength [3], linear Rec.709."""
    tint = torch.ones(3) if light.kelvin is None else torch.from_numpy(blackbody_rgb(light.kelvin)).float()
    return torch.tensor(light.rgb) * tint * 2.0**light.stops


def blackbody_rgb(kelvin: float) -> np.ndarray:
    """Return linear Rec.709 [3] of a blackbody of 1667 to 25000 K with luminance 1; white at `WHITE_K`.

    The Planckian locus is slightly greener than D65, so colours are divided by the colour at `WHITE_K`.
    Colours outside Rec.709, such as candlelight, are clipped.
    """
    rgb = (_planckian_rgb(kelvin) / _planckian_rgb(WHITE_K)).clip(min=0)
    balanced: np.ndarray = rgb / luminance(rgb)
    return balanced


def _planckian_rgb(kelvin: float) -> np.ndarray:
    """Return linear Rec.709 [3] of the Planckian locus (Kang et al. 2002)."""
    x, y = colour_science().temperature.CCT_to_xy_Kang2002(kelvin)
    return np.linalg.solve(rgb_to_xyz(REC709_CHROMATICITIES), np.array([x / y, 1.0, (1 - x - y) / y]))


def rig(lights: int = 150) -> np.ndarray:
    """Return the unit directions [L, 3] of a uniform rig, camera space."""
    return rig_directions(lights).numpy()


def directions_of(lights: int | Array) -> Tensor:
    """Return the directions [L, 3], or those of a rig with this number of lights."""
    if isinstance(lights, Light):
        raise TypeError("lights is a Light; use directions [L, 3] or their number")
    return rig_directions(int(lights)) if np.ndim(lights) == 0 else unit_directions(lights)


def rig_by_text(rig: str) -> Tensor:
    """Return the unit directions [L, 3] that `--lights` specifies."""
    parsed = parse_lights(rig)
    if isinstance(parsed, int):
        return rig_directions(parsed)
    azimuth, elevation = torch.tensor(parsed).T
    return azel_to_direction(azimuth, elevation)


def unit_directions(values: Any) -> Tensor:
    """Return directions [L, 3] on the CPU; raises ValueError unless their lengths are 1."""
    directions = as_tensor(values)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions have shape {list(directions.shape)}, not [L, 3]")
    if not ((directions.norm(dim=1) - 1).abs() < _UNIT).all():
        raise ValueError("directions are not all of length 1")
    return directions


def linear_pixels(name: str, pixels: Any, shape: str = "[H, W, 3]") -> Tensor:
    """Return scene-linear pixels [H, W, 3] or [H, W] on the CPU; raises as `uncopied_pixels` does."""
    uncopied_pixels(name, pixels, shape)
    return as_tensor(pixels)


def uncopied_pixels(name: str, pixels: Any, shape: str = "[H, W, 3]") -> np.ndarray:
    """Return pixels [H, W, 3] or [H, W] without copying them.

    Raises TypeError or ValueError if they are not an array of finite floats of that shape.
    """
    if not isinstance(pixels, np.ndarray | Tensor):
        kind = type(pixels).__name__
        raise TypeError(f"{name} is {kind}, not an array {shape}; read a file with read_image")
    if pixels.ndim != shape.count(",") + 1 or (shape.endswith("3]") and pixels.shape[2] != 3):
        raise ValueError(f"{name} has shape {list(pixels.shape)}, not {shape}")
    if not (pixels.is_floating_point() if isinstance(pixels, Tensor) else pixels.dtype.kind == "f"):
        raise ValueError(f"{name} has type {pixels.dtype}; use scene-linear floats, as read_image returns")
    array = np.asarray(pixels.detach().cpu() if isinstance(pixels, Tensor) else pixels, np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} contains values that are not finite")
    return array


def one_of(choices: Any, name: str, value: str) -> None:
    """Raise ValueError if the word is not one of a Literal's."""
    if value not in get_args(choices):
        raise ValueError(f"{name} is {value!r}, not one of {', '.join(get_args(choices))}")


def as_tensor(values: Any) -> Tensor:
    """Return a float32 tensor on the CPU; gradients flow to a tensor."""
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, np.float32))
    return tensor.float().cpu()


def _joined(one: Array, two: Array) -> Array:
    """Concatenate arrays [..., L, 3] along L; the result is a tensor if either is one."""
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        return np.concatenate([one, two], -2)
    return torch.cat([as_tensor(one), as_tensor(two)], -2)


def _either(one: Any, two: Any, join: Callable[[Any, Any], Any]) -> Any:
    """Join two values, or return the one that is not None."""
    return two if one is None else one if two is None else join(one, two)
