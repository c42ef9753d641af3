"""Options of `facerf relight`, the rules between them, and the images to render. Light to import."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal, Self

from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.batch.inputs import (
    COMPANION,
    VIDEO_SUFFIXES,
    Item,
    NamePattern,
    is_pattern,
    numbered_images,
    only_item,
)
from facerf_cli.batch.recipe import DigestOf, Recipe, recipe_of
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.files.texts import file_sha256
from facerf_cli.light.entries import DELIGHT, ORIGINAL, Sampling, is_sweep, numbers, parse_lights
from facerf_cli.light.setups import LightSetup
from facerf_cli.option import BATCH, IMAGE, LIGHT, METHOD, option
from facerf_cli.work.light_setups import (
    BACKGROUND,
    CachedMap,
    LightSources,
    PhotoLight,
    collect_setups,
    drawn_maps,
    image_path,
    photo_lights,
    set_ambient,
)
from facerf_cli.work.output_options import Exposure, OutputOptions, parse_exposure
from facerf_cli.work.photo_options import (
    FieldOptions,
    LightOptions,
    PhotoOptions,
    PortraitOptions,
    check_companion,
    for_other_photos,
    parse_pose,
    refuse,
)
from facerf_cli.work.shots import Shots, recipe_of_shots, video_rate

Composite = Literal["photo", "face"]
BackgroundKind = Literal["photo", "envmap", "none", "file", "colour"]
_FIELDS = ("field", "portrait")
_OF_EVERY_IMAGE = ("person", "class", "rgb", "rgba")  # names of layers
_LAYERS = ("matte", "albedo", "normal", "position", "depth", "shadow", "specular", "classes", "face", "uv")
_LUMINANCE, _DARK = (0.2126, 0.7152, 0.0722), 0.1  # of linear Rec.709; upper limit of a dark colour
_FORMS = "photo, envmap, none, an image file, a folder, a colour name such as black, #RRGGBB or R,G,B"


@dataclass(frozen=True)
class BackgroundChoice:
    """The background as typed."""

    kind: BackgroundKind
    path: Path | None = option(None, metavar=COMPANION)
    colour: tuple[float, float, float] | None = None  # scene-linear Rec.709
    frames: tuple[Path, ...] = ()  # for the frames of a shot, instead of `path`

    def listed(self, output: Path) -> Self:
        """List the frames of a folder or pattern; the output folder is not searched."""
        return replace(self, path=None, frames=numbered_images(str(self.path), output))

    def is_dark(self, setup: LightSetup) -> bool:
        """True if the background is empty, black or a dark colour."""
        if self.kind == "envmap":
            return setup.envmap is None
        luminance = sum(k * c for k, c in zip(_LUMINANCE, self.colour or (1.0, 1.0, 1.0), strict=True))
        return self.kind == "none" or luminance < _DARK


def parse_background(text: str) -> BackgroundChoice:
    """Parse `--background`; raise UsageError if it is not a background."""
    if text in ("photo", "envmap", "none"):
        return BackgroundChoice(text)  # type: ignore[arg-type]
    path = Path(text)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        advice = f"convert it to images (ffmpeg -i {path.name} bg/%04d.png), and pass their folder"
        raise UsageError(f"--background {path}: videos are not supported; {advice}")
    if path.is_file():
        return BackgroundChoice("file", path)
    if (colour := _named_colour(text)) is not None:
        return BackgroundChoice("colour", colour=colour)
    if path.is_dir() or "{" in text or is_pattern(text):
        check_companion(None if is_pattern(text) else path, "--background")
        return BackgroundChoice("file", path)
    if "," in text:
        red, green, blue = numbers(text, ("R,G,B",), "--background")
        if min(red, green, blue) < 0:
            raise UsageError(f"--background {text!r}: the colour is negative; use values from 0")
        return BackgroundChoice("colour", colour=(red, green, blue))
    raise UsageError(f"--background {text!r}: no such file; use {_FORMS}")


def parse_aov(text: str) -> tuple[str, ...]:
    """Parse `--aov`, names in singular or plural, separated by commas; without the matte, always written."""
    known = {form: name for name in _LAYERS for form in (name, f"{name}s", name.removesuffix("es"))}
    names = dict.fromkeys(name.strip() for name in text.split(",") if name.strip())
    if unknown := [name for name in names if name not in known]:
        raise UsageError(f"--aov {unknown[0]!r}: no such layer; use some of {', '.join(_LAYERS)}")
    return tuple(dict.fromkeys(known[name] for name in names if known[name] != "matte"))


def _named_colour(text: str) -> tuple[float, float, float] | None:
    """Return the scene-linear colour of a CSS name or #RRGGBB; None for other text."""
    from PIL import ImageColor  # --help does without it

    try:
        red, green, blue, *_ = (_srgb_to_linear(value / 255) for value in ImageColor.getrgb(text))
    except ValueError:
        return None
    return red, green, blue


