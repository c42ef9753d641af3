"""The pictures that `facerf relight` is asked for: maps, rotations and lamps, and how they are named."""

import glob
import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from facerf_cli.cli.batch import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.cli.light_options import LightOptions, light_of_photo
from facerf_cli.cli.photo_options import face_model
from facerf_cli.cli.values import azel, numbers, parse_directions
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME, Provenance

if TYPE_CHECKING:
    from torch import Tensor

MAP_SUFFIXES = frozenset({".exr", ".hdr"})
Sampling = Literal["cell", "paper"]
BALL_PX = 256
DRAWN, DRAWN_WIDTH_PX = "procedural:", 512
LIGHT_WIDTH_PX = 512  # of the map of a photo's light
_MOST_FRAMES = 9999
_FRAME = re.compile(r"(.+?)((?:\.\d+)*)")  # a name, and the frame numbers that it ends in
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class DrawnMap:
    """A procedural map, named as `facerf envmap` names its files."""

    name: str
    index: int
    seed: int


@dataclass(frozen=True)
class PhotoLight:
    """The light of a photo, estimated when it is read; its map is what `facerf estimate-light` writes."""

    name: str
    path: Path
    options: LightOptions


@dataclass(frozen=True)
class Shot:
    """One picture of every photo: under a map, turned, or under lamps (azimuth, elevation, r, g, b)."""

    name: str  # of the light
    frame: str = ""  # '.0001': frame numbers, which end a file's name
    envmap: Path | DrawnMap | PhotoLight | None = None
    rotate_deg: float = 0.0
    lamps: tuple[tuple[float, ...], ...] = ()

    def output(self, item: Item, tag: str, suffix: str) -> Path:
        """The picture's file; the photo's own frame number goes last."""
        stem, frame = split_frame(item.output_base.name)
        return item.output_base.with_name(f"{stem}{tag}_{self.name}{self.frame}{frame}{suffix}")


def split_frame(name: str) -> tuple[str, str]:
    """'sky.0001' as 'sky' and '.0001'."""
    match = _FRAME.fullmatch(name)
    assert match is not None
    return match[1], match[2]


def collect_shots(
    envmaps: Sequence[str],
    rotate: str | None,
    lamps: Sequence[str],
    output: Path,
    seed: int = 0,
    lit: Sequence[PhotoLight] = (),
) -> tuple[Shot, ...]:
    """All pictures that the options ask for; maps are named here and read, drawn or estimated later."""
    rotations = parse_rotations(rotate)
    words = [entry for entry in envmaps if entry.startswith(DRAWN)]
    paths = [path for entry in envmaps if entry not in words for path in _expand_glob(entry)]
    shots = [
        Shot(drawn.name + turn, number, drawn, degrees)
        for drawn in drawn_maps(words, seed)
        for turn, number, degrees in rotations
    ]
    maps = collect_items(paths, output, MAP_SUFFIXES) if paths else []
    for item, short in zip(maps, _short_names(maps), strict=True):
        name, frame = split_frame(short)
        shots += [
            Shot(name + turn, frame + number, item.input_path, degrees) for turn, number, degrees in rotations
        ]
    shots += [
        Shot(photo.name + turn, number, photo, degrees)
        for photo in lit
        for turn, number, degrees in rotations
    ]
    shots += map(_lamp_shot, lamps)
    if not shots:
        raise UsageError("no light: give --envmap or --light, or --light-from a photo")
    names = [shot.name + shot.frame for shot in shots]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"two pictures would be called {min(twice)}; give each light once")
    return tuple(shots)


def drawn_maps(words: Sequence[str], seed: int) -> list[DrawnMap]:
    """The maps of `procedural:N`; of several such words, the most."""
    if not words:
        return []
    from facerf_cli.synth.sky.skies import kind_of, parse_envmaps

    most = max(len(parse_envmaps(word, seed)) for word in words)
    if most > _MOST_FRAMES:
        raise UsageError(f"--envmap {DRAWN}{most}: {_MOST_FRAMES} maps at most")
    return [DrawnMap(f"{index:05d}_{kind_of(index, seed)}", index, seed) for index in range(most)]


