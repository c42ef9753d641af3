"""The light of one photo: estimated, and written as a map, as JSON and as an image to look at."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import render_face, see_face
from facerf_cli.files.light_files import LightRecord, write_light
from facerf_cli.files.read import LinearImage
from facerf_cli.files.sheets import labels
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.light.envmap import ball, resampled, rig_to_latlong
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import brightest_direction, direction_to_azel
from facerf_cli.light.studio_points import rig_by_text
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.files import SHIPPED
from facerf_cli.network.inputs import resize
from facerf_cli.portrait.confidence import confidence_of
from facerf_cli.portrait.find import NoFaceError
from facerf_cli.relighting.photo_light import Estimator, LightEstimate, estimate_light
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import LightOptions
from facerf_cli.work.photos import (
    FittedFace,
    facts_of_networks,
    fit_faces,
    load_models_once,
    provenance,
    read_matte,
    read_photo,
    write_each,
)
from facerf_cli.work.sequence import OpenShot
from facerf_cli.work.shots import Shot

TILE_PX = 256
_LABEL_PX = 20
_LABELS = ("photo", "explained", "red: too bright, blue: too dark", "mirror ball", "diffuse ball")
_BALL_PX = 236  # within its tile


def draw_estimate(head: Head, model: MorphableModel, explained: Tensor, envmap: Tensor) -> np.ndarray:
    """Five tiles side by side [H, W, 3], linear, exposed for display; labels above.

    `explained` [3, t, t] is the face's texture as its light explains it; `envmap` [H, 2 H, 3] that light.
    """
    whole = Crop(0.0, 0.0, float(len(head.cropped)), TILE_PX)
    image, mask = _explained_in_crop(head, model, explained)
    gain = np.float32(2 ** auto_exposure_ev(head.cropped, mask))
    photo, remade = (
        head.cropped * gain,
        (mask[..., None] * image + (1 - mask[..., None]) * head.cropped) * gain,
    )
    faces = [whole.apply(tile.clip(0, 1)) for tile in (photo, remade, _difference(photo, remade, mask))]
    both = np.stack([ball(envmap.clamp_min(0), _BALL_PX, kind).numpy() for kind in ("mirror", "diffuse")])
    both *= np.float32(2 ** auto_exposure_ev(both[1], both[1].max(-1) > 0))
    margin = (TILE_PX - _BALL_PX) // 2
    balls = np.pad(both.clip(0, 1), ((0, 0), (margin, margin), (margin, margin), (0, 0)))
    tiles = np.concatenate([*faces, *balls], 1)
    return np.concatenate([labels(_LABELS, TILE_PX, _LABEL_PX), tiles])


def _explained_in_crop(head: Head, model: MorphableModel, explained: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The explained face in the crop [S, S, 3], and how far it stands there for the photo [S, S] in 0..1."""
    uv, coverage = see_face(head.fit.vertices_camera(model), head.fit.camera)
    side = head.face.texture.shape[-1]
    inside = (head.face.visible * region_mask("face", side))[None]
    planes = torch.cat([resize(explained[None], side)[0], inside])
    rendered = render_face(planes[None], uv, coverage)[0].permute(1, 2, 0).numpy()
    return rendered[..., :3], rendered[..., 3].clip(0, 1)


