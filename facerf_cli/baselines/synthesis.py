"""Analysis by synthesis: the most probable albedo, gloss and light of one photo under their priors.

A photo's texture is modelled as exp(albedo) * (transfer x) + exp(gloss) * (mirror x), where x are the
spherical-harmonic coefficients of the light and the transfers describe the geometry. Albedo, gloss and light
are coordinates of Gaussian priors, estimated together with damped Gauss-Newton steps (similar to Blanz and
Vetter, *A Morphable Model for the Synthesis of 3D Faces*, 1999). Texels that the priors cannot explain (hair,
glasses, clipped highlights) lose influence through a Cauchy weight.

The methods that the paper compares with use a morphable albedo model (Blanz and Vetter; with specular albedo:
Smith et al., *A Morphable Face Albedo Model*, 2020). Here it is replaced by principal components of the
logarithms of albedo and gloss in UV space, learnt from procedural skins: albedo stays positive, and the
colour and strength of a light are additive. The prior of light is learnt from procedural environment maps.
`tools/baseline_priors.py` learns both; they ship as an asset, so that all machines use the same priors.
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

SIDE = 64  # texels of the skin priors; finer detail is individual
ASSET = Path(__file__).parents[1] / "assets" / "baseline_priors.safetensors"
_LEAST_SPREAD = 1e-3  # relative to the first mode of light; smaller modes are rounding errors

DETAIL = 0.5  # fraction of the photo's residual that is added to the albedo
_VISIBLE = 0.5  # visible fraction below which a coarse texel is ignored
_FLOOR = 0.1  # fraction of the mean radiance; lower bound of the radiance that errors are relative to
_SHADOW_FLOOR = 0.15  # fraction of the mean shading; darker texels get less of the residual
_MOST_DETAIL = 1.5  # bound of the residual's logarithm
_FIRM_STEPS = 3  # number of steps without outlier weights
_OUTLIER = 2.0  # error in medians at which a texel's weight is halved
_LIGHT_EVIDENCE = 2e4  # evidence for the light alone, which a photo constrains better


@dataclass(frozen=True, eq=False)
class LogGaussian:
    """Logarithm of a texture: mean plus standard normal coordinates times modes."""

    mean: Tensor  # [C, t, t]
    modes: Tensor  # [Q, C, t, t]

    def at(self, coordinates: Tensor, side: int) -> Tensor:
        """Compute the logarithm [C, T, T] at coordinates [Q], resampled to `side` texels."""
        field = self.mean + (coordinates.to(self.modes) @ self.modes.flatten(1)).view_as(self.mean)
        return F.interpolate(field[None], (side, side), mode="bilinear", align_corners=False)[0]


@dataclass(frozen=True, eq=False)
class SkinPrior:
    """Priors of the skin's reflectance."""

    diffuse: LogGaussian  # albedo [3, t, t], linear Rec.709
    gloss: LogGaussian  # reflectance at normal incidence [1, t, t]


@dataclass(frozen=True, eq=False)
class LightPrior:
    """Coefficients of a light (`light/sh.py`): mean plus standard normal coordinates times modes."""

    mean: Tensor  # [K, 3]
    modes: Tensor  # [R, K, 3]


@cache
def skin_prior() -> SkinPrior:
    """Load the shipped prior of skin."""
    tensors, _ = load_checkpoint(ASSET)
    return SkinPrior(
        LogGaussian(tensors["diffuse.mean"], tensors["diffuse.modes"]),
        LogGaussian(tensors["gloss.mean"], tensors["gloss.modes"]),
    )


@cache
def light_prior(order: int) -> LightPrior:
    """Load the shipped prior of light, truncated to an order; R <= 3 K."""
    tensors, _ = load_checkpoint(ASSET)
    count = (order + 1) ** 2
    mean, modes = tensors["light.mean"], tensors["light.modes"]
    if count > len(mean):
        raise ValueError(f"the prior has {len(mean)} coefficients, not {count}")
    _, spread, rotated = torch.linalg.svd(modes[:, :count].flatten(1), full_matrices=False)
    kept = spread > _LEAST_SPREAD * spread[0]
    return LightPrior(mean[:count], (spread[kept, None] * rotated[kept]).view(-1, count, 3))


