"""Options of the commands that read photos: face, landmarks, face model, texture; how light is estimated.

Light to import: the help reads them without torch and numpy.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from facerf_cli.baselines import Kind
from facerf_cli.batch.inputs import COMPANION, OF_FILES, NamePattern
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import UsageError
from facerf_cli.light.entries import numbers, parse_lights
from facerf_cli.light.setups import fov_option
from facerf_cli.option import FACE, IMAGE, LIGHT, METHOD, flag, option
from facerf_cli.relighting import BalanceMode

MOST_ESTIMATED = 1024  # lights; above it the non-negative least squares take minutes
LARGEST_MAP_PX, _MOST_ORDER = 8192, 20
_TEXTURE_STEP, _TEXTURE_MOST = 256, 2048
FITTING = frozenset({"parsing"})  # networks that find faces for a fit
NETWORKS = {  # of reflectance models
    "field": frozenset({"reflectance"}),
    "portrait": frozenset({"reflectance", "portrait"}),
    "diffuse-sh": frozenset({"diffuse_sh"}),
}
Geometry = Literal["landmarks", "network"]
Refine = Literal["none", "features"]
PoseDeg = tuple[float, float, float]


@dataclass(frozen=True)
class FieldOptions:
    """How a photo's face field is made.

    Attributes:
        network_alone: Use the network's field without the correction by the photo's ratio image.
    """

    network_alone: bool = option(False, panel=METHOD)


@dataclass(frozen=True, kw_only=True)
class PortraitOptions:
    """How the portrait field of a photo's person is made.

    Attributes:
        white_balance: White balance: keep (as in the photo), or neutral (removes the colour of coloured
            light, such as sodium lamps).
        normals_from: Normals from another method (.npy, .exr, .png).
    """

    white_balance: BalanceMode = option("keep", panel=IMAGE)
    normals_from: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=METHOD)


@dataclass(frozen=True)
class PhotoOptions:
    """Settings of reading and fitting photos; picklable.

    Attributes:
        colourspace: Colour space of the input: sRGB, linear, ACEScg, Rec.2020, 'Display P3', or a name of the
            OCIO configuration.
        layer: Layer of an EXR to read, such as beauty.
        face_model: Morphable face model to fit: builtin, or a .npz written by face-model import.
        face: Face to use if a photo has several: largest, all, or an index from the left, starting at 0.
        landmarks: 68 landmarks (.pts or .json): a file, a folder with one per photo, or a pattern
            (points/{stem}.pts).
        geometry: How the face is fitted: to landmarks, or by the Geometry Network, without landmarks.
        texture_side: Side of the UV texture, a multiple of 256.
        form: Class of a custom Reflectance Network. Repeatable.
        person: Matte of the person, a greyscale image or an image's alpha, instead of the detected one.
    """

    settings: Settings
    colourspace: str | None = option(
        None, metavar="NAME", flags=("--input-colourspace",), shown_default="the file's", panel=IMAGE
    )
    layer: str | None = option(None, metavar="NAME", shown_default="the image", panel=IMAGE)
    face_model: str = option("builtin", metavar="NAME|PATH", panel=FACE)
    face: str = option("largest", metavar="largest|all|INDEX", panel=FACE, everyday=True)
    landmarks: Path | None = option(None, metavar=COMPANION, shown_default="detected", panel=FACE)
    geometry: Geometry | None = option(None, shown_default="as the checkpoint was trained", panel=FACE)
    texture_side: int | None = option(
        None,
        metavar="T",
        flags=("--texture-size",),
        shown_default="the checkpoint's; 256 for the shipped one",
        panel=METHOD,
    )
    form: tuple[str, ...] = option(
        (), metavar="MODULE:CLASS", shown_default=False, typed=list[str] | None, parse=tuple, panel=METHOD
    )
    person: Path | None = option(None, metavar=COMPANION, shown_default=False, panel=FACE)
    ocio_config: str = ""  # defines the colour space; '' is $OCIO, or the built-in one

    def check(self) -> None:
        """Raise UsageError for options that would fail every photo."""
        side, face = self.texture_side, self.face
        refuse(
            {
                f"--face {face!r}: not a face; use largest, all, or an index starting at 0": (
                    face not in ("largest", "all") and not face.isdecimal()
                ),
                f"--texture-size {side}: use a multiple of 256 up to {_TEXTURE_MOST}": (
                    side is not None and (side % _TEXTURE_STEP > 0 or not 0 < side <= _TEXTURE_MOST)
                ),
                "--landmarks: not used by --geometry network; remove one of them": (
                    self.landmarks is not None and self.geometry == "network"
                ),
                "--face all: a --person matte shows one person; use --face INDEX": (
                    face == "all" and self.person is not None
                ),
            }
        )
        check_companion(self.landmarks, "--landmarks")
        check_companion(self.person, "--person")

    @property
    def first_tag(self) -> str:
        """Tag of a photo's first face in output names.

        The number of faces that `--face all` finds is unknown beforehand. Faces are therefore written last to
        first, and the first one's outputs mark the photo as finished.
        """
        return "_face0" if self.face == "all" else ""


def photo_words(options: PhotoOptions, number: int = 0) -> list[str]:
    """Return options that differ from defaults, as typed; `--face all` becomes `--face` and a `number`."""
    words, settings = [], options.settings
    for part in fields(options):
        value, about = getattr(options, part.name), part.metadata.get("option")
        if about and value != part.default:
            text = number if value == "all" else value
            words += [about.flags[0] if about.flags else flag(part.name), str(text)]
    checkpoints = () if settings.checkpoints_by_default else settings.checkpoints
    return words + [word for path in checkpoints for word in ("--checkpoint", str(path))]


@dataclass(frozen=True)
class SolveOptions:
    """How the light is solved for.

    Attributes:
        non_negative: Solve for non-negative weights, robust to hair and glasses; or for the paper's signed
            least squares.
        refine: Refinement of the light: features compares features of the texture.
    """

    non_negative: bool = option(True, flags=("--non-negative/--signed",), panel=METHOD)
    refine: Refine = option("none", panel=METHOD)


@dataclass(frozen=True, kw_only=True)
class LightOptions(SolveOptions):
    """Settings of estimating the light of a photo; picklable.

    Attributes:
        reflectance: Reflectance model; each baseline estimates its own light.
        rig: Lights to solve for: the number of a uniform rig, or a file of directions (az,el or x y z; .lp).
        vgg_weights: The paper's V_f for --refine features: imagenet downloads it once (528 MiB); or a file.
        keep_eyes: Also use the eyes, which the paper leaves out.
        fov_deg: Horizontal field of view of an image without a face.
        width_px: Width of the map; its height is half of it.
        sh_order: Order of the spherical harmonics in the JSON.
        matte: Grey image, or its alpha, of the part to use, such as skin; --person replaces the detected
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
    width_px: int = option(512, metavar="PX", least=16, most=LARGEST_MAP_PX, panel=LIGHT)
    sh_order: int = option(2, least=0, most=_MOST_ORDER, panel=LIGHT)
    matte: Path | None = option(None, metavar=COMPANION, shown_default="the photo's alpha", panel=FACE)

    @property
    def networks(self) -> frozenset[str]:
        """Names of the networks that these options use."""
        features = self.refine == "features" and self.vgg_weights is None
        return networks_of([self.reflectance]) | (frozenset({"light_features"}) if features else frozenset())

    def check(self) -> None:
        """Raise UsageError for options that exclude each other or would fail every photo."""
        lights = parse_lights(self.rig)
        refuse(
            {
                f"--reflectance {self.reflectance}: estimates its own light; remove --lights, --signed and "
                "--refine": self.reflectance != "field"
                and (self.refine != "none" or self.rig != "150" or not self.non_negative),
                f"--lights {self.rig}: too many lights to estimate; use {MOST_ESTIMATED} at most": (
                    (lights if isinstance(lights, int) else len(lights)) > MOST_ESTIMATED
                ),
            }
        )
        refuse_odd("--width", self.width_px)
        check_companion(self.matte, "--matte")


