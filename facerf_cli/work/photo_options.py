"""Options of every verb that reads photos: face, landmarks, face model, texture; how light is estimated.

Light to import: the help reads them without torch and numpy.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from facerf_cli.baselines import Kind
from facerf_cli.batch.inputs import COMPANION, OF_FILES, NamePattern
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import numbers, parse_lights
from facerf_cli.option import FACE, IMAGE, LIGHT, METHOD, flag, option

MOST_ESTIMATED = 1024  # in the least squares; with more, non-negative ones take minutes
_TURNED_AWAY_DEG, _MOST_ROLL_DEG = 90.0, 180.0
_TEXTURE_STEP, _TEXTURE_MOST = 256, 2048
FITTING = frozenset({"parsing"})  # networks that find faces for a fit
# Networks of the reflectance models.
NETWORKS = {
    "field": frozenset({"reflectance"}),
    "portrait": frozenset({"reflectance", "portrait"}),
    "diffuse-sh": frozenset({"diffuse_sh"}),
}
Geometry = Literal["landmarks", "network"]
Refine = Literal["none", "features"]
PoseDeg = tuple[float, float, float]


def network_alone_option() -> Any:
    """Make the field of `--network-alone`."""
    return option(
        False,
        "Use the network's own field, without the correction by the photo's quotient.",
        flags=("--network-alone",),
        panel=METHOD,
    )


def white_option() -> Any:
    """Make the field of `--white`."""
    return option(
        "photo",
        "Keep the photo's white, or take the colour of the scene's light out (sodium, party).",
        flags=("--white",),
        panel=IMAGE,
    )


def normals_option() -> Any:
    """Make the field of `--normals-from`."""
    return option(
        None,
        "Relight by normals of another method (.npy, .exr, .png).",
        metavar=COMPANION,
        shown_default=False,
        panel=METHOD,
    )


@dataclass(frozen=True)
class FieldOptions:
    """The making of the field of a photo."""

    network_alone: bool = network_alone_option()


@dataclass(frozen=True)
class PhotoOptions:
    """Settings of reading and fitting photos, which can be sent to other processes.

    Attributes:
        colourspace: Read the input in this colour space: sRGB, linear, ACEScg, Rec.2020, 'Display P3', or
            any name of the OCIO configuration.
        layer: Read this layer of an EXR, such as beauty, in place of its image.
        face_model: Fit this morphable model: builtin, or a .npz of `face-model import`.
        face: Choose the face of a photo with several; INDEX counts from the left, from 0.
        landmarks: Read 68 landmarks (.pts or .json) from a file; for each photo from a folder, or by a
            pattern (points/{stem}.pts).
        geometry: Fit the face model to landmarks, or regress it by the Geometry Network, without landmarks.
        texture_side: Side of the UV texture; a multiple of 256.
        form: Class of a Reflectance Network of your own.
        person: Replace the matte that facerf finds by a grey image, or its alpha; --matte only multiplies
            it.
    """

    settings: Settings
    colourspace: str | None = option(
        None, metavar="NAME", flags=("--input-colourspace",), shown_default="the file's", panel=IMAGE
    )
    layer: str | None = option(None, metavar="NAME", shown_default="the image", panel=IMAGE)
    face_model: str = option("builtin", metavar="NAME|PATH", panel=FACE)
    face: str = option("largest", metavar="largest|all|INDEX", panel=FACE, everyday=True)
    landmarks: Path | None = option(None, metavar=COMPANION, shown_default="detect them", panel=FACE)
    geometry: Geometry | None = option(None, shown_default="as the checkpoint was trained", panel=FACE)
    texture_side: int | None = option(
        None,
        metavar="T",
        flags=("--texture-size",),
        shown_default="the checkpoint's; 256 for the shipped one",
        panel=METHOD,
    )
    form: str | None = option(None, metavar="MODULE:CLASS", shown_default=False, panel=METHOD)
    person: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=FACE)
    ocio_config: str = ""  # that knows the colour space; '' is $OCIO, or the built-in one

    def check(self) -> None:
        """Raise UsageError for an option that would fail every photo; nothing heavy is loaded."""
        if self.face not in ("largest", "all") and not self.face.isdecimal():
            raise UsageError(f"--face {self.face!r}: not a face; give largest, all or a number from 0")
        side = self.texture_side
        if side is not None and (side % _TEXTURE_STEP or not 0 < side <= _TEXTURE_MOST):
            raise UsageError(
                f"--texture-size {self.texture_side}: give a multiple of 256 up to {_TEXTURE_MOST}"
            )
        if self.landmarks is not None and self.geometry == "network":
            raise UsageError("--landmarks: --geometry network uses none; leave one out")
        check_companion(self.landmarks, "--landmarks")
        if self.face == "all" and self.person is not None:
            raise UsageError("--face all: --person shows one person; pass --face INDEX")
        check_companion(self.person, "--person")

    @property
    def first_tag(self) -> str:
        """The tag of a photo's first face in the names of its outputs; faces are written last to first.

        The number of faces that `--face all` finds is not known beforehand. So the first one's outputs are
        written last and mark the photo as finished.
        """
        return "_face0" if self.face == "all" else ""


def photo_words(options: PhotoOptions, number: int = 0) -> list[str]:
    """Options that are not defaults, as they are typed; of all faces that of a `number` alone."""
    words, settings = [], options.settings
    for one in fields(options):
        value, about = getattr(options, one.name), one.metadata.get("option")
        if about and value != one.default:
            text = number if value == "all" else value
            words += [about.flags[0] if about.flags else flag(one.name), str(text)]
    checkpoints = () if settings.checkpoints_by_default else settings.checkpoints
    return words + [word for path in checkpoints for word in ("--checkpoint", str(path))]


def fov_option() -> Any:
    """`--fov`, the angle of view of pictures without a face."""
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
class SolveOptions:
    """The solution for the light.

    Attributes:
        non_negative: Solve for weights from 0 up, robust to hair and glasses; or for the paper's least
            squares, with negative ones.
        refine: Refine the least squares by comparing features of the texture.
    """

    non_negative: bool = option(True, flags=("--non-negative/--signed",), panel=METHOD)
    refine: Refine = option("none", panel=METHOD)


@dataclass(frozen=True, kw_only=True)
class LightOptions(SolveOptions):
    """Settings of estimating the light of a photo, which can be sent to other processes.

    Attributes:
        reflectance: Choose the reflectance model; each baseline estimates its own light.
        rig: Solve for the light of a rig of N lights, or of a file of directions (az,el or x y z; .lp).
        vgg_weights: Use the paper's V_f in --refine features: download it once (528 MiB), or read a file.
        keep_eyes: Use the eyes, too (the paper leaves them out).
        fov_deg: The angle of view of a picture without face.
        matte: Use only what a grey image, or its alpha, shows, such as skin alone; --person replaces the
            matte.
    """

    photo: PhotoOptions
    reflectance: Kind = option("field", panel=METHOD)
    rig: str = option("150", metavar="N|FILE", flags=("--lights",), panel=LIGHT)
    vgg_weights: str | None = option(
        None,
        metavar="imagenet|PATH",
        shown_default="S_f, the shipped network trained to find the light",
        panel=METHOD,
    )
    keep_eyes: bool = option(False, panel=FACE)
    fov_deg: float | None = fov_option()
    matte: Path | None = option(None, metavar=COMPANION, shown_default="the photo's alpha", panel=FACE)

    @property
    def networks(self) -> frozenset[str]:
        """Names of the networks that these options use."""
        features = self.refine == "features" and self.vgg_weights is None
        return networks_of([self.reflectance]) | (frozenset({"light_features"}) if features else frozenset())

    def check(self) -> None:
        """Raise UsageError for options that do not go together or would fail every photo."""
        if self.reflectance != "field" and (
            self.refine != "none" or self.rig != "150" or not self.non_negative
        ):
            raise UsageError(
                f"--reflectance {self.reflectance}: estimates its own light; "
                "leave out --lights, --signed and --refine"
            )
        if self.vgg_weights is not None and self.refine == "none":
            raise UsageError("--vgg-weights: used by --refine features only; give both")
        lights = parse_lights(self.rig)
        if (lights if isinstance(lights, int) else len(lights)) > MOST_ESTIMATED:
            raise UsageError(
                f"--lights {self.rig}: too many lights to estimate; give {MOST_ESTIMATED} at most"
            )
        check_companion(self.matte, "--matte")


def for_other_photos(photo: PhotoOptions) -> PhotoOptions:
    """Options for photos of which only the light is used: those of the inputs that describe one file go."""
    folder = photo.landmarks if photo.landmarks is not None and not photo.landmarks.is_file() else None
    alone = replace(photo, colourspace=None, layer=None, person=None)
    return replace(alone, face="largest", landmarks=folder)


def networks_of(kinds: Iterable[str]) -> frozenset[str]:
    """Names of the networks that reading photos by some reflectance models uses."""
    return FITTING.union(*(NETWORKS.get(kind, ()) for kind in kinds))


def check_companion(given: Path | None, option: str) -> None:
    """Raise UsageError for a file or folder that does not exist; a pattern is filled in for each photo."""
    if given is not None and not given.exists():
        if "{" not in str(given):
            raise UsageError(f"{option} {given}: no such file or folder; give one that exists")
        NamePattern.parse(given.as_posix().lstrip("/"), option, OF_FILES)


def parse_pose(text: str | None) -> PoseDeg | None:
    """Parse `YAW,PITCH,ROLL` in degrees; None stays None (the photo's own pose)."""
    if text is None:
        return None
    yaw_deg, pitch_deg, roll_deg = numbers(text, ("YAW,PITCH,ROLL",), "--pose")
    if max(abs(yaw_deg), abs(pitch_deg)) > _TURNED_AWAY_DEG or abs(roll_deg) > _MOST_ROLL_DEG:
        raise UsageError(
            f"--pose {text!r}: turns the face away; give yaw and pitch of -90 to 90, roll of -180 to 180"
        )
    return yaw_deg, pitch_deg, roll_deg