@dataclass(frozen=True, eq=False)
class Scene:
    """N texels of a photo, in the order of the priors' texels."""

    radiance: Tensor  # [3, N]
    trust: Tensor  # [N] in 0..1
    transfer: Tensor  # [3, N, K], radiance of a white diffuse face per coefficient of the light
    mirror: Tensor  # [N, K], radiance of a face with gloss 1 per coefficient; zeros without gloss


@dataclass(frozen=True, eq=False)
class Solution:
    """Coordinates of albedo and gloss, and coefficients [K, 3] of the light."""

    albedo: Tensor
    gloss: Tensor
    light: Tensor


def scene_of(face: FaceTexture, transfer: Tensor, mirror: Tensor) -> Scene:
    """Shrink a photo's texture to the side of the priors, with trust 0 in the eyes."""
    visible = shrunk(face.visible[None])[0]
    radiance = shrunk(face.texture * face.visible) / visible.clamp_min(1e-6)
    trust = visible * (visible > _VISIBLE) * (1 - region_mask("eyes", SIDE))
    return Scene(radiance.flatten(1), trust.flatten(), transfer, mirror)


def shrunk(texture: Tensor) -> Tensor:
    """Shrink a texture [C, T, T] to the side of the priors."""
    return F.interpolate(texture[None], (SIDE, SIDE), mode="area")[0]


def solve(
    scene: Scene,
    albedo: LogGaussian,
    gloss: LogGaussian,
    light: LightPrior,
    evidence: float = 500.0,
    steps: int = 15,
) -> Solution:
    """Estimate the most probable albedo, gloss and light of a scene whose texels match the priors' [t, t].

    `evidence` is the total weight of all texels against priors of unit variance. Errors of neighbouring
    texels are correlated, so it is much smaller than the number of texels.
    """
    used = scene.trust > 0
    scale = float((scene.radiance[:, used].mean(0) * scene.trust[used]).sum() / scene.trust.sum())
    if not scale > 0:  # a black photo has no light and does not constrain the face
        dark = torch.zeros_like(light.mean)
        return Solution(torch.zeros(len(albedo.modes)), torch.zeros(len(gloss.modes)), dark)
    problem = _problem(scene, used, scale, albedo, gloss, light, evidence)
    state = _minimise(problem, steps)
    _, _, albedo_at, gloss_at = problem.split(state)
    return Solution(albedo_at.float(), gloss_at.float(), scale * problem.light_of(state).float())


def solve_light(scene: Scene, albedo: Tensor, gloss: Tensor, light: LightPrior) -> Tensor:
    """Estimate the light [K, 3] of a scene with known logarithms of albedo [3, t, t] and gloss [1, t, t]."""
    return solve(scene, known(albedo), known(gloss), light, _LIGHT_EVIDENCE).light


def known(logarithm: Tensor) -> LogGaussian:
    """Return a prior that allows only one logarithm [C, t, t]."""
    return LogGaussian(logarithm, logarithm.new_zeros(0, *logarithm.shape))


def with_detail(
    albedo: Tensor, face: FaceTexture, shading: Tensor, specular: Tensor, fraction: float = DETAIL
) -> Tensor:
    """Add a fraction of the photo's residual to the logarithm of an albedo [3, T, T].

    `shading` [3, T, T] is the radiance of a white diffuse face in the photo's light, `specular` the radiance
    of the gloss. Dark or hidden texels get less: the residual is the most probable one under a Gaussian
    prior, with noise relative to the shading.
    """
    floor = _SHADOW_FLOOR * (shading * face.visible).sum((1, 2)) / face.visible.sum()
    floor = floor.clamp_min(1e-9)[:, None, None]
    lit = shading.clamp_min(0) + floor
    residual = (face.texture - specular + floor * albedo.exp()).clamp_min(1e-9).log() - lit.log() - albedo
    detailed = albedo + fraction * face.visible * residual.clamp(-_MOST_DETAIL, _MOST_DETAIL)
    return detailed.clamp(max=0)  # no surface reflects more light than it receives


