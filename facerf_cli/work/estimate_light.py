"""Write the light of a photo for `facerf estimate-light`: a map, JSON, and a contact sheet.

The light of a photo is estimated from a face; the light of an image without a face is a guess.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.batch.inputs import Item
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import render_face, see_face
from facerf_cli.files.image_metadata import Provenance
from facerf_cli.files.light_files import LightRecord, write_light
from facerf_cli.files.read import LinearImage
from facerf_cli.files.sheets import labels
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.image.strips import resized
from facerf_cli.light.envmap import ball, envmap_weights, resampled, rig_to_latlong
from facerf_cli.light.light import rig_by_text
from facerf_cli.light.picture import FOV_DEG, light_of_picture
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight, brightest_direction, direction_to_azel
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.files import SHIPPED
from facerf_cli.network.inputs import resize
from facerf_cli.portrait.confidence import confidence_of
from facerf_cli.portrait.find import NoFaceError
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.photo_light import Estimator, LightEstimate, estimate_light
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import LightOptions
from facerf_cli.work.photos import (
    FittedFace,
    facts_of_networks,
    load_models_once,
    naming,
    provenance,
    read_matte,
    read_photo,
    write_each,
)
from facerf_cli.work.sequence import OpenShot
from facerf_cli.work.shots import Shot

_TILE_PX, _LABEL_PX = 256, 20
_BALL_PX = 236  # within its tile
_FILM_MM = 36.0  # longer side of the frame that EXIF's 35 mm focal length refers to
_UNEXPLAINED = 0.25  # of the photo's norm: larger residuals are logged; usual ones are 0.05 to 0.2
_SOFT = 0.32  # key light's fraction below which the brightest direction was off by 15 to 120 degrees
Tiles = dict[str, np.ndarray]  # images [256, w, 3] of a sheet, linear, by their labels
log = logging.getLogger(LOGGER_NAME)


def write_shot_light(shot: Shot, item: Item, options: LightOptions) -> tuple[list[str], Any]:
    """Estimate and write the light of each take that shows the face, from key frames together.

    Returns the takes' tags, and facts for the report.
    """
    tags: list[str] = []
    facts: list[dict[str, Any]] = []
    opened = OpenShot(shot, options.photo)
    for frames in opened.track.takes_with_face:
        take = opened.take_of(frames.start)
        image, face = opened.fitted(take.middle, portrait=False)
        face = replace(face, tag=f"_take{len(tags) + 1}" if tags else "")
        written = _write_estimate(item, image, face, options, take.other_heads)
        tags.append(face.tag)
        facts.append(face.described() | written | {"frames": take.key_frames})
    return tags, (facts[0] if len(facts) == 1 else {"takes": facts}) | facts_of_networks(options.photo)


def write_lights(item: Item, options: LightOptions) -> tuple[list[str], Any]:
    """Estimate and write the light of each chosen face of a photo; without a face, guess it.

    Returns the faces' tags, and facts for the report.
    """
    image = read_photo(item, options.photo)

    def write(face: FittedFace) -> dict[str, Any]:
        if options.photo.landmarks is None and confidence_of(face.facts).word == "doubtful":
            raise NoFaceError(f"{face.name}: its face is too small, dark or unclear to read light from")
        return {"light_from": "face"} | _write_estimate(item, image, face, options)

    try:
        return write_each(item, image, options.photo, write)
    except NoFaceError:
        return [""], _write_guess(item, image, options)


def _write_estimate(
    item: Item,
    image: LinearImage,
    face: FittedFace,
    options: LightOptions,
    other_heads: Sequence[Head] = (),
) -> dict[str, Any]:
    """Estimate and write the light of a fitted face and `other_heads` of its shot; return facts."""
    models = load_models_once(options.photo)
    features, name = feature_network(options) if options.refine == "features" else (None, None)
    with naming(item.input_path):
        head, masks = face.head, [] if image.alpha is None else [image.alpha]
        if options.matte is not None:
            masks.append(read_matte(item, options.matte, image.pixels.shape[:2]))
        for mask in masks:
            head = head.without(models.face, head.fit.crop.apply(mask[..., None])[..., 0])
        estimate = estimate_light(
            models,
            head,
            options.reflectance,
            rig_by_text(options.rig),
            Estimator(options.non_negative, features),
            options.keep_eyes,
            other_heads,
            white_balance="neutral",
        )
    residual = estimate.evidence.residual(estimate.explained)
    if residual > _UNEXPLAINED:
        log.warning(
            "%s: the estimated light does not reproduce the face (residual %.0f %%); check _light.png: the "
            "face fit may be wrong, or this may not be a face",
            item.input_path,
            100 * residual,
        )
    if estimate.key_share is not None and estimate.key_share < _SOFT:
        log.info("%s: the light is soft; its brightest direction is uncertain", item.input_path)
    facts = _facts(estimate, residual, options, name)
    metadata = provenance(item, options.photo, models.checkpoint_name())
    tiles = _explained_tiles(face.head, models, estimate.explained)
    envmap = rig_to_latlong(estimate.light, options.width_px // 2)
    base = item.output(f"{face.tag}_light")
    _write(base, envmap, estimate.light, tiles, options, metadata, facts)
    return facts


def _facts(
    estimate: LightEstimate, residual: float, options: LightOptions, features: str | None
) -> dict[str, Any]:
    light, evidence = estimate.light, estimate.evidence
    azel_deg = [round(float(angle), 1) for angle in direction_to_azel(brightest_direction(light))]
    facts: dict[str, Any] = {
        "reflectance": options.reflectance,
        "brightest_azel_deg": azel_deg,
        "residual": round(residual, 4),
        "clipped": round(float(evidence.clipped.any(0).sum() / evidence.mask.sum()), 4),
        "texels": int(evidence.mask.sum()),
        "lights": len(light.directions),
    }
    if options.reflectance != "field":
        return facts | {"non_negative": bool((light.weights >= 0).all())}
    facts |= {"non_negative": options.non_negative, "features": features}
    if estimate.key_share is not None:
        facts["key_share"] = round(estimate.key_share, 3)
    if (refined := estimate.refined) is not None and estimate.least_squares is not None:
        facts |= {
            "feature_loss": [float(f"{loss:.4g}") for loss in (refined.loss_before, refined.loss_after)],
            "refine_steps": refined.steps,
            "residual_before": round(evidence.residual(evidence.relit(estimate.least_squares)), 4),
        }
    return facts


@cache
def feature_network(options: LightOptions) -> tuple[FeatureNetwork, str]:
    """Return V_f if the user passed its weights, otherwise S_f; and its name for the report."""
    networks = load_models_once(options.photo).networks
    if options.vgg_weights is not None:
        from facerf_cli.network.vgg import load_vgg  # relight does without it

        return load_vgg(options.vgg_weights).to(networks.device), "V_f (VGG-16, ImageNet)"
    path = networks.files["light_features"]
    return networks.light_features, f"S_f ({'shipped' if path == SHIPPED['light_features'] else path.name})"


def _write_guess(item: Item, image: LinearImage, options: LightOptions) -> dict[str, Any]:
    """Guess and write the light of an image without a face; log the expected error, and return facts."""
    fov_deg = options.fov_deg or stated_fov_deg(image) or FOV_DEG
    guess = light_of_picture(torch.from_numpy(image.pixels), fov_deg)
    log.warning(
        "%s: no usable face, so the light is a guess from the image, %.0f degrees wide (--fov); expected "
        "error of a matte white ball's shading: %.0f %% (RMS)",
        item.input_path,
        fov_deg,
        100 * guess.error,
    )
    facts: dict[str, Any] = {"light_from": "picture", "guess_error": round(guess.error, 3)}
    directions = rig_by_text(options.rig)
    light = RigLight(directions, envmap_weights(guess.envmap, directions))
    height, width = image.pixels.shape[:2]
    small = resized(image.pixels, _TILE_PX, max(1, round(width * _TILE_PX / height)))
    tiles = {"picture": small * np.float32(2 ** auto_exposure_ev(image.pixels, None))}
    metadata = Provenance(item.input_path.name, key=item.key).attributes()
    envmap = resampled(guess.envmap, options.width_px // 2)
    _write(item.output("_light"), envmap, light, tiles, options, metadata, facts)
    return facts


def stated_fov_deg(image: LinearImage) -> float | None:
    """Return an image's horizontal angle of view by the focal length in its EXIF; None without one."""
    focal_mm = image.metadata.get("Exif:FocalLengthIn35mmFilm")
    if not isinstance(focal_mm, (int, float)) or not 4 <= focal_mm <= 2000:
        return None
    height, width = image.pixels.shape[:2]
    return math.degrees(2 * math.atan(_FILM_MM / 2 / focal_mm * width / max(height, width)))


