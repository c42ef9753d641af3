"""Move and stretch brows, eyes, nose and lips of a photo a little, each by itself.

Synthetic people have brows and lips painted at the same places of one mesh. A network that is trained on them
guesses where these are from the rest of the face; real brows lie higher or lower, and real lips are thinner
or thicker.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

_FEATURES = (slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), slice(48, 68))
_REACHES = (0.10, 0.10, 0.12, 0.08, 0.08, 0.13)  # standard deviations, in extents of the 68 landmarks
_MOVE_STD = 0.02  # in extents
_STRETCH_STD = 0.15
_MOST = 2.0  # standard deviations; beyond it a warp could fold
_ROUNDS = 8  # of the search for the place that is taken from another; each lowers its error threefold


@dataclass(frozen=True)
class FeatureWarp:
    """A smooth warp of the plane: what is shown at p is taken from p + `shift(p)`; all in pixels.

    Of each of K features: its centre [K, 2] and reach [K], how far it moves [K, 2], and how much it is
    stretched [K, 2] along x and y.
    """

    centres: Tensor
    reaches: Tensor
    moves: Tensor
    stretches: Tensor

    @staticmethod
    def draw(landmarks_px: Tensor, generator: torch.Generator) -> "FeatureWarp":
        """Draw a warp of a face with landmarks [68, 2]."""
        extent = (landmarks_px.amax(0) - landmarks_px.amin(0)).max()
        moves, stretches = (
            torch.randn(2, len(_FEATURES), 2, generator=generator).clamp(-_MOST, _MOST).unbind()
        )
        return FeatureWarp(
            centres=torch.stack([landmarks_px[feature].mean(0) for feature in _FEATURES]),
            reaches=extent * torch.tensor(_REACHES),
            moves=extent * _MOVE_STD * moves,
            stretches=_STRETCH_STD * stretches,
        )

    def shift(self, places: Tensor) -> Tensor:
        """Offsets from places [..., 2] to those that are shown there."""
        total = torch.zeros_like(places)
        for centre, reach, move, stretch in zip(
            self.centres, self.reaches, self.moves, self.stretches, strict=True
        ):
            off = places - centre
            weight = torch.exp(-0.5 * off.square().sum(-1, keepdim=True) / reach**2)
            total = total + weight * (move + stretch * off)
        return total

    def shown_at(self, places: Tensor) -> Tensor:
        """Places at which those at [..., 2] are shown, the inverse of the warp."""
        shown = places
        for _ in range(_ROUNDS):
            shown = places - self.shift(shown)
        return shown