@dataclass(frozen=True, eq=False)
class _Problem:
    """Scene and priors in float64, flattened, without texels of trust 0."""

    radiance: Tensor  # [3, N], of mean 1
    evidence: Tensor  # [N], weight of a texel's squared relative error
    transfer: Tensor  # [3, N, K]
    mirror: Tensor  # [N, K]
    albedo: tuple[Tensor, Tensor]  # mean [3, N] and modes [Q, 3, N] of logarithms
    gloss: tuple[Tensor, Tensor]  # [N], [P, N]
    light: LightPrior

    def split(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Split a state into the log strength of the light and coordinates of light, albedo and gloss."""
        sizes = [1, len(self.light.modes), len(self.albedo[1]), len(self.gloss[1])]
        strength, light, albedo, gloss = torch.split(state, sizes)
        return strength, light, albedo, gloss

    def light_of(self, state: Tensor) -> Tensor:
        strength, light, _, _ = self.split(state)
        return strength.exp() * (self.light.mean + torch.einsum("r,rkc->kc", light, self.light.modes))


def _problem(
    scene: Scene,
    used: Tensor,
    scale: float,
    albedo: LogGaussian,
    gloss: LogGaussian,
    light: LightPrior,
    evidence: float,
) -> _Problem:
    def at(texture: Tensor) -> Tensor:
        return texture.flatten(-2)[..., used].double()

    weight = scene.trust[used].double() / scene.trust.sum() / 3
    return _Problem(
        radiance=scene.radiance[:, used].double() / scale,
        evidence=evidence * weight,
        transfer=scene.transfer[:, used].double(),
        mirror=scene.mirror[used].double(),
        albedo=(at(albedo.mean), at(albedo.modes)),
        gloss=(at(gloss.mean)[0], at(gloss.modes)[:, 0]),
        light=LightPrior(light.mean.double(), light.modes.double()),
    )


def _minimise(problem: _Problem, steps: int) -> Tensor:
    """Minimise the cost from the mean face in the mean light of the right strength."""
    size = 1 + len(problem.light.modes) + len(problem.albedo[1]) + len(problem.gloss[1])
    state = torch.zeros(size, dtype=torch.float64)
    image, _ = _synthesise(problem, state, with_slopes=False)
    state[0] = -image.mean().clamp_min(1e-6).log()
    damping = 1e-3
    prior = torch.ones(size, dtype=torch.float64)
    prior[0] = 0  # the light's strength has no prior
    for step in range(steps):
        image, slopes = _synthesise(problem, state)
        error = image - problem.radiance
        # Errors are relative to the larger radiance; otherwise, black hair would outweigh the face.
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
    """Compute the radiance [3, N] at a state, and its derivatives [S, 3, N]."""
    strength, _, albedo_at, gloss_at = problem.split(state)
    light = problem.light_of(state)
    diffuse = (problem.albedo[0] + torch.einsum("q,qcn->cn", albedo_at, problem.albedo[1])).exp()
    lit = diffuse * torch.einsum("cnk,kc->cn", problem.transfer, light)
    gloss = (problem.gloss[0] + torch.einsum("p,pn->n", gloss_at, problem.gloss[1])).exp()
    specular = gloss * (problem.mirror @ light).T
    image = lit + specular
    if not with_slopes:
        return image, image
    lights = strength.exp() * problem.light.modes  # [R, K, 3]
    by_light = torch.einsum("cnk,rkc->rcn", problem.transfer, lights) * diffuse
    by_light = by_light + torch.einsum("nk,rkc->rcn", problem.mirror, lights) * gloss
    by_gloss = problem.gloss[1][:, None] * specular
    return image, torch.cat([image[None], by_light, problem.albedo[1] * lit, by_gloss])


def _cost(error: Tensor, weight: Tensor, state: Tensor, prior: Tensor) -> float:
    return float((weight * error.square()).sum() + (prior * state.square()).sum())
