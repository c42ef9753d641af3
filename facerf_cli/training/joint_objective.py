"""Heads as the Geometry Network finds them: meshes in the fixed camera, landmarks, textures and pictures.

The differentiable path of the joint stage, from coefficients and pose to pixels (paper, 'Network
Architecture'): gradients run through the mesh, the unwrapped texture, the normals and the rendered picture.
Which vertex is a contour landmark, which texel is seen and which triangle a pixel sees are constants.

Stage `joint`: both networks through the differentiable rasterizer, under all of the paper's terms.

Source and target crops give two heads; the source unwrapped with its own, relit by the Reflectance Network
and rendered with the target's is compared with the target (paper, 'Loss Functions'). A share of the batches
are photos of faces, for the terms of geometry alone (paper, 'Training').
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.dataset.crops import CropPairs, open_pairs, spread_pairs
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair
from facerf_cli.dataset.photos import PhotoCrops, Photos
from facerf_cli.dataset.samples import DatasetTextures, provenance_of
from facerf_cli.face.silhouette import silhouette_ids
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import (
    CONTOUR,
    INNER_MOUTH_CORNERS,
    OUTER_EYE_CORNERS,
    grid_triangles,
    grid_uv,
    interior_mask,
)
from facerf_cli.network.feature_networks import FeatureNetwork
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.network.inputs import resize
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork
from facerf_cli.raster.camera import Camera, crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import UnwrapSettings, inpaint, normal_map, sample_texture, unwrap
from facerf_cli.training.losses import (
    PaperWeights,
    Seen,
    appearance_loss,
    clipped_si_mse,
    landmark_loss,
    light_loss,
    photometric_loss,
    regularisation,
    slid_contour,
)
from facerf_cli.training.objective import Objective, Validation, concatenate, seeded
from facerf_cli.training.pretrained import VGG16_LICENCE

FIXED_LANDMARKS = tuple(i for i in range(len(CONTOUR), 68) if i not in INNER_MOUTH_CORNERS)
LANDMARKS = (*CONTOUR, *FIXED_LANDMARKS)  # the paper's 66 (Saragih et al., 2011), sliding ones first

_DEPTH_PX, _DEPTH_PER_PX = 512, 3  # side of the depth map at most, and for small crops in crop pixels


@dataclass(frozen=True)
class PosedHeads:
    """B meshes in camera space [B, V, 3], their rotations head_to_camera [B, 3, 3] and fixed landmarks."""

    vertices: Tensor
    rotation: Tensor
    fixed_landmarks: Tensor  # [B, 49, 3] camera space

    def landmarks_px(self, detected_px: Tensor, camera: Camera) -> Tensor:
        """L(v): where the 66 `LANDMARKS` lie [B, 66, 2]; detected_px [B, 68, 2] tells the contour's place."""
        px = project(self.vertices, camera)
        outline = silhouette_ids(px, self.rotation)
        outline_px = px.gather(1, outline[..., None].expand(-1, -1, 2))
        contour_px = slid_contour(outline_px, detected_px[:, list(CONTOUR)])
        return torch.cat([contour_px, project(self.fixed_landmarks, camera)], 1)


def pose_heads(model: MorphableModel, estimate: GeometryEstimate, mean_face: bool = False) -> PosedHeads:
    """v^c = R v(alpha, beta) + t of the leading shapes of the model; `mean_face` leaves the shapes out."""
    head = leading(model, estimate.alpha.shape[1], estimate.beta.shape[1])
    alpha, beta = estimate.alpha, estimate.beta
    if mean_face:
        alpha, beta = torch.zeros_like(alpha), torch.zeros_like(beta)
    turned = head.vertices(alpha, beta) @ estimate.rotation.mT
    vertices = turned + estimate.translation_m[:, None]
    return PosedHeads(vertices, estimate.rotation, head.landmarks(vertices)[:, list(FIXED_LANDMARKS)])


def leading(model: MorphableModel, identities: int, expressions: int) -> MorphableModel:
    """The model without the shapes that a Geometry Network of so many coefficients does not know."""
    return MorphableModel(
        model.name,
        model.licence,
        model.mean,
        model.identity[:identities],
        model.expression[:expressions],
        model.expression_names[:expressions],
    )


@dataclass(frozen=True)
class Unwrapped:
    """B textures [B, 3, T, T], unseen texels filled; how well seen [B, 1, T, T]; normals [B, 3, T, T]."""

    texture: Tensor
    visible: Tensor
    normals: Tensor


