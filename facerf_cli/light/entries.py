"""Lights as the command line and files give them: numbers, directions, keys, rig files and presets.

Wrong ones raise UsageError. Light to import, since the help does without numpy.
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
_MOST_DIGITS = 9  # of a count; Python refuses to read thousands
_FORMS = ("AZ,EL", "AZ,EL,STRENGTH")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_RIGS = Path(__file__).parents[1] / "assets" / "rigs"
ROOM_BEFORE_BRIGHT, ROOM_BEFORE_DARK = 0.06, 0.03  # of lights: what a room sends back, by the background
# Words, and by default names, of lights by the photo: its own, and even light as bright.
OWN, EVEN = "own", "even"
_DISTANCE_M = (0.15, 1e4)  # of a near light


Sampling = Literal["cell", "smooth", "paper"]  # how lights of a rig sample a map
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class StudioLight:
    """A light from a direction (azimuth, elevation), or near, at a place in metres from the face's centre.

    Or a lat-long map, with `rotate_deg` added to every azimuth; or the photo's `own` light, under which the
    person is as photographed. A light that has none of these comes from all around, as of a room or a dull
    sky: every surface that nothing shades receives the same. If `even` it is so bright that skin is as in the
    photo.

    Camera axes. At the face's centre its irradiance is that of a far light of its colour: `rgb` times the
    colour of a blackbody of `kelvin`, times 2 to `stops`; a map's radiance is multiplied by these. `size_m`
    is the side of the square of a near light, which faces the face; `size_deg` that of a far one, as seen
    from there. `spot_deg` is the full angle of a near light's cone, which is aimed at the face. Of several
    people a light may shine on one alone, by the number of the `face` from the left, from 0.
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
    own: bool = False
    even: bool = False

    @property
    def is_around(self) -> bool:
        """True of a light from all around."""
        return self.azel_deg is None and self.at_m is None and self.envmap is None and not self.own


WORDS = {  # lights that have a word
    "left": StudioLight((-90.0, 0.0)),
    "right": StudioLight((90.0, 0.0)),
    "above": StudioLight((0.0, 90.0)),
    "below": StudioLight((0.0, -90.0)),
    "behind": StudioLight((180.0, 0.0)),
    "front": StudioLight((0.0, 0.0)),
    "around": StudioLight(),
    OWN: StudioLight(own=True),
    EVEN: StudioLight(even=True),
}


