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
    Item,
    NamePattern,
    only_item,
    split_frame,
)
from facerf_cli.batch.made_from import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import BatchOptions
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.light.entries import EVEN, OWN, is_sweep, numbers, parse_lights
from facerf_cli.option import BATCH, IMAGE, LIGHT, METHOD, option
from facerf_cli.relighting import White
from facerf_cli.work.light_setups import (
    LightSetup,
    LightSources,
    PhotoLight,
    Sampling,
    collect_setups,
    in_room,
)
from facerf_cli.work.output_options import (
    SUFFIXES,
    Exposure,
    Format,
    OutputOptions,
    parse_exposure,
)
from facerf_cli.work.photo_options import (
    LightOptions,
    PhotoOptions,
    check_companion,
    for_other_photos,
    network_alone_option,
    networks_of,
    parse_pose,
    white_option,
)
from facerf_cli.work.shots import (
    FilmOutput,
    Shots,
    film_rate,
    recipe_of_shots,
)

Composite = Literal["photo", "face"]
ExposureGroup = Literal["photo", "folder", "sequence"]
BackgroundKind = Literal["photo", "envmap", "none", "file", "colour"]
_LAYERS = ("matte", "albedo", "normal", "position", "depth", "shadow", "specular", "classes", "face", "uv")
_LUMINANCE, _DARK = (0.2126, 0.7152, 0.0722), 0.1  # of linear Rec.709; of a dark colour, at most
_FORMS = "photo, envmap, none, an image file, black or another name, #RRGGBB or R,G,B"


