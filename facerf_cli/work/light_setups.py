"""The light setups that `facerf relight` renders (maps, rotations, single lights) and their names."""

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
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import (
    MOST_FRAMES,
    ROOM_BEFORE_BRIGHT,
    ROOM_BEFORE_DARK,
    MapSource,
    Sampling,
    StudioLight,
    is_sweep,
    lit_images,
    named_map,
    numbers,
    preset_names,
    sweep,
)
from facerf_cli.option import LIGHT, option
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import LightOptions, fov_option

DRAWN = "procedural:"
BACKGROUND = "background"  # the picture behind the person, as --light-from names it
ROOM = "room"  # the name of a room's light, and of its layer
_MOST_ROOM = 1.0
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class LightSources:
    """The lights, as the command line names them.

    Attributes:
        envmap: Relight under lat-long maps (.exr, .hdr; files, folders, quoted patterns), lights of
            estimate-light (.json), or procedural:N, maps of facerf envmap; NAME=MAP together with lights that
            have names. Repeatable.
        light: Relight under AZ,EL in degrees (AZ > 0: from the right), left, own (the photo's), even
            (delight), a preset (rembrandt), a rig file, keys (at=, size=), NAME=LIGHT;stops=-1;
            docs/lights.md. Repeatable.
        light_from: Relight under the light of another photo, or of the picture of --background (background),
            as estimate-light finds it; NAME=PHOTO together with lights that have names. Repeatable.
        fov_deg: The angle of view of a picture without face.
        room: Add what a room sends back to lights: a share of them, from all around; a map; or none.
        rotate: Rotate the maps: add DEG to every azimuth; or render N frames .0000 on, without TO.
        sampling: Give each light the map's integral over its cell; share it smoothly among lights; or, as in
            the paper, one pixel.
    """

    envmap: list[str] | None = option(None, metavar="MAP|DIR", shown_default=False, panel=LIGHT)
    light: list[str] | None = option(None, metavar="LIGHT", shown_default=False, panel=LIGHT)
    light_from: list[str] | None = option(
        None, metavar="PHOTO|DIR", shown_default=False, panel=LIGHT, everyday=True
    )
    fov_deg: float | None = fov_option()
    room: str | None = option(
        None, metavar="SHARE|MAP|none", shown_default="0.06; 0.03 before black", panel=LIGHT
    )
    rotate: str | None = option(None, metavar="DEG|FROM:TO:N", shown_default="as they are", panel=LIGHT)
    sampling: Sampling | None = option(
        None, flags=("--envmap-sampling",), shown_default="cell; smooth for --rotate FROM:TO:N", panel=LIGHT
    )


@dataclass(frozen=True)
class DrawnMap:
    """A procedural map, named as `facerf envmap` names its files."""

    name: str
    index: int
    seed: int


@dataclass(frozen=True)
class PhotoLight:
    """The light of a photo, estimated when it is read; its map is that of `facerf estimate-light`."""

    name: str
    path: Path
    options: LightOptions
    is_background: bool = False


@dataclass(frozen=True)
class LightSetup:
    """The lights of one image of every photo: a map, rotated, or single lights, or both.

    Lights with `names` are layers of the image, too. `room` is the share of the lights, without maps, that
    comes from all around besides. `exposure_ev` is the image's, where none is asked for.
    """

    name: str
    frame: str = ""  # '.0001': frame numbers, which end a file's name
    lights: tuple[StudioLight, ...] = ()
    names: tuple[str, ...] = ()
    room: float = 0.0
    exposure_ev: float | None = None

    @property
    def envmap(self) -> StudioLight | None:
        """The map among the lights, the first of several."""
        return next((light for light in self.lights if light.envmap is not None), None)

    @property
    def has_single(self) -> bool:
        """True where some light is neither a map nor the photo's own."""
        return any(light.envmap is None and not light.own for light in self.lights)

    @property
    def has_own(self) -> bool:
        """True where the photo's own light is one of the lights."""
        return any(light.own for light in self.lights)

    @property
    def has_scale(self) -> bool:
        """True where the lights are as bright as the photo, or as the picture behind it."""
        maps = (light.envmap for light in self.lights)
        behind = any(isinstance(envmap, PhotoLight) and envmap.is_background for envmap in maps)
        return behind or bool(self.by_photo)

    @property
    def by_photo(self) -> list[StudioLight]:
        """The lights that are as bright as the photo."""
        return [light for light in self.lights if light.own or light.even]

    def output(self, item: Item, tag: str, suffix: str, pattern: NamePattern | None = None) -> Path:
        """The image's file, by a pattern of --name or the default: the photo's own frame number goes last."""
        stem, frame = split_frame(item.output_base.name)
        if pattern is None:
            return item.output_base.with_name(f"{stem}{tag}_{self.name}{self.frame}{frame}{suffix}")
        path = item.filled(pattern, tag, light=self.name, frame=self.frame.rpartition(".")[2])
        return path.with_name(f"{path.name}{suffix}")


