"""`facerf relight`: its options, what each image is made by, and where it goes. Light to import."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal, Self

from facerf_cli.baselines import Kind, RelightKind
from facerf_cli.batch.inputs import (
    COMPANION,
    FILM_SUFFIXES,
    Item,
    NamePattern,
    is_pattern,
    numbered_images,
    only_item,
)
from facerf_cli.batch.recipe import DigestOf, Recipe, recipe_of
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import EVEN, OWN, Sampling, is_sweep, numbers, parse_lights
from facerf_cli.option import BATCH, IMAGE, LIGHT, METHOD, option
from facerf_cli.relighting import White
from facerf_cli.work.light_setups import (
    BACKGROUND,
    LightSetup,
    LightSources,
    PhotoLight,
    collect_setups,
    in_room,
    photo_lights,
)
from facerf_cli.work.output_options import (
    Exposure,
    OutputOptions,
    parse_exposure,
)
from facerf_cli.work.photo_options import (
    LightOptions,
    PhotoOptions,
    check_companion,
    for_other_photos,
    network_alone_option,
    normals_option,
    parse_pose,
    white_option,
)
from facerf_cli.work.shots import (
    Shots,
    film_rate,
    recipe_of_shots,
)

Composite = Literal["photo", "face"]
BackgroundKind = Literal["photo", "envmap", "none", "file", "colour"]
_FIELDS = ("field", "portrait")
_OF_EVERY_IMAGE = ("person", "class", "rgb", "rgba")  # names of layers
_LAYERS = ("matte", "albedo", "normal", "position", "depth", "shadow", "specular", "classes", "face", "uv")
_LUMINANCE, _DARK = (0.2126, 0.7152, 0.0722), 0.1  # of linear Rec.709; of a dark colour, at most
_FORMS = "photo, envmap, none, an image file, a folder, black or another name, #RRGGBB or R,G,B"


@dataclass(frozen=True)
class BackgroundChoice:
    """A choice of background; `colour` is scene-linear Rec.709.

    `path` is an image, or a folder or pattern with one for each photo. `frames` are the images behind the
    frames of a shot, in place of it.
    """

    kind: BackgroundKind
    path: Path | None = option(None, metavar=COMPANION)
    colour: tuple[float, float, float] | None = None
    frames: tuple[Path, ...] = ()

    def listed(self, output: Path) -> Self:
        """This choice with the frames of a folder or pattern, which is not searched in the output folder."""
        return replace(self, path=None, frames=numbered_images(str(self.path), output))

    def is_dark(self, setup: LightSetup) -> bool:
        """True where nothing bright is behind the person: nothing, black, or a dark colour."""
        if self.kind == "envmap":
            return setup.envmap is None
        luminance = sum(k * c for k, c in zip(_LUMINANCE, self.colour or (1.0, 1.0, 1.0), strict=True))
        return self.kind == "none" or luminance < _DARK


def parse_background(text: str) -> BackgroundChoice:
    """Parse `--background`; raises UsageError where it names none."""
    if text in ("photo", "envmap", "none"):
        return BackgroundChoice(text)  # type: ignore[arg-type]
    path = Path(text)
    if path.suffix.lower() in FILM_SUFFIXES:
        advice = f"convert it to images (ffmpeg -i {path.name} bg/%04d.png), and pass their folder"
        raise UsageError(f"--background {path}: a video is not read; {advice}")
    if path.is_file():
        return BackgroundChoice("file", path)
    if (colour := _named(text)) is not None:
        return BackgroundChoice("colour", colour=colour)
    if path.is_dir() or "{" in text or is_pattern(text):
        check_companion(None if is_pattern(text) else path, "--background")
        return BackgroundChoice("file", path)
    if "," in text:
        red, green, blue = numbers(text, ("R,G,B",), "--background")
        if min(red, green, blue) < 0:
            raise UsageError(f"--background {text!r}: the colour is negative; give values from 0")
        return BackgroundChoice("colour", colour=(red, green, blue))
    raise UsageError(f"--background {text!r}: no such file; give {_FORMS}")


def parse_aov(text: str) -> tuple[str, ...]:
    """Parse `--aov`, names with commas, singular or plural; the matte, which is always there, is left out."""
    known = {form: name for name in _LAYERS for form in (name, f"{name}s", name.removesuffix("es"))}
    names = dict.fromkeys(name.strip() for name in text.split(",") if name.strip())
    if unknown := [name for name in names if name not in known]:
        raise UsageError(f"--aov {unknown[0]!r}: no such layer; give some of {', '.join(_LAYERS)}")
    return tuple(dict.fromkeys(known[name] for name in names if known[name] != "matte"))


def _named(text: str) -> tuple[float, float, float] | None:
    """The colour of a name of CSS or of #RRGGBB, scene-linear; None for another text."""
    from PIL import ImageColor  # --help does without it

    try:
        red, green, blue, *_ = (_linear(value / 255) for value in ImageColor.getrgb(text))
    except ValueError:
        return None
    return red, green, blue


