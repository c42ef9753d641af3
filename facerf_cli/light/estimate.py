"""Estimate the light of a photo from a reflectance field (paper, 'Light Estimation').

`LightEvidence` holds the textures under each single light of a rig and the texture of the photo.
`LightEvidence.least_squares` solves Eq. (leastsq) of the paper for the weights of the lights; `refine_light`
then minimises |V_f(explained texture) - V_f(photo's texture)|^2 over the weights by Adadelta (Zeiler,
*ADADELTA: an adaptive learning rate method*, 2012), as the paper does. The caller gives the features.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError

Features = Callable[[Tensor], Sequence[Tensor]]  # of linear textures [B, 3, T, T], black outside the mask

_WHITE = 0.95  # of a photo that ends at 1: clipped texels, averaged with their neighbours, lie above this
_LEAST_TEXELS = 200  # fewer do not determine where light comes from
_BLACK = 1e-4  # mean of an unlit face: below one step of 8 bits
# As shares of the photo's norm, against uneven light from around, and against lights of several colours.
_EVEN, _ONE_COLOUR = 0.3, 0.3
_REACHES = 0.1  # share of the largest mean radiance of the face under a light; below it, it is not solved for
_CONDITION = 1e-2  # least singular value of signed least squares, as a share of the largest
_OUTLIER = 3.0  # median errors from which on a texel's weight falls in inverse proportion to its error
_ROUNDS, _ROUNDS_GREY = 3, 5  # of reweighting
# Weights of smoothness and of shortness, as shares of the photo's norm: of the grey light that all channels
# share, and of each channel's difference from it.
_SMOOTH, _SHORT = 0.1, 0.01
_SMOOTH_CHANNEL, _SHORT_CHANNEL = 1.0, 0.1
_STANDS_OUT = 3.0  # mean weights by which a light differs from its neighbours if it is a lone bright light
_NEIGHBOURHOOD = 1.5  # standard deviation of the neighbourhood of a light, in mean spacings of the lights
_STEPS, _RATE = 150, 1.0  # of Adadelta, at most, and its learning rate, which is its own
_PATIENCE, _SETTLED = 20, 0.002  # steps that end the search where they lower the loss by less than this share
_TINY = 1e-12  # avoids divisions by 0


@dataclass(frozen=True, eq=False)
class LightEvidence:
    """A face in UV space under each single light, and in its photo; all scene-linear.

    directions [L, 3], unit, camera space; olats [L, 3, T, T]; photo [3, T, T]; mask [T, T] bool: the texels
    that are compared (the paper's M_t in UV space).
    """

    directions: Tensor
    olats: Tensor
    photo: Tensor
    mask: Tensor

    @property
    def clipped(self) -> Tensor:
        """Texels [3, T, T] bool that are white in the photo, where the true radiance may be higher."""
        return clipped(self.photo, self.mask)

    def require_a_face(self) -> None:
        """Raise InputError if too little of the face is visible, or if it is black."""
        texels = int(self.mask.sum())
        if texels < _LEAST_TEXELS:
            raise InputError(
                f"too little of the face is visible to estimate its light ({texels} points of its texture; "
                f"{_LEAST_TEXELS} are needed); give a photo or a matte that shows more of it"
            )
        if float(self.photo[:, self.mask].mean()) < _BLACK:
            raise InputError("the face is black in the photo: it shows no light; give a brighter photo")

    def relit(self, weights: Tensor) -> Tensor:
        """The face under weights [L, 3]: [3, T, T]."""
        return torch.einsum("lc,lcij->cij", weights, self.olats)

    def residual(self, explained: Tensor) -> float:
        """|explained [3, T, T] - photo| / |photo| in the mask; clipped texels count only if too dark."""
        photo, clipped = self.photo[:, self.mask], self.clipped[:, self.mask]
        error = explained[:, self.mask] - photo
        error = torch.where(clipped, error.clamp(max=0), error)
        return float(error.norm() / photo.norm().clamp_min(_TINY))

    def least_squares(self, non_negative: bool = True) -> Tensor:
        """Weights [L, 3] over the mask by `estimate_smooth_weights`, or by `estimate_signed_weights`."""
        olats, photo = self.olats[..., self.mask], self.photo[:, self.mask]
        if not non_negative:
            return estimate_signed_weights(olats, photo)
        return estimate_smooth_weights(self.directions, olats, photo, self.clipped[:, self.mask])


def clipped(photo: Tensor, mask: Tensor) -> Tensor:
    """Texels [3, ...] bool of a mask [...] that are white in a photo [3, ...].

    A photo with any value above 1 there is not clipped.
    """
    ends_at_white = bool(photo[:, mask].max() <= 1) if mask.any() else False
    return (photo >= _WHITE) & mask & ends_at_white


def joined(frames: Sequence[LightEvidence]) -> LightEvidence:
    """The evidence of several frames under the same lights, one below the other."""
    if len(frames) == 1:
        return frames[0]
    return LightEvidence(
        frames[0].directions,
        torch.cat([frame.olats for frame in frames], -2),
        torch.cat([frame.photo for frame in frames], -2),
        torch.cat([frame.mask for frame in frames], -2),
    )


def estimate_lamps(olats: Tensor, image: Tensor, lamps: int) -> Tensor:
    """Solve Eq. (leastsq) for non-negative weights [L, C] of some lamps and light from around.

    Images [L, C, N], which are to sum to an image [C, N], are scene-linear. Iteratively reweighted least
    squares: clipped, covered and misfitted elements lose weight. The lights after the first `lamps` are the
    light from around; it is as even, and all lights are as much of one colour, as the image allows.
    """
    count = len(olats)
    uneven = np.zeros((count - lamps, count))
    uneven[:, lamps:] = np.eye(count - lamps) - 1 / (count - lamps)
    mean = _channels(olats.mean(1, keepdim=True), image.mean(0, keepdim=True))
    grey = _robust(mean, [1.0], _EVEN**2 * uneven.T @ uneven, np.zeros(count))
    weights = _near_grey(_channels(olats, image), grey, _ONE_COLOUR**2 * np.eye(count))
    return torch.from_numpy(weights).float()


def lamp_error(lamp: Tensor, around: Tensor, image: Tensor) -> float:
    """Root of the mean squared error of an image [N] as a sum of those of a lamp and of light from around."""
    (channel,) = _channels(torch.stack([lamp, around])[:, None], image[None])
    weights = _robust([channel], [1.0], np.zeros((2, 2)), np.zeros(2))
    return float(np.sqrt(np.square(channel.lights @ weights - channel.target).mean()))


def estimate_signed_weights(olats: Tensor, image: Tensor) -> Tensor:
    """Solve Eq. (leastsq) as the paper states it: signed weights [L, C], all elements weighted alike.

    It is the solution of least norm among the combinations of lights that change the image noticeably:
    singular values below `_CONDITION` of the largest are left out, for they are noise of the field (truncated
    singular value decomposition; Hansen, *Rank-deficient and discrete ill-posed problems*, 1998).
    """
    channels = _channels(olats, image)
    solved = [np.linalg.lstsq(one.lights, one.target, rcond=_CONDITION)[0] for one in channels]
    return torch.from_numpy(np.stack(solved, -1)).float()


def estimate_smooth_weights(directions: Tensor, olats: Tensor, image: Tensor, clipped: Tensor) -> Tensor:
    """Solve Eq. (leastsq) for a plausible light: non-negative, smooth where the face does not determine it.

    The lights have directions [L, 3] and images [L, 3, N], which are to sum to an image [3, N]. A face
    determines few of the hundreds of weights, and a solution for each channel alone has coloured specks. So
    all channels first share one grey light, tinted, that is smooth except for lone bright lights; then each
    channel differs from it by weights that are smooth over the sphere. Lights that hardly reach the face
    (their mean radiance on it is below a tenth of the brightest light's) are not solved for:
    their weights continue those around them. Covered and misfitted elements lose weight;
    where `clipped` [3, N] bool, only too dark a result is an error.
    """
    from_near = _difference_from_neighbours(directions.double().numpy())
    radiance = olats.double().mean((1, 2)).numpy()
    continued = _continuation(from_near, radiance > _REACHES * radiance.max())  # [L, S]
    channels = _channels(olats, image, clipped, continued)
    from_near = from_near @ continued
    grey = _grey_light(channels, from_near)
    hold = _SMOOTH_CHANNEL**2 * from_near.T @ from_near + _SHORT_CHANNEL**2 * np.eye(len(grey))
    return torch.from_numpy(continued @ _near_grey(channels, grey, hold)).float()


def _continuation(from_near: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """Weights of all lights [L, S] from those of the lights that reach the face, [L] bool.

    Each of the others is the mean of its neighbours (a discrete harmonic function), so it lies between the
    weights around it and is never negative.
    """
    continued = np.zeros((len(reaches), int(reaches.sum())))
    continued[reaches] = np.eye(continued.shape[1])
    if not reaches.all():
        hidden = ~reaches
        inner, border = from_near[np.ix_(hidden, hidden)], from_near[np.ix_(hidden, reaches)]
        continued[hidden] = np.linalg.solve(inner, -border)
    return continued


class _Channel:
    """One colour channel of the images under each light [N, L] and of the photo [N], with trust [N]."""

    def __init__(self, lights: np.ndarray, target: np.ndarray, clipped: np.ndarray) -> None:
        self.lights, self.target, self._clipped = lights, target, clipped
        self._trust = np.ones(len(target))  # weight of each squared error
        self.power = float(target @ target)

    def normal_equations(self, gain: float) -> tuple[np.ndarray, np.ndarray]:
        """The Gram matrix [L, L] and moments [L] of the weights that explain this channel, times `gain`."""
        trusted = gain * self.lights.T * self._trust
        return gain * trusted @ self.lights, trusted @ self.target

    def gain_of(self, weights: np.ndarray) -> float:
        """The factor by which `weights` explain this channel best."""
        explained = self.lights @ weights
        return float(
            (self._trust * self.target) @ explained / max((self._trust * explained) @ explained, _TINY)
        )

    def reweight(self, weights: np.ndarray) -> None:
        """Set trust by the errors under the weights (Huber), 0 for clipped texels that are bright enough."""
        if not len(self.target):  # nothing is visible enough
            return
        beyond = self.lights @ weights - self.target
        error = np.abs(np.where(self._clipped, np.minimum(beyond, 0), beyond))
        typical = error if self._clipped.all() else error[~self._clipped]
        limit = _OUTLIER * np.median(typical) + _TINY
        self._trust = np.minimum(1, limit / np.maximum(error, limit)) * ~(self._clipped & (beyond > 0))


def _channels(
    olats: Tensor, image: Tensor, clipped: Tensor | None = None, unknowns: np.ndarray | None = None
) -> list[_Channel]:
    """The channels of images [L, C, N] and [C, N], none of which is clipped by default.

    `unknowns` [L, S] gives the lights' weights from those that are solved for.
    """
    white = torch.zeros_like(image, dtype=torch.bool) if clipped is None else clipped
    lights = [own.double().T.numpy() for own in olats.unbind(1)]
    lights = lights if unknowns is None else [own @ unknowns for own in lights]
    targets = image.double().numpy()
    return [_Channel(*one) for one in zip(lights, targets, white.numpy(), strict=True)]


def _robust(
    channels: Sequence[_Channel],
    gains: Sequence[float] | np.ndarray,
    hold: np.ndarray,
    wanted: np.ndarray,
    rounds: int = _ROUNDS,
) -> np.ndarray:
    """Weights [L] >= 0 that explain each channel when multiplied by its gain, by reweighted least squares.

    They are held near the `wanted` ones: `hold` [L, L] weighs squared differences, as shares of the channels'
    power. Trust goes on from what it was before.
    """
    holding = sum(channel.power for channel in channels) * hold
    for _ in range(rounds):
        gram, moment = holding, holding @ wanted
        for channel, gain in zip(channels, gains, strict=True):
            own_gram, own_moment = channel.normal_equations(gain)
            gram, moment = gram + own_gram, moment + own_moment
        weights = least_non_negative(gram, moment)
        for channel, gain in zip(channels, gains, strict=True):
            channel.reweight(gain * weights)
    return weights


def _near_grey(channels: Sequence[_Channel], grey: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """Weights [L, C] that explain each channel alone and are held near the grey light [L], times its gain."""
    return np.stack([_robust([one], [1.0], hold, one.gain_of(grey) * grey) for one in channels], -1)


def _grey_light(channels: list[_Channel], from_near: np.ndarray) -> np.ndarray:
    """Estimate the light [S] that all channels share, each times a gain of its own.

    The more a light stands out from its neighbours, the less smoothness is demanded of it (Cauchy weights);
    otherwise a lone bright light would be spread over its neighbours.
    """
    lights = from_near.shape[1]
    grey, smooth = np.zeros(lights), np.ones(len(from_near))
    colour = np.array([channel.gain_of(np.ones(lights)) for channel in channels])
    colour /= max(colour.mean(), _TINY)
    for _ in range(_ROUNDS_GREY):
        hold = _SMOOTH**2 * (from_near.T * smooth) @ from_near + _SHORT**2 * np.eye(lights)
        grey = _robust(channels, colour, hold, np.zeros(lights), rounds=1)
        smooth = 1 / (1 + (from_near @ grey / max(_STANDS_OUT * grey.mean(), _TINY)) ** 2)
        colour = np.array([channel.gain_of(grey) for channel in channels])
    return grey


def least_non_negative(gram: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """argmin over x >= 0 of x' gram x - 2 moment' x, by the active sets of Lawson and Hanson's NNLS."""
    floor = 1e-9 * gram.trace() / len(gram) + _TINY  # a channel may be black throughout
    gram = gram + floor * np.eye(len(gram))
    found, free = np.zeros(len(gram)), np.zeros(len(gram), bool)
    least = 1e-12 * np.abs(moment).max()
    for _ in range(3 * len(gram)):
        gain = np.where(free, -np.inf, moment - gram @ found)
        if gain.max() <= least:
            break
        free[gain.argmax()] = True
        while True:
            solved = np.zeros(len(gram))
            solved[free] = np.linalg.solve(gram[np.ix_(free, free)], moment[free])
            under = np.flatnonzero(free & (solved <= 0))
            if not len(under):
                break
            steps = found[under] / (found[under] - solved[under])
            found += steps.min() * (solved - found)
            free[under[steps == steps.min()]] = False
        found = solved
    return found


def _difference_from_neighbours(directions: np.ndarray) -> np.ndarray:
    """The matrix [L, L] from lights' weights to the difference of each from the mean of its neighbours."""
    spacing = math.sqrt(4 * math.pi / len(directions))
    near = np.exp((directions @ directions.T - 1) / (_NEIGHBOURHOOD * spacing) ** 2)
    np.fill_diagonal(near, 0)
    return np.eye(len(directions)) - near / np.maximum(near.sum(1, keepdims=True), _TINY)


@dataclass(frozen=True, eq=False)
class RefinedLight:
    """Weights [L, 3], the losses of the start and of the result, and the number of steps."""

    weights: Tensor
    loss_before: float
    loss_after: float
    steps: int


@torch.enable_grad()
def refine_light(
    evidence: LightEvidence,
    start: Tensor,
    features: Features,
    non_negative: bool = True,
) -> RefinedLight:
    """Minimise the feature loss of a light by Adadelta; the result is never worse than the start.

    Clipped texels have no error where they are bright enough.

    Args:
        evidence: The photo's texture and its OLATs.
        start: First weights [L, 3].
        features: Of textures.
        non_negative: Keep weights from 0 up, by projection.
    """
    loss_of = _feature_loss(evidence, features)
    unit = float(start.square().mean().sqrt()) or 1.0  # makes the size of a step the same for all photos
    scaled = (start / unit).requires_grad_()
    optimizer = torch.optim.Adadelta([scaled], lr=_RATE)
    best, first, least, losses = start, 0.0, float("inf"), []
    for _ in range(_STEPS + 1):
        loss = loss_of(scaled * unit)
        losses.append(float(loss.detach()))
        first = losses[0]
        if losses[-1] < least:
            best, least = scaled.detach() * unit, losses[-1]
        if not first > 0 or _has_settled(losses):
            break
        optimizer.zero_grad()
        (loss / first).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if non_negative:
            scaled.data.clamp_(min=0)
    return RefinedLight(best.clone() if least < first else start, first, min(first, least), len(losses) - 1)


def _feature_loss(evidence: LightEvidence, features: Features) -> Callable[[Tensor], Tensor]:
    """The loss of weights: the squared difference of masked textures' features, a mean for each layer."""
    photo, clipped, mask = evidence.photo, evidence.clipped, evidence.mask
    with torch.no_grad():
        wanted = [layer.clone() for layer in features((photo * mask)[None])]

    def loss_of(weights: Tensor) -> Tensor:
        explained = evidence.relit(weights)
        explained = torch.where(clipped, explained.minimum(photo), explained)
        found = features((explained * mask)[None])
        return torch.stack([(a - b).square().mean() for a, b in zip(found, wanted, strict=True)]).sum()

    return loss_of


def _has_settled(losses: list[float]) -> bool:
    if len(losses) <= _PATIENCE:
        return False
    return min(losses) > (1 - _SETTLED) * min(losses[:-_PATIENCE])
