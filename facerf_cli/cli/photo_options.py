"""Options of every verb that reads photos: the face, its landmarks, the face model, the texture."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.inputs import OF_PHOTOS, NamePattern
from facerf_cli.batch.settings import Settings
from facerf_cli.cli.options import FACE, METHOD
from facerf_cli.errors import UsageError

_TEXTURE_STEP, _TEXTURE_MOST = 256, 2048
FITTING = frozenset({"parsing", "geometry"})  # networks that find and fit faces
# Networks of the reflectance models.
NETWORKS = {
    "field": frozenset({"reflectance"}),
    "portrait": frozenset({"reflectance", "portrait"}),
    "diffuse-sh": frozenset({"diffuse_sh"}),
}

FaceOption = Annotated[
    str,
    typer.Option(
        "--face",
        metavar="largest|all|INDEX",
        help="Choose the face of a photo with several; INDEX counts from the left, from 0.",
        rich_help_panel=FACE,
    ),
]
LandmarksOption = Annotated[
    Path | None,
    typer.Option(
        "--landmarks",
        metavar="FILE|DIR|PATTERN",
        help="Read 68 landmarks (.pts or .json) from a file; for each photo from a folder, or by a pattern "
        "(points/{stem}.pts).",
        show_default="detect them",
        rich_help_panel=FACE,
    ),
]
LandmarksFrom = Literal["facerf", "dlib"]
LandmarksFromOption = Annotated[
    LandmarksFrom,
    typer.Option(
        "--landmarks-from",
        help="Find landmarks by facerf's own network, or by dlib's predictor (an extra; its licence excludes "
        "commercial use).",
        rich_help_panel=FACE,
    ),
]
Geometry = Literal["landmarks", "network"]
GeometryOption = Annotated[
    Geometry | None,
    typer.Option(
        "--geometry",
        help="Fit the face model to landmarks, or regress it by the Geometry Network, without landmarks.",
        show_default="as the checkpoint was trained",
        rich_help_panel=FACE,
    ),
]
TextureSizeOption = Annotated[
    int | None,
    typer.Option(
        "--texture-size",
        metavar="T",
        help="Side of the UV texture; a multiple of 256.",
        show_default="the checkpoint's; 256 for the shipped one",
        rich_help_panel=METHOD,
    ),
]


@dataclass(frozen=True)
class PhotoOptions:
    """Settings of reading and fitting photos, which can be sent to other processes."""

    settings: Settings
    colourspace: str | None = None
    face_model: str = "builtin"
    face: str = "largest"
    landmarks: Path | None = None
    geometry: Geometry | None = None  # None: as the checkpoint was trained
    texture_side: int | None = None  # None: the checkpoint's
    landmarks_from: LandmarksFrom = "facerf"
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

    def preparation(self, dry_run: bool, uses: Collection[str]) -> Callable[[], None]:
        """A function that loads what every photo needs, in a dry run without the networks."""

        def prepare() -> None:
            from facerf_cli.work.photos import prepare_photos

            prepare_photos(self, uses, with_networks=not dry_run)

        return prepare

    @property
    def first_tag(self) -> str:
        """The tag of a photo's first face in the names of its outputs; faces are written last to first.

        The number of faces that `--face all` finds is not known beforehand. So the first one's outputs are
        written last and mark the photo as finished.
        """
        return "_face0" if self.face == "all" else ""


def networks_of(kinds: Iterable[str]) -> frozenset[str]:
    """Names of the networks that reading photos by some reflectance models uses."""
    return FITTING.union(*(NETWORKS.get(kind, ()) for kind in kinds))


def check_companion(given: Path | None, option: str) -> None:
    """Raise UsageError for a file or folder that does not exist; a pattern is filled in for each photo."""
    if given is not None and not given.exists():
        if "{" not in str(given):
            raise UsageError(f"{option} {given}: no such file or folder; give one that exists")
        NamePattern.parse(given.as_posix().lstrip("/"), option, OF_PHOTOS)
