"""The light of a photo by least squares over a field's single lights (paper, 'Light Estimation')."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import qr
from scipy.optimize import nnls
from torch import Tensor

from facerf_cli.errors import InputError

_RIDGE = 0.02  # against lights that undo each other, as a share of the picture's norm
_OUTLIER = 3.0  # a texel further off than this many median errors weighs in inverse proportion
_ROUNDS, _ROUNDS_CLIPPED = 3, 6  # of reweighting; which texels stay clipped takes longer to settle
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
        return float(error.norm() / photo.norm().clamp_min(1e-12))

    def least_squares(self, non_negative: bool = True) -> Tensor:
        """Weights [L, 3]: `estimate_light` or `plain_estimate` over the mask."""
        olats, photo = self.olats[..., self.mask], self.photo[:, self.mask]
        if not non_negative:
            return plain_estimate(olats, photo)
        return estimate_light(olats, photo, self.clipped[:, self.mask])


def estimate_light(olats: Tensor, picture: Tensor, clipped: Tensor | None = None) -> Tensor:
    """Non-negative weights [L, C] with which lights' pictures [L, C, N] sum to a picture [C, N].

    Eq. (leastsq) of the paper, a channel at a time, with what is covered or misfitted weighing less
    (iteratively reweighted least squares). `clipped` [C, N] bool marks what is at white in the picture: there
    only being too dark is an error. Everything is scene-linear.
    """
    if clipped is None:
        clipped = torch.zeros_like(picture, dtype=torch.bool)
    channels = [_weights(a, b, c) for a, b, c in zip(olats.unbind(1), picture, clipped, strict=True)]
    return torch.from_numpy(np.stack(channels, -1)).float()


def plain_estimate(olats: Tensor, picture: Tensor) -> Tensor:
    """Eq. (leastsq) as it stands: signed weights [L, C], every element of the picture [C, N] alike.

    Of the many solutions where lights cannot be told apart, the shortest.
    """
    channels = [
        np.linalg.lstsq(lights.double().T.numpy(), target.double().numpy())[0]
        for lights, target in zip(olats.unbind(1), picture, strict=True)
    ]
    return torch.from_numpy(np.stack(channels, -1)).float()


def _weights(olats: Tensor, picture: Tensor, clipped: Tensor) -> np.ndarray:
    lights, target = olats.double().T.numpy(), picture.double().numpy()  # [N, L], [N]
    white = clipped.numpy()
    if not len(target):  # nothing is seen well enough
        return np.zeros(lights.shape[1])
    ridge = _RIDGE * np.linalg.norm(target) * np.eye(lights.shape[1])
    trust = np.ones(len(target))
    for _ in range(_ROUNDS_CLIPPED if white.any() else _ROUNDS):
        rows = np.concatenate([lights * trust[:, None], ridge])
        basis, square = qr(rows, mode="economic")  # as small a problem as there are lights
        weights, _ = nnls(square, basis[: len(target)].T @ (target * trust))
        beyond = lights @ weights - target
        error = np.abs(np.where(white, np.minimum(beyond, 0), beyond))
        limit = _OUTLIER * np.median(error[~white] if not white.all() else error) + 1e-12
        trust = np.sqrt(np.minimum(1, limit / np.maximum(error, limit)))
        trust[white & (beyond > 0)] = 0
    return np.asarray(weights)
