"""The verbs that write a few files for each input: options, outputs, recipes. Light to import.

A class has the options of its verb as fields, is sent to the processes that take the items, and is part of
what the outputs' recipes hold; `run` is the verb.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.made_from import DigestOf, Recipe, one_recipe, recipe_of
from facerf_cli.batch.run import BatchOptions, Outcome, run_items, sums_up
from facerf_cli.batch.settings import NOT_IN_RECIPE, Settings
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import parse_lights
from facerf_cli.option import IMAGE, LIGHT, METHOD, Only, Without, option
from facerf_cli.work.photo_options import (
    FITTING,
    LightOptions,
    PhotoOptions,
    network_alone_option,
    networks_of,
    parse_pose,
)
from facerf_cli.work.shots import (
    FRAMES_IN_A_ROW,
    Shot,
    ShotOptions,
    collect_frames,
    recipe_of_shots,
    whole_shots,
)

Precision = Literal["float32", "bf16"]
Frame = Literal["photo", "face", "uv"]
StackFormat = Literal["exr", "relight"]
Form = Literal["latlong", "json", "sh", "dpr", "sfsnet", "blender", "mitsuba"]
Axes = Literal["facerf", "blender", "mitsuba"]
_LIGHT_FILES = ("_light.exr", "_light.json", "_light.png")
_SEGMENT_FILES = ("_segment.exr", "_person.png", "_overlay.jpg", "_landmarks.json")
_FIT_FILES = (
    "_texture.exr",
    "_texture.png",
    "_normals.exr",
    "_normals.png",
    "_mesh.glb",
    "_mesh.mtl",
    "_mesh.obj",
    "_overlay.jpg",
    "_fit.npz",
)
_PAGE, _INDEX = ".html", "index.html"
_ENDINGS: dict[Form, str] = {
    "latlong": "_latlong.exr",
    "json": "_light.json",
    "sh": "_sh.json",
    "dpr": "_dpr.txt",
    "sfsnet": "_sfsnet.txt",
    "blender": "_blender.exr",
    "mitsuba": "_mitsuba.exr",
}
_MAPS: tuple[Form, ...] = ("latlong", "blender", "mitsuba")
MADE_FOR: dict[str, tuple[Form, ...]] = {  # the forms that an option of `ConvertLight` is for
    "width_px": _MAPS,
    "order": ("json", "sh"),
    "lights": ("json",),
    "signed": ("json", *_MAPS),
}
_LIGHT_SUFFIXES = frozenset({".exr", ".hdr", ".json", ".txt"})
_MOST_ORDER = 20
_LARGEST_MAP_PX, _LARGEST_PX = 8192, 16384

T = TypeVar("T")
Process = Callable[[T, Item], Outcome]  # the work on one item, which the verb's file imports


@dataclass(frozen=True)
class Segment:
    """`facerf segment`."""

    photo: Annotated[
        PhotoOptions, Only("colourspace", "face", "landmarks", "landmarks_from", "person", "matte_from")
    ]
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    def run(self, inputs: Sequence[str], wanted: ShotOptions, batch: BatchOptions) -> int:
        """Segment the inputs; return the exit code."""
        self.photo.check()
        items, shots = collect_frames(inputs, wanted, batch, self.photo)
        work, batch = replace(self, shots=shots), replace(batch, in_a_row=FRAMES_IN_A_ROW if shots else 1)
        prepare = partial(_prepare, self.photo, ("parsing",), batch.dry_run, shots)
        settings = self.photo.settings
        return run_items("segment", items, work, work.outputs_of, batch, settings, work.recipes_of, prepare)

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _SEGMENT_FILES]

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all outputs."""
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Segment the person of every chosen face."""
        from facerf_cli.work.segment_and_fit import write_segments

        tags, facts = write_segments(item, self.photo, self.shots)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _SEGMENT_FILES], facts)


@dataclass(frozen=True)
class FitGeometry:
    """`facerf fit-geometry`."""

    photo: PhotoOptions

    def run(self, inputs: Sequence[str], batch: BatchOptions) -> int:
        """Fit the face model to the inputs; return the exit code."""
        self.photo.check()
        prepare = partial(_prepare, self.photo, FITTING, batch.dry_run)
        recipe, settings = one_recipe(self), self.photo.settings
        items = collect_items(inputs, batch.output, PHOTO_SUFFIXES, batch.name, settings.null_separated)
        return run_items("fit-geometry", items, self, self.outputs_of, batch, settings, recipe, prepare)

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _FIT_FILES]

    def __call__(self, item: Item) -> Outcome:
        """Fit every chosen face."""
        from facerf_cli.work.segment_and_fit import write_fits

        tags, facts = write_fits(item, self.photo)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _FIT_FILES], facts)


@dataclass(frozen=True)
class EstimateLight:
    """`facerf estimate-light`."""

    options: LightOptions
    width_px: int = option(
        512,
        "Write a map of this width; the height is half of it.",
        "PX",
        flags=("--width",),
        least=16,
        most=_LARGEST_MAP_PX,
        panel=LIGHT,
    )
    sh_order: int = option(
        2, "Write spherical harmonics of this order in the JSON.", least=0, most=_MOST_ORDER, panel=LIGHT
    )
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    def run(self, inputs: Sequence[str], wanted: ShotOptions, batch: BatchOptions) -> int:
        """Estimate the light of the inputs; return the exit code."""
        _refuse_odd(self.width_px)
        photo = self.options.photo
        photo.check()
        self.options.check()
        items, shots = collect_frames(inputs, wanted, batch, photo)
        how = self.options
        if shots and (how.refine != "none" or how.reflectance != "field" or how.matte is not None):
            raise UsageError(
                "a film or --sequence: its light is that of the field; leave out --refine, "
                "--reflectance and --matte"
            )
        work = replace(self, shots=shots)
        prepare = partial(work.prepare, batch.dry_run)
        items = whole_shots(items, shots)
        return run_items(
            "estimate-light",
            items,
            work,
            work.outputs_of,
            batch,
            photo.settings,
            work.recipes_of,
            prepare,
        )

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.options.photo.first_tag + ending) for ending in _LIGHT_FILES]

    def prepare(self, dry_run: bool) -> None:
        """Load the models, before the first photo; in a dry run check the options only."""
        from facerf_cli.work.light_of_photo import prepare_light
        from facerf_cli.work.sequence import follow_all

        prepare_light(self.options, with_networks=not dry_run)
        follow_all(self.shots, self.options.photo, dry_run)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all outputs."""
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Estimate the light of every chosen face, or that of a shot."""
        from facerf_cli.work.light_of_photo import write_lights, write_shot_light

        for shot in self.shots:
            if item.output_base == shot.base:
                tags, facts = write_shot_light(shot, item, self.options, self.width_px, self.sh_order)
                break
        else:
            tags, facts = write_lights(item, self.options, self.width_px, self.sh_order)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _LIGHT_FILES], facts)


@dataclass(frozen=True)
class PredictOlat:
    """`facerf predict-olat`."""

    photo: PhotoOptions
    lights: str = option(
        "150",
        "Predict a uniform rig of N lights, or directions in degrees: a text file, or a list.",
        "N|FILE|'AZ,EL;...'",
        panel=LIGHT,
    )
    pose: str | None = option(
        None,
        "Turn the head to a pose, in degrees.",
        "YAW,PITCH,ROLL",
        shown_default="the photo's",
        panel=IMAGE,
    )
    frame: Frame | None = option(
        None,
        "Predict the whole person in the photo's frame; the face alone in that of its crop; or UV textures, "
        "which other poses can be rendered from.",
        shown_default="photo; face with --pose",
        panel=IMAGE,
    )
    size_px: int = option(
        1024,
        "Scale larger photos down to this longer side, with --frame photo.",
        "PX",
        flags=("--size",),
        least=64,
        most=_LARGEST_PX,
        panel=IMAGE,
    )
    network_alone: bool = network_alone_option()
    precision: Precision = option(
        "float32",
        "Compute the network in this precision; bf16 where the device has instructions for it.",
        panel=METHOD,
    )
    format: StackFormat = option(
        "exr",
        "Write OpenEXR; or a folder for the web viewers Relight and OpenLIME, front lights only.",
        panel=IMAGE,
    )
    page: bool = option(False, "Write the web page of `facerf view`, too.", panel=IMAGE)

    def run(self, inputs: Sequence[str], batch: BatchOptions, process: "Process[PredictOlat]") -> int:
        """Predict the stacks of the inputs by `process`; return the exit code."""
        parse_lights(self.lights)
        parse_pose(self.pose)
        self.photo.check()
        if self.frame == "photo" and self.pose is not None:
            raise UsageError("--pose: turns the head out of its photo; use --frame face or uv with it")
        work = replace(self, frame=self.frame or ("photo" if self.pose is None else "face"))
        if work.format == "relight" and work.frame == "uv":
            raise UsageError("--format relight: shows images, not UV textures; use --frame photo or face")
        if work.page and (work.network_alone or work.pose is not None):
            raise UsageError(
                "--page: shows the photo's own pose and light; give neither --pose nor --network-alone"
            )
        kinds = ["portrait" if work.page or work.frame == "photo" else "field"]
        prepare = partial(_prepare, self.photo, networks_of(kinds), batch.dry_run)
        recipe, settings = one_recipe(work), self.photo.settings
        items = collect_items(inputs, batch.output, PHOTO_SUFFIXES, batch.name, settings.null_separated)
        predict = partial(process, work)
        return run_items("predict-olat", items, predict, work.outputs_of, batch, settings, recipe, prepare)

    def outputs_of(self, item: Item) -> list[Path]:
        """The stack, its contact sheet and, where they are asked for, its page."""
        return self.files_of(item, self.photo.first_tag)

    def files_of(self, item: Item, tag: str) -> list[Path]:
        """The files of the face with a tag: stack, contact sheet, page."""
        stack = f"{tag}_olat.exr" if self.format == "exr" else f"{tag}_relight/info.json"
        pages = [item.output(f"{tag}.html")] if self.page else []
        return [item.output(stack), item.output(f"{tag}_olat.png"), *pages]


@dataclass(frozen=True)
class MakePage:
    """`facerf view`."""

    photo: Annotated[PhotoOptions, Without("texture_side")]
    size_px: int = option(
        1024,
        "Show photos with so many pixels along the longer side.",
        "PX",
        flags=("--size",),
        least=256,
        most=4096,
        panel=IMAGE,
    )

    def run(self, inputs: Sequence[str], output: Path, batch: BatchOptions) -> int:
        """Write the page of one photo to the file `output`, or pages to this folder; return the exit code."""
        self.photo.check()
        settings, one = self.photo.settings, output.suffix.lower() == _PAGE
        folder = output.parent if one else output
        items = collect_items(inputs, folder, PHOTO_SUFFIXES, null_separated=settings.null_separated)
        if one:
            if len(items) > 1 or self.photo.face == "all":
                raise UsageError(f"-o {output}: is one page; give one photo and one face, or a folder")
            items = [replace(items[0], output_base=output.with_suffix(""), name=output.stem)]
        elif any(item.name == Path(_INDEX).stem for item in items):
            raise UsageError(f"{_INDEX}: is the list of all pages; rename the photo of that name")
        batch = replace(batch, output=folder)
        prepare = partial(_prepare, self.photo, networks_of(["portrait"]), batch.dry_run)
        recipe = one_recipe(self)
        code = run_items("view", items, self, self.outputs_of, batch, settings, recipe, prepare)
        if not one and not batch.dry_run and sums_up(items, self.outputs_of, batch):
            from facerf_cli.work.view_photos import write_index

            write_index(folder / _INDEX, items, self.photo)
        return code

    def outputs_of(self, item: Item) -> list[Path]:
        """The page of an item's (first) face."""
        return [item.output(self.photo.first_tag + _PAGE)]

    def __call__(self, item: Item) -> Outcome:
        """Write the page of every chosen face."""
        from facerf_cli.work.view_photos import write_pages

        return Outcome(*write_pages(item, self.photo, self.size_px))


