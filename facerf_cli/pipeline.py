"""From one photo to the face under any light, from any head pose: one function an arrow of the method.

photo -> crop_face -> fit_face -> unwrap_face (-> explain_photo) -> predict_olat -> weigh -> render_face
-> picture
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, FitStart, fit_landmarks, trust_inside
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles, grid_uv, interior_texture, region_mask
from facerf_cli.light.estimate import LightEvidence, RefinedLight, estimate_light, refine_light
from facerf_cli.light.quotient import Quotient
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.feature_networks import Layered
from facerf_cli.network.reflectance import ReflectanceNetwork, colour_cast, exposure_of
from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, sample_texture, unwrap

DEFAULT_CHECKPOINT = Path(__file__).parent / "assets" / "default.safetensors"
_DECODER_CHANNELS = 220  # that the decoder holds at once for each light, at its working side
_EXPLAINED_SIDE, _EXPLAINING_LIGHTS = 128, 50  # texels and lights for the estimate of a photo's light
_SEEN_WELL = 0.9  # of a small texel: the photo says what colour it is
_LIGHTS_ON_CPU = 4  # at a time; more of them leave the processor's cache and are slower


@dataclass(frozen=True)
class Models:
    """The face model, on the processor as all geometry is, and the trained networks on `device`."""

    face: MorphableModel
    network: ReflectanceNetwork | None  # what of these the checkpoint holds: a Reflectance Network,
    geometry: nn.Module | None  # a Geometry Network,
    diffuse: DiffuseNetwork | None  # the network of the baseline diffuse-sh
    checkpoint_name: str
    metadata: dict[str, Any]
    device: torch.device


@dataclass(frozen=True)
class FaceTexture:
    """A photo in the chart: texture [3, T, T], unseen texels filled; visible [T, T]; normals [3, T, T].

    The texture is scene-linear, `visible` in 0..1, normals are unit vectors in camera space.
    """

    texture: Tensor
    visible: Tensor
    normals: Tensor


def load_models(checkpoint: Path | None, face_model: str | Path, device: torch.device) -> Models:
    """Load what the arrows need; `checkpoint` None is the one shipped."""
    path = checkpoint or DEFAULT_CHECKPOINT
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    if not networks.keys() & {"reflectance", "diffuse_sh"}:
        raise InputError(f"{path}: holds no Reflectance Network; give one by `facerf train`")
    _require_builtin_coefficients(path, networks.get("geometry"))
    on_device: Any = {name: network.to(device).eval() for name, network in networks.items()}
    return Models(
        face=load_face_model(face_model),
        network=on_device.get("reflectance"),
        geometry=on_device.get("geometry"),
        diffuse=on_device.get("diffuse_sh"),
        checkpoint_name=path.stem,
        metadata=metadata,
        device=device,
    )


def _require_builtin_coefficients(path: Path, geometry: Any) -> None:
    """InputError where a Geometry Network regresses more coefficients than the built-in model has."""
    if geometry is None:
        return
    model, settings = load_face_model(BUILTIN), geometry.settings
    if settings.identity > len(model.identity) or settings.expression > len(model.expression):
        raise InputError(f"{path}: its Geometry Network is of another built-in face model; train it again")


def crop_face(photo: np.ndarray, landmarks_px: np.ndarray, size_px: int) -> tuple[Crop, np.ndarray]:
    """The square crop [size, size, 3] of a linear photo [H, W, 3] around landmarks [68, 2] in its pixels."""
    crop = from_landmarks(landmarks_px, size_px)
    return crop, crop.apply(photo)


@torch.no_grad()
def see_head(models: Models, cropped: np.ndarray) -> FitStart | None:
    """Where the Geometry Network sees the head in a crop [S, S, 3]; None where there is no such network."""
    if models.geometry is None:
        return None
    image = torch.from_numpy(cropped).permute(2, 0, 1)[None].to(models.device)
    return FitStart(*(tensor.cpu() for tensor in models.geometry(image)))


def fit_face(
    model: MorphableModel,
    crop: Crop,
    landmarks_px: np.ndarray,
    photo_shape: tuple[int, ...],
    start: FitStart | None = None,
) -> FaceFit:
    """Fit the face model to landmarks [68, 2] in the pixels of a photo [H, W, ...].

    `start` is what `see_head` found in the crop; without it the fit starts from the landmarks alone.
    """
    in_crop = crop.to_crop(landmarks_px)
    trust = trust_inside(in_crop, crop, *photo_shape[:2])
    return fit_landmarks(model, in_crop, crop, trust=trust, start=start)


def unwrap_face(
    model: MorphableModel,
    fit: FaceFit,
    cropped: np.ndarray,
    texture_side: int,
    photo_shape: tuple[int, ...],
) -> FaceTexture:
    """Unwrap the crop [S, S, 3] of a photo [H, W, ...] into the chart (paper, 'Network Architecture')."""
    vertices = fit.vertices_camera(model)
    inside = fit.crop.valid(*photo_shape[:2])  # beyond the photo the crop only repeats its border
    image = torch.from_numpy(np.dstack([cropped, inside.astype(np.float32)])).permute(2, 0, 1)
    unwrapped, visible = unwrap(image, vertices, grid_triangles(), fit.camera, texture_side)
    texture, visible = unwrapped[:3], visible * (unwrapped[3] > 0.99)
    if visible.max() < 0.5:
        raise InputError("the fitted face lies outside the picture; give its landmarks with --landmarks")
    normals = normal_map(vertices, grid_triangles(), texture_side)
    return FaceTexture(inpaint(texture, visible), visible, normals)


def leave_out(model: MorphableModel, fit: FaceFit, face: FaceTexture, shown: np.ndarray) -> FaceTexture:
    """The texture without what a mask [S, S] of the crop, 0 to 1, leaves out: filled in from around it."""
    mask = torch.from_numpy(shown.astype(np.float32))[None]
    side = face.texture.shape[-1]
    kept = unwrap(mask, fit.vertices_camera(model), grid_triangles(), fit.camera, side)[0][0]
    visible = face.visible * (kept > _SEEN_WELL)
    if visible.max() < 0.5:
        raise InputError("the face is masked out: nothing of it is left to look at")
    return FaceTexture(inpaint(face.texture, visible), visible, face.normals)


def explain_photo(models: Models, face: FaceTexture) -> Quotient:
    """What the field lacks of the face's own photo, for `predict_olat` to give back.

    The photo's light is estimated over a coarse rig, on small textures.
    """
    small = _shrunk(face)
    olats = torch.cat(list(predict_olat(models, small, _coarse_rig())))
    seen = small.visible > _SEEN_WELL
    weights = estimate_light(olats[..., seen], small.texture[:, seen])
    return Quotient.of(small.texture, weigh(olats, weights[None])[0], small.visible)


def estimate_photo_light(
    models: Models, face: FaceTexture, rig: Tensor, non_negative: bool = True, keep_eyes: bool = False
) -> RigLight:
    """The light of the face's photo over lights [L, 3] (paper, Eq. leastsq).

    Not `non_negative`: the paper's plain least squares. InputError where there is no face to read it from.
    """
    evidence = light_evidence(models, face, rig, keep_eyes)
    return RigLight(rig, evidence.least_squares(non_negative))


def light_evidence(models: Models, face: FaceTexture, rig: Tensor, keep_eyes: bool = False) -> LightEvidence:
    """What the light of the face's photo is read from, over lights [L, 3], on small textures."""
    seen = evidence_of_photo(face, keep_eyes)
    return replace(seen, directions=rig, olats=torch.cat(list(predict_olat(models, _shrunk(face), rig))))


