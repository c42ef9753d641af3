"""Estimate the light of a photo from a reflectance field (paper, 'Light Estimation').

`LightEvidence` contains the textures under each single light of a rig and the texture of the photo.
`LightEvidence.least_squares` solves Eq. (leastsq) of the paper for the weights of the lights; `refine_light`
then minimises |V_f(explained texture) - V_f(photo's texture)|^2 over the weights by Adadelta (Zeiler,
*ADADELTA: an adaptive learning rate method*, 2012), as the paper does. The caller passes the features.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError

Features = Callable[[Tensor], Sequence[Tensor]]  # of linear textures [B, 3, T, T], black outside the mask

_WHITE = 0.95  # clipped texels of a photo that ends at 1, averaged with their neighbours, lie above this
_LEAST_TEXELS = 200  # fewer do not determine the direction of light
_BLACK = 1e-4  # mean of an unlit face: below one step of 8 bits
# Penalties of non-uniform ambient light and of lights of different colours, per norm of the photo.
_EVEN, _ONE_COLOUR = 0.3, 0.3
_REACHES = 0.1  # lights below this fraction of the largest mean radiance on the face are not solved for
_CONDITION = 1e-2  # least singular value of signed least squares, relative to the largest
_OUTLIER = 3.0  # median errors above which a texel's weight is inversely proportional to its error
_ROUNDS, _ROUNDS_GREY = 3, 5  # of reweighting
# Penalties of roughness and of length, per norm of the photo: of the grey light that all channels share, and
# of each channel's difference from it.
_SMOOTH, _SHORT = 0.1, 0.01
_SMOOTH_CHANNEL, _SHORT_CHANNEL = 1.0, 0.1
_STANDS_OUT = 3.0  # difference of an isolated bright light from its neighbours, in mean weights
_NEIGHBOURHOOD = 1.5  # standard deviation of a light's neighbourhood, in mean spacings of the lights
_STEPS, _RATE = 150, 1.0  # maximum steps and learning rate of Adadelta
_PATIENCE, _SETTLED = 20, 0.002  # the search ends when this many steps lower the loss by less than a fraction
_TINY = 1e-12  # avoids division by 0


@dataclass(frozen=True, eq=False)
class LightEvidence:
    """Evidence for a light: a face's textures under each single light and in its photo, scene-linear.

    directions [L, 3], unit, camera space; olats [L, 3, T, T]; photo [3, T, T]; mask [T, T] bool: the texels
    that are compared (the paper's M_t in UV space).
    """

    directions: Tensor
    olats: Tensor
    photo: Tensor
    mask: Tensor

    @property
    def clipped(self) -> Tensor:
        """White texels [3, T, T] bool of the photo, whose true radiance may be higher."""
        return clipped(self.photo, self.mask)

    def require_a_face(self) -> None:
        """Raise InputError if too little of the face is visible, or if it is black."""
        texels = int(self.mask.sum())
        if texels < _LEAST_TEXELS:
            raise InputError(
                f"too little of the face is visible to estimate its light ({texels} points of its texture; "
                f"{_LEAST_TEXELS} are needed); use a photo or a matte that shows more of it"
            )
        if float(self.photo[:, self.mask].mean()) < _BLACK:
            raise InputError("the face is black in the photo, so its light is unknown; use a brighter photo")

    def relit(self, weights: Tensor) -> Tensor:
        """Return the face [3, T, T] under weights [L, 3]."""
        return torch.einsum("lc,lcij->cij", weights, self.olats)

    def residual(self, explained: Tensor) -> float:
        """Return |explained [3, T, T] - photo| / |photo| in the mask; clipped texels count if too dark."""
        photo, clipped = self.photo[:, self.mask], self.clipped[:, self.mask]
        error = explained[:, self.mask] - photo
        error = torch.where(clipped, error.clamp(max=0), error)
        return float(error.norm() / photo.norm().clamp_min(_TINY))

    def least_squares(self, non_negative: bool = True) -> Tensor:
        """Solve for weights [L, 3] by `estimate_smooth_weights` or, if signed, `estimate_signed_weights`."""
        olats, photo = self.olats[..., self.mask], self.photo[:, self.mask]
        if not non_negative:
            return estimate_signed_weights(olats, photo)
        return estimate_smooth_weights(self.directions, olats, photo, self.clipped[:, self.mask])


def clipped(photo: Tensor, mask: Tensor) -> Tensor:
    """Return the texels [3, ...] bool of a mask [...] that are white in a photo [3, ...].

    If any value in the mask is above 1, the photo is not clipped.
    """
    ends_at_white = bool(photo[:, mask].max() <= 1) if mask.any() else False
    return (photo >= _WHITE) & mask & ends_at_white


def joined(frames: Sequence[LightEvidence]) -> LightEvidence:
    """Stack the evidence of several frames under the same lights."""
    if len(frames) == 1:
        return frames[0]
    return LightEvidence(
        frames[0].directions,
        torch.cat([frame.olats for frame in frames], -2),
        torch.cat([frame.photo for frame in frames], -2),
        torch.cat([frame.mask for frame in frames], -2),
    )


def estimate_key_light(olats: Tensor, image: Tensor) -> Tensor:
    """Solve Eq. (leastsq) for non-negative weights [L, C] of a key light and of ambient light.

    The first of the scene-linear images [L, C, N], whose weighted sum is to equal an image [C, N], is under
    the key light, the others are under the lights of the ambient rig. Iteratively reweighted least squares
    gives less weight to clipped, covered and misfitted elements. Ambient light is as uniform, and all light
    as much of one colour, as the image allows.
    """
    count = len(olats)
    uneven = np.zeros((count - 1, count))
    uneven[:, 1:] = np.eye(count - 1) - 1 / (count - 1)
    mean = _channels(olats.mean(1, keepdim=True), image.mean(0, keepdim=True))
    grey = _robust(mean, [1.0], _EVEN**2 * uneven.T @ uneven, np.zeros(count))
    weights = _near_grey(_channels(olats, image), grey, _ONE_COLOUR**2 * np.eye(count))
    return torch.from_numpy(weights).float()


def key_light_error(key: Tensor, uniform: Tensor, image: Tensor) -> float:
    """Return the RMS error of an image [N] explained by a key light and uniform light, each an image [N]."""
    (channel,) = _channels(torch.stack([key, uniform])[:, None], image[None])
    weights = _robust([channel], [1.0], np.zeros((2, 2)), np.zeros(2))
    return float(np.sqrt(np.square(channel.lights @ weights - channel.target).mean()))


def estimate_signed_weights(olats: Tensor, image: Tensor) -> Tensor:
    """Solve Eq. (leastsq) as the paper states it: signed weights [L, C], all elements weighted equally.

    The solution has the least norm among the combinations of lights that change the image noticeably.
    Singular values below `_CONDITION` of the largest are dropped, because they are noise of the field
    (truncated singular value decomposition; Hansen, *Rank-deficient and discrete ill-posed problems*, 1998).
    """
    channels = _channels(olats, image)
    solved = [np.linalg.lstsq(channel.lights, channel.target, rcond=_CONDITION)[0] for channel in channels]
    return torch.from_numpy(np.stack(solved, -1)).float()


def estimate_smooth_weights(directions: Tensor, olats: Tensor, image: Tensor, clipped: Tensor) -> Tensor:
    """Solve Eq. (leastsq) for non-negative weights that are smooth where the face does not determine them.

    The lights have directions [L, 3] and images [L, 3, N], whose weighted sum is to equal an image [3, N]. A
    face determines few of the hundreds of weights, and separate solutions for the channels have coloured
    specks. So all channels first share one grey light, tinted, that is smooth except for isolated bright
    lights; then each channel differs from it by weights that are smooth over the sphere. Lights that hardly
    reach the face (their mean radiance on it is below a tenth of the brightest light's) are interpolated from
    their neighbours. Covered and misfitted elements lose weight; where `clipped` [3, N] bool, only too dark a
    result is an error.
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
    """Return the matrix [L, S] from the weights of the lights that reach the face, [L] bool, to all weights.

    Each other weight is the mean of its neighbours (a discrete harmonic function), so it lies between the
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
    """Images [N, L] under each light and the photo [N] in one colour channel."""

    def __init__(self, lights: np.ndarray, target: np.ndarray, clipped: np.ndarray) -> None:
        self.lights, self.target, self._clipped = lights, target, clipped
        self._trust = np.ones(len(target))  # weight of each squared error
        self.power = float(target @ target)

    def normal_equations(self, gain: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gram matrix [L, L] and moments [L] for weights that are multiplied by `gain`."""
        trusted = gain * self.lights.T * self._trust
        return gain * trusted @ self.lights, trusted @ self.target

    def gain_of(self, weights: np.ndarray) -> float:
        """Return the factor that best fits `weights` to this channel."""
        explained = self.lights @ weights
        return float(
            (self._trust * self.target) @ explained / max((self._trust * explained) @ explained, _TINY)
        )

    def reweight(self, weights: np.ndarray) -> None:
        """Set trust from the errors under the weights (Huber), and 0 for clipped texels that are bright."""
        if not len(self.target):
            return
        beyond = self.lights @ weights - self.target
        error = np.abs(np.where(self._clipped, np.minimum(beyond, 0), beyond))
        typical = error if self._clipped.all() else error[~self._clipped]
        limit = _OUTLIER * np.median(typical) + _TINY
        self._trust = np.minimum(1, limit / np.maximum(error, limit)) * ~(self._clipped & (beyond > 0))


def _channels(
    olats: Tensor, image: Tensor, clipped: Tensor | None = None, unknowns: np.ndarray | None = None
) -> list[_Channel]:
    """Split images [L, C, N] and [C, N] into channels.

    `unknowns` [L, S] maps the solved weights to those of all lights.
    """
    white = torch.zeros_like(image, dtype=torch.bool) if clipped is None else clipped
    lights = [channel.double().T.numpy() for channel in olats.unbind(1)]
    lights = lights if unknowns is None else [channel @ unknowns for channel in lights]
    targets = image.double().numpy()
    return [_Channel(*channel) for channel in zip(lights, targets, white.numpy(), strict=True)]


def _robust(
    channels: Sequence[_Channel],
    gains: Sequence[float] | np.ndarray,
    hold: np.ndarray,
    wanted: np.ndarray,
    rounds: int = _ROUNDS,
) -> np.ndarray:
    """Solve for weights [L] >= 0 that explain each channel when multiplied by its gain.

    Reweighted least squares starts from the channels' present trust. `hold` [L, L] weighs squared differences
    from the `wanted` weights, relative to the channels' power.
    """
    holding = sum(channel.power for channel in channels) * hold
    for _ in range(rounds):
        gram, moment = holding, holding @ wanted
        for channel, gain in zip(channels, gains, strict=True):
            of_channel = channel.normal_equations(gain)
            gram, moment = gram + of_channel[0], moment + of_channel[1]
        weights = least_non_negative(gram, moment)
        for channel, gain in zip(channels, gains, strict=True):
            channel.reweight(gain * weights)
    return weights


def _near_grey(channels: Sequence[_Channel], grey: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """Solve for weights [L, C] that explain each channel and stay near the grey light [L] times its gain."""
    solved = [_robust([channel], [1.0], hold, channel.gain_of(grey) * grey) for channel in channels]
    return np.stack(solved, -1)


def _grey_light(channels: list[_Channel], from_near: np.ndarray) -> np.ndarray:
    """Estimate the light [S] that all channels share, each times its own gain.

    The more a light differs from its neighbours, the less smoothness is demanded of it (Cauchy weights);
    otherwise an isolated bright light would be spread over its neighbours.
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
    """Return argmin over x >= 0 of x' gram x - 2 moment' x by Lawson and Hanson's active sets (NNLS).

    scipy's `nnls` does not accept a Gram matrix, and scipy.optimize is slow to import.
    """
    floor = 1e-9 * gram.trace() / len(gram) + _TINY  # a channel may be black throughout
    gram = gram + floor * np.eye(len(gram))
    weights, free = np.zeros(len(gram)), np.zeros(len(gram), bool)
    least = 1e-12 * np.abs(moment).max()
    for _ in range(3 * len(gram)):
        gain = np.where(free, -np.inf, moment - gram @ weights)
        if gain.max() <= least:
            break
        free[gain.argmax()] = True
        while True:
            solved = np.zeros(len(gram))
            solved[free] = np.linalg.solve(gram[np.ix_(free, free)], moment[free])
            under = np.flatnonzero(free & (solved <= 0))
            if not len(under):
                break
            steps = weights[under] / (weights[under] - solved[under])
            weights += steps.min() * (solved - weights)
            free[under[steps == steps.min()]] = False
        weights = solved
    return weights


def _difference_from_neighbours(directions: np.ndarray) -> np.ndarray:
    """Return the matrix [L, L] from weights to each light's difference from the mean of its neighbours."""
    spacing = math.sqrt(4 * math.pi / len(directions))
    near = np.exp((directions @ directions.T - 1) / (_NEIGHBOURHOOD * spacing) ** 2)
    np.fill_diagonal(near, 0)
    return np.eye(len(directions)) - near / np.maximum(near.sum(1, keepdims=True), _TINY)


@dataclass(frozen=True, eq=False)
class RefinedLight:
    """Refined weights [L, 3], the losses before and after, and the number of steps."""

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

    Clipped texels that are bright enough have no error.

    Args:
        evidence: The photo's texture and its OLATs.
        start: Initial weights [L, 3].
        features: Computes the features of textures.
        non_negative: Clamp weights to 0 after each step.
    """
    photo, clipped, mask = evidence.photo, evidence.clipped, evidence.mask
    with torch.no_grad():
        wanted = [layer.clone() for layer in features((photo * mask)[None])]

    def loss_of(weights: Tensor) -> Tensor:
        explained = evidence.relit(weights)
        explained = torch.where(clipped, explained.minimum(photo), explained)
        layers = features((explained * mask)[None])
        return torch.stack([(a - b).square().mean() for a, b in zip(layers, wanted, strict=True)]).sum()

    unit = float(start.square().mean().sqrt()) or 1.0  # makes the step size equal for all photos
    scaled = (start / unit).requires_grad_()
    optimizer = torch.optim.Adadelta([scaled], lr=_RATE)
    best, first, least, losses = start, 0.0, float("inf"), []
    for _ in range(_STEPS + 1):
        loss = loss_of(scaled * unit)
        losses.append(float(loss.detach()))
        first = losses[0]
        if losses[-1] < least:
            best, least = scaled.detach() * unit, losses[-1]
        has_settled = len(losses) > _PATIENCE and min(losses) > (1 - _SETTLED) * min(losses[:-_PATIENCE])
        if not first > 0 or has_settled:
            break
        optimizer.zero_grad()
        (loss / first).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if non_negative:
            scaled.data.clamp_(min=0)
    return RefinedLight(best.clone() if least < first else start, first, min(first, least), len(losses) - 1)
