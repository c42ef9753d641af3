"""A light by its keys, as `--light "at=0.5,0.3,1;size=0.4"` and rig files have them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from facerf_cli.cli.values import azel, is_sweep, numbers, sweep
from facerf_cli.errors import UsageError
from facerf_cli.light.studio import StudioLight

_AROUND = "around"  # as a direction: from all of them
KEYS = ("at", "from", "az", "el", "rgb", "kelvin", "stops", "size", "size_deg", "spot")
# Limits of values.
_KELVIN, _STOPS, _DISTANCE_M = (1667.0, 25000.0), (-20.0, 20.0), (0.15, 1e4)
_SIZE_M, _SIZE_DEG, _SPOT_DEG, _RGB = (0.0, 10.0), (0.0, 120.0), (1.0, 170.0), (0.0, 1e6)


@dataclass(frozen=True)
class GivenLight:
    """A light that an entry gives: one, or in a sweep one for each frame. A light with a name is a layer."""

    name: str | None
    frames: tuple[StudioLight, ...]
    sweeps: bool = False


def read_keys(text: str) -> dict[str, str] | None:
    """Read the settings of `key=value;...`; None where no part has one of `KEYS`."""
    pairs = [part.partition("=") for part in text.split(";") if part.strip()]
    keys = [key.strip() for key, _, _ in pairs]
    if not set(keys) & {"name", *KEYS}:
        return None
    if any("=" in value for _, _, value in pairs):
        raise UsageError(f"--light {text!r}: give ; between keys, as in 'az=60;el=10'")
    if twice := {key for key in keys if keys.count(key) > 1}:
        raise UsageError(
            f"--light {text!r}: {min(twice)} is given twice; a light has one, give --light again"
        )
    return {key: value.strip() for key, (_, _, value) in zip(keys, pairs, strict=True)}


def light_by_keys(given: Mapping[str, str], where: str, name: str | None) -> GivenLight:
    """Check the settings of a light and make it; raises UsageError that begins with `where`."""
    if wrong := [key for key in given if key not in KEYS]:
        raise UsageError(f"{where} {wrong[0]!r}: no such key; give {', '.join(KEYS)}")
    is_far = bool(given.keys() & {"from", "az", "el"})
    if is_far == ("at" in given) or ("from" in given and given.keys() & {"az", "el"}):
        raise UsageError(f"{where} {_shown(given)}: give one of at=X,Y,Z, from=AZ,EL, or az and el")
    if "size_deg" in given and given.get("from") == _AROUND:
        raise UsageError(f"{where} {_shown(given)}: a light from all around has no size; leave size_deg out")
    if wrong := sorted(given.keys() & ({"size", "spot"} if is_far else {"size_deg"})):
        right = "is of near lights (at=); a far one has size_deg" if is_far else "is of far lights; give size"
        raise UsageError(f"{where} {_shown(given)}: {wrong[0]} {right}")

    def number(key: str, form: str, limits: tuple[float, float]) -> float | None:
        return _numbers(given[key], form, limits, f"{where} {key}")[0] if key in given else None

    rgb = _numbers(given.get("rgb", "1,1,1"), "R,G,B", _RGB, f"{where} rgb")
    common = StudioLight(
        rgb=(rgb[0], rgb[1], rgb[2]),
        kelvin=number("kelvin", "KELVIN", _KELVIN),
        stops=number("stops", "STOPS", _STOPS) or 0.0,
        size_m=number("size", "METRES", _SIZE_M) or 0.0,
        size_deg=number("size_deg", "DEG", _SIZE_DEG) or 0.0,
        spot_deg=number("spot", "DEG", _SPOT_DEG),
    )
    if is_far:
        sweeps = any(is_sweep(given.get(key, "")) for key in ("az", "el"))
        frames = tuple(replace(common, azel_deg=azel_deg) for azel_deg in _directions(given, where))
        return GivenLight(name, frames, sweeps)
    return GivenLight(name, (replace(common, at_m=_place(given["at"], where)),))


def _shown(given: Mapping[str, str]) -> str:
    return repr(";".join(f"{key}={value}" for key, value in given.items()))


def _numbers(text: str, form: str, limits: tuple[float, float], option: str) -> list[float]:
    values = numbers(text, (form,), option)
    if not all(limits[0] <= value <= limits[1] for value in values):
        raise UsageError(f"{option} {text!r}: out of range; give {limits[0]:g} to {limits[1]:g}")
    return values


def _place(text: str, where: str) -> tuple[float, float, float]:
    x, y, z = numbers(text, ("X,Y,Z",), f"{where} at")
    if not _DISTANCE_M[0] <= (x * x + y * y + z * z) ** 0.5 <= _DISTANCE_M[1]:
        raise UsageError(
            f"{where} at {text!r}: the distance from the face is out of range; give {_DISTANCE_M[0]:g} to "
            f"{_DISTANCE_M[1]:g} metres"
        )
    return x, y, z


def _directions(given: Mapping[str, str], where: str) -> list[tuple[float, float] | None]:
    """Azimuth and elevation, of each frame where they sweep; None is from all around."""
    if given.get("from") == _AROUND:
        return [None]
    if "from" in given:
        azimuth, elevation = azel(given["from"], (f"AZ,EL or {_AROUND}",), f"{where} from")
        return [(azimuth, elevation)]
    azimuths, elevations = (_angles(given.get(key, "0"), f"{where} {key}") for key in ("az", "el"))
    count = max(len(azimuths), len(elevations))
    if min(len(azimuths), len(elevations)) not in (1, count):
        raise UsageError(f"{where} {_shown(given)}: az and el sweep in another number of frames; give one N")
    pairs = [(azimuths[k % len(azimuths)], elevations[k % len(elevations)]) for k in range(count)]
    for pair in pairs:
        azel(f"{pair[0]},{pair[1]}", ("AZ,EL",), where)
    return [*pairs]


def _angles(text: str, option: str) -> list[float]:
    """Parse `DEG`, or `FROM:TO:N` to N angles."""
    return sweep(text, option) if is_sweep(text) else numbers(text, ("DEG or FROM:TO:N",), option)