def collect_setups(
    sources: LightSources,
    output: Path,
    seed: int = 0,
    how: LightOptions | None = None,
    background: Path | None = None,
) -> tuple[LightSetup, ...]:
    """List the light setups that the options name; maps are read, drawn or estimated later.

    Args:
        sources: The options.
        output: The output folder, which is not searched for maps.
        seed: The seed of drawn maps.
        how: How the lights of photos are estimated.
        background: The picture behind the person.
    """
    envmaps, rotate = sources.envmap or (), sources.rotate
    rotations = parse_rotations(rotate)
    turns, is_numbered = [degrees for _, _, degrees in rotations], is_sweep(rotate or "")
    together = {entry: named for entry in envmaps if (named := named_map(entry, turns, is_numbered))}
    envmaps = [entry for entry in envmaps if entry not in together]
    lit: list[PhotoLight] = []
    if sources.light_from and how:
        photo = _PhotoLights(replace(how, fov_deg=sources.fov_deg), background)
        alone = [entry for entry in sources.light_from if entry not in (BACKGROUND, *together)]
        with_names = {
            entry: image for entry in alone if (image := named_map(entry, turns, is_numbered, photo.one))
        }
        together |= with_names
        lit = [photo.one(BACKGROUND)] if BACKGROUND in sources.light_from else []
        lit += photo.each([entry for entry in alone if entry not in with_names], output)
    elif sources.fov_deg is not None:
        raise UsageError("--fov: is for --light-from; add it, or leave --fov out")
    words = [entry for entry in envmaps if entry.startswith(DRAWN)]
    paths = [entry for entry in envmaps if entry not in words]
    files = collect_items(paths, output, MAP_SUFFIXES) if paths else []
    short = map(split_frame, _short_names(files))
    maps: list[tuple[str, str, MapSource]] = [
        *((drawn.name, "", drawn) for drawn in drawn_maps(words, seed)),
        *((name, frame, file.input_path) for (name, frame), file in zip(short, files, strict=True)),
        *((photo.name, "", photo) for photo in lit),
    ]
    setups = [
        LightSetup(name + turn, frame + number, (StudioLight(envmap=envmap, rotate_deg=degrees),))
        for name, frame, envmap in maps
        for turn, number, degrees in rotations
    ]
    images = lit_images(sources.light or (), [*together.values()])
    if images and images[-1].is_shared:
        names = [setup.name for setup in setups] + [image.name for image in images[:-1]]
        _say_apart([*dict.fromkeys(names)], images[-1].name)
    for image in images:
        for number, shining in enumerate(image.frames):
            frame = f".{number:04d}" if image.is_numbered else ""
            setups.append(LightSetup(image.name, frame, shining, image.names))
    if not setups:
        raise UsageError("no light given; add --envmap, --light, or --light-from with a photo")
    if rotate is not None and not any(setup.envmap for setup in setups):
        raise UsageError("--rotate: turns maps; add --envmap or --light-from, or leave it out")
    names = [setup.name + setup.frame for setup in setups]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"two images would be named {min(twice)}; give each light once")
    return tuple(setups)


def _say_apart(names: Sequence[str], shared: str) -> None:
    """Log in a line that maps and lights without names, of images `names`, are not in the shared image."""
    if names:
        preset = next((name for name in names if name in preset_names()), None)
        log.warning(
            "%s%s: an image each, since only lights with names share one (%s); to add it there give it a "
            "name, as in %s or --envmap sky=MAP%s",
            names[0],
            f" and {len(names) - 1} more" if len(names) > 1 else "",
            shared,
            f"a={preset}" if preset else "fill=40,20, fill=rembrandt",
            f" ({preset} alone is the preset, {preset}=AZ,EL a light of that name)" if preset else "",
        )