def photo_lights(entries: Sequence[str], output: Path, options: LightOptions) -> list[PhotoLight]:
    """The lights of photos: files, folders or quoted patterns; called as `estimate-light` calls its maps."""
    paths = [path for entry in entries for path in _expand_glob(entry)]
    items = collect_items(paths, output, PHOTO_SUFFIXES) if paths else []
    names = _short_names(items)
    return [
        PhotoLight(f"{name}_light", item.input_path, options) for name, item in zip(names, items, strict=True)
    ]


def _short_names(items: Sequence[Item]) -> list[str]:
    """The last part of each item's name, or, where that is no item's own, all of it."""
    last_parts = [Path(item.name).name for item in items]
    return [
        short if last_parts.count(short) == 1 else item.name.replace("/", "_")
        for item, short in zip(items, last_parts, strict=True)
    ]


def parse_rotations(text: str | None) -> list[tuple[str, str, float]]:
    """`DEG` or `FROM:TO:N` (N frames, TO left out) as what follows the name, the frame, and degrees."""
    if text is None:
        return [("", "", 0.0)]
    if ":" not in text:
        degrees = numbers(text, ("DEG or FROM:TO:N",), "--rotate")[0]
        return [(f"_rot{degrees:g}", "", degrees)]
    try:
        start, end, count = numbers(text.replace(":", ","), ("FROM,TO,N",), "--rotate")
    except UsageError:
        count = 0.0
    if not (count.is_integer() and 1 <= count <= _MOST_FRAMES):
        raise UsageError(f"--rotate {text!r}: give degrees, or FROM:TO:N with N frames, as in 0:360:24")
    return [("", f".{k:04d}", start + (end - start) * k / count) for k in range(int(count))]


def usable(shots: Iterable[Shot]) -> tuple[Shot, ...]:
    """The shots whose maps can be read; each that cannot costs one line."""
    good: list[Shot] = []
    for path, group in groupby(shots, lambda shot: shot.envmap):
        try:
            if isinstance(path, (Path, PhotoLight)):
                read_map(path)
            good += group
        except InputError as error:
            log.error("%s", error)
    return tuple(good)


def read_map(path: Path | DrawnMap | PhotoLight) -> "Tensor":
    """A lat-long map [H, W, 3], linear; an InputError names what is wrong with it."""
    if isinstance(path, PhotoLight):
        return _map_of_photo(path)
    if isinstance(path, DrawnMap):
        import torch

        from facerf_cli.synth.sky.skies import draw_sky

        return torch.from_numpy(draw_sky(path.index, path.seed, DRAWN_WIDTH_PX)[0])
    from facerf_cli.files.light_files import read_map_file

    return read_map_file(path)