def _srgb_to_linear(encoded: float) -> float:
    return encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4


@dataclass(frozen=True, kw_only=True)
class RelightOptions(FieldOptions, PortraitOptions):
    """The options that all images share.

    Attributes:
        rig: Lights that approximate maps: the number of a uniform rig, or a file of directions (az,el or
            x y z; .lp).
        pose: Head pose in degrees; renders only the face.
        reflectance: Reflectance model: portrait (the whole person), field (the paper's face field), or a
            baseline: diffuse-sh, specular-sh, prt.
        exposure: Exposure of PNG and JPEG: auto (the face as bright as in the photo), face (the face well
            exposed), or EV.
        composite: Image to write: the photo with the relit person, or only the rendered face, with alpha.
        background: Background: photo, an image, images by frame (bg/b.%04d.png) or name (bg/{stem}.png), a
            folder, or a colour (#RRGGBB or linear R,G,B), which keep their look; envmap; or none (alpha).
        background_blur: Lens blur of a map used as background, in percent of the longer side.
        light_wrap: Amount of background light that wraps over the matte's edge (EXR layer: wrap).
        aov: Additional EXR layers besides the matte: albedo, normal, position, depth, shadow, specular,
            classes, face, uv.
        matte: Grey image of the part of the photo to change (mattes/{stem}.png); --person replaces the
            detected matte.
        identity: Report identity_distance, the distance of an image from its photo by dlib's face descriptor
            (an extra).
        fps: Frame rate of -o FILE.mp4, such as 25 or 24000/1001.
        name: Pattern of the images' names: {dir}, {parent}, {stem}, {ext}, {light} and {frame:04}.
    """

    photo: PhotoOptions
    rig: str = option("150", metavar="N|FILE", flags=("--lights",), panel=LIGHT)
    pose: str | None = option(
        None, metavar="YAW,PITCH,ROLL", shown_default="the photo's", panel=IMAGE, everyday=True
    )
    reflectance: RelightKind = option("portrait", metavar="KIND", panel=METHOD)
    exposure: Exposure | None = option(
        None,
        metavar="auto|face|EV",
        shown_default="auto; 0 with original",
        parse=parse_exposure,
        panel=IMAGE,
        everyday=True,
    )
    output: OutputOptions = field(default_factory=OutputOptions)
    composite: Composite | None = option(None, shown_default="photo; face with --pose", panel=IMAGE)
    background: BackgroundChoice = option(
        BackgroundChoice("photo"),
        metavar="KIND|FILE|COLOUR",
        default_text="photo",
        parse=parse_background,
        panel=IMAGE,
        everyday=True,
    )
    background_blur: float = option(
        0.01,
        metavar="PERCENT",
        least=0.0,
        most=50.0,
        default_text=1.0,
        typed=float,
        parse=lambda percent: percent / 100,
        panel=IMAGE,
    )
    light_wrap: float = option(0.0, metavar="FRACTION", least=0.0, most=1.0, panel=IMAGE)
    aov: tuple[str, ...] = option(
        (), metavar="NAME,...", shown_default="none", default_text="", parse=parse_aov, panel=IMAGE
    )
    matte: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=IMAGE)
    identity: bool = option(False, in_recipe=False, panel=METHOD)
    fps: Fraction | None = option(
        None, metavar="RATE", in_recipe=False, shown_default="the EXR's, or 24", parse=video_rate, panel=IMAGE
    )
    name: NamePattern | None = option(
        None,
        metavar="PATTERN",
        in_recipe=False,
        shown_default="{dir}/{stem}_{light}",
        parse=partial(NamePattern.parse, option="--name"),
        panel=BATCH,
    )

    @property
    def is_face_only(self) -> bool:
        """True if only the rendered face is written."""
        return self.composite == "face" or self.pose is not None


