"""Stage `joint`: both networks, through the differentiable rasterizer, with all of the paper's loss terms.

The Geometry Network estimates a head for the source and one for the target crop. The source is unwrapped
with its head, relit by the Reflectance Network, rendered with the target's head and compared with the target
(paper, 'Loss Functions'). Some of the batches are photos, which train only the geometry ('Training').
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, collect_items
from facerf_cli.dataset.crops import (
    CropPairs,
    mean_translation_m,
    open_pairs,
    require_crops,
    spread_pairs,
    unwrap_crops,
)
from facerf_cli.dataset.dataset import Dataset, provenance_of
from facerf_cli.dataset.faces import mean_face_of
from facerf_cli.dataset.pairs import Pair
from facerf_cli.dataset.photos import PhotoCrops, Photos, open_photos
from facerf_cli.errors import UsageError
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import (
    CONTOUR,
    INNER_MOUTH_CORNERS,
    OUTER_EYE_CORNERS,
    grid_triangles,
    grid_uv,
    interior_mask,
    on_device,
    silhouette_ids,
)
from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.network.features import FEATURE_LAYERS, TrainedFeatures, VggFeatures, layer_powers
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.network.inputs import SourceColours, resize, without_cast
from facerf_cli.network.vgg import VGG16_LICENCE, load_vgg
from facerf_cli.raster.camera import Camera, crop_camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, sample_texture
from facerf_cli.training.losses import (
    Features,
    MaskedPair,
    PaperWeights,
    channels_apart,
    clipped_si_mse,
    colour_shares,
    landmark_loss,
    load_features,
    photometric_loss,
    regularisation,
    slid_contour,
)
from facerf_cli.training.objective import Objective, Validation, seeded, tiled
from facerf_cli.training.processes import broadcast_from_first, process_rank
from facerf_cli.training.run import Run

FIXED_LANDMARKS = tuple(i for i in range(len(CONTOUR), 68) if i not in INNER_MOUTH_CORNERS)
LANDMARKS = (*CONTOUR, *FIXED_LANDMARKS)  # the paper's 66 (Saragih et al., 2011), the contour's first


def chosen(points: Tensor, landmarks: tuple[int, ...]) -> Tensor:
    """Select some of the 68 landmarks [B, 68, C]."""
    return points.index_select(1, on_device(points.device, torch.tensor, landmarks))


@dataclass(frozen=True)
class PosedHeads(Batch):
    """B meshes in camera space [B, V, 3], rotations head_to_camera [B, 3, 3] and fixed landmarks."""

    vertices: Tensor
    rotation: Tensor
    fixed_landmarks: Tensor  # [B, 49, 3] camera space

    def landmarks_px(self, detected_px: Tensor, camera: Camera) -> Tensor:
        """L(v): the 66 `LANDMARKS` [B, 66, 2]; contour ones slide to the detected landmarks [B, 68, 2]."""
        px = project(self.vertices, camera)
        outline = silhouette_ids(px, self.rotation)
        outline_px = px.gather(1, outline[..., None].expand(-1, -1, 2))
        contour_px = slid_contour(outline_px, chosen(detected_px, CONTOUR))
        return torch.cat([contour_px, project(self.fixed_landmarks, camera)], 1)


def pose_heads(model: MorphableModel, estimate: GeometryEstimate) -> PosedHeads:
    """v^c = R v(alpha, beta) + t, with as many leading shapes of the model as there are coefficients."""
    identities, expressions = estimate.alpha.shape[1], estimate.beta.shape[1]
    head = replace(
        model,
        identity=model.identity[:identities],
        expression=model.expression[:expressions],
        expression_names=model.expression_names[:expressions],
    )
    rotated = head.vertices(estimate.alpha, estimate.beta) @ estimate.rotation.mT
    vertices = rotated + estimate.translation_m[:, None]
    return PosedHeads(vertices, estimate.rotation, chosen(head.landmarks(vertices), FIXED_LANDMARKS))


@dataclass(frozen=True)
class UnwrappedHeads(Batch):
    """B unwrapped heads: textures with unseen texels filled, visibility and normals, [B, C, T, T]."""

    texture: Tensor
    visible: Tensor
    normals: Tensor


def unwrap_images(images: Tensor, heads: PosedHeads, side: int) -> UnwrappedHeads:
    """Unwrap images [B, 3, S, S] of the heads: T_s and N_s."""
    texture, visible = unwrap_crops(images, heads.vertices, side)
    return UnwrappedHeads(inpaint(texture, visible), visible[:, None], head_normals(heads, side))


def head_normals(heads: PosedHeads, side: int) -> Tensor:
    """Camera-space normal maps [B, 3, T, T] of the heads: N_t."""
    return normal_map(heads.vertices, on_device(heads.vertices.device, grid_triangles), side)


def render_textures(textures: Tensor, heads: PosedHeads, camera: Camera) -> tuple[Tensor, Tensor]:
    """Render textures [B, C, T, T] on the heads: images [B, C, S, S] and masks M_t [B, 1, S, S] in 0..1."""
    triangles, uv = (on_device(textures.device, constant) for constant in (grid_triangles, grid_uv))
    fragments = rasterize(heads.vertices, triangles, camera)
    seen_uv = interpolate(uv, triangles, fragments)
    images = (sample_texture(textures, seen_uv) * fragments.covered[..., None]).permute(0, 3, 1, 2)
    return images, interior_mask(heads.vertices, fragments, seen_uv, textures.shape[-1])


_PAPER = PaperWeights()
_DARKEST = 1e-4  # least radiance; networks take square roots, whose slope at 0 is infinite
_COLOURS_MEASURED, _TARGETS_MEASURED = 192, 8  # sources and targets
_SHEET_ROWS, _SHEET_PX = 8, 256


@dataclass(frozen=True)
class JointSettings:
    """Settings of the stage; the defaults are the paper's."""

    crop_px: int = 512
    texture_side: int = 512
    photos_share: float = 0.2  # of the batches, if photos are given
    weights: PaperWeights = _PAPER
    validation_pairs: int = 48  # of each kind: same pose as the source, other pose
    seed: int = 0