@cache
def _map_of_photo(photo: PhotoLight) -> "Tensor":
    """Estimated once a process; in the half floats of the file that `facerf estimate-light` writes."""
    from facerf_cli.light.rig_latlong import rig_to_latlong

    return rig_to_latlong(light_of_photo(photo.path, photo.options), LIGHT_WIDTH_PX // 2).half().float()


@lru_cache(maxsize=1)
def light_photos(shots: tuple[Shot, ...], rig: str, sampling: Sampling) -> tuple["Tensor", "Tensor"]:
    """Directions [L, 3] and rgb weights [M, L, 3] of M shots of a photo.

    Maps are weighed over the rig's lights; lamps are lights of their own, after the rig's.
    """
    import torch

    from facerf_cli.light.sphere import azel_to_direction

    lamps = [(row, lamp) for row, shot in enumerate(shots) for lamp in shot.lamps]
    directions = parse_directions(rig) if any(shot.envmap for shot in shots) else torch.zeros(0, 3)
    weights = torch.zeros(len(shots), len(directions) + len(lamps), 3)
    weights[:, : len(directions)] = _map_weights(shots, directions, sampling)
    for column, (row, lamp) in enumerate(lamps, len(directions)):
        weights[row, column] = torch.tensor(lamp[2:])
    own = [azel_to_direction(*lamp[:2]) for _, lamp in lamps]
    return torch.cat([directions, *(direction[None] for direction in own)]), weights


def light_stack(shots: tuple[Shot, ...], directions: "Tensor", sampling: Sampling) -> "Tensor":
    """Weights [M, L, 3] over lights [L, 3] that are given; a lamp goes to the light nearest to it."""
    import torch

    from facerf_cli.light.sphere import azel_to_direction

    weights = _map_weights(shots, directions, sampling)
    for row, shot in enumerate(shots):
        for lamp in shot.lamps:
            nearest = int((directions @ azel_to_direction(*lamp[:2])).argmax())
            weights[row, nearest] += torch.tensor(lamp[2:])
    return weights


def _map_weights(shots: tuple[Shot, ...], directions: "Tensor", sampling: Sampling) -> "Tensor":
    """[M, L, 3], zero for shots without a map; a map is read once for all its rotations."""
    import torch

    from facerf_cli.light.envmap import rotated_weights

    weights = torch.zeros(len(shots), len(directions), 3)
    for path, group in groupby(enumerate(shots), lambda row: row[1].envmap):
        rows = list(group)
        if path is not None:
            angles = [shot.rotate_deg for _, shot in rows]
            weights[[row for row, _ in rows]] = rotated_weights(read_map(path), directions, angles, sampling)
    return weights


def _expand_glob(entry: str) -> list[str]:
    found = [] if Path(entry).exists() else sorted(glob.glob(entry))
    return found or [entry]


def _lamp_shot(text: str) -> Shot:
    """`az,el[,r,g,b][;...]`: lamps that shine together."""
    parts = [part for part in text.split(";") if part.strip()] or [""]
    given = [azel(part, ("AZ,EL", "AZ,EL,R,G,B"), "--light") for part in parts]
    name = "+".join("_".join(f"{value:g}" for value in values) for values in given)
    lamps = tuple(tuple(values) if len(values) == 5 else (*values, 1.0, 1.0, 1.0) for values in given)
    return Shot(f"light_{name}", lamps=lamps)


def write_balls(shots: Iterable[Shot], output: Path, exposure_ev: float | None, overwrite: bool) -> None:
    """`balls/NAME.exr` and `.png`: a mirror ball beside a diffuse one, under each map as it is turned."""
    import torch

    from facerf_cli.files.images import write_display, write_exr
    from facerf_cli.light.envmap import ball

    for shot in shots:
        path = output / "balls" / f"{shot.name}{shot.frame}.exr"
        if shot.envmap is None or (path.with_suffix(".png").exists() and not overwrite):
            continue
        envmap = read_map(shot.envmap)
        both = [ball(envmap, BALL_PX, kind, shot.rotate_deg) for kind in ("mirror", "diffuse")]
        pixels = torch.cat(both, 1).numpy()
        metadata = _marks_of(shot.envmap)
        write_exr(path, pixels, metadata=metadata)
        write_display(
            path.with_suffix(".png"),
            pixels,
            "auto" if exposure_ev is None else exposure_ev,
            metadata=metadata,
        )


def _marks_of(envmap: Path | DrawnMap | PhotoLight) -> dict[str, str | int]:
    """Metadata of what shows a light; one that was estimated depends on the face model."""
    if isinstance(envmap, PhotoLight):
        return Provenance(envmap.name, **face_model(envmap.options.photo).stamp).attributes()
    made = Provenance(envmap.name).attributes()
    if isinstance(envmap, DrawnMap):
        return made
    from facerf_cli.files.light_files import face_model_of_map

    return made | face_model_of_map(envmap)