def evidence_of_photo(face: FaceTexture, keep_eyes: bool = False) -> LightEvidence:
    """The photo's side of the evidence, without any light; InputError where too little of a face is seen.

    The mask is the interior of the face where the photo shows it well. Without `keep_eyes` the eyes are left
    out, for the field of open eyes is not learnt (paper, 'Results').
    """
    small = _shrunk(face)
    mask = (small.visible > _SEEN_WELL) & (interior_texture(_EXPLAINED_SIDE)[0] > 0.5)
    if not keep_eyes:
        mask &= region_mask("eyes", _EXPLAINED_SIDE) < 0.5
    evidence = LightEvidence(torch.zeros(0, 3), torch.zeros(0, 3, *mask.shape), small.texture, mask)
    evidence.require_a_face()
    return evidence


def refine_photo_light(
    evidence: LightEvidence, start: Tensor, network: Layered, non_negative: bool = True
) -> RefinedLight:
    """`refine_light` from weights [L, 3] by V_f or S_f, at the exposure at which these are trained."""
    exposure = exposure_of(evidence.photo[None], evidence.mask[None, None].float())
    return refine_light(evidence, start, lambda linear: network.layers(linear / exposure), non_negative)


def _shrunk(face: FaceTexture) -> FaceTexture:
    """The texture at the side at which light is estimated."""
    side = (_EXPLAINED_SIDE, _EXPLAINED_SIDE)
    fields = torch.cat([face.texture, face.visible[None], face.normals])[None]
    small = F.interpolate(fields, side, mode="area")[0]
    return FaceTexture(small[:3], small[3], F.normalize(small[4:], dim=0))


