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
from facerf_cli.batch.journal import file_row
from facerf_cli.batch.recipe import RESULTS_VERSION, key_of, recipe_of
from facerf_cli.errors import UsageError
from facerf_cli.files.texts import file_sha256
from facerf_cli.light.entries import (
    MOST_FRAMES,
    ROOM_BEFORE_BRIGHT,
    ROOM_BEFORE_DARK,
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
from facerf_cli.work.photo_options import LightOptions, fov_option

DRAWN = "procedural:"
BACKGROUND = "background"  # the picture behind the person, as --light-from names it
_LIGHT = "_light"  # ends the name of the light of a photo
_WIDTH_PX = 512  # of maps in the cache
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
class PhotoLight:
    """The light of a photo: a map in the user's cache, as `facerf estimate-light` writes it.

    Attributes:
        photo: A photo, or the picture behind the person if `is_background`.
        envmap: The map, whose folder is named by the content of the photo and by the options.
        options: How the light is estimated.
        layer: Name of the light in an image of several; '' for an image of its own.
        is_background: True for a light on the scale of the background.
    """

    photo: Path
    envmap: Path
    options: LightOptions
    layer: str = ""
    is_background: bool = False

    def estimate(self) -> None:
        """Write the map if it is not there yet; raises InputError for a photo that cannot be used."""
        if not self.envmap.is_file():
            from facerf_cli.work.estimate_light import write_lights

            base = self.envmap.with_name(self.envmap.name.removesuffix(f"{_LIGHT}.exr"))
            write_lights(Item(self.photo, base, self.photo.stem), self.options, _WIDTH_PX, sh_order=2)


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
    sources: LightSources, output: Path, seed: int = 0, photos: Sequence[PhotoLight] = ()
) -> tuple[LightSetup, ...]:
    """List the light setups that the options name; maps are read later.

    Args:
        sources: The options.
        output: The output folder, which is not searched for maps.
        seed: The seed of drawn maps.
        photos: The lights of photos.
    """
    rotate = sources.rotate
    rotations = parse_rotations(rotate)
    entries = [named_entry(entry) for entry in dict.fromkeys(sources.envmap or ())]
    named = [(name, Path(path)) for name, path in entries if name]
    named += [(photo.layer, photo.envmap) for photo in photos if photo.layer]
    words = [path for name, path in entries if not name and path.startswith(DRAWN)]
    paths = [path for name, path in entries if not name and path not in words]
    files = collect_items(paths, output, MAP_SUFFIXES) if paths else []
    short = map(split_frame, _short_names(files))
    maps = [
        *((path.stem, "", path) for path in drawn_maps(words, seed)),
        *((name, frame, file.input_path) for (name, frame), file in zip(short, files, strict=True)),
        *((photo.envmap.stem, "", photo.envmap) for photo in photos if not photo.layer),
    ]
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
    apart = dict.fromkeys([one.name for one in setups] + [image.name for image in images[:-1]])
    if apart and images and images[-1].is_shared:
        log.warning(
            "%s: not in the image of the lights that have names (%s); to add a light there, name it: "
            "fill=40,20, fill=rembrandt or --envmap sky=MAP",
            ", ".join(apart),
            images[-1].name,
        )
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


def drawn_maps(words: Sequence[str], seed: int) -> list[Path]:
    """Draw the maps of `procedural:N` into the user's cache; of several such words the largest N counts."""
    if not words:
        return []
    from facerf_cli.files.write import write_exr
    from facerf_cli.synth.sky.skies import draw_sky, kind_of, parse_envmaps

    most = max(len(parse_envmaps(word, seed)) for word in words)
    if most > MOST_FRAMES:
        raise UsageError(f"--envmap {DRAWN}{most}: {MOST_FRAMES} maps are the most; give fewer")
    folder = _cached("maps", f"{RESULTS_VERSION}-{seed}")
    maps = [folder / f"{index:05d}_{kind_of(index, seed)}.exr" for index in range(most)]
    for index, path in enumerate(maps):
        if not path.is_file():
            write_exr(path, draw_sky(index, seed, _WIDTH_PX)[0])
    return maps


def photo_lights(
    sources: LightSources, how: LightOptions, background: Path | None, output: Path
) -> tuple[PhotoLight, ...]:
    """List the lights of photos that --light-from names, each once.

    Args:
        sources: The options.
        how: How the lights are estimated.
        background: The picture behind the person.
        output: The output folder, which is not searched for photos.
    """
    entries = dict.fromkeys(sources.light_from or ())
    if sources.fov_deg is not None and not entries:
        raise UsageError("--fov: is for --light-from; add it, or leave --fov out")
    options = replace(how, fov_deg=sources.fov_deg)

    def light(photo: Path, name: str, layer: str = "", is_background: bool = False) -> PhotoLight:
        recipe = recipe_of(options, file_sha256) | {"photo": file_row(photo)["sha256"]}
        envmap = _cached("lights", key_of(recipe), f"{name}{_LIGHT}.exr")
        return PhotoLight(photo, envmap, options, layer, is_background)

    lights, alone = [], []
    for layer, path in map(named_entry, entries):
        if path == BACKGROUND:
            if background is None:
                raise UsageError(
                    "--light-from background: no picture is behind the person; add --background FILE, or "
                    "give ./background for a file of that name"
                )
            lights.append(light(background, split_frame(background.stem)[0], layer, is_background=True))
        elif layer:
            (item,) = collect_items([path], Path(), PHOTO_SUFFIXES)
            lights.append(light(item.input_path, Path(item.name).name, layer))
        else:
            alone.append(path)
    items = collect_items(alone, output, PHOTO_SUFFIXES) if alone else []
    lights += [light(item.input_path, name) for item, name in zip(items, _short_names(items), strict=True)]
    return tuple(lights)


def _cached(*parts: str) -> Path:
    """A path in the user's cache."""
    from facerf_cli.files.downloads import cache_folder  # --help does without it

    return cache_folder().joinpath(*parts)


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