@dataclass(frozen=True)
class RelightPlan:
    """The images of each photo; see `plan_relight`.

    Attributes:
        options: The options, with defaults that depend on other options filled in.
        setups: The lights of each image; each recipe contains its own setup.
        sampling: How maps become weights of a rig's lights.
        cached: Maps in the user's cache that the setups use.
        has_ambient: True if --ambient was given; without it, OLAT stacks get no ambient fill.
        shots: Videos and image sequences among the inputs.
        exposures: Exposures by setup of each take's middle frame, as far as this process knows them.
    """

    options: RelightOptions
    setups: tuple[LightSetup, ...] = field(metadata=NOT_IN_RECIPE)
    sampling: Sampling
    cached: tuple[CachedMap, ...] = field(default=(), metadata=NOT_IN_RECIPE)
    has_ambient: bool = field(default=False, metadata=NOT_IN_RECIPE)
    shots: Shots = field(default_factory=Shots, metadata=NOT_IN_RECIPE)
    exposures: dict[Path, dict[str, float]] = field(
        default_factory=dict, metadata=NOT_IN_RECIPE, compare=False
    )

    @property
    def photo(self) -> PhotoOptions:
        return self.options.photo

    @property
    def exposure_rule(self) -> Exposure:
        """The exposure in EV, or the rule that chooses it."""
        return "auto" if self.options.exposure is None else self.options.exposure

    @property
    def lit_faces(self) -> set[int]:
        """Numbers of the faces that have their own lights."""
        lights = (light for setup in self.setups for light in setup.lights)
        return {light.face for light in lights if light.face is not None}

    def write_maps(self) -> None:
        """Draw the maps, and estimate the lights of photos, that are not in the user's cache yet."""
        for made in self.cached:
            if not made.envmap.is_file():
                made.write()

    def outputs_of(self, item: Item) -> list[Path]:
        """List the files of an item: one per format and setup."""
        return [path for setup in self.setups for path in self._images(item, setup)]

    def _images(self, item: Item, setup: LightSetup) -> list[Path]:
        options = self.options
        tag = "" if options.composite == "photo" else self.photo.first_tag
        return [image_path(setup, item, tag, suffix, options.name) for suffix in options.output.suffixes]

    def setups_of(self, item: Item) -> tuple[LightSetup, ...]:
        """Return the setups of an item's stale images, with all frames of each light."""
        stale = {setup.name for setup in self.setups if not item.stale.isdisjoint(self._images(item, setup))}
        return tuple(setup for setup in self.setups if not item.stale or setup.name in stale)

    def of_items(self, items: Sequence[Item], shots: Shots, output: Path) -> Self:
        """Return this plan for photos and frames of shots.

        Raises UsageError if two images would have one path, or if a frame lacks an image of `--background`.
        """
        behind = self.options.background
        if shots.all and behind.path is not None and behind.path.is_dir():
            behind = behind.listed(output)
        for item in items if behind.frames else ():
            where = f"--background {behind.frames[0].parent}: {len(behind.frames)} images"
            if item.output_base not in shots.places:
                advice = "add --sequence, or pass one image, or a folder of images with the photos' names"
                raise UsageError(f"{where}, but {item.input_path} is not a frame of a shot; {advice}")
            frames = shots.places[item.output_base][0].frames
            if len(frames) > len(behind.frames):
                raise UsageError(
                    f"{where}, but the shot has {len(frames)} frames; add images or remove frames"
                )
        if self.options.output.file_suffix:
            all_faces = self.photo.face == "all" and self.options.composite == "face"
            only_item(items, self.outputs_of(items[0])[0], several=all_faces or len(self.setups) > 1)
        face = {int(self.photo.face)} if self.photo.face.isdecimal() else set()
        if shots.all and (others := self.lit_faces - face):  # its other faces are not tracked
            raise UsageError(f"--light face={min(others)}: not the tracked face; add --face {min(others)}")
        (path, count), *_ = Counter(path for item in items for path in self.outputs_of(item)).most_common(1)
        if count > 1:
            raise UsageError(f"--name: {path} would be the name of two images; add fields to the pattern")
        return replace(self, options=replace(self.options, background=behind), shots=shots)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """Return the recipe of every output, which contains only its own setup."""
        shared = recipe_of(self, digest_of)
        shared |= recipe_of_shots(self.shots.all, digest_of)
        lit = [recipe_of(setup, digest_of) | shared for setup in self.setups]
        return [recipe | {"format": name} for recipe in lit for name in self.options.output.formats]