def _write(
    base: Path,
    envmap: Tensor,
    light: RigLight,
    tiles: Tiles,
    options: LightOptions,
    provenance: Mapping[str, str | int],
    facts: Mapping[str, Any],
) -> None:
    """Write a light as a map [H, 2 H, 3], as JSON, and as a sheet of images and balls under it."""
    metadata: dict[str, Any] = dict(provenance)
    for name, value in facts.items():  # headers contain only words and numbers
        plain = value if isinstance(value, (int, float, str)) else " ".join(map(str, value or ["none"]))
        metadata[f"facerf:light_{name}"] = plain
    write_exr(Path(f"{base}.exr"), envmap.numpy(), metadata=metadata)
    harmonics, rig = rig_coefficients(light, options.sh_order), f"--lights {options.rig}"
    record = LightRecord(light.directions, light.weights, rig, harmonics, metadata)
    write_light(Path(f"{base}.json"), record)
    write_display(Path(f"{base}.png"), _sheet(tiles, envmap), metadata=metadata)


def _sheet(tiles: Tiles, envmap: Tensor) -> np.ndarray:
    """Return tiles, a mirror ball and a diffuse ball side by side [H, W, 3], linear, with labels above."""
    light = envmap.clamp_min(0)
    both = np.stack([ball(light, _BALL_PX, "mirror").numpy(), ball(light, _BALL_PX, "diffuse").numpy()])
    both *= np.float32(2 ** auto_exposure_ev(both[1], both[1].max(-1) > 0))
    margin = (_TILE_PX - _BALL_PX) // 2
    mirror, diffuse = np.pad(both, ((0, 0), (margin, margin), (margin, margin), (0, 0)))
    labelled = [
        np.concatenate([labels([label], tile.shape[1], _LABEL_PX), tile.clip(0, 1)])
        for label, tile in (tiles | {"mirror ball": mirror, "diffuse ball": diffuse}).items()
    ]
    return np.concatenate(labelled, 1)


