"""Analysis by synthesis: albedo and light of one photo, as coordinates of their priors.

A photo's texture is taken to be exp(albedo) * (transfer x) + exp(gloss) * (mirror x), where x are the light's
spherical-harmonic coefficients and the transfers, linear in them, hold what geometry does to light. The most
probable albedo, gloss and light are found together by damped Gauss-Newton steps, a small problem as all three
are Gaussian (Blanz and Vetter, *A Morphable Model for the Synthesis of 3D Faces*, 1999, do so step by step).
What no skin explains (hair, glasses, clipped highlights) is weighed down by a Cauchy weight.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.baselines.base import LightPrior, LogGaussian

_FLOOR = 0.1  # of the mean radiance, below which errors do not grow: they are relative to the radiance
_FIRM_STEPS = 3  # before outliers are told by the fit
_OUTLIER = 2.0  # median errors at which a texel's weight is halved


@dataclass(frozen=True)
class SolveSettings:
    """`evidence`: what all texels' relative errors weigh together, against priors of unit variance.

    Neighbouring texels err together, so it is far less than a term a texel would make it.
    """

    evidence: float = 500.0
    steps: int = 15


_OF_LIGHT = SolveSettings(evidence=2e4)


@dataclass(frozen=True, eq=False)
class Scene:
    """N texels of a photo, in the chart's order of the priors' fields.

    radiance [3, N]; trust [N] in 0..1; transfer [3, N, K]: radiance of a white diffuse face a coefficient;
    mirror [N, K] of one with gloss 1, None where nothing shines.
    """

    radiance: Tensor
    trust: Tensor
    transfer: Tensor
    mirror: Tensor | None


@dataclass(frozen=True, eq=False)
class Solution:
    """Coordinates of albedo and gloss, and the light's coefficients [K, 3]."""

    albedo: Tensor
    gloss: Tensor
    light: Tensor


def light_given(scene: Scene, albedo: Tensor, gloss: Tensor, light: LightPrior) -> Tensor:
    """The light [K, 3] of a scene whose logarithms of albedo [3, t, t] and gloss [1, t, t] are known.

    The photo says more of it than of a face that is still to be found.
    """
    return solve(scene, _known(albedo), _known(gloss), light, _OF_LIGHT).light


def _known(logarithm: Tensor) -> LogGaussian:
    return LogGaussian(logarithm, logarithm.new_zeros(0, *logarithm.shape))


@dataclass(frozen=True, eq=False)
class _Problem:
    """All in float64 and flattened; texels of no trust are left out."""

    radiance: Tensor  # [3, N], of mean 1
    evidence: Tensor  # [N], of a texel's squared relative error
    transfer: Tensor  # [3, N, K]
    mirror: Tensor | None
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


def solve(
    scene: Scene,
    albedo: LogGaussian,
    gloss: LogGaussian,
    light: LightPrior,
    settings: SolveSettings = SolveSettings(),
) -> Solution:
    """The most probable albedo, gloss and light of a scene whose texels are the priors' [t, t]."""
    seen = scene.trust > 0
    scale = float((scene.radiance[:, seen].mean(0) * scene.trust[seen]).sum() / scene.trust.sum())
    if not scale > 0:  # black: no light, and nothing to be said of the face
        dark = torch.zeros_like(light.mean)
        return Solution(torch.zeros(len(albedo.modes)), torch.zeros(len(gloss.modes)), dark)
    problem = _problem(scene, seen, scale, albedo, gloss, light, settings)
    state = _minimise(problem, settings.steps)
    _, _, albedo_at, gloss_at = problem.split(state)
    return Solution(albedo_at.float(), gloss_at.float(), scale * problem.light_of(state).float())


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
    modes = 0 if scene.mirror is None else len(gloss.modes)
    return _Problem(
        radiance=radiance,
        evidence=settings.evidence * share,
        transfer=scene.transfer[:, seen].double(),
        mirror=None if scene.mirror is None else scene.mirror[seen].double(),
        albedo=(at(albedo.mean), at(albedo.modes)),
        gloss=(at(gloss.mean)[0], at(gloss.modes)[:modes, 0]),
        light=LightPrior(light.mean.double(), light.modes.double()),
    )


def _minimise(problem: _Problem, steps: int) -> Tensor:
    """The state of least cost, from the mean face in the mean light of the right strength."""
    size = 1 + len(problem.light.modes) + len(problem.albedo[1]) + len(problem.gloss[1])
    state = torch.zeros(size, dtype=torch.float64)
    image, _ = _synthesise(problem, state, with_slopes=False)
    state[0] = -image.mean().clamp_min(1e-6).log()
    damping = 1e-3
    prior = torch.ones(size, dtype=torch.float64)
    prior[0] = 0  # any exposure is as likely
    for step in range(steps):
        image, slopes = _synthesise(problem, state)
        error = image - problem.radiance
        # Against the greater of the two, or black hair would count for more than the face.
        reach = torch.maximum(image, problem.radiance) + _FLOOR
        weight = problem.evidence / reach.square()
        if step >= _FIRM_STEPS:
            weight = weight * _robust(error / reach)
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
    """The picture [3, N] and, for all of the state, its slopes [S, 3, N]."""
    strength, _, albedo_at, gloss_at = problem.split(state)
    light = problem.light_of(state)
    diffuse = (problem.albedo[0] + torch.einsum("q,qcn->cn", albedo_at, problem.albedo[1])).exp()
    lit = diffuse * torch.einsum("cnk,kc->cn", problem.transfer, light)
    shining, gloss = torch.zeros_like(lit), torch.zeros_like(lit[0])
    if problem.mirror is not None:
        gloss = (problem.gloss[0] + torch.einsum("p,pn->n", gloss_at, problem.gloss[1])).exp()
        shining = gloss * (problem.mirror @ light).T
    image = lit + shining
    if not with_slopes:
        return image, image
    lights = strength.exp() * problem.light.modes  # [R, K, 3]
    by_light = torch.einsum("cnk,rkc->rcn", problem.transfer, lights) * diffuse
    if problem.mirror is not None:
        by_light = by_light + torch.einsum("nk,rkc->rcn", problem.mirror, lights) * gloss
    by_gloss = problem.gloss[1][:, None] * shining
    return image, torch.cat([image[None], by_light, problem.albedo[1] * lit, by_gloss])


def _robust(relative: Tensor) -> Tensor:
    """Cauchy weights [N] of the texels' relative errors [3, N], against their median."""
    size = relative.abs().mean(0)
    return 1 / (1 + (size / (_OUTLIER * size.median() + 1e-9)).square())


def _cost(error: Tensor, weight: Tensor, state: Tensor, prior: Tensor) -> float:
    return float((weight * error.square()).sum() + (prior * state.square()).sum())