def _difference(photo: np.ndarray, remade: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """On grey: red where the face was made too bright for the eye, blue where too dark."""
    encoded = [linear_to_srgb(tile.clip(0, 1)).mean(-1) for tile in (remade, photo)]
    error = 2 * (encoded[0] - encoded[1]) * mask
    bright, dark = error.clip(0, 0.5), (-error).clip(0, 0.5)
    shown = np.stack([0.5 + bright - dark, 0.5 - bright - dark, 0.5 - bright + dark], -1)
    return np.asarray(srgb_to_linear(shown.astype(np.float32)))


_UNEXPLAINED = 0.25  # of the photo's norm: photos leave 0.05 to 0.2
_SOFT = 0.32  # share of one lamp below which the brightest direction was 15 to 120 degrees off
log = logging.getLogger(LOGGER_NAME)


def write_shot_light(
    shot: Shot, item: Item, options: LightOptions, width_px: int, sh_order: int
) -> tuple[list[str], Any]:
    """Estimate and write the one light of each take of a shot; their tags, and facts for the report.

    A light is estimated from key frames together. Takes that do not show the face have none.
    """
    tags: list[str] = []
    facts: list[dict[str, Any]] = []
    followed = OpenShot(shot, options.photo)
    for frames in followed.track.takes_with_face:
        take = followed.take_of(frames.start)
        image, face = followed.fitted(take.middle, portrait=False)
        face = replace(face, tag=f"_take{len(tags) + 1}" if tags else "")
        found = _write(item, image, face, options, width_px, sh_order, take.other_heads)
        tags.append(face.tag)
        facts.append(face.described() | found | {"frames": take.key_frames})
    return tags, (facts[0] if len(facts) == 1 else {"takes": facts}) | facts_of_networks(options.photo)


def write_lights(item: Item, options: LightOptions, width_px: int, sh_order: int) -> tuple[list[str], Any]:
    """Estimate and write the light of each chosen face of a photo; their tags, and facts for the report."""
    image = read_photo(item, options.photo)

    def write(face: FittedFace) -> dict[str, Any]:
        _require_light_on(face, options)
        return {"light_from": "face"} | _write(item, image, face, options, width_px, sh_order)

    try:
        return write_each(item, image, options.photo, write)
    except NoFaceError:
        from facerf_cli.work.light_of_picture import write_guess

        return [""], write_guess(item, image, options, width_px, sh_order)


def map_of_photo(path: Path, options: LightOptions, height: int) -> Tensor:
    """The light of the largest face of a photo, or of a picture without one: a map [height, 2 height, 3]."""
    item = Item(path, Path(path.stem), path.stem)
    image = read_photo(item, options.photo)
    try:
        face = fit_faces(item, image, options.photo)[0]
        _require_light_on(face, options)
    except NoFaceError:
        from facerf_cli.work.light_of_picture import guessed_light

        return resampled(guessed_light(item, image, options.fov_deg).envmap, height)
    return rig_to_latlong(_estimate(item, image, face.head, options)[0].light, height)


def _require_light_on(face: FittedFace, options: LightOptions) -> None:
    """Raise NoFaceError for a detected face that is too small, dark or doubtful to read light from."""
    if options.photo.landmarks is None and confidence_of(face.facts).word == "doubtful":
        raise NoFaceError(f"{face.name}: its face is doubtful")


def _estimate(
    item: Item, image: LinearImage, head: Head, options: LightOptions, more: Sequence[Head] = ()
) -> tuple[LightEstimate, dict[str, Any]]:
    """The light of one fitted face, and facts for the report."""
    models = load_models_once(options.photo)
    features, name = feature_network(options) if options.refine == "features" else (None, None)
    try:
        estimate = estimate_light(
            models,
            _unmasked(item, image, head, options),
            options.reflectance,
            rig_by_text(options.rig),
            Estimator(options.non_negative, features),
            options.keep_eyes,
            more,
            white="scene",
        )
    except InputError as error:
        raise InputError(f"{item.input_path}: {error}") from None
    residual = estimate.evidence.residual(estimate.explained)
    if residual > _UNEXPLAINED:
        log.warning(
            "%s: the light found does not give this face (%.0f %% of it differs); look at _light.png: "
            "perhaps the face model is off, or it is not a face",
            item.input_path,
            100 * residual,
        )
    if estimate.key_share is not None and estimate.key_share < _SOFT:
        log.info("%s: soft light; its brightest direction is doubtful", item.input_path)
    return estimate, _facts(estimate, residual, options, name)


def _unmasked(item: Item, image: LinearImage, head: Head, options: LightOptions) -> Head:
    """The head without what the photo's alpha or --matte leaves out."""
    masks = [] if image.alpha is None else [image.alpha]
    if options.matte is not None:
        masks.append(read_matte(item, options.matte, image.pixels.shape[:2]))
    for mask in masks:
        in_crop = head.fit.crop.apply(mask[..., None])[..., 0]
        head = head.without(load_models_once(options.photo).face, in_crop)
    return head


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
    """V_f if its weights were given, else S_f; and its name for the report."""
    networks = load_models_once(options.photo).networks
    if options.vgg_weights is not None:
        from facerf_cli.network.vgg import load_vgg  # a relight does without it

        return load_vgg(options.vgg_weights).to(networks.device), "V_f (VGG-16, ImageNet)"
    path = networks.files["light_features"]
    return networks.light_features, f"S_f ({'shipped' if path == SHIPPED['light_features'] else path.name})"


def _write(
    item: Item,
    image: LinearImage,
    face: FittedFace,
    options: LightOptions,
    width_px: int,
    sh_order: int,
    more: Sequence[Head] = (),
) -> dict[str, Any]:
    estimate, facts = _estimate(item, image, face.head, options, more)
    models = load_models_once(options.photo)
    said = {f"facerf:light_{name}": value for name, value in facts.items()}
    for name, value in said.items():
        if not isinstance(value, (int, float, str)):  # a file's header holds words and numbers
            said[name] = " ".join(map(str, value or ["none"]))
    metadata = provenance(item, options.photo, models.checkpoint_name()) | said
    envmap = rig_to_latlong(estimate.light, width_px // 2)
    base = item.output(f"{face.tag}_light")
    write_exr(base.with_name(base.name + ".exr"), envmap.numpy(), metadata=metadata)
    light, rig = estimate.light, f"--lights {options.rig}"
    harmonics = rig_coefficients(light, sh_order)
    record = LightRecord(light.directions, light.weights, rig, harmonics, metadata)
    write_light(base.with_name(base.name + ".json"), record)
    shown = draw_estimate(face.head, models.face, estimate.explained, envmap)
    write_display(base.with_name(base.name + ".png"), shown, metadata=metadata)
    return facts
