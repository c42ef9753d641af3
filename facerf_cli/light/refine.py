"""A photo's light refined by features of its texture (paper, 'Light Estimation').

From the least-squares light on, argmin over the weights of |V_f(explained texture) - V_f(photo's texture)|^2
by Adadelta (Zeiler, *ADADELTA: an adaptive learning rate method*, 2012), as the paper does it. What features
are compared is handed in.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.light.estimate import LightEvidence

Features = Callable[[Tensor], Sequence[Tensor]]  # of textures [B, 3, T, T], linear, black beyond the mask


@dataclass(frozen=True)
class RefineSettings:
    """Adadelta's own rate is 1; it ends once `patience` steps gained less than the share `settled`."""

    steps: int = 150
    learning_rate: float = 1.0
    patience: int = 20
    settled: float = 0.002


@dataclass(frozen=True, eq=False)
class RefinedLight:
    """Weights [L, 3], the loss of the start and theirs, and after how many steps it ended."""

    weights: Tensor
    loss_before: float
    loss_after: float
    steps: int


def refine_light(
    evidence: LightEvidence,
    start: Tensor,
    features: Features,
    non_negative: bool = True,
    settings: RefineSettings = RefineSettings(),
) -> RefinedLight:
    """The light of least feature loss on the way from `start` [L, 3]; never worse than the start.

    Non-negativity is kept by projection. Beyond white nothing is asked of clipped texels.
    """
    loss_of = _FeatureLoss(evidence, features)
    unit = float(start.square().mean().sqrt()) or 1.0  # so that a step is of the same size for every photo
    scaled = (start / unit).requires_grad_()
    optimizer = torch.optim.Adadelta([scaled], lr=settings.learning_rate)
    best, first, least, losses = start, 0.0, float("inf"), []
    for _ in range(settings.steps + 1):
        loss = loss_of(scaled * unit)
        losses.append(float(loss.detach()))
        first = losses[0]
        if losses[-1] < least:
            best, least = scaled.detach() * unit, losses[-1]
        if not first > 0 or _has_settled(losses, settings):
            break
        optimizer.zero_grad()
        (loss / first).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if non_negative:
            scaled.data.clamp_(min=0)
    return RefinedLight(best.clone() if least < first else start, first, min(first, least), len(losses) - 1)


class _FeatureLoss:
    """Mean squared difference of features, summed over layers, of the masked textures of one face."""

    def __init__(self, evidence: LightEvidence, features: Features) -> None:
        self._evidence, self._features = evidence, features
        self._clipped = evidence.clipped
        with torch.no_grad():
            self._wanted = [layer.clone() for layer in features((evidence.photo * evidence.mask)[None])]

    def __call__(self, weights: Tensor) -> Tensor:
        photo, explained = self._evidence.photo, self._evidence.relit(weights)
        explained = torch.where(self._clipped, explained.minimum(photo), explained)
        found = self._features((explained * self._evidence.mask)[None])
        terms = [(a - b).square().mean() for a, b in zip(found, self._wanted, strict=True)]
        return torch.stack(terms).sum()


def _has_settled(losses: list[float], settings: RefineSettings) -> bool:
    if len(losses) <= settings.patience:
        return False
    return min(losses) > (1 - settings.settled) * min(losses[: -settings.patience])
