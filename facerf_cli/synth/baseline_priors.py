"""The priors of the baselines, learnt from procedural skins and maps.

`python -m facerf_cli.synth.baseline_priors FILE` writes the asset that `baselines/priors.py` loads; no dataset
uses its seeds. Light differs by direction: there is more from above than from below, and its colours vary
together. Its prior has the mean and covariance of procedural maps, turned about the vertical, each of mean
radiance 1.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.baselines.priors import ASSET, SIDE, LightPrior, LogGaussian
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles
from facerf_cli.network.checkpoint import save_checkpoint
from facerf_cli.synth.appearance.people import draw_people
from facerf_cli.synth.appearance.skin import paint_skin
from facerf_cli.synth.random_fields import UV_SPAN, Window, mask
from facerf_cli.synth.sky.skies import draw_sky

SEED = 52017
SKINS, MAPS = 1500, 600
DIFFUSE_MODES, GLOSS_MODES, LIGHT_MODES = 50, 8, 160
LIGHT_ORDER = 8
_AT_ONCE, _MAP_PX = 50, 64
_TURNS = 8  # of a map about the vertical
_TEETH, _DARK = 0.5, 0.06  # as `synth/appearance/skin.py` has them
_SHINE = 0.3  # deviation of the logarithm of all of a face's gloss, as photographs differ in it


def learn_skin(skins: int = SKINS) -> tuple[LogGaussian, LogGaussian]:
    """Diffuse albedo and gloss of procedural skins with painted eyes; nobody wears random colours."""
    generator = torch.Generator().manual_seed(SEED)
    diffuse, gloss = [], []
    for first in range(0, skins, _AT_ONCE):
        people = draw_people(min(_AT_ONCE, skins - first), generator)
        people = replace(people, random_texture=torch.zeros_like(people.random_texture))
        skin = paint_skin(people, Window(SIDE, UV_SPAN), generator, painted_eyes=True)
        shine = _SHINE * torch.randn(len(skin.specular), 1, 1, 1, generator=generator)
        diffuse.append(_with_mouths(skin.albedo, generator).log())
        gloss.append(skin.specular.log() + shine)
    return _principal(torch.cat(diffuse), DIFFUSE_MODES), _principal(torch.cat(gloss), GLOSS_MODES)


def _with_mouths(albedo: Tensor, generator: torch.Generator) -> Tensor:
    """Lips [B, 3, t, t] as they are when closed, or open on teeth, or on the dark."""
    inside = mask(Window(SIDE, UV_SPAN), "mouth", 1.0)
    kind = torch.randint(3, (len(albedo), 1, 1, 1), generator=generator)
    between = torch.where(kind == 1, _TEETH, _DARK)
    return torch.where(kind == 0, albedo, albedo + inside * (between - albedo))


def learn_light(maps: int = MAPS) -> LightPrior:
    """Coefficients of procedural maps of mean radiance 1, at random azimuths."""
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
    """Mean and principal components of samples [N, ...], each scaled by its standard deviation."""
    mean = samples.mean(0)
    centred = (samples - mean).flatten(1).double()
    wide = centred.shape[1] > len(centred)
    gram = centred @ centred.T if wide else centred.T @ centred
    squares, vectors = torch.linalg.eigh(gram)
    squares, vectors = squares.flip(0)[:modes].clamp_min(0), vectors.flip(1)[:, :modes]
    along = vectors.T @ centred if wide else vectors.T * squares.sqrt()[:, None]
    return LogGaussian(mean, (along / (len(centred) - 1) ** 0.5).float().view(-1, *mean.shape))


def main(path: Path) -> None:
    """Write the asset."""
    diffuse, gloss = learn_skin()
    light = learn_light()
    parts = {"diffuse": diffuse, "gloss": gloss, "light": light}
    tensors = {
        f"{name}.{field}": getattr(part, field) for name, part in parts.items() for field in ("mean", "modes")
    }
    made = {"skins": SKINS, "maps": MAPS, "turns": _TURNS, "seed": SEED, "side": SIDE, "order": LIGHT_ORDER}
    save_checkpoint(path, tensors, {"made_by": "facerf_cli.synth.baseline_priors", **made})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ASSET)
