"""Stage `portrait`: the Portrait Network, on people under different lights at every step.

The loss adds errors of single lights, which determine sums of lights, and of their contrast; of the photo
under its own light, which should be reproduced; and of normals and albedo, which make training on synthetic
people generalise (Yeh et al., *Learning to relight portrait images via a virtual light stage and
synthetic-to-real adaptation*, 2022).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.dataset.squares import open_squares
from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.network.portrait import PortraitMaps, PortraitNetwork
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.bank.portrait_samples import (
    SMALL,
    PortraitSample,
    PortraitSource,
    PortraitSquares,
)
from facerf_cli.synth.bank.proxies import add_proxies
from facerf_cli.training.objective import Objective, PeopleObjective, Validation, seeded, tiled
from facerf_cli.training.run import Run

_ROOT_OFFSET = 0.01  # keeps the slope of the root finite at black
_SCALE = (0.4, 2.5)  # range of exposure between prediction and truth without a penalty
_SHEET_ROWS, _SHEET_TARGETS, _SHEET_PX = 8, 4, 128
# Regions that are measured.
_REGIONS = {
    "face": ("skin", "brows", "lips", "eyes"),
    "hair": ("hair",),
    "ears": ("ears",),
    "neck": ("neck",),
    "garment": ("garment",),
}


@dataclass(frozen=True)
class PortraitObjectiveSettings:
    """Weights of the terms, targets per sample, and the held-out people and draws of each."""

    edges: float = 1.0  # of differences of neighbouring roots
    original: float = 1.0
    albedo: float = 0.3
    normals: float = 0.5
    contrast: float = 0.5
    scale: float = 0.05
    targets: int = 12
    held_out_people: int = 16
    held_out_draws: int = 3


class PortraitObjective(PeopleObjective):
    """Minimise errors of the images that the Portrait Network predicts."""

    chooses_by, validation_seed = "error", 20216

    def __init__(
        self,
        portraits: PortraitSource,
        network: PortraitNetwork | None = None,
        settings: PortraitObjectiveSettings = PortraitObjectiveSettings(),
    ) -> None:
        super().__init__("portrait", network or PortraitNetwork(), portraits, settings)

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Batch:
        """Draw `count` samples of random people, all in squares of one side (see `Objective.draw`)."""
        sides = self.source.sides_px(self.people)
        side = sides[int(torch.randint(len(sides), (), generator=seeded(step)))]
        targets = self.settings.targets
        return concatenate(
            [self.source.draw(self.people, targets, generator_of(i), side) for i in range(count)]
        )

    def draw_person(self, person: int, generator: torch.Generator) -> PortraitSample:
        sample: PortraitSample = self.source.draw([person], self.settings.targets, generator)
        return sample

    def forward(self, batch: PortraitSample) -> dict[str, Tensor]:
        """Compute the weighted terms, each a mean over samples."""
        settings = self.settings
        maps, images = self._predict(batch)
        scale = _best_scale(images, batch).clamp(*_SCALE)
        alpha = 1 - batch.shares[:, :1]
        covered = alpha.mean((1, 2, 3)).clamp_min(1e-3).view(-1, 1, 1, 1)
        off = (_root(images * scale) - _root(batch.targets)) * alpha[:, None] / covered[:, None]
        edges = off.diff(dim=-1).abs().mean() + off.diff(dim=-2).abs().mean()
        relit, photo = _relight_by_original(maps, batch), F.avg_pool2d(batch.original, SMALL)
        original = (_root(relit * scale[:, 0]) - _root(photo)) * F.avg_pool2d(alpha, SMALL) / covered
        albedo = (_root(maps.albedo * scale[:, 0]) - _root(batch.albedo)) * alpha / covered
        labelled = batch.labelled.view(-1, 1, 1, 1)
        cosine = (maps.normals * F.normalize(batch.true_normals, dim=1)).sum(1, keepdim=True)
        return {
            "lights": off.abs().mean(),
            "edges": settings.edges * edges,
            "original": settings.original * original.abs().mean(),
            "albedo": settings.albedo * (albedo * labelled).abs().mean(),
            "normals": settings.normals * ((1 - cosine) * labelled * alpha / covered).mean(),
            "contrast": settings.contrast * _contrast_error(images * scale, batch),
            "scale": settings.scale * scale.log().abs().mean(),
        }

    def _predict(self, batch: PortraitSample) -> tuple[PortraitMaps, Tensor]:
        """Predict maps, and images [B, T, 3, S, S] under the targets' lights."""
        with self.mixed_precision():
            maps: PortraitMaps = self.network(batch.inputs)
        size = batch.inputs.image.shape[-2:]
        visible = F.interpolate(batch.visible, size=size, mode="bilinear", align_corners=False)
        return maps, maps.olats(batch.lights, visible)

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure held-out people: relative errors by region under one scale of the head, and of roots."""
        sums: list[Tensor] = []
        rows: list[list[Tensor]] = []
        for held_out in self.held_out_samples():
            sample = held_out.to(self.device)
            _, images = self._predict(sample)
            images = images * _best_scale(images, sample)
            sums.append(_error_sums(images, sample))
            if len(rows) < _SHEET_ROWS:
                pairs = torch.stack([images[0], sample.targets[0]], 1)[:_SHEET_TARGETS].flatten(0, 1)
                row, size = torch.cat([sample.inputs.image[:1], pairs]), (_SHEET_PX, _SHEET_PX)
                rows.append([*F.interpolate(row, size, mode="bilinear", antialias=True)])
        errors = zip((*_REGIONS, "error"), torch.stack(sums).cpu().sum(0), strict=True)
        return Validation({name: float(a / b) for name, (a, b) in errors if b > 0}, tiled(rows))


def _error_sums(images: Tensor, sample: PortraitSample) -> Tensor:
    """Return squared errors and squares of the truth [R + 1, 2] by region; last, root errors and alpha."""
    squared = (images - sample.targets).square().mean(2)
    truth = sample.targets.square().mean(2)
    sums = []
    for classes in _REGIONS.values():
        share = sample.shares[:, [class_index(name) for name in classes]].sum(1)[:, None]
        sums.append(torch.stack([(squared * share).mean(), (truth * share).mean()]))
    alpha = (1 - sample.shares[:, :1])[:, None]
    root = ((_root(images) - _root(sample.targets)) * alpha).abs().mean()
    return torch.stack([*sums, torch.stack([root, alpha.mean()])])


def _relight_by_original(maps: PortraitMaps, batch: PortraitSample) -> Tensor:
    """Relight with the photo's original light [B, 3, S / 4, S / 4]."""
    side = batch.inputs.image.shape[-1] // SMALL
    small = type(maps)(*(F.interpolate(values, size=(side, side), mode="area") for values in maps))
    visible = F.interpolate(batch.rig_visible, size=small.gain.shape[-2:], mode="area")
    shading, glow, _ = small.shaded(batch.rig, visible)
    lit = torch.einsum("blij,blc->bcij", shading, batch.weights)
    return small.albedo * lit + torch.einsum("blij,blc->bcij", glow, batch.weights)


