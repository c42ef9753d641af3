"""The light of a picture without a face, such as a background: guessed, and written."""

import logging
import math
from typing import Any

import numpy as np
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.files.light_files import LightRecord, write_light
from facerf_cli.files.read import LinearImage
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import auto_exposure_ev
from facerf_cli.image.strips import resized
from facerf_cli.light.envmap import ball, envmap_weights, resampled
from facerf_cli.light.picture import FOV_DEG, PictureLight, light_of_picture
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight
from facerf_cli.light.studio_points import rig_by_text
from facerf_cli.run.logs import LOGGER_NAME, Provenance
from facerf_cli.work.photo_options import LightOptions

_TILE_PX = 256
_FILM_MM = 36.0  # longer side of the frame that EXIF's focal length is of
log = logging.getLogger(LOGGER_NAME)


def guessed_light(item: Item, image: LinearImage, fov_deg: float | None) -> PictureLight:
    """Estimate a picture's light, and warn that it is a guess and of the error to expect."""
    fov_deg = fov_deg or stated_fov_deg(image) or FOV_DEG
    guess = light_of_picture(torch.from_numpy(image.pixels), fov_deg)
    log.warning(
        "%s: has no face to find the light by, so the light is a guess from the picture, %.0f degrees wide "
        "(--fov); the shading that it gives a matte white ball is expected to be wrong by %.0f %% (RMS)",
        item.input_path,
        fov_deg,
        100 * guess.error,
    )
    return guess


def stated_fov_deg(image: LinearImage) -> float | None:
    """The angle of view across a picture's width by its EXIF, of a frame of 36 mm; or None."""
    focal_mm = image.metadata.get("Exif:FocalLengthIn35mmFilm")
    if not isinstance(focal_mm, (int, float)) or not 4 <= focal_mm <= 2000:
        return None
    height, width = image.pixels.shape[:2]
    return math.degrees(2 * math.atan(_FILM_MM / 2 / focal_mm * width / max(height, width)))


def write_guess(
    item: Item, image: LinearImage, options: LightOptions, width_px: int, sh_order: int
) -> dict[str, Any]:
    """Write a picture's light as a map, as JSON and as an image; return facts for the report."""
    guess = guessed_light(item, image, options.fov_deg)
    facts: dict[str, Any] = {"light_from": "picture", "guess_error": round(guess.error, 3)}
    said = {f"facerf:light_{name}": value for name, value in facts.items()}
    metadata = {**Provenance(item.input_path.name, key=item.key).attributes(), **said}
    envmap, base = resampled(guess.envmap, width_px // 2), item.output("_light")
    write_exr(base.with_name(base.name + ".exr"), envmap.numpy(), metadata=metadata)
    directions = rig_by_text(options.rig)
    light = RigLight(directions, envmap_weights(guess.envmap, directions))
    harmonics = rig_coefficients(light, sh_order)
    record = LightRecord(directions, light.weights, f"--lights {options.rig}", harmonics, metadata)
    write_light(base.with_name(base.name + ".json"), record)
    write_display(base.with_name(base.name + ".png"), _sheet(image.pixels, guess), metadata=metadata)
    return facts


def _sheet(picture: np.ndarray, guess: PictureLight) -> np.ndarray:
    """The picture, its map, a mirror ball and a diffuse ball, each 256 pixels high, exposed alike."""
    height, width = picture.shape[:2]
    balls = [ball(guess.envmap, _TILE_PX, kind).numpy() for kind in ("mirror", "diffuse")]
    tiles = [
        resized(picture, _TILE_PX, max(1, round(width * _TILE_PX / height))),
        resized(guess.envmap.numpy(), _TILE_PX, 2 * _TILE_PX),
        *balls,
    ]
    gain = np.float32(2 ** auto_exposure_ev(picture, None))
    return np.concatenate([(tile * gain).clip(0, 1) for tile in tiles], 1)
