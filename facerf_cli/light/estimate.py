"""The light of a photo by least squares over a field's single lights (paper, 'Light Estimation').

A photo's light refined by features of its texture (paper, 'Light Estimation').

From the least-squares light on, argmin over the weights of |V_f(explained texture) - V_f(photo's texture)|^2
by Adadelta (Zeiler, *ADADELTA: an adaptive learning rate method*, 2012), as the paper does it. What features
are compared is handed in.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import cholesky, qr, solve_triangular
from scipy.optimize import nnls
from torch import Tensor

from facerf_cli.errors import InputError

_RIDGE = 0.02  # against lights that undo each other, as a share of the picture's norm
_OUTLIER = 3.0  # a texel further off than this many median errors weighs in inverse proportion
_ROUNDS, _ROUNDS_GREY = 3, 5  # of reweighting
_SMOOTH, _SHORT = 0.1, 0.01  # the grey light of `estimate_smooth_light`, as shares of the picture's norm;
_SMOOTH_OWN, _SHORT_OWN = 1.0, 0.1  # and what each channel adds to it
_STANDS_OUT = 3.0  # a light further from its neighbours than this many mean lights may well be a lamp
_TINY = 1e-12
_NEIGHBOURHOOD = 1.5  # standard deviation of what is around a light, in mean distances between lights
_WHITE = 0.95  # of a picture that ends at 1: what was brighter lies, averaged with its neighbours, above this
_LEAST_TEXELS = 200  # fewer say nothing of where light comes from
_BLACK = 1e-4  # the mean of a face that nothing lights: below one step of 8 bits


@dataclass(frozen=True, eq=False)
class LightEvidence:
    """A face in the chart under each single light, and in its photo; all scene-linear.

    directions [L, 3], unit, camera space; olats [L, 3, T, T]; photo [3, T, T]; mask [T, T] bool: the texels
    in which the two are held against each other (the paper's M_t in the chart).
    """

    directions: Tensor
    olats: Tensor
    photo: Tensor
    mask: Tensor

    @property
    def clipped(self) -> Tensor:
        """Where the photo is at white, which may stand for anything brighter [3, T, T] bool.

        A photo that goes beyond 1 anywhere was not clipped there.
        """
        ends_at_white = bool(self.photo[:, self.mask].max() <= 1) if self.mask.any() else False
        return (self.photo >= _WHITE) & self.mask & ends_at_white

    def require_a_face(self) -> None:
        """InputError where there is nothing to read a light from."""
        texels = int(self.mask.sum())
        if texels < _LEAST_TEXELS:
            raise InputError(
                f"too little of the face is seen to read its light from ({texels} texels of the "
                f"{self.mask.shape[-1]} x {self.mask.shape[-1]}, at least {_LEAST_TEXELS} are needed)"
            )
        if float(self.photo[:, self.mask].mean()) < _BLACK:
            raise InputError("the face is black in the photo, so no light can be read from it")

    def relit(self, weights: Tensor) -> Tensor:
        """The face under weights [L, 3], as it is explained: [3, T, T]."""
        return torch.einsum("lc,lcij->cij", weights, self.olats)

    def residual(self, explained: Tensor) -> float:
        """|explained [3, T, T] - photo| / |photo| in the mask; of clipped texels only what is too dark."""
        photo, clipped = self.photo[:, self.mask], self.clipped[:, self.mask]
        error = explained[:, self.mask] - photo
        error = torch.where(clipped, error.clamp(max=0), error)
        return float(error.norm() / photo.norm().clamp_min(_TINY))

    def least_squares(self, non_negative: bool = True) -> Tensor:
        """Weights [L, 3] over the mask: by `estimate_smooth_light`, or the paper's own `plain_estimate`."""
        olats, photo = self.olats[..., self.mask], self.photo[:, self.mask]
        if not non_negative:
            return plain_estimate(olats, photo)
        return estimate_smooth_light(self.directions, olats, photo, self.clipped[:, self.mask])


def estimate_light(olats: Tensor, image: Tensor) -> Tensor:
    """Non-negative weights [L, C] with which lights' pictures [L, C, N] sum to a picture [C, N].

    Eq. (leastsq) of the paper, a channel at a time, with what is clipped, covered or misfitted weighing less
    (iteratively reweighted least squares). Everything is scene-linear.
    """
    channels = [_weights(a, b) for a, b in zip(olats.unbind(1), image, strict=True)]
    return torch.from_numpy(np.stack(channels, -1)).float()


def _weights(olats: Tensor, image: Tensor) -> np.ndarray:
    lights, target = olats.double().T.numpy(), image.double().numpy()  # [N, L], [N]
    if not len(target):  # nothing is seen well enough
        return np.zeros(lights.shape[1])
    ridge = _RIDGE * np.linalg.norm(target) * np.eye(lights.shape[1])
    trust = np.ones(len(target))
    for _ in range(_ROUNDS):
        rows = np.concatenate([lights * trust[:, None], ridge])
        basis, square = qr(rows, mode="economic")  # as small a problem as there are lights
        weights, _ = nnls(square, basis[: len(target)].T @ (target * trust))
        error = np.abs(lights @ weights - target)
        limit = _OUTLIER * np.median(error) + _TINY
        trust = np.sqrt(np.minimum(1, limit / np.maximum(error, limit)))
    return np.asarray(weights)


def plain_estimate(olats: Tensor, image: Tensor) -> Tensor:
    """Eq. (leastsq) as it stands: signed weights [L, C], every element of the picture [C, N] alike.

    Of the many solutions where lights cannot be told apart, the shortest.
    """
    channels = [
        np.linalg.lstsq(lights.double().T.numpy(), target.double().numpy())[0]
        for lights, target in zip(olats.unbind(1), image, strict=True)
    ]
    return torch.from_numpy(np.stack(channels, -1)).float()


def estimate_smooth_light(directions: Tensor, olats: Tensor, image: Tensor, clipped: Tensor) -> Tensor:
    """Eq. (leastsq) for a light that is to be looked at: non-negative, smooth where the face leaves it open.

    Of lights at directions [L, 3], whose pictures [L, 3, N] are to sum to a picture [3, N]. A face fixes few
    numbers of the hundreds sought, and a channel at a time the rest comes out as coloured specks. So first
    all channels share one grey light in one colour, smooth but for lamps that stand out;
    then each channel departs from that, again by what is smooth over the sphere. What is covered or
    misfitted weighs less; where `clipped` [3, N] bool, only being too dark is an error.
    """
    channels = [
        _Channel(lights.double().T.numpy(), target.double().numpy(), white.numpy())
        for lights, target, white in zip(olats.unbind(1), image, clipped, strict=True)
    ]
    from_near = _from_near(directions.double().numpy())
    grey, colour = _grey_light(channels, from_near)
    roughness = from_near.T @ from_near
    own = [channel.near(gain * grey, roughness) for channel, gain in zip(channels, colour, strict=True)]
    return torch.from_numpy(np.stack(own, -1)).float()


def _grey_light(channels: "list[_Channel]", from_near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The light [L] that all channels share, and how much of it each has [3].

    What stands out from its neighbours is held to them the less the more it does (Cauchy's weights), or a
    lone lamp would be smeared out.
    """
    lights = len(from_near)
    power = sum(channel.power for channel in channels)
    hold = np.ones(lights)
    colour = np.array([channel.gain_of(np.ones(lights)) for channel in channels])
    colour /= max(colour.mean(), _TINY)
    for _ in range(_ROUNDS_GREY):
        gram = power * (_SMOOTH**2 * (from_near.T * hold) @ from_near + _SHORT**2 * np.eye(lights))
        moment = np.zeros(lights)
        for channel, gain in zip(channels, colour, strict=True):
            gram += gain * gain * channel.gram()
            moment += gain * channel.moment()
        grey = _non_negative(gram, moment)
        hold = 1 / (1 + (from_near @ grey / max(_STANDS_OUT * grey.mean(), _TINY)) ** 2)
        for channel, gain in zip(channels, colour, strict=True):
            channel.weigh_anew(gain * grey)
        colour = np.array([channel.gain_of(grey) for channel in channels])
    return grey, colour


class _Channel:
    """One colour of the pictures under each light [N, L] and of the photo [N], and each texel's trust."""

    def __init__(self, lights: np.ndarray, target: np.ndarray, clipped: np.ndarray) -> None:
        self._lights, self._target, self._clipped = lights, target, clipped
        self._trust = np.ones(len(target))  # of its squared error
        self.power = float(target @ target)

    def gram(self) -> np.ndarray:
        return (self._lights.T * self._trust) @ self._lights

    def moment(self) -> np.ndarray:
        return self._lights.T @ (self._trust * self._target)

    def gain_of(self, weights: np.ndarray) -> float:
        """What `weights` are best multiplied by."""
        explained = self._lights @ weights
        return float(
            (self._trust * self._target) @ explained / max((self._trust * explained) @ explained, _TINY)
        )

    def weigh_anew(self, weights: np.ndarray) -> None:
        """Trust each texel by its error under the weights (Huber); none that is clipped and bright enough."""
        beyond = self._lights @ weights - self._target
        error = np.abs(np.where(self._clipped, np.minimum(beyond, 0), beyond))
        told = error if self._clipped.all() else error[~self._clipped]
        limit = _OUTLIER * np.median(told) + _TINY
        self._trust = np.minimum(1, limit / np.maximum(error, limit)) * ~(self._clipped & (beyond > 0))

    def near(self, wanted: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """The weights [L] that explain this channel and differ smoothly from the `wanted` ones."""
        hold = self.power * (_SMOOTH_OWN**2 * roughness + _SHORT_OWN**2 * np.eye(len(wanted)))
        for _ in range(_ROUNDS):
            weights = _non_negative(self.gram() + hold, self.moment() + hold @ wanted)
            self.weigh_anew(weights)
        return weights


def _non_negative(gram: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """argmin over x >= 0 of x' gram x - 2 moment' x, by Lawson and Hanson's NNLS on the Cholesky factor."""
    floor = 1e-9 * gram.trace() / len(gram) + _TINY  # a channel may be black throughout
    factor = cholesky(gram + floor * np.eye(len(gram)), lower=True)
    return np.asarray(nnls(factor.T, solve_triangular(factor, moment, lower=True))[0])


def _from_near(directions: np.ndarray) -> np.ndarray:
    """The matrix [L, L] that takes lights' weights to how far each is from the mean of those around it."""
    spacing = math.sqrt(4 * math.pi / len(directions))
    near = np.exp((directions @ directions.T - 1) / (_NEIGHBOURHOOD * spacing) ** 2)
    np.fill_diagonal(near, 0)
    return np.eye(len(directions)) - near / np.maximum(near.sum(1, keepdims=True), _TINY)


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
