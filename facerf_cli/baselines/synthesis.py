"""Analysis by synthesis: the most probable albedo, gloss and light of one photo under their priors.

The texture of a photo is modelled as exp(albedo) * (transfer x) + exp(gloss) * (mirror x), where x are the
spherical-harmonic coefficients of the light, and the transfers, linear in x, hold the effect of the geometry.
Albedo, gloss and light, as coordinates of Gaussian priors, are found together by damped Gauss-Newton steps
(Blanz and Vetter, *A Morphable Model for the Synthesis of 3D Faces*, 1999, optimise them likewise). Texels
that the priors cannot explain (hair, glasses, clipped highlights) lose influence by a Cauchy weight.

The methods with which the paper compares use a morphable model of albedo (the same; with specular albedo:
Smith et al., *A Morphable Face Albedo Model*, 2020). Here it is replaced by the principal components of
logarithms of albedo and gloss in UV space, learnt from procedural skins: albedo stays positive, and the
colour and strength of a light only add to it. The prior of light is learnt from procedural envmaps.
`tools/baseline_priors.py` learns both; they ship as an asset, so that every machine has the same.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import region_mask
from facerf_cli.network.checkpoint import load_checkpoint

SIDE = 64  # texels of the priors of skin; finer detail is individual
ASSET = Path(__file__).parents[1] / "assets" / "baseline_priors.safetensors"
_LEAST_SPREAD = 1e-3  # of a mode of light, relative to the first: below it a mode is rounding error

DETAIL = 0.5  # share of the photo's residual that is added to the albedo
_SEEN = 0.5  # visible share of a coarse texel from which on it counts
_FLOOR = 0.1  # share of the mean radiance: relative errors are relative to at least this
_SHADOW_FLOOR = 0.15  # share of the mean shading: in darker shadow less of the residual is added
_MOST_DETAIL = 1.5  # bound of the residual's logarithm
_FIRM_STEPS = 3  # before outliers are found by their errors
_OUTLIER = 2.0  # median errors at which a texel's weight is halved


@dataclass(frozen=True, eq=False)
class LogGaussian:
    """Logarithm of a texture: mean [C, t, t] plus standard normal coordinates times modes [Q, C, t, t]."""

    mean: Tensor
    modes: Tensor

    def at(self, coordinates: Tensor, side: int) -> Tensor:
        """The logarithm [C, T, T] at coordinates [Q], resampled to `side` texels."""
        field = self.mean + (coordinates.to(self.modes) @ self.modes.flatten(1)).view_as(self.mean)
        return F.interpolate(field[None], (side, side), mode="bilinear", align_corners=False)[0]


@dataclass(frozen=True, eq=False)
class SkinPrior:
    """Diffuse albedo [3, t, t], linear Rec.709, and gloss: reflectance at normal incidence [1, t, t]."""

    diffuse: LogGaussian
    gloss: LogGaussian


@dataclass(frozen=True, eq=False)
class LightPrior:
    """Coefficients of a light (`light/sh.py`): mean [K, 3] plus standard normals times modes [R, K, 3]."""

    mean: Tensor
    modes: Tensor


@cache  # an asset that every fit needs
def skin_prior() -> SkinPrior:
    """Load the shipped prior of skin."""
    tensors, _ = load_checkpoint(ASSET)
    return SkinPrior(
        LogGaussian(tensors["diffuse.mean"], tensors["diffuse.modes"]),
        LogGaussian(tensors["gloss.mean"], tensors["gloss.modes"]),
    )


@cache  # an asset that every fit needs
def light_prior(order: int) -> LightPrior:
    """Load the shipped prior of light, truncated to an order up to that of the asset; R <= 3 K."""
    tensors, _ = load_checkpoint(ASSET)
    count = (order + 1) ** 2
    mean, modes = tensors["light.mean"], tensors["light.modes"]
    if count > len(mean):
        raise ValueError(f"the prior has {len(mean)} coefficients, not {count}")
    _, spread, rotated = torch.linalg.svd(modes[:, :count].flatten(1), full_matrices=False)
    kept = spread > _LEAST_SPREAD * spread[0]
    return LightPrior(mean[:count], (spread[kept, None] * rotated[kept]).view(-1, count, 3))


@dataclass(frozen=True)
class SolveSettings:
    """Number of steps, and `evidence`: the weight of all texels together against priors of unit variance.

    Errors of neighbouring texels are correlated, so that it is far less than the number of texels.
    """

    evidence: float = 500.0
    steps: int = 15


_LIGHT_SETTINGS = SolveSettings(evidence=2e4)  # for the light alone, of which a photo says more


@dataclass(frozen=True, eq=False)
class Scene:
    """N texels of a photo, in the order of the priors' texels.

    radiance [3, N]; trust [N] in 0..1; transfer [3, N, K], the radiance of a white diffuse face per
    coefficient of the light; mirror [N, K], that of a face with gloss 1: zeros without gloss.
    """

    radiance: Tensor
    trust: Tensor
    transfer: Tensor
    mirror: Tensor


@dataclass(frozen=True, eq=False)
class Solution:
    """Coordinates of albedo and gloss, and coefficients [K, 3] of the light."""

    albedo: Tensor
    gloss: Tensor
    light: Tensor


def scene_of(face: FaceTexture, transfer: Tensor, mirror: Tensor) -> Scene:
    """A photo at the side of the priors; its trust is 0 in the eyes."""
    share = F.interpolate(face.visible[None, None], (SIDE, SIDE), mode="area")[0, 0]
    seen = F.interpolate((face.texture * face.visible)[None], (SIDE, SIDE), mode="area")[0]
    trust = share * (share > _SEEN) * (1 - region_mask("eyes", SIDE))
    return Scene((seen / share.clamp_min(1e-6)).flatten(1), trust.flatten(), transfer, mirror)


def shrunk(field: Tensor) -> Tensor:
    """A texture [C, T, T] at the side of the priors."""
    return F.interpolate(field[None], (SIDE, SIDE), mode="area")[0]


def solve(
    scene: Scene,
    albedo: LogGaussian,
    gloss: LogGaussian,
    light: LightPrior,
    settings: SolveSettings = SolveSettings(),
) -> Solution:
    """Find the most probable albedo, gloss and light of a scene whose texels are the priors' [t, t]."""
    seen = scene.trust > 0
    scale = float((scene.radiance[:, seen].mean(0) * scene.trust[seen]).sum() / scene.trust.sum())
    if not scale > 0:  # a black photo has no light and says nothing about the face
        dark = torch.zeros_like(light.mean)
        return Solution(torch.zeros(len(albedo.modes)), torch.zeros(len(gloss.modes)), dark)
    problem = _problem(scene, seen, scale, albedo, gloss, light, settings)
    state = _minimise(problem, settings.steps)
    _, _, albedo_at, gloss_at = problem.split(state)
    return Solution(albedo_at.float(), gloss_at.float(), scale * problem.light_of(state).float())


