"""Options for reading and checking a capture; light to import."""

from dataclasses import dataclass
from typing import Literal

from facerf_cli.option import option

CAPTURE, CORRECTION = "Capture", "Checks and corrections"  # panels of the help


@dataclass(frozen=True)
class ReadSettings:
    """Settings for reading a capture's frames.

    Attributes:
        layout: Layout of the capture: stage (with stage.json), extended-yale-b (cropped),
            faceolat, or faceolat-linear (without colour calibration).
        subtract_ambient: Subtract each camera's image without lights, if there is one.
    """

    layout: str = option("stage", metavar="NAME", panel=CAPTURE, everyday=True)
    subtract_ambient: bool = option(False, panel=CORRECTION)


@dataclass(frozen=True)
class ChartSettings:
    """Photographed colour chart that corrects the frames.

    Attributes:
        colour_chart: Image of a ColorChecker Classic under the stage's lights, used to correct the colours;
            {camera} in its name selects one image per camera.
        chart_corners: Corners of the chart's patches in pixels, clockwise from dark skin; one set per camera,
            separated by ;.
    """

    colour_chart: str = option("", metavar="IMAGE", shown_default=False, panel=CORRECTION, everyday=True)
    chart_corners: str = option("", metavar="'X,Y X,Y X,Y X,Y'", shown_default=False, panel=CORRECTION)


@dataclass(frozen=True)
class CheckSettings:
    """Settings for the checks of frames and for the effect of findings.

    Attributes:
        checks: Whether to check the frames first: broken frames are left out, errors stop a subject. only:
            list the findings, and prepare nothing.
        strict: Stop a subject for any finding, missing frame or undetected face.
    """

    checks: Literal["on", "off", "only"] = option("on", panel=CORRECTION)
    strict: bool = option(False, panel=CORRECTION)
