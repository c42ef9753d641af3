"""Lights of setups as weights over a rig's lights, or over the lights of an OLAT stack."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from itertools import accumulate, groupby, pairwise
from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.light.entries import Sampling, StudioLight
from facerf_cli.light.envmap import NO_KEYS, lights_around, rotated_weights, turned, without_keys
from facerf_cli.light.light import Light, far_samples, intensity_of, is_narrow, rig_by_text
from facerf_cli.light.setups import AMBIENT, LightSetup
from facerf_cli.run.logs import LOGGER_NAME, step

_CLIPPED = 2.0  # linear Rec.709: display values of any gamut are below it
LightsOf = Callable[[tuple[LightSetup, ...]], Light]  # from M setups to M sums of lights
FarLight = tuple[int, Tensor, Tensor]  # index of its setup, directions [n, 3], rgb weights [n, 3]
log = logging.getLogger(LOGGER_NAME)


def readable_setups(setups: Sequence[LightSetup]) -> tuple[LightSetup, ...]:
    """Return the setups whose maps can be read; log an error for each map that cannot."""
    good = {path: _is_readable(path) for path in dict.fromkeys(_maps_of(setups))}
    return tuple(setup for setup in setups if all(good[path] for path in _maps_of([setup])))


def _maps_of(setups: Sequence[LightSetup]) -> list[Path]:
    return [light.envmap for setup in setups for light in setup.lights if light.envmap is not None]


@cache  # an error is logged once
def _is_readable(envmap: Path) -> bool:
    try:
        brightest = float(read_map(envmap).max())
    except InputError as error:
        log.error("%s", error)
        return False
    header = read_header(envmap)
    if header and not header.is_floating and brightest < _CLIPPED:
        log.warning(
            "%s: its %d-bit values are clipped at white, so highlights are missing; use an .hdr or .exr map",
            envmap,
            header.bits,
        )
    return True


def read_map(envmap: Path) -> Tensor:
    """Read a lat-long map [H, W, 3], scene-linear; raise InputError if it is not one."""
    from facerf_cli.files.light_files import read_map_file  # imports pydantic

    return read_map_file(envmap)


@step("light")
def lights_over_rig(setups: tuple[LightSetup, ...], rig: str, sampling: Sampling) -> Light:
    """Return the lights of M setups: maps integrated over a rig's lights, their key lights, single lights."""
    single = single_lights(setups)
    if not _maps_of(setups):
        return single
    maps = (tuple(light for light in setup.lights if light.envmap is not None) for setup in setups)
    of_maps = _maps_over_rig(tuple(LightSetup("", lights=lights) for lights in maps), rig, sampling)
    return of_maps + single


@lru_cache(maxsize=1)
def _maps_over_rig(setups: tuple[LightSetup, ...], rig: str, sampling: Sampling) -> Light:
    """Integrate the maps of M setups over a rig; the paper's sampling has no separate key lights."""
    directions = rig_by_text(rig)
    weights, keys = _map_weights(setups, directions, sampling, with_keys=sampling != "paper")
    return Light(directions, weights) + _far(len(setups), keys)


def single_lights(setups: Sequence[LightSetup]) -> Light:
    """Return the lights of M setups without their maps.

    Equal lights of several setups are listed once. There is at least one far light, if necessary a dark one.
    """
    far = replace(_far(len(setups), _far_lights(setups)), original_rgb=_original_weights(setups))
    near = [
        (row, replace(light, rgb=(1.0, 1.0, 1.0), kelvin=None, stops=0.0), intensity_of(light))
        for row, setup in enumerate(setups)
        for light in setup.lights
        if light.at_m is not None
    ]
    if not near:
        return far
    lights = tuple(dict.fromkeys(light for _, light, _ in near))
    near_weights = torch.zeros(len(setups), len(lights), 3)
    for row, light, rgb in near:
        near_weights[row, lights.index(light)] += rgb
    return replace(far, near=lights, near_weights=near_weights)


def _far(count: int, lights: Iterable[FarLight]) -> Light:
    """Join the far lights of `count` setups; lights from the same directions are listed once."""
    by_place: dict[bytes, tuple[Tensor, Tensor]] = {}
    for row, towards, rgb in lights:
        new = towards, torch.zeros(count, len(towards), 3)
        by_place.setdefault(towards.numpy().tobytes(), new)[1][row] += rgb
    dark = [(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(count, 1, 3))]
    directions, weights = zip(*(by_place.values() or dark), strict=True)
    ends = [0, *accumulate(map(len, directions))]
    keys = tuple(
        slice(*at) for at, toward in zip(pairwise(ends), directions, strict=True) if is_narrow(toward)
    )
    return Light(torch.cat(directions), torch.cat(weights, 1), keys=keys)