def _linear(encoded: float) -> float:
    """Decode sRGB; without numpy, which --help does without."""
    return encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4


@dataclass(frozen=True)
class RelightOptions:
    """The options that images share.

    Attributes:
        rig: Approximate maps by a rig of N lights, or by a file of directions (az,el or x y z; .lp).
        pose: Turn the head to a pose, in degrees; shows the face alone.
        reflectance: Relight the whole portrait, or the face by the paper's field; or by a baseline:
            diffuse-sh, specular-sh, prt.
        exposure: Expose PNG and JPEG by EV, or the face as in the photo (auto) or well lit (face).
        composite: Show the photo with its face relit, or the rendered face alone, with alpha.
        background: Show behind the person the photo, an image, images by frame (bg/b.%04d.png) or name
            (bg/{stem}.png), a folder of either, or a colour (#RRGGBB or linear R,G,B), which keep their look;
            the envmap; or none (alpha).
        background_blur: Blur the map behind the person as a lens does, in percent of the longer side.
        light_wrap: Let so much of the background's light run over the matte's edge; the EXR's layer wrap.
        aov: Add layers to the EXR besides its matte: albedo, normal, position, depth, shadow, specular,
            classes, face, uv.
        matte: Change only what a grey image shows (mattes/{stem}.png: of each its own); --person replaces the
            matte.
        identity: Report `identity_distance`: how far an image is from its photo by dlib's descriptor of faces
            (an extra).
        fps: Set the frames per second of -o FILE.mp4, such as 25 or 24000/1001.
        name: Name the images by a pattern of {dir}, {parent}, {stem}, {ext}, {light} and {frame:04}.
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
        shown_default="auto; 0 with own",
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
    light_wrap: float = option(0.0, metavar="SHARE", least=0.0, most=1.0, panel=IMAGE)
    aov: tuple[str, ...] = option(
        (), metavar="NAME,...", shown_default="none", default_text="", parse=parse_aov, panel=IMAGE
    )
    matte: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=IMAGE)
    identity: bool = option(False, in_recipe=False, panel=METHOD)
    network_alone: bool = network_alone_option()
    white: White = white_option()
    normals_from: Path | None = normals_option()
    fps: Fraction | None = option(
        None, metavar="RATE", in_recipe=False, shown_default="the EXR's, or 24", parse=film_rate, panel=IMAGE
    )
    name: NamePattern | None = option(
        None,
        metavar="PATTERN",
        in_recipe=False,
        shown_default="{dir}/{stem}_{light}",
        parse=partial(NamePattern.parse, option="--name"),
        panel=BATCH,
    )


@dataclass(frozen=True)
class RelightPlan:
    """The images that each photo gets; see `plan_relight`.

    Attributes:
        options: With what depends on other options.
        setups: The lights of each image; a recipe has its own.
        sampling: How maps give a rig's lights their weights.
        photos: The lights of photos, whose maps are among the setups.
        keeps_photo: True by --composite photo, which no stack can have.
        has_room: True by --room; a stack has none else.
        shots: The films and sequences among the inputs.
        exposures: Exposure by setup of the middle frame of each take that this process knows.
    """

    options: RelightOptions
    setups: tuple[LightSetup, ...] = field(metadata=NOT_IN_RECIPE)
    sampling: Sampling
    photos: tuple[PhotoLight, ...] = field(default=(), metadata=NOT_IN_RECIPE)
    keeps_photo: bool = field(default=False, metadata=NOT_IN_RECIPE)
    has_room: bool = field(default=False, metadata=NOT_IN_RECIPE)
    shots: Shots = field(default_factory=Shots, metadata=NOT_IN_RECIPE)
    exposures: dict[Path, dict[str, float]] = field(
        default_factory=dict, metadata=NOT_IN_RECIPE, compare=False
    )

    @property
    def photo(self) -> PhotoOptions:
        """Settings of reading photos."""
        return self.options.photo

    @property
    def exposure_rule(self) -> Exposure:
        """EV, or the rule that chooses it."""
        return "auto" if self.options.exposure is None else self.options.exposure

    @property
    def lit_faces(self) -> set[int]:
        """The numbers of the faces that have lights of their own."""
        lights = (light for setup in self.setups for light in setup.lights)
        return {light.face for light in lights if light.face is not None}

    def outputs_of(self, item: Item) -> list[Path]:
        """A file of each format for each setup."""
        return [path for setup in self.setups for path in self._images(item, setup)]

    def _images(self, item: Item, setup: LightSetup) -> list[Path]:
        options = self.options
        tag = "" if options.composite == "photo" else self.photo.first_tag
        return [setup.output(item, tag, suffix, options.name) for suffix in options.output.suffixes]

    def setups_of(self, item: Item) -> tuple[LightSetup, ...]:
        """The lights of an item's stale images; a light has all of its frames."""
        stale = {setup.name for setup in self.setups if not item.stale.isdisjoint(self._images(item, setup))}
        return tuple(setup for setup in self.setups if not item.stale or setup.name in stale)

    def of_items(self, items: Sequence[Item], shots: Shots, output: Path) -> Self:
        """This plan for some photos, and frames of shots.

        Raises UsageError where two images have one path, and where frames lack an image of `--background`.
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
        for path in self.outputs_of(items[0]) if self.options.output.file_suffix else ():
            if len(self.setups) > 1:
                raise UsageError(
                    f"-o {path}: is one file, and these lights make {len(self.setups)} images; give a "
                    "folder, or names to lights that shine together, as in key=60,25"
                )
            all_faces = self.photo.face == "all" and self.options.composite == "face"
            only_item(items, path, several=all_faces)
        which = self.photo.face
        relit = {int(which)} if which.isdecimal() else set()
        if (which.isdecimal() or shots.all) and (others := self.lit_faces - relit):
            advice = f"add --face {min(others) if shots.all else 'all'}"
            raise UsageError(f"--light face={min(others)}: --face {which} is not that face; {advice}")
        paths: set[Path] = set()
        for item, path in ((one, path) for one in items for path in self.outputs_of(one)):
            if path in paths:
                raise UsageError(
                    f"{item.input_path}: {path} would be the name of two images; give --name more fields"
                )
            paths.add(path)
        options = replace(self.options, background=behind)
        return replace(self, options=options, shots=shots)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of every output, which holds the light of its own setup alone."""
        shared = recipe_of(self, digest_of)
        shared |= recipe_of_shots(self.shots.all, digest_of)
        lit = [recipe_of(setup, digest_of) | shared for setup in self.setups]
        return [recipe | {"format": name} for recipe in lit for name in self.options.output.formats]


