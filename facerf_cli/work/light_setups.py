"""Light options of `facerf relight`, and the light setups that they name. Light to import."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facerf_cli.batch.inputs import (
    MAP_SUFFIXES,
    PHOTO_SUFFIXES,
    Item,
    NamePattern,
    collect_items,
    split_frame,
)
from facerf_cli.batch.recipe import RESULTS_VERSION, DigestOf, key_of, recipe_of
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import (
    AMBIENT_OVER_BRIGHT,
    AMBIENT_OVER_DARK,
    MOST_FRAMES,
    LitImage,
    Sampling,
    StudioLight,
    is_sweep,
    lit_images,
    named_entry,
    numbers,
    sweep,
)
from facerf_cli.light.setups import AMBIENT, LightSetup
from facerf_cli.option import LIGHT, option
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import LightOptions, fov_option

BACKGROUND = "background"  # value of --light-from: the background image
_DRAWN = "procedural:"
_LIGHT = "_light"  # ends the name of a photo's light
_WIDTH_PX = 512  # of maps in the cache
log = logging.getLogger(LOGGER_NAME)


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
        fov_deg: Horizontal angle of view of an image without a face.
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
class DrawnMap:
    """A procedural map in the user's cache, drawn when the work begins."""

    envmap: Path
    index: int
    seed: int
    layer: str = ""

    def write(self) -> None:
        """Draw the map."""
        from facerf_cli.files.write import write_exr
        from facerf_cli.synth.sky.skies import draw_sky

        write_exr(self.envmap, draw_sky(self.index, self.seed, _WIDTH_PX)[0])


@dataclass(frozen=True)
class PhotoLight:
    """The light of a photo: a map in the user's cache, as `facerf estimate-light` writes it.

    Attributes:
        envmap: The map, in a folder named by the photo's content and the options.
        photo: A photo, or the background image.
        options: How the light is estimated.
        layer: Name of the light in an image of several; '' if it has its own image.
        is_background: True if the light has the brightness of the background image.
    """

    envmap: Path
    photo: Path
    options: LightOptions
    layer: str = ""
    is_background: bool = False

    def write(self) -> None:
        """Estimate the light; raise InputError if the photo cannot be used."""
        from facerf_cli.work.estimate_light import write_lights

        base = self.envmap.with_name(self.envmap.name.removesuffix(f"{_LIGHT}.exr"))
        write_lights(Item(self.photo, base, self.photo.stem), self.options, _WIDTH_PX, sh_order=2)


CachedMap = DrawnMap | PhotoLight


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
    paths = [path for name, path in entries if not name and not path.startswith(_DRAWN)]
    files = collect_items(paths, output, MAP_SUFFIXES) if paths else []
    short = map(split_frame, _short_names(files))
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
            "%s: not in the image of the named lights (%s); to combine a light with them, name it: "
            "fill=40,20, fill=rembrandt or --envmap sky=MAP",
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


def drawn_maps(sources: LightSources, seed: int) -> tuple[DrawnMap, ...]:
    """List the maps of `procedural:N`; if it is there several times, the largest N counts."""
    words = [entry for entry in sources.envmap or () if entry.startswith(_DRAWN)]
    if not words:
        return ()
    from facerf_cli.synth.sky.skies import kind_of, parse_envmaps

    most = max(len(parse_envmaps(word, seed)) for word in words)
    if most > MOST_FRAMES:
        raise UsageError(f"--envmap {_DRAWN}{most}: too many maps; use {MOST_FRAMES} at most")
    folder = _cached("maps", f"{RESULTS_VERSION}-{seed}")
    return tuple(
        DrawnMap(folder / f"{index:05d}_{kind_of(index, seed)}.exr", index, seed) for index in range(most)
    )


def photo_lights(
    sources: LightSources, how: LightOptions, background: Path | None, output: Path, digest_of: DigestOf
) -> tuple[PhotoLight, ...]:
    """List the lights of photos that --light-from names, each once.

    Args:
        sources: The options.
        how: How the lights are estimated.
        background: The background image.
        output: The output folder, which is not searched for photos.
        digest_of: Returns the SHA-256 of a photo or a network.
    """
    entries = dict.fromkeys(sources.light_from or ())
    if not entries:
        return ()
    options = replace(how, fov_deg=sources.fov_deg)
    recipe = recipe_of(options, digest_of)

    def light(photo: Path, name: str, layer: str = "", is_background: bool = False) -> PhotoLight:
        folder = _cached("lights", key_of(recipe | {"photo": digest_of(photo)}))
        return PhotoLight(folder / f"{name}{_LIGHT}.exr", photo, options, layer, is_background)

    lights, unnamed = [], []
    for layer, path in map(named_entry, entries):
        if path == BACKGROUND:
            if background is None:
                raise UsageError(
                    "--light-from background: there is no background image; add --background FILE, or write "
                    "./background for a file of that name"
                )
            lights.append(light(background, split_frame(background.stem)[0], layer, is_background=True))
        elif layer:
            (item,) = collect_items([path], Path(), PHOTO_SUFFIXES)
            lights.append(light(item.input_path, Path(item.name).name, layer))
        else:
            unnamed.append(path)
    items = collect_items(unnamed, output, PHOTO_SUFFIXES) if unnamed else []
    lights += [light(item.input_path, name) for item, name in zip(items, _short_names(items), strict=True)]
    return tuple(lights)


def _cached(*parts: str) -> Path:
    from facerf_cli.files.downloads import cache_folder  # --help does without it

    return cache_folder().joinpath(*parts)


def _short_names(items: Sequence[Item]) -> list[str]:
    """Return the last part of each item's name, or the whole name if several items share that part."""
    last_parts = [Path(item.name).name for item in items]
    return [
        short if last_parts.count(short) == 1 else item.name.replace("/", "_")
        for item, short in zip(items, last_parts, strict=True)
    ]


def parse_rotations(text: str | None) -> list[tuple[str, str, float]]:
    """Parse `DEG` or `FROM:TO:N` (N frames, without TO) to (suffix of the name, frame, degrees)."""
    if text is None:
        return [("", "", 0.0)]
    if not is_sweep(text):
        degrees = numbers(text, ("DEG or FROM:TO:N",), "--rotate")[0]
        return [(f"_rot{degrees:g}", "", degrees)]
    return [("", f".{frame:04d}", degrees) for frame, degrees in enumerate(sweep(text, "--rotate"))]