def _original_weights(setups: Sequence[LightSetup]) -> Tensor | None:
    """Return the weights [M, 3] of the photo's original light; None if no setup uses it."""
    each = [[intensity_of(light) for light in setup.lights if light.original] for setup in setups]
    return torch.stack([sum(factors, torch.zeros(3)) for factors in each]) if any(each) else None


def with_ambient(setup: LightSetup) -> LightSetup:
    """Return the setup with its ambient fill as one more light."""
    if not setup.ambient:
        return setup
    lights = [light for light in setup.lights if light.envmap is None and not light.original]
    total = torch.stack([intensity_of(light) for light in lights]).sum(0)
    red, green, blue = (setup.ambient * float(value) for value in total)
    names = (*setup.names, AMBIENT) if setup.names else ()
    return replace(setup, lights=(*setup.lights, StudioLight(rgb=(red, green, blue))), names=names)


def as_lit(setups: Sequence[LightSetup], face: int, uniform: float = 1.0) -> tuple[LightSetup, ...]:
    """Return the setups as they light one person, with ambient fill; see `LightSetup.on_person`.

    A setup whose lights have names is followed by one setup for each of its lights.
    """
    lit = [with_ambient(setup.on_person(face, uniform)) for setup in setups]
    each = [[replace(setup, lights=(light,)) for light in setup.lights if setup.names] for setup in lit]
    return tuple(setup for whole, parts in zip(lit, each, strict=True) for setup in (whole, *parts))


def lights_over_stack(setups: tuple[LightSetup, ...], directions: Tensor, sampling: Sampling) -> Light:
    """Return the lights of M setups over a stack's lights [L, 3].

    A single light between them is interpolated from the three around it.
    """
    weights, _ = _map_weights(setups, directions, sampling, with_keys=False)
    for row, towards, rgb in _far_lights(setups):
        index, share = lights_around(towards, directions)
        weights[row].index_add_(0, index.flatten(), (share[..., None].float() * rgb[:, None]).flatten(0, 1))
    return Light(directions, weights, _original_weights(setups))


def off_rig_deg(setups: Sequence[LightSetup], directions: Tensor) -> float:
    """Return the largest angle between a far light and the nearest of a stack's lights [L, 3], in degrees."""
    far = [light for setup in setups for light in setup.lights if light.azel_deg is not None]
    cosines = [float((far_samples(light)[0] @ directions.T).amax(1).min()) for light in far]
    return math.degrees(math.acos(min(1.0, *cosines))) if cosines else 0.0


def _far_lights(setups: Sequence[LightSetup]) -> Iterator[FarLight]:
    for row, setup in enumerate(setups):
        for light in setup.lights:
            if light.azel_deg is not None or light.is_uniform:
                towards, shares = far_samples(light)
                yield row, towards, shares[:, None] * intensity_of(light)


def _map_weights(
    setups: tuple[LightSetup, ...], directions: Tensor, sampling: Sampling, with_keys: bool
) -> tuple[Tensor, list[FarLight]]:
    """Return weights [M, L, 3], zero for setups without a map, and the maps' key lights.

    A map is read once for all its rotations.
    """
    weights, keys = torch.zeros(len(setups), len(directions), 3), list[FarLight]()
    maps = [(row, light) for row, setup in enumerate(setups) for light in setup.lights if light.envmap]
    for path, group in groupby(maps, lambda entry: entry[1].envmap):
        rows, lights = zip(*group, strict=True)
        assert path is not None
        envmap = read_map(path)
        rest, suns = without_keys(envmap) if with_keys else (envmap, NO_KEYS)
        for row, light in zip(rows, lights, strict=True):
            key_light = turned(suns, light.rotate_deg)
            rgb = key_light.weights * intensity_of(light)
            keys += [(row, *key) for key in zip(key_light.directions[:, None], rgb[:, None], strict=True)]
        angles = [light.rotate_deg for light in lights]
        of_map = rotated_weights(rest, directions, angles, sampling)
        colours = torch.stack([intensity_of(light) for light in lights])
        weights.index_add_(0, torch.tensor(rows), of_map * colours[:, None])
    return weights, keys