def light_given(scene: Scene, albedo: Tensor, gloss: Tensor, light: LightPrior) -> Tensor:
    """Find the light [K, 3] of a scene whose logarithms of albedo [3, t, t] and gloss [1, t, t] are known."""
    return solve(scene, known(albedo), known(gloss), light, _LIGHT_SETTINGS).light


def known(logarithm: Tensor) -> LogGaussian:
    """A prior that allows one logarithm [C, t, t] only."""
    return LogGaussian(logarithm, logarithm.new_zeros(0, *logarithm.shape))


def with_detail(
    albedo: Tensor, face: FaceTexture, shading: Tensor, shining: Tensor, share: float = DETAIL
) -> Tensor:
    """Add a share of the photo's residual to the logarithm of an albedo [3, T, T].

    `shading` [3, T, T] is the radiance of a white diffuse face in the photo's light, `shining` that of the
    gloss. Less is added where the photo is dark or the face hidden: it is the most probable residual under a
    Gaussian prior, with noise relative to the shading.
    """
    floor = _SHADOW_FLOOR * (shading * face.visible).sum((1, 2)) / face.visible.sum()
    floor = floor.clamp_min(1e-9)[:, None, None]
    lit = shading.clamp_min(0) + floor
    lacking = (face.texture - shining + floor * albedo.exp()).clamp_min(1e-9).log() - lit.log() - albedo
    finer = albedo + share * face.visible * lacking.clamp(-_MOST_DETAIL, _MOST_DETAIL)
    return finer.clamp(max=0)  # nothing reflects more light than it receives


