"""The settings of `facerf evaluate` on faces, light to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facerf_cli.errors import UsageError
from facerf_cli.evaluation.options import EvaluateOptions, SplitOptions
from facerf_cli.work.photo_options import PhotoOptions, SolveOptions

_WHOLE_SPLIT, _AS_RELIGHT = SplitOptions(), SolveOptions()
Protocol = Literal["olat", "reconstruction", "transfer", "geometry", "yale-b"]


@dataclass(frozen=True)
class FaceSettings:
    """The settings of a protocol on faces; `network_alone` leaves the photo's correction out of the field."""

    protocol: Protocol
    options: EvaluateOptions
    photo: PhotoOptions
    data: SplitOptions = _WHOLE_SPLIT
    network_alone: bool = True
    solve: SolveOptions = _AS_RELIGHT
    mean_checkpoint: Path | None = None
    facts: Path | None = None
    files: tuple[Path, ...] = ()  # that shape the figures beside the items

    def check(self) -> None:
        """Raise UsageError for options that would fail every item, or that exclude each other."""
        self.options.check()
        self.photo.check()
        if self.options.preset and self.data.every > 1:
            raise UsageError(
                "--preset and --every exclude each other: a preset has a fixed number of images; leave one "
                "out"
            )
        if self.data.pairs and (self.options.preset or self.data.every > 1):
            raise UsageError("--pairs: is a list of its own; leave --preset and --every out")
        if self.protocol == "geometry" and self.options.against:
            raise UsageError("--against: does not apply to geometry; give --checkpoint and --mean-checkpoint")
