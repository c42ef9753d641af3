"""The lights of setups: maps and single lights."""

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
from facerf_cli.run.logs import LOGGER_NAME, step
from facerf_cli.work.light_setups import ROOM, LightSetup

_CLIPPED = 2.0  # above what display values have in linear Rec.709, of any gamut
LightsOf = Callable[[tuple[LightSetup, ...]], Light]  # gives the lights of M setups
FarLight = tuple[int, Tensor, Tensor]  # its setup, directions [n, 3] and rgb weights [n, 3]
log = logging.getLogger(LOGGER_NAME)


def readable(setups: Sequence[LightSetup]) -> tuple[LightSetup, ...]:
    """The setups whose maps can be read; each map that cannot is logged in one line."""
    good = {one: _is_readable(one) for one in dict.fromkeys(_maps_of(setups))}
    return tuple(setup for setup in setups if all(good[envmap] for envmap in _maps_of([setup])))


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
            "%s: its %d-bit values are clipped at white, so its highlights are missing and its light is too "
            "flat; use an .hdr or .exr map",
            envmap,
            header.bits,
        )
    return True


def read_map(envmap: Path) -> Tensor:
    """A lat-long map [H, W, 3], scene-linear; raises InputError that names what is wrong with it."""
    from facerf_cli.files.light_files import read_map_file  # single lights do without it

    return read_map_file(envmap)


@step("light")
def lights_over_rig(setups: tuple[LightSetup, ...], rig: str, sampling: Sampling) -> Light:
    """The lights of M setups: maps integrated over the rig's lights, their keys, and single lights."""
    single = single_lights(setups)
    if not _maps_of(setups):
        return single
    maps = (tuple(light for light in setup.lights if light.envmap is not None) for setup in setups)
    of_maps = _maps_over_rig(tuple(LightSetup("", lights=lights) for lights in maps), rig, sampling)
    return of_maps + single


@lru_cache(maxsize=1)
def _maps_over_rig(setups: tuple[LightSetup, ...], rig: str, sampling: Sampling) -> Light:
    """The maps of M setups over a rig's lights, and their keys, which the paper's sampling does not know."""
    directions = rig_by_text(rig)
    weights, keys = _map_weights(setups, directions, sampling, with_keys=sampling != "paper")
    return Light(directions, weights) + _far(len(setups), keys)


def single_lights(setups: Sequence[LightSetup]) -> Light:
    """The lights of M setups without their maps; at least one far light, if dark, and each near one once."""
    far = replace(_far(len(setups), _far_lights(setups)), own_rgb=own_weights(setups))
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
    """Far lights of so many setups, each once; at least one, if dark."""
    found: dict[bytes, tuple[Tensor, Tensor]] = {}
    for row, towards, rgb in lights:
        new = towards, torch.zeros(count, len(towards), 3)
        found.setdefault(towards.numpy().tobytes(), new)[1][row] += rgb
    dark = [(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(count, 1, 3))]
    directions, weights = zip(*(found.values() or dark), strict=True)
    ends = [0, *accumulate(map(len, directions))]
    keys = tuple(
        slice(*at) for at, toward in zip(pairwise(ends), directions, strict=True) if is_narrow(toward)
    )
    return Light(torch.cat(directions), torch.cat(weights, 1), keys=keys)


def own_weights(setups: Sequence[LightSetup]) -> Tensor | None:
    """Weights [M, 3] of the photo's own light in M setups; None where it shines in none."""
    each = [[intensity_of(light) for light in setup.lights if light.own] for setup in setups]
    return torch.stack([sum(own, torch.zeros(3)) for own in each]) if any(each) else None


def on_face(setup: LightSetup, number: int) -> LightSetup:
    """A setup in which the lights of other faces than one are dark."""
    dark = (0.0, 0.0, 0.0)
    lights = (light if light.face in (None, number) else replace(light, rgb=dark) for light in setup.lights)
    return replace(setup, lights=tuple(lights))


def as_in_photo(setup: LightSetup, brightness: float) -> LightSetup:
    """A setup whose even light has the brightness by which a person's skin is as in the photo."""

    def bright(light: StudioLight) -> StudioLight:
        red, green, blue = (brightness * value for value in light.rgb)
        return replace(light, rgb=(red, green, blue), even=False)

    return replace(setup, lights=tuple(bright(light) if light.even else light for light in setup.lights))


def with_room(setup: LightSetup) -> LightSetup:
    """A setup with the light of its room as one of its lights."""
    if not setup.room:
        return setup
    lights = [light for light in setup.lights if light.envmap is None and not light.own]
    sent = torch.stack([intensity_of(light) for light in lights]).sum(0)
    red, green, blue = (setup.room * float(value) for value in sent)
    names = (*setup.names, ROOM) if setup.names else ()
    return replace(setup, lights=(*setup.lights, StudioLight(rgb=(red, green, blue))), names=names)


def each_alone(setup: LightSetup) -> tuple[LightSetup, ...]:
    """A setup for each light of a setup."""
    return tuple(replace(setup, lights=(light,)) for light in setup.lights)


def as_lit(setups: Sequence[LightSetup], face: int, even: float = 1.0) -> tuple[LightSetup, ...]:
    """Setups as they shine on one of the people, with the light of their rooms.

    After one whose lights have names comes each of these alone.
    """
    lit = [with_room(as_in_photo(on_face(setup, face), even)) for setup in setups]
    return tuple(one for setup in lit for one in (setup, *(each_alone(setup) if setup.names else ())))


def lights_over_stack(setups: tuple[LightSetup, ...], directions: Tensor, sampling: Sampling) -> Light:
    """The lights of M setups by a stack's own [L, 3]; single lights are shared by those around."""
    weights, _ = _map_weights(setups, directions, sampling, with_keys=False)
    for row, towards, rgb in _far_lights(setups):
        index, share = lights_around(towards, directions)
        weights[row].index_add_(0, index.flatten(), (share[..., None].float() * rgb[:, None]).flatten(0, 1))
    return Light(directions, weights, own_weights(setups))


def off_rig_deg(setups: Sequence[LightSetup], directions: Tensor) -> float:
    """The largest angle between a single far light and the nearest of a stack's own [L, 3], in degrees."""
    far = [light for setup in setups for light in setup.lights if light.azel_deg is not None]
    cosines = [float((far_samples(light)[0] @ directions.T).amax(1).min()) for light in far]
    return math.degrees(math.acos(min(1.0, *cosines))) if cosines else 0.0


def _far_lights(setups: Sequence[LightSetup]) -> Iterator[FarLight]:
    for row, setup in enumerate(setups):
        for light in setup.lights:
            if light.azel_deg is not None or light.is_around:
                towards, shares = far_samples(light)
                yield row, towards, shares[:, None] * intensity_of(light)


def _map_weights(
    setups: tuple[LightSetup, ...], directions: Tensor, sampling: Sampling, with_keys: bool
) -> tuple[Tensor, list[FarLight]]:
    """[M, L, 3], zero for setups without a map, and keys apart; a map is read once for all its rotations."""
    weights, keys = torch.zeros(len(setups), len(directions), 3), list[FarLight]()
    maps = [(row, light) for row, setup in enumerate(setups) for light in setup.lights if light.envmap]
    for source, group in groupby(maps, lambda one: one[1].envmap):
        rows, lights = zip(*group, strict=True)
        assert source is not None
        envmap = read_map(source)
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