def unwrap_images(images: Tensor, heads: PosedHeads, camera: Camera, side: int) -> Unwrapped:
    """T_s and N_s of pictures [B, 3, S, S] of the heads."""
    triangles = grid_triangles().to(images.device)
    settings = UnwrapSettings(depth_side_px=min(_DEPTH_PX, _DEPTH_PER_PX * camera.width_px))
    faces = []
    for image, vertices in zip(images, heads.vertices, strict=True):
        texture, visible = unwrap(image, vertices, triangles, camera, side, settings)
        faces.append((inpaint(texture, visible), visible[None], normal_map(vertices, triangles, side)))
    textures, seen, normals = (torch.stack(parts) for parts in zip(*faces, strict=True))
    return Unwrapped(textures, seen, normals)


def head_normals(heads: PosedHeads, side: int) -> Tensor:
    """N_t: camera-space normal maps [B, 3, T, T] of the heads."""
    triangles = grid_triangles().to(heads.vertices.device)
    return torch.stack([normal_map(vertices, triangles, side) for vertices in heads.vertices])


def render_textures(textures: Tensor, heads: PosedHeads, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pictures [B, C, S, S] of textures [B, C, T, T] on the heads, and M_t [B, 1, S, S] in 0..1."""
    device = textures.device
    triangles, uv = grid_triangles().to(device), grid_uv().to(device)
    images, masks = [], []
    for texture, vertices in zip(textures, heads.vertices, strict=True):
        fragments = rasterize(vertices, triangles, camera)
        seen_uv = interpolate(uv, triangles, fragments)
        covered = fragments.covered[..., None].to(texture.dtype)
        images.append((sample_texture(texture, seen_uv) * covered).permute(2, 0, 1))
        masks.append(interior_mask(vertices, fragments, seen_uv, texture.shape[-1]))
    return torch.stack(images), torch.stack(masks)


_PAPER = PaperWeights()
_DARK = 1e-4  # radiance; networks take square roots, whose slope ends before it is infinite
_SHEET_ROWS, _SHEET_PX = 8, 256


@dataclass(frozen=True)
class JointSettings:
    """The paper's, but for what the ablations leave out."""

    crop_px: int = 512
    texture_side: int = 512
    photos_share: float = 0.2  # of the batches, where there are photos
    mean_face: bool = False  # pose alone: alpha = beta = 0 (paper, 'Ablative Study')
    weights: PaperWeights = _PAPER
    validation_pairs: int = 12  # of each kind: the source's own pose, and another
    seed: int = 0


@dataclass(frozen=True)
class _Relit:
    """What both networks make of pairs of crops."""

    target: PosedHeads
    texture: Tensor  # [B, 3, T, T] predicted
    image: Tensor  # [B, 3, S, S], it rendered
    mask: Tensor  # [B, 1, S, S] M_t


class JointObjective(Objective):
    """The paper's loss over a prepared dataset's pairs, and photos.

    `model` is the one whose coefficients the Geometry Network gives: the built-in one, for whoever takes its
    heads for a start (`face/fit.py`). `appearance` is V_f, `light` S_f; without one its term is left
    out. They are frozen, and are not saved.
    """

    def __init__(
        self,
        dataset: Dataset,
        model: MorphableModel,
        reflectance: nn.Module,
        geometry: nn.Module,
        appearance: nn.Module | None = None,
        light: nn.Module | None = None,
        photos: Photos | None = None,
        settings: JointSettings = JointSettings(),
    ) -> None:
        super().__init__()
        self.networks = nn.ModuleDict({"reflectance": reflectance, "geometry": geometry})
        self.chooses_by = "si_mse"
        self.provenance = _provenance(dataset, model, photos, appearance is not None, light is not None)
        self.settings = settings
        self.photos = photos
        self.skips_networks = photos is not None  # which teach the geometry alone
        self.feature_networks = nn.ModuleDict(
            {
                name: network.requires_grad_(False).eval()
                for name, network in (("appearance", appearance), ("light", light))
                if network is not None
            }
        )
        self.camera = crop_camera(settings.crop_px)
        self._model = model
        self._train = open_pairs(dataset, "train", settings.crop_px)
        self._held_out = open_pairs(dataset, "validation", settings.crop_px)
        self._validation: dict[str, list[CropPairs]] | None = None
        if isinstance(reflectance, DefaultReflectanceNetwork) and not reflectance.mean_normals.any():
            rig_lights = reflectance.settings.rig_lights
            reflectance.set_mean_face(*DatasetTextures(dataset, model, 0, {}, {}, rig_lights).mean_face())

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """The networks' own functions alone: shapes in the rasterizer depend on what is seen."""
        called = {"reflectance": ("encode", "decode"), "geometry": ("forward",)}
        for name, network in (*self.networks.items(), *self.feature_networks.items()):
            for function in called.get(name, ("layers",)):
                setattr(network, function, torch.compile(getattr(network, function), *args, **kwargs))

    def draw(
        self, count: int, generator_of: Callable[[int], torch.Generator], step: int
    ) -> CropPairs | PhotoCrops:
        """`count` pairs, or, on `photos_share` of the steps, photos."""
        generators = [generator_of(i) for i in range(count)]
        chance = torch.rand((), generator=seeded(self.settings.seed, step))
        if self.photos is not None and chance < self.settings.photos_share:
            return concatenate([self.photos.draw(generator) for generator in generators])
        return concatenate([self._train.draw(generator) for generator in generators])

    def forward(self, batch: CropPairs | PhotoCrops) -> dict[str, Tensor]:
        """The weighed terms: landmarks and regularisation of either, the others of pairs alone."""
        if isinstance(batch, PhotoCrops):
            estimate, heads = self._heads(batch.crops)
            terms = self._geometry_terms(estimate, heads, batch.landmarks_px)
            return {name: term.mean() for name, term in terms.items()}
        estimate, heads = self._heads(torch.cat([batch.source, batch.target]))
        detected_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
        terms = self._geometry_terms(estimate, heads, detected_px)
        # a mean over twice the samples, times two: source and target each add theirs
        result = {name: 2 * term.mean() for name, term in terms.items()}
        relit = self._relit(batch, heads)
        return result | {name: term.mean() for name, term in self._image_terms(batch, relit).items()}

    def _heads(self, crops: Tensor) -> tuple[GeometryEstimate, PosedHeads]:
        with self.mixed_precision():
            raw = self.networks["geometry"](crops)
        estimate = GeometryEstimate(*(tensor.float() for tensor in raw))
        if self._model.mean.device != crops.device:
            self._model = self._model.to(crops.device)
        return estimate, pose_heads(self._model, estimate, self.settings.mean_face)

    def _geometry_terms(
        self, estimate: GeometryEstimate, heads: PosedHeads, detected_px: Tensor
    ) -> dict[str, Tensor]:
        """L_l and L_r of each picture [B]."""
        weights = self.settings.weights
        found_px = heads.landmarks_px(detected_px, self.camera)
        landmarks = landmark_loss(found_px, detected_px[:, list(LANDMARKS)], self.settings.crop_px)
        terms = {"landmarks": weights.landmarks * landmarks}
        if not self.settings.mean_face:
            prior = regularisation(estimate.alpha, estimate.beta, weights)
            terms["regularisation"] = weights.regularisation * prior
        return terms

    def _relit(self, batch: CropPairs, heads: PosedHeads) -> _Relit:
        """The sources of pairs in the light and pose of their targets; heads are of both, sources first."""
        side, count = self.settings.texture_side, len(batch.source)
        source, target = _part(heads, slice(None, count)), _part(heads, slice(count, None))
        face = unwrap_images(batch.source, source, self.camera, side)
        normals = head_normals(target, side)
        network: Any = self.networks["reflectance"]
        with self.mixed_precision():
            encoded = network.encode(face.texture.clamp_min(_DARK), face.normals, face.visible)
            texture = network.decode(encoded, normals, batch.light[:, None])[:, 0]
        image, mask = render_textures(texture.float(), target, self.camera)
        return _Relit(target, texture.float(), image, mask)

    def _image_terms(self, batch: CropPairs, relit: _Relit) -> dict[str, Tensor]:
        """L_p, L_I and L_L of each pair [B]."""
        weights = self.settings.weights
        photometric = photometric_loss(relit.image, batch.target, relit.mask)
        terms = {"photometric": weights.photometric * photometric}
        if not self.feature_networks:
            return terms
        with torch.no_grad():
            truth = unwrap_images(batch.target, relit.target, self.camera, self.settings.texture_side)
        texture = Seen(relit.texture, truth.texture, (truth.visible > 0).float())
        with self.mixed_precision():
            if "appearance" in self.feature_networks:
                image = Seen(relit.image, batch.target, relit.mask)
                appearance = appearance_loss(self._features("appearance"), image, texture)
                terms["appearance_features"] = weights.features * appearance
            if "light" in self.feature_networks:
                terms["light_features"] = weights.features * light_loss(self._features("light"), texture)
        return terms

    def _features(self, name: str) -> FeatureNetwork:
        network: Any = self.feature_networks[name]
        return network

    @torch.no_grad()
    def validate(self) -> Validation:
        """Si-MSE in the image, clipped at white, for the source's own pose and another; and landmarks.

        `landmarks_iod` is the mean distance of the 66 over that of the outer eye corners.
        """
        if self._validation is None:
            self._validation = self._held_out_pairs()
        metrics: dict[str, float] = {}
        errors, distances, rows = [], [], []
        device = next(self.networks.parameters()).device
        for kind, pairs in self._validation.items():
            of_kind = []
            for index, pair in enumerate(pairs):
                batch = pair.to(device)
                _, heads = self._heads(torch.cat([batch.source, batch.target]))
                relit = self._relit(batch, heads)
                of_kind.append(clipped_si_mse(relit.image[:, None], batch.target[:, None], relit.mask))
                distances.append(_landmark_error(heads, batch, self.camera))
                if index % max(1, 2 * len(pairs) // _SHEET_ROWS) == 0:
                    rows.append(_sheet_row(batch, relit, self.camera))
            metrics[f"si_mse_{kind}"] = float(torch.cat(of_kind).mean())
            metrics[f"si_mse_{kind}_std"] = float(torch.cat(of_kind).std(correction=0))
            errors += of_kind
        metrics["si_mse"] = float(torch.cat(errors).mean())
        metrics["landmarks_iod"] = float(torch.cat(distances).mean())
        return Validation(metrics, np.concatenate(rows))

    def _held_out_pairs(self) -> dict[str, list[CropPairs]]:
        """By kind, what the validation looks at; a dataset of one camera has no other pose."""

        def same(pair: Pair) -> bool:
            return pair.source_camera == pair.target_camera

        kinds = {"same_pose": same, "other_pose": lambda pair: not same(pair)}
        chosen = {
            kind: spread_pairs(self._held_out, self.settings.validation_pairs, wanted)
            for kind, wanted in kinds.items()
        }
        return {
            kind: [self._held_out.read(pair) for pair in pairs] for kind, pairs in chosen.items() if pairs
        }


def _part(heads: PosedHeads, which: slice) -> PosedHeads:
    return PosedHeads(heads.vertices[which], heads.rotation[which], heads.fixed_landmarks[which])


def _landmark_error(heads: PosedHeads, batch: CropPairs, camera: Camera) -> Tensor:
    """Mean distance of the 66 landmarks over that of the outer eye corners, of sources and targets [2 B]."""
    detected_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
    distance_px = (heads.landmarks_px(detected_px, camera) - detected_px[:, list(LANDMARKS)]).norm(dim=-1)
    left, right = (detected_px[:, corner] for corner in OUTER_EYE_CORNERS)
    return distance_px.mean(1) / (left - right).norm(dim=-1)


def _sheet_row(batch: CropPairs, relit: _Relit, camera: Camera) -> np.ndarray:
    """Source, target, prediction in M_t, and the target's normals as found [S, 4 S, 3] of the first pair."""
    normals = head_normals(relit.target, _SHEET_PX)
    shape, _ = render_textures((normals + 1) / 4, relit.target, camera)
    images = (batch.source, batch.target, relit.image * relit.mask, shape)
    row = torch.cat([resize(image[:1], min(_SHEET_PX, camera.width_px))[0] for image in images], -1)
    result: np.ndarray = row.permute(1, 2, 0).cpu().numpy()
    return result


def _provenance(
    dataset: Dataset, model: MorphableModel, photos: Photos | None, appearance: bool, light: bool
) -> dict[str, Any]:
    """The dataset's, and what else the networks learnt from."""
    terms = [name for name, there in ((f"V_f, {VGG16_LICENCE}", appearance), ("S_f", light)) if there]
    found = {"feature_losses": terms, "photos": len(photos.paths) if photos else 0}
    return provenance_of(dataset, model) | found
