"""Stage `geometry`: train only the Geometry Network, on rendered faces with known landmarks.

The estimated head's landmarks are compared with the true ones in the image, like in the paper's landmark
loss. Contour landmarks do not slide, because here hidden ones are also known. The targets of pose and
coefficients are from the fit to the same landmarks.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.face.fit import FitSettings
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.network.batch import concatenate
from facerf_cli.network.geometry import GeometryEstimate, GeometryNetwork, GeometryNetworkSettings
from facerf_cli.raster.camera import crop_camera, project
from facerf_cli.synth.bank.geometry_crops import GeometryCrops, GeometryPhotos
from facerf_cli.training.objective import (
    FOUND_COLOUR,
    TRUE_COLOUR,
    Objective,
    PeopleObjective,
    Validation,
    in_rows,
    mark,
    tiled,
)
from facerf_cli.training.run import Run

_SHEET_ROWS, _SHEET_COLUMNS, _SHEET_PX = 4, 8, 192


@dataclass(frozen=True)
class GeometryObjectiveSettings:
    """Weights of the terms, and the held-out people and draws of each for validation."""

    landmarks: float = 10.0  # of distances in inter-ocular distances
    contour: float = 0.5  # of a contour landmark, relative to the others
    rotation: float = 2.0  # of the chord between rotations
    depth: float = 2.0  # of the ratio of depths
    coefficients: float = 0.08  # of squared differences, in units of the fit's priors
    held_out_people: int = 12
    held_out_draws: int = 16


class GeometryObjective(PeopleObjective):
    """Errors of landmarks, pose and coefficients on rendered faces."""

    chooses_by, validation_seed = "landmarks_percent", 20211
    mean_m: Tensor
    identity_m: Tensor
    expression_m: Tensor

    def __init__(
        self,
        faces: GeometryPhotos,
        network: GeometryNetwork | None = None,
        settings: GeometryObjectiveSettings = GeometryObjectiveSettings(),
    ) -> None:
        network = network or GeometryNetwork(
            GeometryNetworkSettings(mean_translation_m=faces.mean_translation_m())
        )
        super().__init__("geometry", network, faces, settings)
        self.side = network.side
        model = load_face_model()
        own = network.settings
        points = [model.landmarks(x) for x in (model.mean[None], model.identity, model.expression)]
        self.register_buffer("mean_m", points[0][0])
        self.register_buffer("identity_m", points[1][: own.identity])
        self.register_buffer("expression_m", points[2][: own.expression])

    def draw_person(self, person: int, generator: torch.Generator) -> GeometryCrops:
        crops: GeometryCrops = self.source.draw(person, self.side, generator)
        return crops

    def forward(self, batch: GeometryCrops) -> dict[str, Tensor]:
        """Compute the weighted terms, each a mean over faces."""
        with self.mixed_precision():
            estimate = GeometryEstimate(*(x.float() for x in self.network(batch.crops)))
        settings, fit = self.settings, FitSettings()
        weight = torch.ones(68, device=batch.crops.device)
        weight[list(CONTOUR)] = settings.contour
        distance = self.distances_iod(estimate, batch)
        landmarks = (distance * weight).sum(1).mean() / weight.sum()
        chord = (estimate.rotation - batch.rotation).flatten(1).norm(dim=1) / 2**0.5
        depth = (estimate.translation_m[:, 2] / batch.translation_m[:, 2]).log().abs()
        alpha = (estimate.alpha - batch.alpha[:, : estimate.alpha.shape[1]]) / fit.identity_std
        beta = (estimate.beta - batch.beta[:, : estimate.beta.shape[1]]) / fit.expression_std
        squared = alpha.square().sum(1) + beta.square().sum(1)
        return {
            "landmarks": settings.landmarks * landmarks,
            "rotation": settings.rotation * chord.mean(),
            "depth": settings.depth * depth.mean(),
            "coefficients": settings.coefficients * squared.mean(),
        }

    def landmarks_px(self, estimate: GeometryEstimate, side: int) -> Tensor:
        """Project the landmarks [B, 68, 2] of an estimate into a crop of a side, differentiably."""
        offset = torch.einsum("bk,knc->bnc", estimate.alpha, self.identity_m)
        offset = offset + torch.einsum("bk,knc->bnc", estimate.beta, self.expression_m)
        in_camera = (self.mean_m + offset) @ estimate.rotation.mT + estimate.translation_m[:, None]
        return project(in_camera, crop_camera(side))

    def distances_iod(self, estimate: GeometryEstimate, batch: GeometryCrops) -> Tensor:
        """Return distances [B, 68] to the true landmarks over the mean face's inter-ocular distance there.

        The eyes of a turned head are close together in the image; their distance would give it more weight.
        """
        side, (left, right) = batch.crops.shape[-1], OUTER_EYE_CORNERS
        predicted = self.landmarks_px(estimate, side)
        depth_m = -(self.mean_m[[left, right]].mean(0) @ batch.rotation.mT + batch.translation_m)[:, 2]
        iod_m: Any = (self.mean_m[left] - self.mean_m[right]).norm()
        frontal_px = crop_camera(side).focal_px * iod_m / depth_m  # [B]
        return (predicted - batch.landmarks_px).norm(dim=-1) / frontal_px[:, None]

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure mean errors on held-out people; landmarks in percent of the inter-ocular distance."""
        batch = concatenate(self.held_out_samples()).to(self.device)
        estimate = self.network(batch.crops)
        distance_px = (self.landmarks_px(estimate, self.side) - batch.landmarks_px).norm(dim=-1)
        left, right = OUTER_EYE_CORNERS
        eyes_px = (batch.landmarks_px[:, left] - batch.landmarks_px[:, right]).norm(dim=-1)
        percent = 100 * distance_px / eyes_px[:, None]
        chord = (estimate.rotation - batch.rotation).flatten(1).norm(dim=1)
        angle_deg = torch.rad2deg(2 * torch.asin((chord / 8**0.5).clamp(max=1)))
        depth = (estimate.translation_m[:, 2] / batch.translation_m[:, 2]).log().abs()
        metrics = {
            "landmarks_percent": float(percent.mean()),
            "inner_percent": float(percent[:, len(CONTOUR) :].mean()),
            "angle_deg": float(angle_deg.mean()),
            "depth_percent": float(100 * depth.mean()),
        }
        return Validation(metrics, self._sheet(batch, estimate))

    def _sheet(self, batch: GeometryCrops, estimate: GeometryEstimate) -> np.ndarray:
        """Draw held-out crops with the true landmarks in green and the estimated ones in red."""
        side, count, size = batch.crops.shape[-1], _SHEET_ROWS * _SHEET_COLUMNS, _SHEET_PX
        images = nn.functional.interpolate(batch.crops[:count].cpu(), (size, size), mode="nearest")
        images = images / images.mean((1, 2, 3), keepdim=True).clamp_min(1e-6) * 0.18
        predicted = self.landmarks_px(estimate, side)[:count].cpu()
        for image, true_px, found_px in zip(images, batch.landmarks_px[:count].cpu(), predicted, strict=True):
            mark(image, true_px * size / side, TRUE_COLOUR)
            mark(image, found_px * size / side, FOUND_COLOUR)
        return tiled(in_rows([*images], _SHEET_COLUMNS))


def build(run: Run) -> Objective:
    """Make the objective of the stage; bake synthetic people that are missing."""
    held_out = run.sizes.held_out_people
    folder, provenance = run.bake_people(held_out, with_squares=False)
    faces = GeometryPhotos(folder, run.backgrounds(run.bank), provenance)
    settings = GeometryObjectiveSettings(held_out_people=held_out)
    network = run.geometry(faces.mean_translation_m())
    objective: Objective = run.objective(GeometryObjective)(faces, network, settings)
    return objective