def plan_relight(options: RelightOptions, sources: LightSources, output: Path) -> RelightPlan:
    """Give each photo its images: lights, and what depends on other options; raises UsageError."""
    alone, is_field = options.composite == "face" or options.pose is not None, options.reflectance in _FIELDS
    if options.pose is not None and options.composite == "photo":
        raise UsageError("--pose: turns the head out of its photo; use --composite face with it")
    parse_pose(options.pose)
    parse_lights(options.rig)
    if options.network_alone and not is_field:
        raise UsageError("--network-alone: is for --reflectance portrait or field; leave it out")
    if options.white != "photo" and not is_field:
        raise UsageError("--white: is for --reflectance portrait or field; leave it out")
    photo = replace(options.photo, ocio_config=options.output.config)
    photo.check()
    if options.background.kind != "photo" and alone:
        raise UsageError("--background: is for the whole photo; leave out --pose and --composite face")
    behind = options.background.kind
    if options.light_wrap and behind in ("photo", "none"):
        raise UsageError("--light-wrap: is of another background; add --background FILE, COLOUR or envmap")
    if options.identity and alone:
        raise UsageError("--identity: is for the whole photo; leave out --pose and --composite face")
    check_companion(options.matte, "--matte")
    check_companion(options.normals_from, "--normals-from")
    if options.normals_from is not None and (alone or options.reflectance != "portrait"):
        raise UsageError(
            "--normals-from: is for the portrait field; leave out --reflectance, --pose and --composite face"
        )
    of_light: Kind = "field" if options.reflectance == "portrait" else options.reflectance
    how = LightOptions(photo=for_other_photos(photo), reflectance=of_light)
    background = options.background
    if background.path is not None and not background.path.is_file():
        from_behind = any(entry.rpartition("=")[2] == BACKGROUND for entry in sources.light_from or ())
        if from_behind or is_pattern(str(background.path)):
            background = background.listed(output)
    photos = photo_lights(sources, how, (*background.frames, background.path)[0], output)
    setups = collect_setups(sources, output, photo.settings.seed, photos)
    layers = {*_OF_EVERY_IMAGE, *options.aov, *(["wrap"] if options.light_wrap else [])}
    for name in (name for setup in setups for name in setup.names):
        if name in layers:
            raise UsageError(f"a light has the name {name}, as a layer of the EXR; give it another")
    if alone and any(setup.has_own for setup in setups):
        raise UsageError("--light own: needs the whole photo; leave out --pose and --composite face")
    by_photo = [light for setup in setups for light in setup.by_photo]
    if by_photo and not is_field:
        word = OWN if by_photo[0].own else EVEN
        raise UsageError(f"--light {word}: is not for --reflectance {options.reflectance}; leave one out")
    if options.exposure is None:  # 0 under lights as bright as the photo, or as the picture behind it
        behind_it = {light.envmap for light in photos if light.is_background}
        setups = tuple(
            replace(one, exposure_ev=0.0)
            if one.by_photo or not behind_it.isdisjoint(light.envmap for light in one.lights)
            else one
            for one in setups
        )
    if sources.room not in (None, "none") and all(not setup.has_single for setup in setups):
        raise UsageError(f"--room {sources.room}: is added to lights; add --light, or leave it out")
    sweeps = sources.rotate is not None and is_sweep(sources.rotate)
    dark = options.background.is_dark
    filled = replace(
        options,
        photo=photo,
        background=background,
        composite="face" if alone else "photo",
        exposure="auto" if options.exposure is None else options.exposure,
        reflectance="field" if alone and options.reflectance == "portrait" else options.reflectance,
    )
    return RelightPlan(
        filled,
        tuple(in_room(one, sources.room, alone or dark(one)) for one in setups),
        sources.sampling or ("smooth" if sweeps else "cell"),
        photos,
        keeps_photo=options.composite == "photo",
        has_room=sources.room is not None,
    )
