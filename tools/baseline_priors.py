"""Learn the priors of the baselines from procedural skins and envmaps.

`python -m tools.baseline_priors FILE` writes the asset that `baselines/synthesis.py` loads. Its seeds
are used by no dataset. The prior of light is the mean and covariance of procedural maps of mean radiance 1,
rotated about the vertical: more light comes from above, and the colours of directions are correlated.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.baselines.synthesis import ASSET, SIDE, LightPrior, LogGaussian
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles
from facerf_cli.network.checkpoint import save_checkpoint
from facerf_cli.synth.appearance.people import draw_people
from facerf_cli.synth.appearance.skin import paint_skin
from facerf_cli.synth.random_fields import Window, mask
from facerf_cli.synth.sky.skies import draw_sky

SEED = 52017
SKINS, MAPS = 1500, 600
DIFFUSE_MODES, GLOSS_MODES, LIGHT_MODES = 50, 8, 160
LIGHT_ORDER = 8
_AT_ONCE = 50  # skins painted at a time
_MAP_PX = 64  # width of an envmap
_TURNS = 8  # random azimuths per map
_TEETH, _DARK = 0.5, 0.06  # albedo in an open mouth, as in `synth/appearance/skin.py`
_SHINE = 0.3  # standard deviation of the logarithm of a face's overall gloss


def learn_skin(skins: int = SKINS) -> tuple[LogGaussian, LogGaussian]:
    """Learn diffuse albedo and gloss from procedural skins with painted eyes, without random colours."""
    generator = torch.Generator().manual_seed(SEED)
    diffuse, gloss = [], []
    for first in range(0, skins, _AT_ONCE):
        people = draw_people(min(_AT_ONCE, skins - first), generator)
        people = replace(people, random_texture=torch.zeros_like(people.random_texture))
        skin = paint_skin(people, Window(SIDE), generator, painted_eyes=True)
        shine = _SHINE * torch.randn(len(skin.specular), 1, 1, 1, generator=generator)
        diffuse.append(_with_mouths(skin.albedo, generator).log())
        gloss.append(skin.specular.log() + shine)
    return _principal(torch.cat(diffuse), DIFFUSE_MODES), _principal(torch.cat(gloss), GLOSS_MODES)


def _with_mouths(albedo: Tensor, generator: torch.Generator) -> Tensor:
    """Leave the lips of skins [B, 3, t, t] closed, or open them on teeth or on a dark mouth."""
    inside = mask(Window(SIDE), "mouth", 1.0)
    kind = torch.randint(3, (len(albedo), 1, 1, 1), generator=generator)
    between = torch.where(kind == 1, _TEETH, _DARK)
    return torch.where(kind == 0, albedo, albedo + inside * (between - albedo))


def learn_light(maps: int = MAPS) -> LightPrior:
    """Learn spherical-harmonic coefficients from procedural maps at random azimuths."""
    random = torch.Generator().manual_seed(SEED)
    basis = sh_basis(latlong_directions(_MAP_PX // 2, _MAP_PX), LIGHT_ORDER)
    basis = basis * latlong_solid_angles(_MAP_PX // 2, _MAP_PX)[..., None]
    rows = []
    for index in range(maps):
        envmap = torch.from_numpy(draw_sky(index, SEED, _MAP_PX)[0])
        for turn in torch.randint(_MAP_PX, (_TURNS,), generator=random).tolist():
            rows.append(torch.einsum("hwk,hwc->kc", basis, envmap.roll(turn, 1)))
    found = _principal(torch.stack(rows), LIGHT_MODES)
    return LightPrior(found.mean, found.modes)


def _principal(samples: Tensor, modes: int) -> LogGaussian:
    """Compute the mean and the principal components of samples [N, ...], scaled to standard deviations."""
    mean = samples.mean(0)
    centred = (samples - mean).flatten(1).double()
    wide = centred.shape[1] > len(centred)
    gram = centred @ centred.T if wide else centred.T @ centred
    squares, vectors = torch.linalg.eigh(gram)
    squares, vectors = squares.flip(0)[:modes].clamp_min(0), vectors.flip(1)[:, :modes]
    along = vectors.T @ centred if wide else vectors.T * squares.sqrt()[:, None]
    return LogGaussian(mean, (along / (len(centred) - 1) ** 0.5).float().view(-1, *mean.shape))


def main(path: Path) -> None:
    """Learn the priors and write them to `path`."""
    diffuse, gloss = learn_skin()
    light = learn_light()
    parts = {"diffuse": diffuse, "gloss": gloss, "light": light}
    tensors = {
        f"{name}.{field}": getattr(part, field) for name, part in parts.items() for field in ("mean", "modes")
    }
    made = {"skins": SKINS, "maps": MAPS, "turns": _TURNS, "seed": SEED, "side": SIDE, "order": LIGHT_ORDER}
    save_checkpoint(path, tensors, {"made_by": "tools.baseline_priors", **made})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ASSET)