def plan_relight(
    options: RelightOptions, sources: LightSources, output: Path, digest_of: DigestOf = file_sha256
) -> RelightPlan:
    """List the images of each photo; raise UsageError for options that exclude each other.

    Args:
        options: The options that all images share.
        sources: The lights.
        output: The output folder, which is not searched for inputs.
        digest_of: Returns the SHA-256 of a photo whose light is used, or of a network.
    """
    photo = replace(options.photo, ocio_config=options.output.config)
    photo.check()
    parse_pose(options.pose)
    parse_lights(options.rig)
    check_companion(options.matte, "--matte")
    check_companion(options.normals_from, "--normals-from")
    background = options.background
    if background.path is not None and not background.path.is_file():
        from_behind = any(entry.rpartition("=")[2] == BACKGROUND for entry in sources.light_from or ())
        if from_behind or is_pattern(str(background.path)):
            background = background.listed(output)
    of_light: Kind = "field" if options.reflectance == "portrait" else options.reflectance
    how = LightOptions(photo=for_other_photos(photo), reflectance=of_light)
    image_behind = (*background.frames, background.path)[0]
    lights = photo_lights(sources, how, image_behind, output, digest_of)
    cached: tuple[CachedMap, ...] = (*drawn_maps(sources, photo.settings.seed), *lights)
    setups = collect_setups(sources, output, cached)
    refuse(_rules(options, setups))
    if options.exposure is None:
        setups = _at_photos_exposure(setups, lights)
    face_only, dark = options.is_face_only, background.is_dark
    sweeps = sources.rotate is not None and is_sweep(sources.rotate)
    filled = replace(
        options,
        photo=photo,
        background=background,
        composite="face" if face_only else "photo",
        exposure="auto" if options.exposure is None else options.exposure,
        reflectance="field" if face_only and options.reflectance == "portrait" else options.reflectance,
    )
    return RelightPlan(
        filled,
        tuple(set_ambient(setup, sources.ambient, face_only or dark(setup)) for setup in setups),
        sources.sampling or ("smooth" if sweeps else "cell"),
        cached,
        has_ambient=sources.ambient is not None,
    )


def _rules(options: RelightOptions, setups: Sequence[LightSetup]) -> dict[str, bool]:
    """Return whether each rule between options is broken, by its message."""
    baseline, whole = options.reflectance not in _FIELDS, not options.is_face_only
    of_field = "requires --reflectance portrait or field"
    of_whole = "requires the whole photo; remove --pose and --composite face"
    by_photo = [light for setup in setups for light in setup.by_photo]
    word = ORIGINAL if by_photo and by_photo[0].original else DELIGHT
    layers = {*_OF_EVERY_IMAGE, *options.aov, *(["wrap"] if options.light_wrap else [])}
    taken = [name for setup in setups for name in setup.names if name in layers]
    keeps_background = options.background.kind in ("photo", "none")
    return {
        "--pose: turns the head away from its photo; use --composite face": (
            options.pose is not None and options.composite == "photo"
        ),
        f"--network-alone: {of_field}": options.network_alone and baseline,
        f"--white-balance: {of_field}": options.white_balance != "keep" and baseline,
        f"--light {word}: {of_field}": bool(by_photo) and baseline,
        f"--background: {of_whole}": options.background.kind != "photo" and not whole,
        f"--light {ORIGINAL}: {of_whole}": any(setup.has_original for setup in setups) and not whole,
        "--normals-from: requires --reflectance portrait and the whole photo": (
            options.normals_from is not None and (options.reflectance != "portrait" or not whole)
        ),
        "--light-wrap: requires a new background; add --background FILE, COLOUR or envmap": (
            bool(options.light_wrap) and keeps_background
        ),
        f"--light: {''.join(taken[:1])} is also a layer of the EXR; rename the light": bool(taken),
    }


def _at_photos_exposure(setups: Sequence[LightSetup], lights: Sequence[PhotoLight]) -> tuple[LightSetup, ...]:
    """Set the exposure to 0 EV if the lights are as bright as the photo, or as the background image."""
    behind = {light.envmap for light in lights if light.is_background}
    return tuple(
        replace(setup, exposure_ev=0.0)
        if setup.by_photo or not behind.isdisjoint(light.envmap for light in setup.lights)
        else setup
        for setup in setups
    )
