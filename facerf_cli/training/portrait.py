"""Stage `portrait`: the Portrait Network, on people lit by other lights at every step.

Errors of single lights, which sums of lights follow from, and of their contrast; of the photo under its
light, so that it comes back; and of normals and albedo, which make training on synthetic people hold for
others (Yeh et al., *Learning to relight portrait images via a virtual light stage and synthetic-to-real
adaptation*, 2022).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.dataset.portraits import open_dataset_portraits
from facerf_cli.network.inputs import Batch, concatenate
from facerf_cli.network.portrait import PortraitMaps, PortraitNetwork
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.bank.portrait_samples import (
    SMALL,
    PortraitSample,
    PortraitSource,
    StoredTransport,
)
from facerf_cli.synth.bank.transport import TINY_BANK, TransportBankSettings, add_proxies, add_transport
from facerf_cli.training.build import Run
from facerf_cli.training.objective import Objective, Validation, seeded
from facerf_cli.training.sheets import tiled

_ROOT_OFFSET = 0.01  # keeps the slope of the root finite at black
_SCALE = (0.4, 2.5)  # of exposure between prediction and truth that is forgiven
_SHEET_ROWS, _SHEET_TARGETS, _SHEET_PX = 8, 4, 128
# Regions that are measured, as in the benchmark of whole heads.
_REGIONS = {
    "face": ("skin", "brows", "lips", "eyes"),
    "hair": ("hair",),
    "ears": ("ears",),
    "neck": ("neck",),
    "garment": ("garment",),
}


@dataclass(frozen=True)
class PortraitObjectiveSettings:
    """Weights of the terms, targets of a sample, and the held-out people and draws of each."""

    edges: float = 1.0  # of differences of neighbouring roots
    own: float = 1.0
    albedo: float = 0.3
    normals: float = 0.5
    contrast: float = 0.5
    scale: float = 0.05
    targets: int = 12
    held_out_people: int = 16
    held_out_draws: int = 3


class PortraitObjective(Objective):
    """Errors of the images that the Portrait Network predicts."""

    chooses_by, validation_seed = "error", 20216

    def __init__(
        self,
        portraits: PortraitSource,
        network: PortraitNetwork | None = None,
        settings: PortraitObjectiveSettings = PortraitObjectiveSettings(),
    ) -> None:
        super().__init__({"portrait": network or PortraitNetwork()}, portraits.provenance)
        self.portraits, self.settings = portraits, settings
        self.people, self.held_out = portraits.people(settings.held_out_people)

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Batch:
        """Draw `count` samples of random people, all in squares of one side (see `Objective.draw`)."""
        sides = self.portraits.sides_px(self.people)
        side = sides[int(torch.randint(len(sides), (), generator=seeded(step)))]
        targets = self.settings.targets
        return concatenate(
            [self.portraits.draw(self.people, targets, generator_of(i), side) for i in range(count)]
        )

    def draw_held_out(self, person: int, generator: torch.Generator) -> PortraitSample:
        return self.portraits.draw([person], self.settings.targets, generator)

    def forward(self, batch: PortraitSample) -> dict[str, Tensor]:
        """Compute the weighted terms, each a mean over samples."""
        maps, settings = self._maps(batch), self.settings
        found, own = maps.olats(batch.lights, _larger(batch.visible, batch.inputs.image)), _own(maps, batch)
        scale = _best_scale(found, batch.targets, 1 - batch.shares[:, :1])
        alpha = (1 - batch.shares[:, :1])[:, None]
        off = (_root(found * scale) - _root(batch.targets)) * alpha
        covered = alpha.mean((1, 2, 3, 4)).clamp_min(1e-3).view(-1, 1, 1, 1, 1)
        off = off / covered
        edges = off.diff(dim=-1).abs().mean() + off.diff(dim=-2).abs().mean()
        small = alpha[:, 0], covered[:, 0]
        own_off = (_root(own * scale[:, 0]) - _root(_smaller(batch.own))) * _smaller(small[0]) / small[1]
        albedo_off = (_root(maps.albedo * scale[:, 0]) - _root(batch.albedo)) * small[0] / small[1]
        labelled = batch.labelled.view(-1, 1, 1, 1)
        turned = _turned(maps, batch.true_normals)
        return {
            "lights": off.abs().mean(),
            "edges": settings.edges * edges,
            "own": settings.own * own_off.abs().mean(),
            "albedo": settings.albedo * (albedo_off * labelled).abs().mean(),
            "normals": settings.normals * (turned * labelled * small[0] / small[1]).mean(),
            "contrast": settings.contrast * _contrast_error(found * scale, batch),
            "scale": settings.scale * scale.log().abs().mean(),
        }

    def _maps(self, batch: PortraitSample) -> PortraitMaps:
        with self.mixed_precision():
            maps: PortraitMaps = self.network(batch.inputs)
        return maps

    @torch.no_grad()
    def validate(self) -> Validation:
        """Measure held-out people: relative error by region under one scale of the head, and its SSIM."""
        measured: list[Tensor] = []
        rows: list[list[Tensor]] = []
        for held_out in self.held_out_samples():
            sample = held_out.to(self.device)
            found = self._maps(sample).olats(sample.lights, _larger(sample.visible, sample.inputs.image))
            found = found * _best_scale(found, sample.targets, 1 - sample.shares[:, :1], clamp=False)
            measured.append(_measured(found, sample))
            if len(rows) < _SHEET_ROWS:
                pairs = torch.stack([found[0], sample.targets[0]], 1)[:_SHEET_TARGETS].flatten(0, 1)
                rows.append([_shrunk(image) for image in (sample.inputs.image[0], *pairs)])
        return Validation(_summed(torch.stack(measured).cpu()), tiled(rows))


def _turned(maps: PortraitMaps, truth: Tensor) -> Tensor:
    """1 less the cosine [B, 1, S, S] to true normals [B, 3, S, S]."""
    return 1 - (maps.normals * F.normalize(truth, dim=1)).sum(1, keepdim=True)


def _measured(found: Tensor, sample: PortraitSample) -> Tensor:
    """Squared errors and squares of the truth [R + 1, 2] of a sample, by region; of all, roots and cover."""
    squared = (found - sample.targets).square().mean(2)
    truth = sample.targets.square().mean(2)
    sums = []
    for classes in _REGIONS.values():
        share = sample.shares[:, [class_index(one) for one in classes]].sum(1)[:, None]
        sums.append(torch.stack([(squared * share).mean(), (truth * share).mean()]))
    alpha = (1 - sample.shares[:, :1])[:, None]
    root = ((_root(found) - _root(sample.targets)) * alpha).abs().mean()
    return torch.stack([*sums, torch.stack([root, alpha.mean()])])


def _summed(table: Tensor) -> dict[str, float]:
    """Relative errors of samples [N, R + 1, 2]; none of regions that nobody shows."""
    sums = table.sum(0)
    names = (*_REGIONS, "error")
    return {n: float(a / b) for n, (a, b) in zip(names, sums, strict=True) if b > 0}


def _shrunk(image: Tensor) -> Tensor:
    return F.interpolate(image[None], (_SHEET_PX, _SHEET_PX), mode="bilinear", antialias=True)[0]


def _own(maps: PortraitMaps, batch: PortraitSample) -> Tensor:
    """The photo under its own light [B, 3, S / 4, S / 4], as the network sees it."""
    side = batch.inputs.image.shape[-1] // SMALL
    small = type(maps)(*(F.interpolate(values, size=(side, side), mode="area") for values in maps))
    visible = F.interpolate(batch.rig_visible, size=small.gain.shape[-2:], mode="area")
    shading, glow, _ = small.shaded(batch.rig, visible)
    lit = torch.einsum("blij,blc->bcij", shading, batch.weights)
    return small.albedo * lit + torch.einsum("blij,blc->bcij", glow, batch.weights)


def _contrast_error(found: Tensor, batch: PortraitSample) -> Tensor:
    """Difference of the standard deviations of the roots, over the person and over its skin.

    Without it images are flatter than true ones: a network that is unsure of a shape blurs its shading.
    """
    regions = 1 - batch.shares[:, :1], batch.shares[:, [class_index("skin")]]
    roots = _root(found).mean(2), _root(batch.targets).mean(2)
    errors = []
    for region in regions:
        own, true = (_deviation(root, region) for root in roots)
        errors.append((own - true).abs().mean())
    return (errors[0] + errors[1]) / 2


def _deviation(values: Tensor, weight: Tensor) -> Tensor:
    """Standard deviation [B, T] of values [B, T, S, S] under weights [B, 1, S, S]."""
    total = weight.sum((2, 3)).clamp_min(1.0)
    mean = ((values * weight).sum((2, 3)) / total)[..., None, None]
    return (((values - mean).square() * weight).sum((2, 3)) / total + 1e-6).sqrt()


def _larger(visible: Tensor, image: Tensor) -> Tensor:
    return F.interpolate(visible, size=image.shape[-2:], mode="bilinear", align_corners=False)


def _smaller(values: Tensor) -> Tensor:
    return F.avg_pool2d(values, SMALL)


def _root(radiance: Tensor) -> Tensor:
    return (radiance.clamp(0, 4) + _ROOT_OFFSET).sqrt()


def _best_scale(found: Tensor, targets: Tensor, alpha: Tensor, clamp: bool = True) -> Tensor:
    """The scale [B, 1, 1, 1, 1] of images [B, T, 3, S, S] that brings them closest to the truth."""
    with torch.no_grad():
        one, other, weight = found.clamp(max=2), targets.clamp(max=2), alpha[:, None]
        scale = (one * other * weight).sum((1, 2, 3, 4)) / (one * one * weight).sum((1, 2, 3, 4)).clamp_min(
            1e-6
        )
        scale = scale.clamp(*_SCALE) if clamp else scale
    return scale.view(-1, 1, 1, 1, 1)


def build(run: Run) -> Objective:
    """Make the objective of the stage, on a dataset or on synthetic people."""
    options, sizes = run.options, run.sizes
    held_out = min(sizes.held_out_heads, max(1, sizes.heads // 8))  # an eighth of a small bank
    source: PortraitSource
    if options.dataset:
        backgrounds = run.backgrounds(options.output)
        source = open_dataset_portraits(options.dataset, backgrounds, run.people, options.jobs)
    else:
        source = _stored_transport(run, held_out)
    settings = PortraitObjectiveSettings(held_out_people=held_out)
    settings = replace(settings, targets=2) if run.is_tiny else settings
    objective: Objective = run.objective(PortraitObjective)(source, run.network("portrait"), settings)
    return objective


def _stored_transport(run: Run, held_out: int) -> StoredTransport:
    """Open the bank of synthetic people; bake and analyse those that are missing."""
    options, folder = run.options, run.bank / "transport"
    people, models, provenance = run.whole_people(held_out)
    settings, seed = TINY_BANK if run.is_tiny else TransportBankSettings(), options.settings.seed
    add_transport(folder, models, people, options.jobs, seed, settings)
    backgrounds = run.backgrounds(run.bank)
    add_proxies(folder, backgrounds, run.people, options.jobs, seed)
    return StoredTransport(folder, backgrounds, provenance)