def in_room(setup: LightSetup, room: str | None, is_before_dark: bool) -> LightSetup:
    """Add the light of a room to a setup's lights, by `--room` or by default.

    Raises UsageError where `room` is neither `none` nor a share nor a map, or where two lights have its name.
    """
    if not setup.has_single:
        return setup
    if room is None:
        has_one = ROOM in setup.names or any(light.is_around or light.own for light in setup.lights)
        default = ROOM_BEFORE_DARK if is_before_dark else ROOM_BEFORE_BRIGHT
        return replace(setup, room=0.0 if has_one else default)
    if room == "none":
        return setup
    if ROOM in setup.names:
        raise UsageError(
            f"--room {room}: a light has the name {ROOM}, too; give another name, or leave it out"
        )
    if Path(room).suffix.lower() in (*MAP_SUFFIXES, ".json"):
        light = StudioLight(envmap=Path(room))
        names = (*setup.names, ROOM) if setup.names else ()
        return replace(setup, lights=(*setup.lights, light), names=names)
    (share,) = numbers(room, ("SHARE or MAP or none",), "--room")
    if not 0 <= share <= _MOST_ROOM:
        raise UsageError(f"--room {room}: out of range; give 0 to {_MOST_ROOM:g}, a map, or none")
    return replace(setup, room=share)


def drawn_maps(words: Sequence[str], seed: int) -> list[DrawnMap]:
    """Name the maps of `procedural:N`; of several such words the largest N counts."""
    if not words:
        return []
    from facerf_cli.synth.sky.skies import kind_of, parse_envmaps

    most = max(len(parse_envmaps(word, seed)) for word in words)
    if most > MOST_FRAMES:
        raise UsageError(f"--envmap {DRAWN}{most}: {MOST_FRAMES} maps are the most; give fewer")
    return [DrawnMap(f"{index:05d}_{kind_of(index, seed)}", index, seed) for index in range(most)]


@dataclass(frozen=True)
class _PhotoLights:
    """Lights of photos that --light-from names, as `estimate-light` names its maps."""

    options: LightOptions
    background: Path | None

    def one(self, name: str) -> PhotoLight:
        """The light of one photo, or of the picture behind the person."""
        if name != BACKGROUND:
            (item,) = collect_items([name], Path(), PHOTO_SUFFIXES)
            return PhotoLight(f"{Path(item.name).name}_light", item.input_path, self.options)
        if self.background is None:
            raise UsageError(
                "--light-from background: no picture is behind the person; add --background FILE, or give "
                "./background for a file of that name"
            )
        name = f"{split_frame(self.background.stem)[0]}_light"
        return PhotoLight(name, self.background, self.options, is_background=True)

    def each(self, entries: Sequence[str], output: Path) -> list[PhotoLight]:
        """The lights of photos (files, folders, quoted patterns)."""
        items = collect_items(entries, output, PHOTO_SUFFIXES) if entries else []
        paths = zip(_short_names(items), items, strict=True)
        return [PhotoLight(f"{name}_light", item.input_path, self.options) for name, item in paths]


def _short_names(items: Sequence[Item]) -> list[str]:
    """The last part of each item's name, or the whole name where several items share that part."""
    last_parts = [Path(item.name).name for item in items]
    return [
        short if last_parts.count(short) == 1 else item.name.replace("/", "_")
        for item, short in zip(items, last_parts, strict=True)
    ]


def parse_rotations(text: str | None) -> list[tuple[str, str, float]]:
    """Parse `DEG` or `FROM:TO:N` (N frames, TO left out) to (suffix of the name, frame, degrees)."""
    if text is None:
        return [("", "", 0.0)]
    if not is_sweep(text):
        degrees = numbers(text, ("DEG or FROM:TO:N",), "--rotate")[0]
        return [(f"_rot{degrees:g}", "", degrees)]
    return [("", f".{frame:04d}", degrees) for frame, degrees in enumerate(sweep(text, "--rotate"))]