def refuse(rules: Mapping[str, bool]) -> None:
    """Raise UsageError for the first broken rule between options; the keys are messages."""
    for message, is_broken in rules.items():
        if is_broken:
            raise UsageError(message)


def refuse_odd(name: str, width_px: int) -> None:
    """Raise UsageError for a map width whose half is not an integer."""
    refuse({f"{name} {width_px}: odd, but the height is half of it; use an even number": width_px % 2 > 0})


def for_other_photos(photo: PhotoOptions) -> PhotoOptions:
    """Return the options for photos of which only the light is used, without those of a particular file."""
    folder = photo.landmarks if photo.landmarks is not None and not photo.landmarks.is_file() else None
    return replace(photo, colourspace=None, layer=None, person=None, face="largest", landmarks=folder)


def networks_of(kinds: Iterable[str]) -> frozenset[str]:
    """Return names of the networks that some reflectance models use, with those that find faces."""
    return FITTING.union(*(NETWORKS.get(kind, ()) for kind in kinds))


def check_companion(path: Path | None, option: str) -> None:
    """Raise UsageError for a missing file or folder, and for a pattern with unknown fields."""
    if path is not None and not path.exists():
        if "{" not in str(path):
            raise UsageError(f"{option} {path}: no such file or folder; pass one that exists")
        NamePattern.parse(path.as_posix().lstrip("/"), option, OF_FILES)


def parse_pose(text: str | None) -> PoseDeg | None:
    """Parse `YAW,PITCH,ROLL` in degrees; None, the photo's own pose, stays None."""
    if text is None:
        return None
    yaw_deg, pitch_deg, roll_deg = numbers(text, ("YAW,PITCH,ROLL",), "--pose")
    if max(abs(yaw_deg), abs(pitch_deg)) > 90 or abs(roll_deg) > 180:
        raise UsageError(f"--pose {text!r}: out of range; use yaw, pitch of -90 to 90, roll of -180 to 180")
    return yaw_deg, pitch_deg, roll_deg
