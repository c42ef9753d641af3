"""The proxy's shading under the light that explains a photo best.

The skin is taken to be of one colour and matt. It is a first guess of the photo's light, from which the
Portrait Network starts.
"""

import torch
import torch.nn.functional as F
from scipy.optimize import nnls
from torch import Tensor

from facerf_cli.network.portrait import SKIN

_SOLVED_PX = 48  # side at which the light is estimated
_SURE = 0.8  # share of skin, and cover of the proxy, of the pixels that are explained
_RIDGE = 0.05  # of the weights, per root of the number of pixels: many lights explain a photo alike
_LEAST_PIXELS = 30
_BRIGHTEST = 3.0  # over the mean: clipped, so that highlights count little


def own_shading(image: Tensor, classes: Tensor, normals: Tensor, rig: Tensor, visible: Tensor) -> Tensor:
    """Shading [1, S, S], with a mean of 1 over the skin, of a proxy under a photo's estimated light.

    image [3, S, S] scene-linear; classes [C, S, S]; normals [3, S, S]; visible [L, s, s] of a rig [L, 3] all
    around.
    """
    skin = _at(classes[SKIN : SKIN + 1], _SOLVED_PX)[0]
    olats = _olats(_at(normals, _SOLVED_PX), rig, _at(visible, _SOLVED_PX))
    grey = _at(image.mean(0, keepdim=True), _SOLVED_PX)[0]
    sure = skin > _SURE
    side = image.shape[-1]
    if sure.sum() < _LEAST_PIXELS:
        return torch.ones(1, side, side)
    wanted = (grey[sure] / grey[sure].mean().clamp_min(1e-6)).clamp(max=_BRIGHTEST)
    columns = olats[:, sure].T
    ridge = _RIDGE * len(columns) ** 0.5 * torch.eye(len(olats))
    padded = torch.cat([wanted, torch.zeros(len(olats))])
    weights, _ = nnls(torch.cat([columns, ridge]).double().numpy(), padded.double().numpy())
    weights = torch.from_numpy(weights).float()
    coarse = torch.einsum("l,lij->ij", weights, _olats(_at(normals, visible.shape[-1]), rig, visible))
    shading = _at(coarse[None], side)
    share = classes[SKIN]
    return shading / ((shading[0] * share).sum() / share.sum().clamp_min(1e-3)).clamp_min(1e-3)


def _olats(normals: Tensor, rig: Tensor, visible: Tensor) -> Tensor:
    """Shading [L, s, s] of a white matt proxy under each light, with a little light in shadows."""
    cosine = torch.einsum("lc,cij->lij", rig, F.normalize(normals, dim=0)).clamp_min(0)
    return visible * cosine + 0.02


def _at(maps: Tensor, side: int) -> Tensor:
    mode = "area" if side < maps.shape[-1] else "bilinear"
    return F.interpolate(maps[None], size=(side, side), mode=mode)[0]