@dataclass(frozen=True, eq=False)
class _Problem:
    """A scene and priors in float64, flattened, without texels of trust 0."""

    radiance: Tensor  # [3, N], of mean 1
    evidence: Tensor  # [N], weight of a texel's squared relative error
    transfer: Tensor  # [3, N, K]
    mirror: Tensor  # [N, K]
    albedo: tuple[Tensor, Tensor]  # mean [3, N] and modes [Q, 3, N] of logarithms
    gloss: tuple[Tensor, Tensor]  # [N], [P, N]
    light: LightPrior

    def split(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Logarithm of the light's strength, and coordinates of light, albedo and gloss."""
        sizes = [1, len(self.light.modes), len(self.albedo[1]), len(self.gloss[1])]
        strength, light, albedo, gloss = torch.split(state, sizes)
        return strength, light, albedo, gloss

    def light_of(self, state: Tensor) -> Tensor:
        """Coefficients [K, 3]."""
        strength, light, _, _ = self.split(state)
        return strength.exp() * (self.light.mean + torch.einsum("r,rkc->kc", light, self.light.modes))


def _problem(
    scene: Scene,
    seen: Tensor,
    scale: float,
    albedo: LogGaussian,
    gloss: LogGaussian,
    light: LightPrior,
    settings: SolveSettings,
) -> _Problem:
    def at(field: Tensor) -> Tensor:
        return field.flatten(-2)[..., seen].double()

    radiance = scene.radiance[:, seen].double() / scale
    share = scene.trust[seen].double() / scene.trust.sum() / 3
    return _Problem(
        radiance=radiance,
        evidence=settings.evidence * share,
        transfer=scene.transfer[:, seen].double(),
        mirror=scene.mirror[seen].double(),
        albedo=(at(albedo.mean), at(albedo.modes)),
        gloss=(at(gloss.mean)[0], at(gloss.modes)[:, 0]),
        light=LightPrior(light.mean.double(), light.modes.double()),
    )


def _minimise(problem: _Problem, steps: int) -> Tensor:
    """Minimise the cost, starting from the mean face in the mean light of the right strength."""
    size = 1 + len(problem.light.modes) + len(problem.albedo[1]) + len(problem.gloss[1])
    state = torch.zeros(size, dtype=torch.float64)
    image, _ = _synthesise(problem, state, with_slopes=False)
    state[0] = -image.mean().clamp_min(1e-6).log()
    damping = 1e-3
    prior = torch.ones(size, dtype=torch.float64)
    prior[0] = 0  # all strengths of the light are equally probable
    for step in range(steps):
        image, slopes = _synthesise(problem, state)
        error = image - problem.radiance
        # Errors are relative to the greater radiance, or black hair would weigh more than the face.
        reach = torch.maximum(image, problem.radiance) + _FLOOR
        weight = problem.evidence / reach.square()
        if step >= _FIRM_STEPS:
            relative = (error / reach).abs().mean(0)  # Cauchy weights, scaled by the median
            weight = weight * (1 / (1 + (relative / (_OUTLIER * relative.median() + 1e-9)).square()))
        cost = _cost(error, weight, state, prior)
        flat = slopes.flatten(1)
        weighted = flat * weight.flatten()
        hessian = weighted @ flat.T + torch.diag(prior)
        gradient = weighted @ error.flatten() + prior * state
        for _ in range(6):
            damped = hessian + damping * torch.diag(hessian.diagonal() + 1e-6)
            tried = state - torch.linalg.solve(damped, gradient)
            there, _ = _synthesise(problem, tried, with_slopes=False)
            if _cost(there - problem.radiance, weight, tried, prior) < cost:  # False for NaN
                state, damping = tried, max(damping / 5, 1e-9)
                break
            damping *= 10
    return state


def _synthesise(problem: _Problem, state: Tensor, with_slopes: bool = True) -> tuple[Tensor, Tensor]:
    """Radiance [3, N] at a state, and its derivatives [S, 3, N] by the state's elements."""
    strength, _, albedo_at, gloss_at = problem.split(state)
    light = problem.light_of(state)
    diffuse = (problem.albedo[0] + torch.einsum("q,qcn->cn", albedo_at, problem.albedo[1])).exp()
    lit = diffuse * torch.einsum("cnk,kc->cn", problem.transfer, light)
    gloss = (problem.gloss[0] + torch.einsum("p,pn->n", gloss_at, problem.gloss[1])).exp()
    shining = gloss * (problem.mirror @ light).T
    image = lit + shining
    if not with_slopes:
        return image, image
    lights = strength.exp() * problem.light.modes  # [R, K, 3]
    by_light = torch.einsum("cnk,rkc->rcn", problem.transfer, lights) * diffuse
    by_light = by_light + torch.einsum("nk,rkc->rcn", problem.mirror, lights) * gloss
    by_gloss = problem.gloss[1][:, None] * shining
    return image, torch.cat([image[None], by_light, problem.albedo[1] * lit, by_gloss])


def _cost(error: Tensor, weight: Tensor, state: Tensor, prior: Tensor) -> float:
    return float((weight * error.square()).sum() + (prior * state.square()).sum())
