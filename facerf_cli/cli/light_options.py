"""Options of estimating the light of a photo, shared by `estimate-light` and `relight --light-from`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.baselines import Kind
from facerf_cli.cli.options import METHOD
from facerf_cli.cli.photo_options import PhotoOptions, check_companion, networks_of
from facerf_cli.cli.values import parse_lights
from facerf_cli.errors import UsageError

Refine = Literal["none", "features"]
NonNegativeOption = Annotated[
    bool,
    typer.Option(
        "--non-negative/--signed",
        help="Solve for weights from 0 up, robust to hair and glasses; or for the paper's least squares, "
        "with negative ones.",
        rich_help_panel=METHOD,
    ),
]
RefineOption = Annotated[
    Refine,
    typer.Option(
        help="Refine the least squares by comparing features of the texture.", rich_help_panel=METHOD
    ),
]
MOST_ESTIMATED = 1024  # in the least squares; with more, non-negative ones take minutes


@dataclass(frozen=True)
class LightOptions:
    """Settings of estimating the light of a photo, which can be sent to other processes."""

    photo: PhotoOptions
    reflectance: Kind = "field"
    rig: str = "150"
    non_negative: bool = True
    refine: Refine = "none"
    vgg_weights: str | None = None
    keep_eyes: bool = False
    matte: Path | None = None

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
    return replace(photo, colourspace=None, face="largest", landmarks=folder)
