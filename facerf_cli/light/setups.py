"""Light setups: the lights that shine together in one image. Imports neither numpy nor torch."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from facerf_cli.batch.inputs import MAP_SUFFIXES, Item, NamePattern, collect_items, split_frame
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import (
    AMBIENT_OVER_BRIGHT,
    AMBIENT_OVER_DARK,
    LitImage,
    Sampling,
    StudioLight,
    is_sweep,
    lit_images,
    named_entry,
    numbers,
    sweep,
)
from facerf_cli.option import LIGHT, option
from facerf_cli.run.logs import LOGGER_NAME

DRAWN = "procedural:"  # begins the name of a map to draw
AMBIENT = "ambient"  # name of the ambient fill, and of its layer
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class LightSetup:
    """Lights of one image: maps, single lights, or both.

    Attributes:
        name: Part of the image's file name.
        frame: Frame number that ends the file name, such as '.0001'; '' for a still.
        lights: The lights, each of them with its own intensity.
        names: One name per light, if each light is also a layer of the image.
        ambient: Ambient fill as a fraction of the sum of the single lights.
        exposure_ev: Exposure of the image if the user does not choose one; None: chosen automatically.
    """

    name: str
    frame: str = ""
    lights: tuple[StudioLight, ...] = ()
    names: tuple[str, ...] = ()
    ambient: float = 0.0
    exposure_ev: float | None = None

    @property
    def envmap(self) -> StudioLight | None:
        """The first map among the lights."""
        return next((light for light in self.lights if light.envmap is not None), None)

    @property
    def has_single(self) -> bool:
        """True if a light is neither a map nor the photo's original light."""
        return any(light.envmap is None and not light.original for light in self.lights)

    @property
    def has_original(self) -> bool:
        """True if the photo's original light is one of the lights."""
        return any(light.original for light in self.lights)

    @property
    def by_photo(self) -> list[StudioLight]:
        """Lights whose brightness follows from the photo."""
        return [light for light in self.lights if light.original or light.delight]

    def on_person(self, face: int, uniform: float = 1.0) -> Self:
        """Return the setup as it lights one person.

        Lights of other faces become dark. `uniform` is the intensity at which uniform light makes the
        person's skin as bright as in the photo.
        """

        def lit(light: StudioLight) -> StudioLight:
            factor = 0.0 if light.face not in (None, face) else uniform if light.delight else 1.0
            red, green, blue = (factor * value for value in light.rgb)
            return replace(light, rgb=(red, green, blue), delight=False)

        return replace(self, lights=tuple(map(lit, self.lights)))


def fov_option() -> Any:
    """Make the field of `--fov`."""
    return option(
        None,
        flags=("--fov",),
        metavar="DEG",
        least=1.0,
        most=170.0,
        shown_default="its EXIF, or 60",
        panel=LIGHT,
    )


@dataclass(frozen=True)
class LightSources:
    """The light options as typed.

    Attributes:
        envmap: Environment map: .exr, .hdr, .json of estimate-light, a folder or a quoted pattern; or
            procedural:N, the first N maps of facerf envmap. NAME=MAP joins the map with the named lights.
            Repeatable.
        light: Light: AZ,EL in degrees (AZ > 0: image right), left, original (the photo's light), delight
            (uniform), a preset (rembrandt), a rig file, or keys (at=, size=); NAME=LIGHT;stops=-1. See
            docs/lights.md. Repeatable.
        light_from: Photo to estimate the light from, as estimate-light does; or background, for the image
            behind the person. NAME=PHOTO joins its light with the named lights. Repeatable.
        fov_deg: Horizontal field of view of an image without a face.
        ambient: Ambient fill: a fraction of the sum of the lights (as uniform light), a map, or none.
        rotate: Azimuth to add to the maps; or FROM:TO:N, which renders N frames up to, not including, TO.
        sampling: How maps become weights of lights: cell (integral over the light's cell), smooth (shared
            between neighbours), or paper (one pixel).
    """

    envmap: list[str] | None = option(None, metavar="MAP|DIR", shown_default=False, panel=LIGHT)
    light: list[str] | None = option(None, metavar="LIGHT", shown_default=False, panel=LIGHT)
    light_from: list[str] | None = option(
        None, metavar="PHOTO|DIR", shown_default=False, panel=LIGHT, everyday=True
    )
    fov_deg: float | None = fov_option()
    ambient: str | None = option(
        None, metavar="FRACTION|MAP|none", shown_default="0.06; 0.03 over black", panel=LIGHT
    )
    rotate: str | None = option(None, metavar="DEG|FROM:TO:N", shown_default="as they are", panel=LIGHT)
    sampling: Sampling | None = option(
        None, flags=("--envmap-sampling",), shown_default="cell; smooth for --rotate FROM:TO:N", panel=LIGHT
    )


@dataclass(frozen=True)
class CachedMap:
    """Map in the user's cache, written when the work begins.

    Attributes:
        envmap: The map.
        layer: Name of its light in an image of several; '' if it has its own image.
    """

    envmap: Path
    layer: str = field(default="", kw_only=True)

    def write(self) -> None:
        """Write the map."""
        raise NotImplementedError