@dataclass(frozen=True)
class BackgroundChoice:
    """A choice of background; `colour` is scene-linear Rec.709."""

    kind: BackgroundKind
    path: Path | None = None
    colour: tuple[float, float, float] | None = None

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
    if Path(text).is_file():
        return BackgroundChoice("file", Path(text))
    if (colour := _named(text)) is not None:
        return BackgroundChoice("colour", colour=colour)
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
class Relight:
    """The options that images share.

    Attributes:
        rig: Approximate maps by a rig of N lights, or by a file of directions.
        pose: Turn the head to a pose, in degrees; shows the face alone.
        reflectance: Relight the whole portrait, or the face by the paper's field; or by a baseline:
            diffuse-sh, specular-sh, prt.
        exposure: Expose PNG and JPEG by EV, or the face as in the photo (auto) or well lit (face).
        exposure_group: Share an exposure: of each photo, or the first one's by folder or sequence of frames.
        composite: Show the photo with its face relit, or the rendered face alone, with alpha.
        background: Show behind the person the photo, an image or a colour (#RRGGBB or linear R,G,B), which
            keep their look; the envmap; or none (alpha).
        background_blur: Blur the map behind the person as a lens does, in percent of the longer side.
        aov: Add layers to the EXR besides its matte: albedo, normal, position, depth, shadow, specular,
            classes, face, uv.
        matte: Change only what a grey image shows (mattes/{stem}.png: of each its own); --person replaces the
            matte.
        photo_of_stack: Put an OLAT stack back on its photo, at the photo's resolution.
        identity: Report `identity_distance`: how far an image is from its photo by dlib's descriptor of faces
            (an extra).
        ball: Write a mirror ball and a diffuse ball under each map, too.
        fps: Show so many frames a second in -o FILE.mp4 (24000/1001, too).
        name: Name the images by a pattern of {dir}, {parent}, {stem}, {ext}, {light} and {frame:04}.
    """

    photo: PhotoOptions
    setups: tuple[LightSetup, ...] = field(default=(), metadata=NOT_IN_RECIPE)  # each in that of its images
    rig: str = option("150", metavar="N|FILE", flags=("--lights",), panel=LIGHT)
    sampling: Sampling = "cell"
    pose: str | None = option(None, metavar="YAW,PITCH,ROLL", shown_default="the photo's", panel=IMAGE)
    reflectance: RelightKind = option("portrait", metavar="KIND", panel=METHOD)
    exposure: Exposure | None = option(
        None,
        metavar="auto|face|EV",
        shown_default="auto; 0 with own",
        parse=parse_exposure,
        panel=IMAGE,
    )
    exposure_group: ExposureGroup = option("photo", metavar="KIND", panel=IMAGE)
    output: OutputOptions = field(default_factory=OutputOptions)
    composite: Composite | None = option(None, shown_default="photo; face with --pose", panel=IMAGE)
    background: BackgroundChoice = option(
        BackgroundChoice("photo"),
        metavar="KIND|FILE|COLOUR",
        default_text="photo",
        parse=parse_background,
        panel=IMAGE,
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
    aov: tuple[str, ...] = option(
        (), metavar="NAME,...", shown_default="none", default_text="", parse=parse_aov, panel=IMAGE
    )
    matte: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=IMAGE)
    photo_of_stack: Path | None = option(
        None, metavar=COMPANION, flags=("--photo",), shown_default=False, panel=IMAGE
    )
    ball: bool = option(False, in_recipe=False, panel=IMAGE)
    identity: bool = option(False, in_recipe=False, panel=METHOD)
    network_alone: bool = network_alone_option()
    white: White = white_option()
    fps: Fraction | None = option(
        None, metavar="RATE", in_recipe=False, shown_default="24", parse=film_rate, panel=IMAGE
    )
    name: NamePattern | None = option(
        None,
        metavar="PATTERN",
        in_recipe=False,
        shown_default="{dir}/{stem}_{light}",
        parse=partial(NamePattern.parse, option="--name"),
        panel=BATCH,
    )
    asked_for_photo: bool = field(default=False, metadata=NOT_IN_RECIPE)  # by --composite photo
    asked_for_room: bool = field(default=False, metadata=NOT_IN_RECIPE)  # by --room; a stack has none else
    leaders: tuple[Item, ...] = field(default=(), metadata=NOT_IN_RECIPE)  # the first photo of each group
    shots: Shots = field(default_factory=Shots, metadata=NOT_IN_RECIPE)
    exposures_of_leaders: dict[Path, dict[str, float]] = field(
        default_factory=dict, metadata=NOT_IN_RECIPE, compare=False
    )  # by place and setup, as far as this process knows them

    def checked(self, sources: LightSources, batch: BatchOptions, film: FilmOutput | None) -> Self:
        """These options with the setups, and with what depends on other options; raises UsageError."""
        alone = self.composite == "face" or self.pose is not None
        if self.pose is not None and self.composite == "photo":
            raise UsageError("--pose: turns the head out of its photo; use --composite face with it")
        parse_pose(self.pose)
        parse_lights(self.rig)
        if self.network_alone and self.reflectance not in ("field", "portrait"):
            raise UsageError("--network-alone: is for the fields; leave it out, or use --reflectance field")
        if self.white != "photo" and self.reflectance not in ("field", "portrait"):
            raise UsageError("--white: is for the fields; leave it out, or use --reflectance field")
        photo = replace(self.photo, ocio_config=self.output.config)
        photo.check()
        if self.background.kind != "photo" and alone:
            raise UsageError("--background: is for the whole photo; leave out --pose and --composite face")
        if film and not film.holds_alpha and (self.background.kind == "none" or alone):
            raise UsageError(f"-o {film.path}: has no alpha; give FILE.mov, a folder, or --background COLOUR")
        if self.identity and alone:
            raise UsageError("--identity: is for the whole photo; leave out --pose and --composite face")
        check_companion(self.matte, "--matte")
        check_companion(self.photo_of_stack, "--photo")
        of_light: Kind = "field" if self.reflectance == "portrait" else self.reflectance
        how = LightOptions(photo=for_other_photos(photo), reflectance=of_light)
        setups = collect_setups(sources, batch.output, photo.settings.seed, how)
        self._check_lights_by_photo(setups, alone)
        if self.exposure is None:
            setups = tuple(replace(one, exposure_ev=0.0) if one.by_photo else one for one in setups)
        if sources.room not in (None, "none") and all(not setup.has_single for setup in setups):
            raise UsageError(f"--room {sources.room}: is added to lights; add --light, or leave it out")
        sweeps = sources.rotate is not None and is_sweep(sources.rotate)
        return replace(
            self,
            photo=photo,
            setups=tuple(in_room(one, sources.room, alone or self.background.is_dark(one)) for one in setups),
            sampling=sources.sampling or ("smooth" if sweeps else "cell"),
            composite="face" if alone else "photo",
            asked_for_photo=self.composite == "photo",
            asked_for_room=sources.room is not None,
            exposure=self.exposure_rule,
            reflectance="field" if alone and self.reflectance == "portrait" else self.reflectance,
        )

    def _check_lights_by_photo(self, setups: Sequence[LightSetup], alone: bool) -> None:
        """Raise UsageError for what the photo's own light, or even light as bright, cannot shine on."""
        if alone and any(setup.has_own for setup in setups):
            raise UsageError("--light own: is of the whole photo; leave out --pose and --composite face")
        for light in (one for setup in setups for one in setup.by_photo):
            if self.reflectance not in ("field", "portrait"):
                word = OWN if light.own else EVEN
                raise UsageError(
                    f"--light {word}: is not for --reflectance {self.reflectance}; leave one out"
                )

    @property
    def exposure_rule(self) -> Exposure:
        """EV, or the rule that chooses it."""
        return "auto" if self.exposure is None else self.exposure

    @property
    def maps(self) -> list[LightSetup]:
        """The setups that are maps."""
        return [setup for setup in self.setups if setup.envmap is not None]

    def outputs_of(self, item: Item) -> list[Path]:
        """A file of each format for each setup."""
        return [path for setup in self.setups for path in self._images(item, setup)]

    def _images(self, item: Item, setup: LightSetup) -> list[Path]:
        tag = "" if self.composite == "photo" else self.photo.first_tag
        return [setup.output(item, tag, suffix, self.name) for suffix in self.output.suffixes]

    def for_stale(self, item: Item) -> Self:
        """These settings with the lights of the item's stale images; a light has all of its frames."""
        stale = {setup.name for setup in self.setups if not item.stale.isdisjoint(self._images(item, setup))}
        setups = tuple(setup for setup in self.setups if setup.name in stale)
        return replace(self, setups=setups) if item.stale else self

    def with_leaders(self, items: Sequence[Item]) -> Self:
        """These settings with the first photo of each group of --exposure-group."""
        groups = {self._group(item): item for item in reversed(items)}
        return replace(self, leaders=tuple(groups.values())) if self.exposure_group != "photo" else self

    def leader_of(self, item: Item) -> Item | None:
        """The photo whose exposure an item shares; None without groups."""
        group = self._group(item)
        return next((leader for leader in self.leaders if self._group(leader) == group), None)

    def _group(self, item: Item) -> Path:
        if self.exposure_group == "folder":
            return item.output_base.parent
        return item.output_base.with_name(split_frame(item.output_base.name)[0])

    def into_file(self, file: Path, format_of_it: Format, formats: tuple[Format, ...]) -> Self:
        """These settings for one image, the file that `-o` names; raises UsageError for other formats."""
        if [SUFFIXES[name] for name in formats] != [SUFFIXES[format_of_it]]:
            raise UsageError(f"-o {file}: is not what --format says; leave that out, or give a folder")
        output = replace(self.output, file_suffix=file.suffix)
        return replace(self, output=output, name=NamePattern.literal(file.stem))

    def refuse_meeting(self, items: Sequence[Item]) -> None:
        """Raise UsageError where two images would have one path: that which -o names, or a --name makes."""
        for path in self.outputs_of(items[0]) if self.output.file_suffix else ():
            all_faces = self.photo.face == "all" and self.composite == "face"
            only_item(items, path, several=all_faces or len(self.setups) > 1)
        paths: set[Path] = set()
        for item, path in ((one, path) for one in items for path in self.outputs_of(one)):
            if path in paths:
                raise UsageError(
                    f"{item.input_path}: {path} would be the name of two images; give --name more fields"
                )
            paths.add(path)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of every output, which holds the light of its own setup alone."""
        shared = recipe_of(self, digest_of)
        if self.leaders:
            shared["leaders"] = [digest_of(leader.input_path) for leader in self.leaders]
        shared |= recipe_of_shots(self.shots.all, digest_of)
        lit = [recipe_of(setup, digest_of) | shared for setup in self.setups]
        return [recipe | {"format": name} for recipe in lit for name in self.output.formats]

    def readable(self, dry_run: bool) -> Self:
        """Load the models, and keep the setups whose maps can be read.

        A dry run loads no networks, and so estimates no light of a photo.
        """
        from facerf_cli.work.lights import readable
        from facerf_cli.work.outputs import check_output
        from facerf_cli.work.photos import prepare_photos
        from facerf_cli.work.sequence import follow_all

        check_output(self.output)
        maps = [setup.envmap.envmap for setup in self.setups if setup.envmap]
        lights = [envmap.options for envmap in maps if isinstance(envmap, PhotoLight)]
        uses = networks_of([self.reflectance]).union(*(light.networks for light in lights))
        prepare_photos(self.photo, uses, with_networks=not dry_run)
        if not dry_run:
            follow_all(self.shots.all, self.photo)
        elif lights:
            return self
        setups = readable(self.setups)
        if not setups:
            raise FacerfError("none of the maps serves; give others, or procedural:8 to draw some")
        return replace(self, setups=setups)