def _contrast_error(images: Tensor, batch: PortraitSample) -> Tensor:
    """Return the difference of the standard deviations of the roots, over the person and over its skin.

    Without it images are too flat: a network that is unsure of a shape blurs its shading.
    """
    regions = 1 - batch.shares[:, :1], batch.shares[:, [class_index("skin")]]
    roots = _root(images).mean(2), _root(batch.targets).mean(2)
    errors = []
    for region in regions:
        predicted, true = (_deviation(root, region) for root in roots)
        errors.append((predicted - true).abs().mean())
    return (errors[0] + errors[1]) / 2


def _deviation(values: Tensor, weight: Tensor) -> Tensor:
    """Return standard deviations [B, T] of values [B, T, S, S] under weights [B, 1, S, S]."""
    total = weight.sum((2, 3)).clamp_min(1.0)
    mean = ((values * weight).sum((2, 3)) / total)[..., None, None]
    return (((values - mean).square() * weight).sum((2, 3)) / total + 1e-6).sqrt()


def _root(radiance: Tensor) -> Tensor:
    return (radiance.clamp(0, 4) + _ROOT_OFFSET).sqrt()


@torch.no_grad()
def _best_scale(images: Tensor, batch: PortraitSample) -> Tensor:
    """Return the scale [B, 1, 1, 1, 1] that brings images [B, T, 3, S, S] closest to the person's targets."""
    predicted, target = images.clamp(max=2), batch.targets.clamp(max=2)
    weight, dims = (1 - batch.shares[:, :1])[:, None], (1, 2, 3, 4)
    square = (predicted * predicted * weight).sum(dims).clamp_min(1e-6)
    return ((predicted * target * weight).sum(dims) / square).view(-1, 1, 1, 1, 1)


def build(run: Run) -> Objective:
    """Make the objective of the stage, on a dataset or on synthetic people."""
    options, sizes = run.options, run.sizes
    held_out = min(sizes.held_out_people, max(1, sizes.heads // 8))  # an eighth of a small bank
    source: PortraitSource
    if options.dataset:
        backgrounds = run.backgrounds(options.output)
        source = open_squares(options.dataset, backgrounds, run.people, options.jobs)
    else:
        source = _stored_squares(run, held_out)
    settings = PortraitObjectiveSettings(held_out_people=held_out)
    settings = replace(settings, targets=2) if run.is_tiny else settings
    objective: Objective = run.objective(PortraitObjective)(source, run.network("portrait"), settings)
    return objective


def _stored_squares(run: Run, held_out: int) -> PortraitSquares:
    """Open the bank of synthetic people; bake and analyse those that are missing."""
    options, backgrounds = run.options, run.backgrounds(run.bank)
    folder, provenance = run.bake_people(held_out, with_squares=True)
    add_proxies(folder, backgrounds, run.people, options.jobs, options.settings.seed)
    return PortraitSquares(folder, backgrounds, provenance)
