"""The light of a photo as verbs ask for it: by least squares over the field, or a baseline's own."""

import logging
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import facerf_cli
from facerf_cli.baselines import Kind
from facerf_cli.cli.batch import Item
from facerf_cli.cli.photo_options import FittedFace, PhotoOptions, fit_faces, load_models_once, read_photo
from facerf_cli.cli.values import parse_directions
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from facerf_cli.files.images import LinearImage
    from facerf_cli.light.estimate import LightEvidence
    from facerf_cli.light.sphere import RigLight
    from facerf_cli.network.feature_networks import Layered

log = logging.getLogger(LOGGER_NAME)
Refine = Literal["none", "features"]
LIGHT_FEATURES = Path(facerf_cli.__file__).parent / "assets" / "light_features.safetensors"
_UNEXPLAINED = 0.25  # of the photo's norm: photos leave 0.05 to 0.2
MOST_LIGHTS = 1024  # that are solved for; beyond it non-negative least squares take minutes


@dataclass(frozen=True)
class LightOptions:
    """How the light of a photo is estimated; settings only."""

    photo: PhotoOptions
    reflectance: Kind = "field"
    rig: str = "150"
    non_negative: bool = True
    refine: Refine = "none"
    vgg_weights: str | None = None
    keep_eyes: bool = False
    matte: Path | None = None

    def check(self) -> None:
        """Raise for what would fail every photo alike, and for options that do not go together."""
        if self.reflectance != "field" and (
            self.refine != "none" or self.rig != "150" or not self.non_negative
        ):
            raise UsageError(
                f"--reflectance {self.reflectance} has a light of its own: --lights, --signed and --refine "
                "are for the field alone"
            )
        if self.vgg_weights is not None and self.refine == "none":
            raise UsageError("--vgg-weights says which features --refine features compares; give both")
        if len(parse_directions(self.rig)) > MOST_LIGHTS:
            raise UsageError(f"--lights {self.rig}: the light of a photo is solved for {MOST_LIGHTS} at most")
        if self.matte is not None and not self.matte.is_file():
            raise UsageError(f"--matte {self.matte}: no such file")
        if self.refine == "features":
            _feature_network(self.vgg_weights)


def of_other_photos(photo: PhotoOptions) -> PhotoOptions:
    """How photos are read whose light alone is wanted: what was said of the inputs is not said of them."""
    folder = photo.landmarks if photo.landmarks is not None and photo.landmarks.is_dir() else None
    return replace(photo, colourspace=None, face="largest", landmarks=folder)


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """A photo's light; the face as it explains it, a small texture [3, t, t]; and what to say of both."""

    light: "RigLight"
    evidence: "LightEvidence"
    explained: "Tensor"
    facts: dict[str, Any] = field(default_factory=dict)


def estimate_light_of(
    path: Path, image: "LinearImage", face: FittedFace, options: LightOptions
) -> LightEstimate:
    """The light of one fitted face of a photo."""
    from facerf_cli.light.rig_latlong import brightest_direction
    from facerf_cli.light.sphere import direction_to_azel

    try:
        face = _shown(image, face, options)
        of_field = options.reflectance == "field"
        estimate = _by_field(face, options) if of_field else _by_baseline(face, options)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    azel = [round(float(angle), 1) for angle in direction_to_azel(brightest_direction(estimate.light))]
    clipped, mask = estimate.evidence.clipped, estimate.evidence.mask
    residual = estimate.evidence.residual(estimate.explained)
    if residual > _UNEXPLAINED:
        log.warning(
            "%s: no light explains this face well (%.0f %% is left over); look at _light.png: perhaps the "
            "fit is off or something else was taken for a face",
            path,
            100 * residual,
        )
    facts = {
        "reflectance": options.reflectance,
        "brightest_azel_deg": azel,
        "residual": round(residual, 4),
        "clipped": round(float(clipped.any(0).sum() / mask.sum()), 4),
        "texels": int(mask.sum()),
    }
    return LightEstimate(estimate.light, estimate.evidence, estimate.explained, facts | estimate.facts)


@cache
def light_of_photo(path: Path, options: LightOptions) -> "RigLight":
    """The light of the (largest) face of a photo on disk, estimated once a process."""
    item = Item(path, Path(path.stem), path.stem)
    image = read_photo(item, options.photo)
    face = fit_faces(item, image, options.photo)[0]
    return estimate_light_of(path, image, face, options).light


def _shown(image: "LinearImage", face: FittedFace, options: LightOptions) -> FittedFace:
    """The face without what the photo's alpha or --matte leaves out."""
    from facerf_cli.cli.items.relit_images import read_matte
    from facerf_cli.pipeline import leave_out

    masks: list[np.ndarray] = [] if image.alpha is None else [image.alpha]
    if options.matte is not None:
        masks.append(read_matte(options.matte, image.pixels.shape[:2]))
    for mask in masks:
        shown = face.fit.crop.apply(mask[..., None])[..., 0]
        model = load_models_once(options.photo).face
        face = replace(face, texture=leave_out(model, face.fit, face.texture, shown))
    return face


def _by_field(face: FittedFace, options: LightOptions) -> LightEstimate:
    from facerf_cli.light.sphere import RigLight
    from facerf_cli.pipeline import light_evidence, refine_photo_light

    rig = parse_directions(options.rig)
    evidence = light_evidence(load_models_once(options.photo), face.texture, rig, options.keep_eyes)
    weights = evidence.least_squares(options.non_negative)
    facts: dict[str, Any] = {"lights": len(rig), "non_negative": options.non_negative, "features": None}
    if options.refine == "features":
        network, name = _feature_network(options.vgg_weights)
        before = evidence.residual(evidence.relit(weights))
        refined = refine_photo_light(evidence, weights, network, options.non_negative)
        weights = refined.weights
        facts |= {
            "features": name,
            "feature_loss": [float(f"{loss:.4g}") for loss in (refined.loss_before, refined.loss_after)],
            "refine_steps": refined.steps,
            "residual_before": round(before, 4),
        }
    return LightEstimate(RigLight(rig, weights), evidence, evidence.relit(weights), facts)


def _by_baseline(face: FittedFace, options: LightOptions) -> LightEstimate:
    from facerf_cli.baselines.explain import explain
    from facerf_cli.network.reflectance import resize
    from facerf_cli.pipeline import evidence_of_photo

    evidence = evidence_of_photo(face.texture, options.keep_eyes)
    explained = explain(options.reflectance, load_models_once(options.photo), face.fit, face.texture)
    light = explained.light
    texture = explained.reflectance.relit(light.directions, light.weights[None])
    facts = {"lights": len(light.directions), "non_negative": bool((light.weights >= 0).all())}
    return LightEstimate(light, evidence, resize(texture, evidence.photo.shape[-1])[0], facts)


@cache
def _feature_network(vgg_weights: str | None) -> "tuple[Layered, str]":
    """V_f where its weights were given, else the S_f that is shipped; and what the report calls it."""
    from facerf_cli.training.pretrained import load_light_features, load_vgg

    if vgg_weights is not None:
        return load_vgg(vgg_weights), "V_f (VGG-16, ImageNet)"
    return load_light_features(LIGHT_FEATURES), "S_f (shipped)"
