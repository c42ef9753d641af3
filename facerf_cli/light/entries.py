"""The grammar of lights: numbers, directions, keys, rig files and presets, from options and files.

Invalid values raise UsageError. numpy is not imported, because `--help` runs without it.
"""

import math
import os.path
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import read_light_list, read_text

MOST_LIGHTS = 4096
MOST_FRAMES = 9999
_DIRECTIONS_HELP = (
    "pass a number, 'az,el;az,el;...' in degrees, or a file with az,el, x y z or name x y z on each line"
)
_MOST_DIGITS = 9  # of a count; Python refuses to parse thousands of digits
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_RIGS = Path(__file__).parents[1] / "assets" / "rigs"
AMBIENT_OVER_BRIGHT, AMBIENT_OVER_DARK = 0.06, 0.03  # ambient fill per sum of the lights, by the background
ORIGINAL, DELIGHT = "original", "delight"  # the photo's light; uniform light of the same brightness
_RENAMED = {"own": ORIGINAL, "even": DELIGHT, "around": "uniform"}
_DISTANCE_M = (0.15, 1e4)  # range of a near light's distance from the face


Sampling = Literal["cell", "smooth", "paper"]  # how the lights of a rig sample a map
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class StudioLight:
    """A light: far, near, an environment map, uniform, or the photo's original light.

    Axes are those of the camera. A far light has a direction `azel_deg` (azimuth, elevation), a near light a
    position `at_m` in metres from the face's centre. A lat-long map has `rotate_deg` added to every azimuth.
    `original` is the photo's original light, which reproduces the photo. Without any of these the light is
    uniform, as in a room or under an overcast sky: every unoccluded surface receives the same irradiance.
    With `delight`, its intensity reproduces the skin's brightness in the photo.

    `rgb` is multiplied by the colour of a blackbody of `kelvin` and by 2 to the power of `stops`. At the
    face's centre a near light has the irradiance of a far light of the same colour; a map's radiance is
    multiplied by the colour. `size_m` is the side of a near light's square panel, which faces the face, and
    `size_deg` the angular side of a far light. `spot_deg` is the full angle of a near light's cone, which is
    aimed at the face. In a group, `face` limits the light to one person, counted from the left, from 0.
    """

    azel_deg: tuple[float, float] | None = None
    at_m: Triple | None = None
    rgb: Triple = (1.0, 1.0, 1.0)
    kelvin: float | None = None
    stops: float = 0.0
    size_m: float = 0.0
    size_deg: float = 0.0
    spot_deg: float | None = None
    envmap: Path | None = None
    rotate_deg: float = 0.0
    face: int | None = None
    original: bool = False
    delight: bool = False

    @property
    def is_uniform(self) -> bool:
        """Whether the light is uniform."""
        return self.azel_deg is None and self.at_m is None and self.envmap is None and not self.original


WORDS = {
    "left": StudioLight((-90.0, 0.0)),
    "right": StudioLight((90.0, 0.0)),
    "above": StudioLight((0.0, 90.0)),
    "below": StudioLight((0.0, -90.0)),
    "behind": StudioLight((180.0, 0.0)),
    "front": StudioLight((0.0, 0.0)),
    "uniform": StudioLight(),
    ORIGINAL: StudioLight(original=True),
    DELIGHT: StudioLight(delight=True),
}