def parse_forms(names: Sequence[str]) -> tuple[Form, ...]:
    """The forms of `--to`, each once; raises UsageError for a name of none."""
    if unknown := [name for name in names if name not in _ENDINGS]:
        raise UsageError(f"--to {unknown[0]}: no such form; give one of {', '.join(_ENDINGS)}")
    return tuple(form for form in dict.fromkeys(names) if form in _ENDINGS)


@dataclass(frozen=True)
class ConvertLight:
    """`facerf convert-light`."""

    forms: tuple[Form, ...] = option(
        ...,
        "Write this form: latlong, json, sh, dpr, sfsnet, blender or mitsuba. Repeatable.",
        "FORM",
        flags=("--to",),
        shown_default=False,
        typed=list[str],  # typer has no lists of choices
        parse=parse_forms,
    )
    from_axes: Axes = option("facerf", "Read input maps in the orientation of this program.", panel=LIGHT)
    width_px: int | None = option(
        None,
        "Write maps of this width; the height is half of it.",
        "PX",
        flags=("--width",),
        shown_default="the map's own, else 512",
        least=16,
        most=_LARGEST_MAP_PX,
        panel=LIGHT,
    )
    order: int | None = option(
        None,
        "Write spherical harmonics of this order in json and sh.",
        shown_default="the input's own, else 2",
        least=0,
        most=_MOST_ORDER,
        panel=LIGHT,
    )
    lights: str | None = option(
        None,
        "Write json over this rig: a number, 'az,el;az,el;...', or a file of such lines.",
        "N|FILE",
        shown_default="the input's own, else 150",
        panel=LIGHT,
    )
    signed: bool = option(
        False,
        "Keep the plain series of spherical harmonics, negative in places (default: the nearest "
        "non-negative light).",
        panel=LIGHT,
    )

    def run(
        self, inputs: Sequence[str], batch: BatchOptions, settings: Settings, process: "Process[ConvertLight]"
    ) -> int:
        """Convert the inputs by `process`; return the exit code."""
        if self.width_px is not None:
            _refuse_odd(self.width_px)
        if self.lights is not None:
            parse_lights(self.lights)  # a wrong one fails the call, not every item
        items = collect_items(inputs, batch.output, _LIGHT_SUFFIXES, null_separated=settings.null_separated)
        convert = partial(process, self)
        return run_items("convert-light", items, convert, self.outputs_of, batch, settings, one_recipe(self))

    def outputs_of(self, item: Item) -> list[Path]:
        """A file for each form."""
        return [item.output(_ENDINGS[form]) for form in self.forms]


