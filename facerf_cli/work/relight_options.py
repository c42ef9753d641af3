"""Options of `facerf relight`, and the images to render. Light to import."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal, Self

from facerf_cli.baselines import RelightKind
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
from facerf_cli.batch.run import Job
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.files.output_options import Exposure, OutputOptions, parse_exposure
from facerf_cli.light.entries import Sampling, numbers
from facerf_cli.light.setups import CachedMap, LightSetup, image_path
from facerf_cli.option import BATCH, IMAGE, LIGHT, METHOD, option
from facerf_cli.work.photo_options import (
    FieldOptions,
    LightOptions,
    PhotoOptions,
    PortraitOptions,
    check_companion,
)
from facerf_cli.work.shots import Shots, recipe_of_shots, video_rate

Composite = Literal["photo", "face"]
BackgroundKind = Literal["photo", "envmap", "none", "file", "colour"]
LIGHT_ENDING = "_light"  # ends the name of a photo's light
_DRAWN_WIDTH_PX = 512
_LAYERS = ("matte", "albedo", "normal", "position", "depth", "shadow", "specular", "classes", "face", "uv")
_LUMINANCE, _DARK = (0.2126, 0.7152, 0.0722), 0.1  # of linear Rec.709; upper limit of a dark colour
_FORMS = "photo, envmap, none, an image file, a folder, a colour name such as black, #RRGGBB or R,G,B"


@dataclass(frozen=True)
class DrawnMap(CachedMap):
    """Procedural map in the user's cache."""

    index: int
    seed: int

    def write(self) -> None:
        """Draw the map."""
        from facerf_cli.files.write import write_exr
        from facerf_cli.synth.sky.skies import draw_sky

        write_exr(self.envmap, draw_sky(self.index, self.seed, _DRAWN_WIDTH_PX)[0])


@dataclass(frozen=True)
class PhotoLight(CachedMap):
    """The light of a photo, as `facerf estimate-light` writes it.

    Attributes:
        photo: A photo, or the background image.
        options: How the light is estimated.
        is_background: True if the light has the brightness of the background image.
    """

    photo: Path
    options: LightOptions
    is_background: bool = False

    def write(self) -> None:
        """Estimate the light; raise InputError if the photo cannot be used."""
        from facerf_cli.work.estimate_light import write_lights

        base = self.envmap.with_name(self.envmap.name.removesuffix(f"{LIGHT_ENDING}.exr"))
        write_lights(Item(self.photo, base, self.photo.stem), self.options)


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
        red, green, blue, *_ = (value / 255 for value in ImageColor.getrgb(text))
    except ValueError:
        return None

    def linear(encoded: float) -> float:
        return encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4

    return linear(red), linear(green), linear(blue)


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
        shown_default="auto; 0 with original, delight or --light-from background",
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
class RelightPlan(Job):
    """The images of each photo.

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
    verb = "relight"

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