def numbers(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse as many finite, comma-separated numbers as one of `forms` ("AZ,EL") has names."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in [form.count(",") + 1 for form in forms] or not all(map(math.isfinite, values)):
        kind = "numbers separated by commas" if "," in forms[0] else "a number"
        raise UsageError(f"{option} {text!r}: invalid; use {' or '.join(forms)}, {kind}")
    return values


def azel(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse azimuth and elevation in degrees, and a strength if one of `forms` has it."""
    values = numbers(text, forms, option)
    if abs(values[1]) > 90:
        raise UsageError(f"{option} {text!r}: the elevation is out of range; use -90 (below) to 90 (above)")
    if min(values[2:], default=0) < 0:
        raise UsageError(f"{option} {text!r}: the strength is negative; use 0 or more")
    return values


def is_sweep(text: str) -> bool:
    """Return True for `FROM:TO:N`, one value for each of N frames."""
    return ":" in text


def sweep(text: str, option: str) -> list[float]:
    """Parse degrees `FROM:TO:N`: N equal steps from FROM, without TO, so that full turns join."""
    try:
        start, end, count = numbers(text.replace(":", ","), ("FROM,TO,N",), option)
    except UsageError:
        count = 0.0
    if not (count.is_integer() and 1 <= count <= MOST_FRAMES):
        raise UsageError(f"{option} {text!r}: invalid; use degrees, or FROM:TO:N with N frames (0:360:24)")
    return [start + (end - start) * frame / count for frame in range(int(count))]


def parse_lights(text: str) -> int | list[tuple[float, float]]:
    """Parse `--lights`: the number of lights of a uniform rig, or each light's (azimuth, elevation).

    Angles are in degrees. The text is a number, 'az,el;az,el', or a file of such lines or of vectors
    (`read_light_list`).
    """
    if text.isdecimal():
        if not (len(text) <= _MOST_DIGITS and 1 <= int(text) <= MOST_LIGHTS):
            raise UsageError(f"--lights {text}: invalid number of lights; use 1 to {MOST_LIGHTS}")
        return int(text)
    is_file = os.path.isfile(text)  # a Path of a long list would raise
    try:
        pairs = _lines(Path(text)) if is_file else [part for part in text.split(";") if part.strip()]
    except InputError as error:
        raise UsageError(f"--lights {error}") from None
    if not pairs or "," not in pairs[0]:
        missing = "" if is_file or "," in text else "no such file; "
        raise UsageError(f"--lights {text!r}: {missing}{_DIRECTIONS_HELP}")
    if len(pairs) > MOST_LIGHTS:
        raise UsageError(f"--lights: {len(pairs)} lights; use at most {MOST_LIGHTS}")
    option = f"--lights {text}:" if is_file else "--lights"
    return [(values[0], values[1]) for values in (azel(pair, ("AZ,EL",), option) for pair in pairs)]


def _lines(path: Path) -> list[str]:
    """Return 'az,el' in degrees for each line of a file that is not empty or a comment, or each vector."""
    text = read_text(path, "pass a text file")
    lines = (line.partition("#")[0].replace(",", " ").split() for line in text.splitlines())
    pairs = [fields for fields in lines if fields]
    if pairs and (len(pairs[0]) != 2 or path.suffix.lower() in (".lp", ".json")):
        vectors = (vector for _, vector in read_light_list(path))
        azels = ((math.atan2(x, z), math.atan2(y, math.hypot(x, z))) for x, y, z in vectors)
        pairs = [[repr(math.degrees(angle)) for angle in pair] for pair in azels]
    return [",".join(fields) for fields in pairs]


@dataclass(frozen=True)
class LitImage:
    """Lights of one image, or of each of several numbered frames; `names` are those of its layers."""

    frames: tuple[tuple[StudioLight, ...], ...]
    is_numbered: bool = False
    names: tuple[str, ...] = ()
    name: str = ""  # of the image, or of a light that can join others in one image
    is_shared: bool = False  # by all named lights


class _Key(NamedTuple):
    """A numeric key: its form, its limits, the field of StudioLight, and the lights that it applies to."""

    form: str
    limits: tuple[float, float]
    field: str
    kind: str = ""  # '': all


_NEAR, _FAR, _MAP = "near lights (at=)", "far lights (from=AZ,EL)", "maps (map=)"
_PLACES = {"at": _NEAR, "from": _FAR, "map": _MAP}  # a light has exactly one of these keys
_NUMBERS = {
    "rgb": _Key("R,G,B", (0.0, 1e6), "rgb"),
    "kelvin": _Key("KELVIN", (1667.0, 25000.0), "kelvin"),
    "stops": _Key("STOPS", (-20.0, 20.0), "stops"),
    "size": _Key("METRES", (0.0, 10.0), "size_m", _NEAR),
    "spot": _Key("DEG", (1.0, 170.0), "spot_deg", _NEAR),
    "size_deg": _Key("DEG", (0.0, 120.0), "size_deg", _FAR),
    "rotate": _Key("DEG", (-3600.0, 3600.0), "rotate_deg", _MAP),
    "face": _Key("NUMBER", (0.0, 99.0), "face"),
}
KEYS = (*_PLACES, *_NUMBERS)
_REMOVED = ("az", "el")


def light_by_keys(
    settings: Mapping[str, str], where: str, name: str | None, rig: LitImage | None = None
) -> LitImage:
    """Make a light from its settings, or apply the settings to all lights of a rig.

    Raises UsageError that begins with `where`.
    """
    if settings.keys() & set(_REMOVED):
        azimuth, elevation = (settings.get(key, "0") for key in _REMOVED)
        raise UsageError(f"{where} az and el: no such keys; use from={azimuth},{elevation}")
    if unknown := [key for key in settings if key not in KEYS]:
        raise UsageError(f"{where} {unknown[0]!r}: no such key; use {', '.join(KEYS)}")
    typed = repr(";".join(f"{key}={value}" for key, value in settings.items()))
    places = [key for key in _PLACES if key in settings]
    if len(places) + (rig is not None) != 1:
        raise UsageError(f"{where} {typed}: a light needs one place; use at=X,Y,Z, from=AZ,EL or map=FILE")
    placed = rig or _placed(places[0], settings[places[0]], where)
    first = placed.frames[0][0]
    kind = "" if rig or first.is_uniform or first.original else _PLACES[places[0]]
    fields: dict[str, Any] = {}
    for key, (form, (least, most), field, applies_to) in _NUMBERS.items():
        if key not in settings:
            continue
        if applies_to not in ("", kind):
            raise UsageError(f"{where} {typed}: {key} applies only to {applies_to}; remove it")
        values = numbers(settings[key], (form,), f"{where} {key}")
        if not all(least <= value <= most for value in values):
            raise UsageError(f"{where} {key} {settings[key]!r}: out of range; use {least:g} to {most:g}")
        fields[field] = values if key == "rgb" else values[0]
    if "face" in fields:
        if not fields["face"].is_integer():
            raise UsageError(f"{where} face {settings['face']!r}: use a whole number; 0 is the leftmost face")
        fields["face"] = int(fields["face"])
    (red, green, blue), stops = fields.pop("rgb", (1.0, 1.0, 1.0)), fields.pop("stops", 0.0)

    def changed(light: StudioLight) -> StudioLight:
        rgb = (light.rgb[0] * red, light.rgb[1] * green, light.rgb[2] * blue)
        return replace(light, rgb=rgb, stops=light.stops + stops, **fields)

    frames = tuple(tuple(map(changed, frame)) for frame in placed.frames)
    if name is None:
        return replace(placed, frames=frames)
    names = tuple(f"{name}_{layer}" for layer in placed.names) or (name,)
    return LitImage(frames, placed.is_numbered, names, name)


def _placed(key: str, text: str, where: str) -> LitImage:
    if key == "from":
        return _far(text, f"{where} from")
    if key == "map":
        return LitImage(((StudioLight(envmap=Path(text)),),))
    x, y, z = numbers(text, ("X,Y,Z",), f"{where} at")
    nearest, farthest = _DISTANCE_M
    if not nearest <= (x * x + y * y + z * z) ** 0.5 <= farthest:
        limits = f"use {nearest:g} to {farthest:g} metres"
        raise UsageError(f"{where} at {text!r}: the distance from the face is out of range; {limits}")
    return LitImage(((StudioLight(at_m=(x, y, z)),),))


def _far(text: str, where: str) -> LitImage:
    """Parse a word, or a direction with an optional strength; swept angles have equal frame counts."""
    if text in WORDS:
        return LitImage(((WORDS[text],),), name=text)
    if text in _RENAMED:
        raise UsageError(f"{where} {text!r}: no such light; use {_RENAMED[text]}")
    if _NAME.fullmatch(text):
        raise UsageError(f"{where} {text!r}: no such direction; use AZ,EL or one of {', '.join(WORDS)}")
    parts = text.split(",")
    if len(parts) == 5:
        light = f"{','.join(parts[:2])};rgb={','.join(parts[2:])}"
        raise UsageError(f"{where} {text!r}: a colour is set by a key; use {light}")
    angles = [sweep(part, where) if is_sweep(part) else [part] for part in parts[:2]]
    count = max(map(len, angles))
    if min(map(len, angles)) not in (1, count):
        raise UsageError(f"{where} {text!r}: the frame counts of both angles differ; use the same N")
    frames = []
    for number in range(count):
        pair = [str(values[number % len(values)]) for values in angles]
        values = azel(",".join([*pair, *parts[2:]]), ("AZ,EL", "AZ,EL,STRENGTH"), where)
        red, green, blue = 3 * (values[2:] or [1.0])
        frames.append((StudioLight((values[0], values[1]), rgb=(red, green, blue)),))
    name = "_".join(part if is_sweep(part) else f"{float(part):g}" for part in parts)
    return LitImage(tuple(frames), is_sweep(text), name=name.replace(":", "_"))


def lit_images(entries: Sequence[str], maps: Sequence[LitImage] = ()) -> list[LitImage]:
    """Parse all `--light` entries; named lights and named `maps` share the last image."""
    images: list[LitImage] = []
    named = list(maps)
    for text in entries:
        lights, image = _entry(text)
        if image is None:
            named += lights
        else:
            images.append(_together(image, lights, "--light"))
    if named:
        all_names = "+".join(light.name for light in named)
        images.append(replace(_together(f"light_{all_names}", named, "--light"), is_shared=True))
    return images


def _entry(text: str) -> tuple[list[LitImage], str | None]:
    """Parse `[NAME=]PLACE;KEY=VALUE;...`, only keys, or several `[NAME=]PLACE;...`.

    Return the lights and their image's name, or None if they are named and share an image with others.
    """
    where = f"--light {text!r}:"
    settings: dict[str, str] = {}
    places: list[tuple[str | None, str | None]] = []
    for key, value in _pairs(text):
        if key is None or key not in ("name", *KEYS, *_REMOVED):
            is_known = value in (*WORDS, *_RENAMED, *preset_names()) or value.endswith(".toml")
            if not is_known and "," not in value:
                part = value if key is None else f"{key}={value}"
                known = f"AZ,EL, a rig file (.toml) or one of {', '.join((*preset_names(), *WORDS))}"
                known += f"; keys: {', '.join(KEYS)}"
                raise UsageError(f"{where} {part!r}: no such light or key; use {known}")
            places.append((key, value))
        elif key in settings:
            raise UsageError(f"{where} {key} occurs twice; use a separate --light for each light")
        else:
            settings[key] = value
    if places and settings and len(places) + len(settings.keys() & _PLACES.keys()) > 1:
        raise UsageError(f"{where} keys apply to one light; use a separate --light for each light")
    places = places or [(None, None)]
    if "name" in settings:
        if places[0][0] is not None:
            raise UsageError(f"{where} the light has two names; remove name=")
        places = [(settings.pop("name"), places[0][1])]
    for number, (name, place) in enumerate(places):
        word = place or settings.get("from")
        if name is None and word in (ORIGINAL, DELIGHT):
            places[number] = (word, place)
    lights = []
    for name, place in places:
        is_rig = place is not None and (place in preset_names() or place.endswith(".toml"))
        fields = settings if place is None or is_rig else {"from": place, **settings}
        lights.append(light_by_keys(fields, "--light", name, _rig(place) if place and is_rig else None))
    if len({bool(light.names) for light in lights}) > 1:
        raise UsageError(
            f"{where} only some lights have names, as original and rigs do; name all: rim=145,15"
        )
    if any(name is not None for name, _ in places):
        return lights, None
    if settings:
        return lights, "light_" + re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_")
    return lights, lights[0].name if lights[0].names else "light_" + "+".join(light.name for light in lights)


def _pairs(text: str) -> list[tuple[str | None, str]]:
    """Split an entry into (key or name, value); without = the key is None."""
    if text.endswith(".toml") and os.path.isfile(text):  # whose path may contain = and ;
        return [(None, text)]
    parts = [part.partition("=") for part in text.split(";") if part.strip()] or [("", "", "")]
    if any("=" in value for *_, value in parts):
        raise UsageError(f"--light {text!r}: separate keys by semicolons; use 'from=60,10;stops=1'")
    return [(key.strip(), value.strip()) if equals else (None, key.strip()) for key, equals, value in parts]


def preset_names() -> tuple[str, ...]:
    """Return the names of the shipped rigs."""
    return tuple(sorted(path.stem for path in _RIGS.glob("*.toml")))


def _rig(preset_or_file: str) -> LitImage:
    """Read the lights of a rig; its maps' paths are relative to the rig file's folder."""
    from facerf_cli.files.documents import read_rig  # pydantic takes a tenth of a second

    is_preset = preset_or_file in preset_names()
    path = _RIGS / f"{preset_or_file}.toml" if is_preset else Path(preset_or_file)
    if not os.path.isfile(path):  # Path's own raises for names that are too long
        raise UsageError(f"--light {path}: no such rig file; check the path")
    lights = []
    try:
        for name, table in read_rig(path).items():
            beside = {"map": str(path.parent / table["map"])} if "map" in table else {}
            lights.append(light_by_keys({**table, **beside}, f"{path}: {name}:", name))
        return _together(path.stem, lights, f"{path}:")
    except UsageError as error:  # the file is at fault, not the command line
        raise InputError(str(error)) from None


def _together(image: str, lights: Sequence[LitImage], where: str) -> LitImage:
    """Put lights into one image; those without a sweep shine in every frame of those with one."""
    if sum(one.original for light in lights for one in light.frames[0]) > 1:
        raise UsageError(f"{where} the original light occurs twice; use it once")
    names = tuple(name for light in lights for name in light.names)
    for name in names:
        if not _NAME.fullmatch(name) or names.count(name) > 1:
            raise UsageError(f"{where} {name!r}: use a different name of letters and digits for each light")
    counts = {len(light.frames) for light in lights if light.is_numbered} or {1}
    if len(counts) > 1:
        raise UsageError(f"{where} sweeps have {min(counts)} and {max(counts)} frames; use the same N")
    frames = tuple(
        tuple(one for light in lights for one in light.frames[number if light.is_numbered else 0])
        for number in range(max(counts))
    )
    return LitImage(frames, any(light.is_numbered for light in lights), names, image)


def named_entry(entry: str) -> tuple[str, str]:
    """Split `NAME=FILE`, a map that shares the image of named lights; the name of a plain path is ''."""
    name, equals, path = entry.partition("=")
    is_named = equals and _NAME.fullmatch(name) and not Path(entry).exists()
    return (name, path) if is_named else ("", entry)