def numbers(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse finite numbers separated by commas, as many as one of `forms` ("AZ,EL") has names."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in [form.count(",") + 1 for form in forms] or not all(map(math.isfinite, values)):
        kind = "numbers separated by commas" if "," in forms[0] else "a number"
        raise UsageError(f"{option} {text!r}: give {' or '.join(forms)}, {kind}")
    return values


def azel(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse numbers that begin with azimuth and elevation in degrees; colours, if any, follow."""
    values = numbers(text, forms, option)
    if abs(values[1]) > 90:
        raise UsageError(f"{option} {text!r}: the elevation is out of range; give -90 (below) to 90 (above)")
    if min(values[2:], default=0) < 0:
        raise UsageError(f"{option} {text!r}: the colour is negative; give values from 0")
    return values


def is_sweep(text: str) -> bool:
    """True for `FROM:TO:N`, a value for each of N frames."""
    return ":" in text


def sweep(text: str, option: str) -> list[float]:
    """Parse degrees `FROM:TO:N`: N equal steps from FROM on, without TO, so that turns join."""
    try:
        start, end, count = numbers(text.replace(":", ","), ("FROM,TO,N",), option)
    except UsageError:
        count = 0.0
    if not (count.is_integer() and 1 <= count <= MOST_FRAMES):
        raise UsageError(f"{option} {text!r}: give degrees, or FROM:TO:N with N frames, as in 0:360:24")
    return [start + (end - start) * frame / count for frame in range(int(count))]


def parse_lights(text: str) -> int | list[tuple[float, float]]:
    """Parse `--lights`: the number of a uniform rig, or (azimuth, elevation) in degrees of each light.

    The text is a number, 'az,el;az,el', or a file of such lines or of vectors (`read_light_list`).
    """
    if text.isdecimal():
        if not (len(text) <= _MOST_DIGITS and 1 <= int(text) <= MOST_LIGHTS):
            raise UsageError(f"--lights {text}: not a number of lights; give 1 to {MOST_LIGHTS}")
        return int(text)
    is_file = os.path.isfile(text)  # Path's own raises where a long list is no possible name
    try:
        pairs = _lines(Path(text)) if is_file else [part for part in text.split(";") if part.strip()]
    except InputError as error:
        raise UsageError(f"--lights {error}") from None
    if not pairs or "," not in pairs[0]:
        missing = "" if is_file or "," in text else "no such file; "
        raise UsageError(f"--lights {text!r}: {missing}{_DIRECTIONS_HELP}")
    if len(pairs) > MOST_LIGHTS:
        raise UsageError(f"--lights: {len(pairs)} lights; give {MOST_LIGHTS} at most")
    option = f"--lights {text}:" if is_file else "--lights"
    return [(values[0], values[1]) for values in (azel(pair, ("AZ,EL",), option) for pair in pairs)]


def _lines(path: Path) -> list[str]:
    """Read az,el in degrees from the lines of a file that are neither empty nor comments, or its vectors."""
    text = read_text(path, "pass a text file")
    lines = (line.partition("#")[0].replace(",", " ").split() for line in text.splitlines())
    pairs = [fields for fields in lines if fields]
    if pairs and (len(pairs[0]) != 2 or path.suffix.lower() in (".lp", ".json")):
        pairs = [list(map(repr, _azel_of(*vector))) for _, vector in read_light_list(path)]
    return [",".join(fields) for fields in pairs]


def _azel_of(x: float, y: float, z: float) -> tuple[float, float]:
    """The azimuth and elevation of a vector, in degrees."""
    return math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z)))


@dataclass(frozen=True)
class LitImage:
    """Lights that shine together in one image, or in each of numbered frames; names are those of layers."""

    frames: tuple[tuple[StudioLight, ...], ...]
    is_numbered: bool = False
    names: tuple[str, ...] = ()
    name: str = ""  # of the image, or of the light that others may join
    is_shared: bool = False  # by all lights that have names


class _Key(NamedTuple):
    """A key that has numbers: their form and limits, the field that it sets, and the kind of its lights."""

    form: str
    limits: tuple[float, float]
    field: str
    kind: str = ""  # '': all


_NEAR, _FAR, _MAP = "near lights (at=)", "far lights (from=AZ,EL)", "maps (map=)"
_PLACES = {"at": _NEAR, "from": _FAR, "map": _MAP}  # keys of which a light has one, and what they make it
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
    given: Mapping[str, str], where: str, name: str | None, rig: LitImage | None = None
) -> LitImage:
    """Make a light of its settings, or change all lights of a rig by them.

    Raises UsageError that begins with `where` for wrong settings.
    """
    if given.keys() & set(_REMOVED):
        azimuth, elevation = (given.get(key, "0") for key in _REMOVED)
        raise UsageError(f"{where} az and el: no such keys; use from={azimuth},{elevation}")
    if wrong := [key for key in given if key not in KEYS]:
        raise UsageError(f"{where} {wrong[0]!r}: no such key; give {', '.join(KEYS)}")
    typed = repr(";".join(f"{key}={value}" for key, value in given.items()))
    places = [key for key in _PLACES if key in given]
    if len(places) + (rig is not None) != 1:
        raise UsageError(f"{where} {typed}: give one of at=X,Y,Z, from=AZ,EL and map=FILE")
    placed = rig or _placed(places[0], given[places[0]], where)
    first = placed.frames[0][0]
    kind = "" if rig or first.is_around or first.own else _PLACES[places[0]]
    numeric = {key: form for key, form in _NUMBERS.items() if key in given}
    if wrong := [key for key, form in numeric.items() if form.kind not in ("", kind)]:
        raise UsageError(f"{where} {typed}: {wrong[0]} is of {numeric[wrong[0]].kind}; leave it out")
    settings: dict[str, Any] = {}
    for key, form in numeric.items():
        values = numbers(given[key], (form.form,), f"{where} {key}")
        if not all(form.limits[0] <= value <= form.limits[1] for value in values):
            limits = f"{form.limits[0]:g} to {form.limits[1]:g}"
            raise UsageError(f"{where} {key} {given[key]!r}: out of range; give {limits}")
        settings[form.field] = values if key == "rgb" else values[0]
    if not settings.get("face", 0.0).is_integer():
        raise UsageError(f"{where} face {given['face']!r}: give the number of one; 0 is on the left")
    if "face" in settings:
        settings["face"] = int(settings["face"])
    (red, green, blue), stops = settings.pop("rgb", (1.0, 1.0, 1.0)), settings.pop("stops", 0.0)

    def lit(light: StudioLight) -> StudioLight:
        rgb = (light.rgb[0] * red, light.rgb[1] * green, light.rgb[2] * blue)
        return replace(light, rgb=rgb, stops=light.stops + stops, **settings)

    frames = tuple(tuple(map(lit, frame)) for frame in placed.frames)
    if name is None:
        return replace(placed, frames=frames)
    names = tuple(f"{name}_{one}" for one in placed.names) or (name,)
    return LitImage(frames, placed.is_numbered, names, name)


def _placed(key: str, text: str, where: str) -> LitImage:
    """The light at the place that a key gives."""
    if key == "from":
        return _far(text, f"{where} from")
    if key == "map":
        return LitImage(((StudioLight(envmap=Path(text)),),))
    x, y, z = numbers(text, ("X,Y,Z",), f"{where} at")
    if not _DISTANCE_M[0] <= (x * x + y * y + z * z) ** 0.5 <= _DISTANCE_M[1]:
        raise UsageError(
            f"{where} at {text!r}: the distance from the face is out of range; give {_DISTANCE_M[0]:g} to "
            f"{_DISTANCE_M[1]:g} metres"
        )
    return LitImage(((StudioLight(at_m=(x, y, z)),),))


def _far(text: str, where: str) -> LitImage:
    """Parse a word, or a direction with its strength; its angles may sweep, in the same number of frames."""
    if text in WORDS:
        return LitImage(((WORDS[text],),), name=text)
    if _NAME.fullmatch(text):
        raise UsageError(f"{where} {text!r}: give AZ,EL or one of {', '.join(WORDS)}")
    parts = text.split(",")
    if len(parts) == 5:
        light = f"{','.join(parts[:2])};rgb={','.join(parts[2:])}"
        raise UsageError(f"{where} {text!r}: a colour has a key of its own; use {light}")
    angles = [sweep(part, where) if is_sweep(part) else [part] for part in parts[:2]]
    count = max(map(len, angles))
    if min(map(len, angles)) not in (1, count):
        raise UsageError(f"{where} {text!r}: azimuth and elevation sweep in different frames; give one N")
    frames = []
    for number in range(count):
        pair = [str(values[number % len(values)]) for values in angles]
        values = azel(",".join([*pair, *parts[2:]]), _FORMS, where)
        red, green, blue = 3 * (values[2:] or [1.0])
        frames.append((StudioLight((values[0], values[1]), rgb=(red, green, blue)),))
    name = "_".join(part if is_sweep(part) else f"{float(part):g}" for part in parts)
    return LitImage(tuple(frames), is_sweep(text), name=name.replace(":", "_"))


def lit_images(entries: Sequence[str], maps: Sequence[LitImage] = ()) -> list[LitImage]:
    """Parse all `--light` entries; lights with names share the last image, with `maps` that have them."""
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
    """Parse `[NAME=]PLACE;KEY=VALUE;...`, keys alone, or several `[NAME=]PLACE;...`.

    Returns the lights and the name of their image; None where they have names, and share one with others.
    """
    where, pairs = f"--light {text!r}:", _pairs(text)
    keys = [key for key, _ in pairs if key in ("name", *KEYS, *_REMOVED)]
    given = {key: value for key, value in pairs if key is not None and key in keys}
    places: list[tuple[str | None, str | None]] = [pair for pair in pairs if pair[0] not in keys]
    if len(given) < len(keys):
        twice = min(key for key in given if keys.count(key) > 1)
        raise UsageError(f"{where} {twice} is given twice; a light has one, give --light again")
    if wrong := [pair for pair in pairs if pair[0] not in keys and not _is_place(pair[1])]:
        part = "=".join(filter(None, wrong[0]))
        known = f"AZ,EL, a rig file (.toml) or one of {', '.join((*preset_names(), *WORDS))}"
        raise UsageError(f"{where} {part!r}: no such light or key; give {known}; keys are {', '.join(KEYS)}")
    if places and given and len(places) + len(given.keys() & _PLACES.keys()) > 1:
        raise UsageError(f"{where} keys are of one light; give each light a --light of its own")
    places = places or [(None, None)]
    if "name" in given:
        if places[0][0] is not None:
            raise UsageError(f"{where} the light has two names; leave name= out")
        places = [(given.pop("name"), places[0][1])]
    places = [
        (word if name is None and (word := place or given.get("from")) in (OWN, EVEN) else name, place)
        for name, place in places
    ]
    lights = [_light(given, name, place) for name, place in places]
    if len({bool(light.names) for light in lights}) > 1:
        raise UsageError(f"{where} some lights have names; give each one, as in key=40,20, or none")
    if any(name is not None for name, _ in places):
        return lights, None
    if given:
        return lights, "light_" + re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_")
    return lights, lights[0].name if lights[0].names else "light_" + "+".join(one.name for one in lights)


def _light(given: Mapping[str, str], name: str | None, place: str | None) -> LitImage:
    """A light of an entry; a place without a key is a rig file, a preset, or that of `from`."""
    if place is None:
        return light_by_keys(given, "--light", name)
    if (path := _rig_path(place)) is not None:
        return light_by_keys(given, "--light", name, _rig(path))
    return light_by_keys({"from": place, **given}, "--light", name)


def _pairs(text: str) -> list[tuple[str | None, str]]:
    """Split an entry into keys or names, None where a part has none, and values."""
    if text.endswith(".toml") and os.path.isfile(text):  # whose path may hold = and ;
        return [(None, text)]
    parts = [part.partition("=") for part in text.split(";") if part.strip()] or [("", "", "")]
    if any("=" in value for *_, value in parts):
        raise UsageError(f"--light {text!r}: give ; between keys, as in 'from=60,10;stops=1'")
    return [(key.strip(), value.strip()) if equals else (None, key.strip()) for key, equals, value in parts]


def _is_place(value: str) -> bool:
    """True for what looks like a direction, a word, a preset or a rig file."""
    return "," in value or value in WORDS or value in preset_names() or value.endswith(".toml")


def preset_names() -> tuple[str, ...]:
    """The names of the rigs that facerf ships."""
    return tuple(sorted(path.stem for path in _RIGS.glob("*.toml")))


def _rig_path(text: str) -> Path | None:
    """The file of a rig or preset; None for directions."""
    if text in preset_names():
        return _RIGS / f"{text}.toml"
    if not text.endswith(".toml"):
        return None
    if not os.path.isfile(text):
        raise UsageError(f"--light {text}: no such rig file; give one that exists")
    return Path(text)


def _rig(path: Path) -> LitImage:
    """The lights of a rig file, whose image has its name; paths of maps begin at the file's folder."""
    from facerf_cli.files.documents import read_rig  # pydantic takes a tenth of a second

    lights = []
    try:
        for name, table in read_rig(path).items():
            beside = {"map": str(path.parent / table["map"])} if "map" in table else {}
            lights.append(light_by_keys({**table, **beside}, f"{path}: {name}:", name))
        return _together(path.stem, lights, f"{path}:")
    except UsageError as error:  # of a value: the file is at fault, not the command line
        raise InputError(str(error)) from None


def _together(image: str, lights: Sequence[LitImage], where: str) -> LitImage:
    """Lights in one image; those that do not sweep shine in every frame of those that do."""
    if sum(one.own for light in lights for one in light.frames[0]) > 1:
        raise UsageError(f"{where} the photo's own light ({OWN}) is there twice; give it once")
    names = tuple(name for light in lights for name in light.names)
    for name in names:
        if not _NAME.fullmatch(name) or names.count(name) > 1:
            raise UsageError(f"{where} {name!r}: give each light a name of its own, letters and digits")
    counts = {len(light.frames) for light in lights if light.is_numbered} or {1}
    if len(counts) > 1:
        raise UsageError(f"{where} sweeps of {min(counts)} and {max(counts)} frames; give one N")
    frames = tuple(
        tuple(one for light in lights for one in light.frames[number if light.is_numbered else 0])
        for number in range(max(counts))
    )
    return LitImage(frames, any(light.is_numbered for light in lights), names, image)


def named_entry(entry: str) -> tuple[str, str]:
    """Split `NAME=FILE`, a map that shines with the lights that have names; no name of a path alone."""
    name, equals, path = entry.partition("=")
    is_named = equals and _NAME.fullmatch(name) and not Path(entry).exists()
    return (name, path) if is_named else ("", entry)
