"""`facerf estimate-light`: the light of a photo as a map, as numbers and as an image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.cli.options import FramesArgument
from facerf_cli.work.photo_options import LightOptions, refuse
from facerf_cli.work.photo_work import FileOrFolder, PhotoWork, Written
from facerf_cli.work.shots import ShotOptions, Shots, collect_frames, whole_shots


@dataclass(frozen=True, kw_only=True)
class EstimateLight(PhotoWork, LightOptions):
    """`facerf estimate-light`."""

    verb = "estimate-light"
    endings = ("_light.exr", "_light.json", "_light.png")
    networks = LightOptions.networks
    file_endings = ("_light.exr", "_light.json")

    def run(self, inputs: Sequence[str], batch: FileOrFolder, frames: ShotOptions | None = None) -> int:
        """Estimate the light of each photo, and one light per take of a shot; return the exit code."""
        self.photo.check()
        self.check()
        items, shots = collect_frames(inputs, frames or ShotOptions(), batch, self.photo)
        message = "a shot's light is that of the face field; remove --refine, --reflectance and --matte"
        plain = self.refine == "none" and self.reflectance == "field" and self.matte is None
        refuse({f"a video or --sequence: {message}": bool(shots) and not plain})
        return replace(self, shots=Shots(shots)).run_on(whole_shots(items, shots), batch)

    def ready(self, dry_run: bool) -> Self:
        """Load what every photo needs, and the network whose features are compared."""
        from facerf_cli.work.estimate_light import feature_network

        super().ready(dry_run)
        if self.refine == "features" and not dry_run:
            feature_network(self)
        return self

    def write(self, item: Item) -> Written:
        """Estimate and write the light of every chosen face, or of each take of a shot."""
        from facerf_cli.work.estimate_light import write_lights, write_shot_light

        for shot in self.shots.all:
            if item.output_base == shot.base:
                return write_shot_light(shot, item, self)
        return write_lights(item, self)


def estimate_light(
    inputs: FramesArgument, work: EstimateLight, shots: ShotOptions, batch: FileOrFolder
) -> None:
    """Estimate the light of photos from the shading of their faces.

    Each photo gets _light.exr, a lat-long map for `relight --envmap`; _light.json, the weights of the lights
    and their spherical harmonics; and _light.png, which shows the photo, the face under the estimated light,
    its errors (red: too bright, blue: too dark), a mirror ball and a diffuse ball. The report contains the
    residual inside the mask, the brightest direction (azimuth, elevation) and the fraction of clipped texels.

    A video, or an image sequence with --sequence, has one light between cuts, estimated from several frames
    together (_take2_light.exr after the first cut).

    A face shows much of the light in front of it and little of the light behind it. Brightness and colour of
    the light cannot be separated from those of the skin; they depend on the albedo that the network predicts.
    """
    raise typer.Exit(work.run(inputs, batch, shots))