def _explained_tiles(head: Head, models: Models, explained: Tensor) -> Tiles:
    """Return the photo's face, the face under the estimated light, and their difference, exposed.

    `explained` [3, t, t] is the face's texture under that light. In the difference, red is too bright for the
    eye, blue too dark.
    """
    uv, coverage = see_face(head.fit.vertices_camera(models.face), head.fit.camera)
    side = head.face.texture.shape[-1]
    inside = (head.face.visible * region_mask("face", side))[None]
    planes = torch.cat([resize(explained[None], side)[0], inside])
    rendered = render_face(planes[None], uv, coverage)[0].permute(1, 2, 0).numpy()
    mask = rendered[..., 3].clip(0, 1)
    gain = np.float32(2 ** auto_exposure_ev(head.cropped, mask))
    photo = head.cropped * gain
    remade = (mask[..., None] * rendered[..., :3] + (1 - mask[..., None]) * head.cropped) * gain
    encoded = [linear_to_srgb(tile.clip(0, 1)).mean(-1) for tile in (remade, photo)]
    error = 2 * (encoded[0] - encoded[1]) * mask
    bright, dark = error.clip(0, 0.5), (-error).clip(0, 0.5)
    difference = np.stack([0.5 + bright - dark, 0.5 - bright - dark, 0.5 - bright + dark], -1)
    tiles = {
        "photo": photo,
        "explained": remade,
        "red: too bright, blue: too dark": np.asarray(srgb_to_linear(difference.astype(np.float32))),
    }
    whole = Crop(0.0, 0.0, float(len(head.cropped)), _TILE_PX)
    return {label: whole.apply(tile.clip(0, 1)) for label, tile in tiles.items()}