def collect_setups(
    sources: LightSources, output: Path, cached: Sequence[CachedMap] = ()
) -> tuple[LightSetup, ...]:
    """List the light setups that the options name, without reading maps.

    Args:
        sources: The options.
        output: The output folder, which is not searched for maps.
        cached: Maps that are drawn and photos' lights.
    """
    rotate = sources.rotate
    rotations = parse_rotations(rotate)
    entries = [named_entry(entry) for entry in dict.fromkeys(sources.envmap or ())]
    named = [(name, Path(path)) for name, path in entries if name]
    named += [(made.layer, made.envmap) for made in cached if made.layer]
    paths = [path for name, path in entries if not name and not path.startswith(DRAWN)]
    files = collect_items(paths, output, MAP_SUFFIXES) if paths else []
    short = map(split_frame, short_names(files))
    maps = [(name, frame, file.input_path) for (name, frame), file in zip(short, files, strict=True)]
    maps += [(made.envmap.stem, "", made.envmap) for made in cached if not made.layer]
    setups = [
        LightSetup(name + turn, frame + number, (StudioLight(envmap=envmap, rotate_deg=degrees),))
        for name, frame, envmap in maps
        for turn, number, degrees in rotations
    ]
    together = [
        LitImage(
            tuple((StudioLight(envmap=envmap, rotate_deg=degrees),) for _, _, degrees in rotations),
            is_sweep(rotate or ""),
            (name,),
            name,
        )
        for name, envmap in named
    ]
    images = lit_images(sources.light or (), together)
    apart = dict.fromkeys([setup.name for setup in setups] + [image.name for image in images[:-1]])
    if apart and images and images[-1].is_shared:
        log.warning(
            "%s: rendered separately from %s; to combine a light with it, name the light: fill=40,20, "
            "fill=rembrandt or --envmap sky=MAP",
            ", ".join(apart),
            images[-1].name,
        )
    for image in images:
        for number, lights in enumerate(image.frames):
            frame = f".{number:04d}" if image.is_numbered else ""
            setups.append(LightSetup(image.name, frame, lights, image.names))
    if not setups:
        raise UsageError("no light given; add --envmap, --light, or --light-from with a photo")
    if rotate is not None and not any(setup.envmap for setup in setups):
        raise UsageError("--rotate: rotates maps only; add --envmap or --light-from, or remove it")
    names = [setup.name + setup.frame for setup in setups]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"two images would be named {min(twice)}; pass each light once")
    return tuple(setups)


def parse_rotations(text: str | None) -> list[tuple[str, str, float]]:
    """Parse `DEG` or `FROM:TO:N` (N frames, without TO) to (suffix of the name, frame, degrees)."""
    if text is None:
        return [("", "", 0.0)]
    if not is_sweep(text):
        degrees = numbers(text, ("DEG or FROM:TO:N",), "--rotate")[0]
        return [(f"_rot{degrees:g}", "", degrees)]
    return [("", f".{frame:04d}", degrees) for frame, degrees in enumerate(sweep(text, "--rotate"))]


def short_names(items: Sequence[Item]) -> list[str]:
    """Return the last part of each item's name, or the whole name if several items share that part."""
    last_parts = [Path(item.name).name for item in items]
    return [
        short if last_parts.count(short) == 1 else item.name.replace("/", "_")
        for item, short in zip(items, last_parts, strict=True)
    ]


def set_ambient(setup: LightSetup, ambient: str | None, over_dark: bool) -> LightSetup:
    """Add ambient fill to a setup's lights, by `--ambient` or by default.

    Raises UsageError if `ambient` is not `none`, a fraction or a map, or if two lights would have its name.
    """
    if not setup.has_single:
        return setup
    if ambient is None:
        has_fill = AMBIENT in setup.names or any(light.is_uniform or light.original for light in setup.lights)
        default = AMBIENT_OVER_DARK if over_dark else AMBIENT_OVER_BRIGHT
        return replace(setup, ambient=0.0 if has_fill else default)
    if ambient == "none":
        return setup
    if AMBIENT in setup.names:
        raise UsageError(f"--ambient {ambient}: a light has this name; rename the light, or remove --ambient")
    if Path(ambient).suffix.lower() in (*MAP_SUFFIXES, ".json"):
        light = StudioLight(envmap=Path(ambient))
        names = (*setup.names, AMBIENT) if setup.names else ()
        return replace(setup, lights=(*setup.lights, light), names=names)
    (fraction,) = numbers(ambient, ("FRACTION or MAP or none",), "--ambient")
    if not 0 <= fraction <= 1:
        raise UsageError(f"--ambient {ambient}: out of range; use 0 to 1, a map, or none")
    return replace(setup, ambient=fraction)


def image_path(
    setup: LightSetup, item: Item, tag: str, suffix: str, pattern: NamePattern | None = None
) -> Path:
    """Return the file of a setup's image, by default or by a pattern of --name.

    By default it ends in the photo's own frame number.
    """
    stem, frame = split_frame(item.output_base.name)
    if pattern is None:
        return item.output_base.with_name(f"{stem}{tag}_{setup.name}{setup.frame}{frame}{suffix}")
    path = item.filled(pattern, tag, light=setup.name, frame=setup.frame.rpartition(".")[2])
    return path.with_name(f"{path.name}{suffix}")