@dataclass(frozen=True)
class _Relit:
    """Prediction of both networks for pairs of crops."""

    target: PosedHeads
    texture: Tensor  # [B, 3, T, T] predicted
    image: Tensor  # [B, 3, S, S] the texture rendered
    mask: Tensor  # [B, 1, S, S] M_t
    truth: UnwrappedHeads  # the targets unwrapped, where a loss compares textures


class JointObjective(Objective):
    """Minimise the paper's loss on a prepared dataset's pairs, and on photos.

    Without `geometry`, heads are fitted to the crops' landmarks, and the geometry terms are omitted. `model`
    is the face model of the coefficients. `appearance` is V_f, `light` S_f; without one, its term is omitted.
    They are frozen and not saved.
    """

    chooses_by = "si_mse"

    def __init__(
        self,
        dataset: Dataset,
        model: MorphableModel,
        reflectance: nn.Module,
        geometry: nn.Module | None,
        appearance: nn.Module | None = None,
        light: nn.Module | None = None,
        photos: Photos | None = None,
        settings: JointSettings = JointSettings(),
    ) -> None:
        trained = {"reflectance": reflectance} | ({} if geometry is None else {"geometry": geometry})
        super().__init__(trained, _provenance(dataset, model, photos, appearance, light))
        self.settings = settings
        self.photos = photos
        self.skips_networks = photos is not None  # photos train only the geometry
        self.feature_networks = nn.ModuleDict(
            {
                name: network.requires_grad_(False).eval()
                for name, network in (("appearance", appearance), ("light", light))
                if network is not None
            }
        )
        self.features: dict[str, Features] = {}
        self.camera = crop_camera(settings.crop_px)
        self._model = self._fitted = model  # on the device of training, and on the CPU
        self._train = open_pairs(dataset, "train", settings.crop_px)
        self._held_out = open_pairs(dataset, "validation", settings.crop_px)
        sides = {"texture_side": settings.texture_side, "crop_px": settings.crop_px}
        self.inputs = {"geometry": "landmarks" if geometry is None else "network", **sides}
        self.source_colours = SourceColours.of(self._train.source_colours(_COLOURS_MEASURED))
        self._validation: dict[str, list[CropPairs]] | None = None
        network: Any = reflectance  # of any form (`network/reflectance.py`)
        if network.rig_lights and not network.has_mean_face:
            network.set_mean_face(*mean_face_of(model, network.rig_lights))

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compile only the networks; shapes in the rasterizer depend on the camera's view."""
        called = {"reflectance": ("encode", "decode"), "geometry": ("forward",)}
        for name, network in (*self.networks.items(), *self.feature_networks.items()):
            for function in called.get(name, ("layers",)):
                setattr(network, function, torch.compile(getattr(network, function), *args, **kwargs))

    def draw(
        self, count: int, generator_of: Callable[..., torch.Generator], step: int
    ) -> CropPairs | PhotoCrops:
        """Draw `count` pairs or, on `photos_share` of the steps, photos."""
        chance = torch.rand((), generator=seeded(self.settings.seed, step))
        if self.photos is not None and chance < self.settings.photos_share:
            return concatenate([self.photos.draw(generator_of(i)) for i in range(count)])
        return self._train.draw(count, generator_of, step)

    def forward(self, batch: CropPairs | PhotoCrops) -> dict[str, Tensor]:
        """Compute the weighted terms: landmarks and regularisation for both, the others only for pairs."""
        if isinstance(batch, PhotoCrops):
            terms = self._geometry_terms(*self._heads(batch.crops, batch.landmarks_px), batch.landmarks_px)
            return {name: term.mean() for name, term in terms.items()}
        detected_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
        estimate, heads = self._heads(torch.cat([batch.source, batch.target]), detected_px)
        terms = self._geometry_terms(estimate, heads, detected_px) if self._regresses else {}
        # times two: the mean is over twice the samples, because source and target each add their terms
        result = {name: 2 * term.mean() for name, term in terms.items()}
        relit = self._relit(batch, heads)
        return result | {name: term.mean() for name, term in self._image_terms(batch, relit).items()}

    @property
    def _regresses(self) -> bool:
        return "geometry" in self.networks

    def _heads(self, crops: Tensor, detected_px: Tensor) -> tuple[GeometryEstimate, PosedHeads]:
        """Regress the heads of crops [B, 3, S, S], or fit them to landmarks [B, 68, 2]."""
        if self._regresses:
            with self.mixed_precision():
                raw = self.networks["geometry"](crops)
        else:
            fit = fit_batch(self._fitted, detected_px.cpu(), self.camera)
            raw = (fit.rotation, fit.translation_m, fit.alpha, fit.beta)
        estimate = GeometryEstimate(*(tensor.float().to(crops.device) for tensor in raw))
        if self._model.mean.device != crops.device:
            self._model = self._model.to(crops.device)
        return estimate, pose_heads(self._model, estimate)

    def _geometry_terms(
        self, estimate: GeometryEstimate, heads: PosedHeads, detected_px: Tensor
    ) -> dict[str, Tensor]:
        """L_l and L_r of each image [B]."""
        weights = self.settings.weights
        found_px = heads.landmarks_px(detected_px, self.camera)
        landmarks = landmark_loss(found_px, chosen(detected_px, LANDMARKS), self.settings.crop_px)
        terms = {"landmarks": weights.landmarks * landmarks}
        if estimate.alpha.shape[1] + estimate.beta.shape[1]:  # none with the mean face
            prior = regularisation(estimate.alpha, estimate.beta, weights)
            terms["regularisation"] = weights.regularisation * prior
        return terms

    def _relit(self, batch: CropPairs, heads: PosedHeads) -> _Relit:
        """Relight and pose the sources of pairs as their targets; `heads` are of both, sources first.

        Sources and targets are unwrapped together, so that the device waits only once for the host.
        """
        side, count = self.settings.texture_side, len(batch.source)
        target = heads.each(lambda x: x[count:])
        images = torch.cat([batch.source, batch.target]) if self.feature_networks else batch.source
        faces = unwrap_images(images, heads.each(lambda x: x[: len(images)]), side)
        face = faces.each(lambda x: x[:count])
        network: Any = self.networks["reflectance"]
        with self.mixed_precision():
            plain = without_cast(face.texture.clamp_min(_DARKEST), face.visible, self.source_colours)
            encoded = network.encode(plain, face.normals, face.visible)
            texture = network.decode(encoded, head_normals(target, side), batch.light[:, None])[:, 0]
        image, mask = render_textures(texture.float(), target, self.camera)
        truth = faces.each(lambda x: x[count:].detach())
        return _Relit(target, texture.float(), image, mask, truth)

    def _image_terms(self, batch: CropPairs, relit: _Relit) -> dict[str, Tensor]:
        """L_p, L_I and L_L of each pair [B]."""
        weights = self.settings.weights
        photometric = photometric_loss(relit.image, batch.target, relit.mask)
        terms = {"photometric": weights.photometric * photometric}
        if not self.feature_networks:
            return terms
        texture = MaskedPair(relit.texture, relit.truth.texture, (relit.truth.visible > 0).float())
        with self.mixed_precision():
            if "appearance" in self.feature_networks:
                image, features = (
                    MaskedPair(relit.image, batch.target, relit.mask),
                    self.features["appearance"],
                )
                appearance = image.distance(features) + texture.distance(features)
                terms["appearance_features"] = weights.features * appearance
            if "light" in self.feature_networks:
                terms["light_features"] = weights.features * texture.distance(self.features["light"])
        return terms

    def measure(self) -> None:
        """Measure the powers of the feature networks' layers, on targets spread over the training pairs.

        Only rank 0 measures.
        """
        networks: Any = self.feature_networks.items()
        for name, network in networks:
            apart = isinstance(network, TrainedFeatures)
            powers = torch.zeros(len(FEATURE_LAYERS), device=self.device)
            if process_rank() == 0:
                pairs = spread_pairs(self._train, _TARGETS_MEASURED, lambda pair: True)
                targets = (self._train.read_target(pair).to(self.device) for pair in pairs)
                seen = (
                    channels_apart(target, colour_shares(target)) if apart else target for target in targets
                )
                powers = torch.stack([layer_powers(network, image) for image in seen]).mean(0)
            self.features[name] = Features(network, broadcast_from_first(powers), apart)

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure the images' Si-MSE, clipped at white, for the same and another pose; and landmarks.

        `landmarks_iod` is the mean error of the 66 landmarks over the distance of the outer eye corners.
        `tint_red` and `tint_blue` are red and blue over green of all faces, relative to the ground truth.
        """
        if self._validation is None:
            self._validation = self._held_out_pairs()
        metrics: dict[str, float] = {}
        errors, distances, colours, rows = [], [], [], []
        for kind, pairs in self._validation.items():
            of_kind = []
            for index, pair in enumerate(pairs):
                batch = pair.to(self.device)
                landmarks_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
                _, heads = self._heads(torch.cat([batch.source, batch.target]), landmarks_px)
                relit = self._relit(batch, heads)
                of_kind.append(clipped_si_mse(relit.image[:, None], batch.target[:, None], relit.mask))
                distances.append(_landmark_error(heads, batch, self.camera))
                images = torch.stack([relit.image, batch.target])  # [2, B, 3, S, S]
                colours.append((images * relit.mask).sum((1, 3, 4)))
                if index % max(1, 2 * len(pairs) // _SHEET_ROWS) == 0:
                    rows.append(_sheet_row(batch, relit, self.camera))
            metrics[f"si_mse_{kind}"] = float(torch.cat(of_kind).mean())
            metrics[f"si_mse_{kind}_std"] = float(torch.cat(of_kind).std(correction=0))
            errors += of_kind
        metrics["si_mse"] = float(torch.cat(errors).mean())
        metrics["landmarks_iod"] = float(torch.cat(distances).mean())
        prediction, truth = torch.stack(colours).sum(0).clamp_min(1e-6)
        red, green, blue = (prediction / truth).tolist()
        metrics |= {"tint_red": red / green, "tint_blue": blue / green}
        metrics["pairs"] = len(torch.cat(errors))
        return Validation(metrics, np.concatenate(rows))

    def _held_out_pairs(self) -> dict[str, list[CropPairs]]:
        """Read validation pairs by kind; a dataset of one camera has no other pose."""

        def same(pair: Pair) -> bool:
            return pair.source_camera == pair.target_camera

        kinds = {"same_pose": same, "other_pose": lambda pair: not same(pair)}
        chosen = {
            kind: spread_pairs(self._held_out, self.settings.validation_pairs, wanted)
            for kind, wanted in kinds.items()
        }
        return {kind: self._held_out.read(pairs) for kind, pairs in chosen.items() if pairs}


def _landmark_error(heads: PosedHeads, batch: CropPairs, camera: Camera) -> Tensor:
    """Return mean landmark errors [2 B] of sources and targets over the distance of the outer eye corners."""
    detected_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
    distance_px = (heads.landmarks_px(detected_px, camera) - chosen(detected_px, LANDMARKS)).norm(dim=-1)
    left, right = (detected_px[:, corner] for corner in OUTER_EYE_CORNERS)
    return distance_px.mean(1) / (left - right).norm(dim=-1)


def _sheet_row(batch: CropPairs, relit: _Relit, camera: Camera) -> np.ndarray:
    """Draw source, target, prediction in M_t and estimated normals of the first pair: [S, 4 S, 3]."""
    normals = head_normals(relit.target, _SHEET_PX)
    shape, _ = render_textures((normals + 1) / 4, relit.target, camera)
    images = (batch.source, batch.target, relit.image * relit.mask, shape)
    return tiled([[resize(image[:1], min(_SHEET_PX, camera.width_px))[0] for image in images]])


def _provenance(
    dataset: Dataset,
    model: MorphableModel,
    photos: Photos | None,
    appearance: nn.Module | None,
    light: nn.Module | None,
) -> dict[str, Any]:
    """Return the provenance of the dataset, the feature losses and the photos."""
    published = isinstance(appearance, VggFeatures)
    of = VGG16_LICENCE if published else "trained on people and lights of a dataset (--appearance-features)"
    terms = [name for name, there in ((f"V_f, {of}", appearance), ("S_f", light)) if there is not None]
    count = len(photos.paths) if photos else 0
    return provenance_of(dataset, model) | {"feature_losses": terms, "photos": count}


def build(run: Run) -> Objective:
    """Make the objective of the stage; detect faces in new photos."""
    options, dataset = run.options, run.dataset()
    side = run.crop_side(dataset)
    appearance, light = _appearance(run, side), run.light_features(side)
    if options.preset == "paper" and (appearance is None or light is None):
        raise UsageError(
            "the paper's loss needs V_f and S_f; pass --vgg-weights imagenet (553 MB), a file of it, or "
            "--appearance-features FILE, and --light-features FILE, checkpoints of `facerf train --stage "
            f"appearance-features --texture-size {side}` and of the stage light-features"
        )
    require_crops(dataset, dataset.crop_px, side)
    reflectance, geometry = run.reflectance(side), None  # without one, heads are fitted to landmarks
    if options.geometry == "network":
        geometry = run.geometry(mean_translation_m(dataset))
    photos = None
    if options.photos:
        items = collect_items([str(options.photos)], options.output, PHOTO_SUFFIXES)
        cache = _cache_of(options.photos, options.output)
        photos = open_photos([item.input_path for item in items], cache, run.people, side, options.jobs)
    settings = JointSettings(side, side, weights=run.training.loss, seed=options.settings.seed)
    model = load_face_model(options.fit_with)  # whatever fitted the dataset
    kind = run.objective(JointObjective)
    objective: Objective = kind(dataset, model, reflectance, geometry, appearance, light, photos, settings)
    return objective


def _appearance(run: Run, side: int) -> nn.Module | None:
    """Load the frozen V_f, if the options name one."""
    options = run.options
    if options.appearance_features:
        network: nn.Module = load_features(options.appearance_features, "appearance_features", side)
        return network
    return load_vgg(options.vgg_weights) if options.vgg_weights else None


def _cache_of(photos: Path, output: Path) -> Path:
    """Return the folder of faces found in photos: next to them for all runs, or the run's if not writable."""
    folder = photos if photos.is_dir() else photos.parent
    return folder / ".facerf-faces" if os.access(folder, os.W_OK) else output / "photos"
