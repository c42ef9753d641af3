"""`facerf estimate-light`: the light of a photo as a map, as numbers and as an image."""

import typer

from facerf_cli.batch.run import BatchOptions
from facerf_cli.cli.options import FramesArgument
from facerf_cli.work.shots import ShotOptions
from facerf_cli.work.verbs import EstimateLight


def estimate_light(
    inputs: FramesArgument,
    work: EstimateLight,
    shots: ShotOptions,
    batch: BatchOptions,
) -> None:
    """Estimate the light of photos from the shading of their faces.

    For each photo: _light.exr, a lat-long map for `relight --envmap`; _light.json, the weights of the lights
    and their spherical harmonics; and _light.png: the photo, the face under the estimated light, where that
    is too bright (red) and too dark (blue), a mirror ball and a diffuse ball. The report holds the residual
    inside the mask, the brightest direction (azimuth, elevation) and the share of clipped texels.

    A film, or images with --sequence, has one light between cuts, estimated from several frames together
    (_take2_light.exr after the first cut).

    A face shows much of the light in front of it and little of the light behind it. Brightness and colour of
    the light cannot be separated from those of the skin; they depend on the albedo that the network assumes.
    """
    raise typer.Exit(work.run(inputs, shots, batch))
