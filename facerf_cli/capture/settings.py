"""Options to read and check a capture; light to import."""

from dataclasses import dataclass
from typing import Literal

from facerf_cli.option import option

CAPTURE, CORRECTION = "Capture", "Checks and corrections"  # panels of the help


@dataclass(frozen=True)
class ReadSettings:
    """Settings of reading a capture's frames."""

    layout: str = option(
        "stage",
        "Read this layout of a capture: stage (with stage.json), or extended-yale-b (that database, cropped, "
        "as distributed).",
        "NAME",
        panel=CAPTURE,
    )
    subtract_ambient: bool = option(
        False, "Subtract each camera's image without lights, where there is one.", panel=CORRECTION
    )
    align: bool = option(
        False, "Shift frames in which the head has moved back to its place.", panel=CORRECTION
    )


@dataclass(frozen=True)
class ChartSettings:
    """A photographed colour chart by which the frames are corrected."""

    colour_chart: str = option(
        "",
        "Correct the colours by this image of a ColorChecker Classic under the stage's lights; with {camera} "
        "in its name, by an image per camera.",
        "IMAGE",
        shown_default=False,
        panel=CORRECTION,
    )
    chart_corners: str = option(
        "",
        "Corners of the chart's 24 patches in pixels, in order around them.",
        "'X,Y X,Y X,Y X,Y'",
        shown_default="search for the chart",
        panel=CORRECTION,
    )


@dataclass(frozen=True)
class CheckSettings:
    """Settings of the checks of frames, and of what a finding does."""

    checks: Literal["on", "off", "only"] = option(
        "on",
        "Check the frames first: broken frames are left out, errors stop a subject. only: list the findings, "
        "and prepare nothing.",
        panel=CORRECTION,
    )
    strict: bool = option(
        False, "Stop a subject for any finding, missing frame or undetected face.", panel=CORRECTION
    )
