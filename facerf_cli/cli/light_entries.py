"""The entries of `--light`: directions, lights by keys, rig files and presets."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from facerf_cli.cli.light_keys import GivenLight, light_by_keys, read_keys
from facerf_cli.cli.values import azel
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import read_rig
from facerf_cli.light.studio import StudioLight

_FORMS = ("AZ,EL", "AZ,EL,R,G,B")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_RIGS = Path(__file__).parents[1] / "assets" / "rigs"


@dataclass(frozen=True)
class LitImage:
    """Lights that shine together in one image, or in each of numbered frames; names are those of layers."""

    name: str
    frames: tuple[tuple[StudioLight, ...], ...]
    is_numbered: bool
    names: tuple[str, ...]


def lit_images(entries: Sequence[str]) -> list[LitImage]:
    """Parse all `--light` entries; lights with names share one image, the last."""
    images: list[LitImage] = []
    named: list[GivenLight] = []
    for text in entries:
        if (path := _rig_path(text)) is not None:
            images.append(_rig(path))
        elif (settings := read_keys(text)) is not None:
            name = settings.pop("name", None)
            light = light_by_keys(settings, "--light", name)
            if light.name is None:
                images.append(_together(_file_name(text), [light], "--light"))
            else:
                named.append(light)
        elif "=" in text:
            named += [_short_named(part) for part in text.split(";")]
        else:
            images.append(_short(text))
    if named:
        all_names = "+".join(light.name or "" for light in named)
        images.append(_together(f"light_{all_names}", named, "--light"))
    return images


@cache
def preset_names() -> tuple[str, ...]:
    """The names of the rigs that facerf ships."""
    return tuple(sorted(path.stem for path in _RIGS.glob("*.toml")))


def _rig_path(text: str) -> Path | None:
    """The file of a rig or preset; None for directions."""
    if text.endswith(".toml"):
        if not Path(text).is_file():
            raise UsageError(f"--light {text}: no such rig file; give one that exists")
        return Path(text)
    if text in preset_names():
        return _RIGS / f"{text}.toml"
    if _NAME.fullmatch(text):
        known = ", ".join(preset_names())
        raise UsageError(f"--light {text}: no such preset; give AZ,EL, a rig file (.toml) or one of {known}")
    return None


def _rig(path: Path) -> LitImage:
    """The lights of a rig file, whose image has its name."""
    tables = read_rig(path)
    try:
        lights = [light_by_keys(table, f"{path}: {name}:", name) for name, table in tables.items()]
        return _together(path.stem, lights, f"{path}:")
    except UsageError as error:  # of a value: the file is at fault, not the command line
        raise InputError(str(error)) from None


def _together(image: str, lights: Sequence[GivenLight], where: str) -> LitImage:
    """Lights in one image; those that do not sweep shine in every frame of those that do."""
    names = tuple(light.name for light in lights if light.name is not None)
    for name in names:
        if not _NAME.fullmatch(name) or names.count(name) > 1:
            raise UsageError(f"{where} {name!r}: give each light a name of its own, letters and digits")
    counts = {len(light.frames) for light in lights if light.sweeps} or {1}
    if len(counts) > 1:
        raise UsageError(f"{where} sweeps of {min(counts)} and {max(counts)} frames; give one N")
    frames = tuple(
        tuple(light.frames[number if light.sweeps else 0] for light in lights)
        for number in range(max(counts))
    )
    return LitImage(image, frames, any(light.sweeps for light in lights), names)


def _short(text: str) -> LitImage:
    """Parse `az,el[,r,g,b][;...]`: lights that shine together."""
    parts = [part for part in text.split(";") if part.strip()] or [""]
    given = [azel(part, _FORMS, "--light") for part in parts]
    name = "+".join("_".join(f"{value:g}" for value in values) for values in given)
    return _together(f"light_{name}", [GivenLight(None, (_far(values),)) for values in given], "--light")


def _short_named(part: str) -> GivenLight:
    """Parse `NAME=az,el[,r,g,b]`."""
    name, _, text = part.partition("=")
    return GivenLight(name.strip(), (_far(azel(text, _FORMS, "--light")),))


def _far(values: Sequence[float]) -> StudioLight:
    red, green, blue = values[2:] or (1.0, 1.0, 1.0)
    return StudioLight(azel_deg=(values[0], values[1]), rgb=(red, green, blue))


def _file_name(text: str) -> str:
    """An image's name from the settings of its light."""
    return "light_" + re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_")