@dataclass(frozen=True)
class DrawnMaps:
    """The maps of `facerf envmap`."""

    count: int = option(10, "Write so many maps.", "N", least=1, panel=LIGHT)
    kind: list[str] | None = option(
        None,
        "Draw from this kind alone (may be repeated): sun, dusk, overcast, windows, hall, studio, night, "
        "stage.",
        "KIND",
        shown_default="all, sun most often",
        panel=LIGHT,
    )
    size_px: int = option(
        512,
        "Write maps of this width; the height is half.",
        "PX",
        flags=("--size",),
        least=16,
        most=_LARGEST_MAP_PX,
        panel=LIGHT,
    )

    def check(self) -> None:
        """Raise UsageError for an odd width."""
        if self.size_px % 2:
            raise UsageError(f"--size {self.size_px}: the height is half of it; give an even number")


def _prepare(photo: PhotoOptions, uses: Collection[str], dry_run: bool, shots: Sequence[Shot] = ()) -> None:
    """Load what every photo needs, in a dry run without the networks, and follow faces through shots."""
    from facerf_cli.work.photos import prepare_photos
    from facerf_cli.work.sequence import follow_all

    prepare_photos(photo, uses, with_networks=not dry_run)
    follow_all(shots, photo, dry_run)


def _refuse_odd(width_px: int) -> None:
    """Raise UsageError for a map whose height is no whole number."""
    if width_px % 2:
        raise UsageError(f"--width {width_px}: an odd width has no half; give an even number")