@cache
def _coarse_rig() -> Tensor:
    return rig_directions(_EXPLAINING_LIGHTS)


@torch.no_grad()
def predict_olat(
    models: Models,
    face: FaceTexture,
    lights: Tensor,
    turn: Tensor | None = None,
    memory_bytes: int = 2 << 30,
    bf16: bool = False,
    quotient: Quotient | None = None,
) -> Iterator[Tensor]:
    """OLAT textures for unit camera-space lights [L, 3], in batches [l, 3, T, T] that fit `memory_bytes`.

    `turn` [3, 3] rotates the head from its pose in the photo to the target's: N_t = turn N_s. `quotient` is
    what `explain_photo` found; without it they are the network's own.
    """
    network, device, texels = models.network, models.device, face.texture.shape[-1] ** 2
    if network is None:
        raise UsageError(
            f"{models.checkpoint_name}: a checkpoint without a Reflectance Network, which the field needs; "
            "give --reflectance diffuse-sh with it, or another --checkpoint"
        )
    most = _LIGHTS_ON_CPU if device.type == "cpu" else len(lights)
    bytes_per_light = 4 * (_DECODER_CHANNELS * network.settings.side**2 + 16 * texels)
    batch = max(1, min(most, memory_bytes // bytes_per_light))
    normals = face.normals if turn is None else torch.einsum("dc,cij->dij", turn, face.normals)
    normals = normals[None].to(device)
    visible = face.visible[None, None]
    texture = face.texture[None] / colour_cast(face.texture[None], visible)
    source = (texture, face.normals[None], visible)
    with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
        encoded = network.encode(*(tensor.to(device) for tensor in source))
    for chunk in torch.split(lights, batch):
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):  # not around a yield: it would leak
            olats = network.decode(encoded, normals, chunk[None].to(device))[0]
        olats = olats.float().cpu()
        yield quotient.corrected(olats) if quotient else olats


def weigh(olats: Tensor, weights: Tensor) -> Tensor:
    """Sum of OLATs [L, 3, ...] with rgb weights [M, L, 3]: M pictures [M, 3, ...] (paper, 'Relighting')."""
    flat = torch.einsum("mlc,lcn->mcn", weights, olats.flatten(2))
    return flat.view(*flat.shape[:2], *olats.shape[2:])


def weigh_batches(batches: Iterable[Tensor], weights: Tensor) -> Tensor:
    """`weigh` of OLATs [L, 3, T, T] that come in batches, so that they are never all held: [M, 3, T, T].

    Pictures are weighed as textures and rendered after, for a render costs more than a texture's product.
    """
    total, done = torch.zeros(()), 0
    for olats in batches:
        total = total + weigh(olats, weights[:, done : done + len(olats)])
        done += len(olats)
    return total


def turn_to(fit: FaceFit, rotation: Tensor) -> Tensor:
    """The turn [3, 3] of camera-space vectors that takes the fit's head to `rotation` (head_to_camera)."""
    return rotation @ fit.rotation.T


def see_face(vertices_camera: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The (u, v) that each pixel of a picture sees [H, W, 2], and the face's coverage [H, W], 0 or 1."""
    fragments = rasterize(vertices_camera, grid_triangles(), camera)
    return interpolate(grid_uv(), grid_triangles(), fragments), fragments.covered.float()


def render_face(textures: Tensor, uv: Tensor, coverage: Tensor) -> Tensor:
    """Pictures [N, C, H, W] of textures [N, C, T, T] on a face seen by `see_face`, black beyond it."""
    images = sample_texture(textures.flatten(0, 1), uv) * coverage[..., None]  # [H, W, N C]
    return images.permute(2, 0, 1).reshape(*textures.shape[:2], *coverage.shape)
