"""Train the network that guesses the light of a picture, on drawn skies, rooms, studios, nights and stages.

`python -m tools.picture_network FILE` writes the asset that `light/picture.py` loads: 6 minutes of one core.
A sample is a map as a camera sees it: an angle of view of 35 to 90 degrees across, an aspect, a small tilt;
a tint, an exposure, a white balance that takes part of the cast away, a tone curve, clipping, noise. What
is compared is the light on a white ball that the camera sees, under one scale, its colour and its level; and,
weakly, the map. Its seed is used by no dataset.
"""

import math
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.light.picture import COLUMNS, ROWS, PictureLightNetwork
from facerf_cli.light.sphere import LUMINANCE, latlong_directions, latlong_solid_angles
from facerf_cli.synth.sky.skies import KINDS, draw_sky

SEED = 53001
MAPS, TURNS, STEPS, BATCH, RATE = 3600, 4, 700, 64, 2e-3  # more steps fit drawn maps better, real ones worse
_MAP_PX, _TRUTH_ROWS = 256, 16  # width of a drawn map; rows of the map that is compared
_ASPECTS = (3 / 2, 3 / 2, 4 / 3, 16 / 9, 1.0, 3 / 4, 2 / 3)
_SAMPLES = 2  # rays a pixel of a view, along each side


def ball_normals(count: int = 21) -> Tensor:
    """Normals [N, 3] of a ball, evenly over the disc that the camera sees."""
    y, x = torch.meshgrid(
        torch.linspace(0.95, -0.95, count), torch.linspace(-0.95, 0.95, count), indexing="ij"
    )
    flat = torch.stack([x, y], -1).reshape(-1, 2)
    flat = flat[flat.square().sum(1) < 0.95]
    return torch.cat([flat, (1 - flat.square().sum(1, keepdim=True)).sqrt()], 1)


DIRECTIONS = latlong_directions(_TRUTH_ROWS, 2 * _TRUTH_ROWS).reshape(-1, 3)
SOLID_ANGLES = latlong_solid_angles(_TRUTH_ROWS, 2 * _TRUTH_ROWS).reshape(-1)
ON_BALL = (ball_normals() @ DIRECTIONS.T).clamp_min(0) * SOLID_ANGLES / math.pi


def draw(index: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Draw one map seen `TURNS` times: truths [T, texels, 3], views [T, 3, 32, 48], tangents [T, 2]."""
    drawn = torch.from_numpy(draw_sky(index, SEED, _MAP_PX, tuple(KINDS))[0]).permute(2, 0, 1)
    truths, views, tangents = [], [], []
    for _ in range(TURNS):
        turn = int(torch.randint(2 * _TRUTH_ROWS, (), generator=generator)) * _MAP_PX // (2 * _TRUTH_ROWS)
        turned = torch.roll(drawn, turn, -1)
        across = math.tan(math.radians(35 * (90 / 35) ** float(torch.rand((), generator=generator)) / 2))
        aspect = _ASPECTS[int(torch.randint(len(_ASPECTS), (), generator=generator))]
        tangent = torch.tensor([across, across / aspect])
        views.append(seen(turned, tangent, 5 * float(torch.randn((), generator=generator))))
        truths.append(F.adaptive_avg_pool2d(turned, (_TRUTH_ROWS, 2 * _TRUTH_ROWS)).flatten(1).T)
        tangents.append(tangent)
    return torch.stack(truths), torch.stack(views), torch.stack(tangents)


def seen(envmap: Tensor, tangents: Tensor, tilt_deg: float) -> Tensor:
    """What a camera that looks along -z, tilted up, sees of a map [3, H, W]: [3, 32, 48]."""
    rows, columns = ROWS * _SAMPLES, COLUMNS * _SAMPLES
    y = (1 - (torch.arange(rows) + 0.5) / rows * 2)[:, None].expand(rows, columns) * tangents[1]
    x = ((torch.arange(columns) + 0.5) / columns * 2 - 1).expand(rows, columns) * tangents[0]
    tilt = math.radians(tilt_deg)
    y, z = y * math.cos(tilt) + math.sin(tilt), y * math.sin(tilt) - math.cos(tilt)
    u = (0.5 - torch.atan2(x, z) / (2 * math.pi)) % 1
    v = 0.5 - torch.asin(y / torch.sqrt(x * x + y * y + z * z)) / math.pi
    wrapped = torch.cat([envmap[..., -1:], envmap, envmap[..., :1]], -1)
    width = envmap.shape[-1]
    grid = torch.stack([(u * width + 1) / (width + 2) * 2 - 1, v * 2 - 1], -1)[None]
    view = F.grid_sample(wrapped[None], grid, padding_mode="border", align_corners=False)
    return F.avg_pool2d(view, _SAMPLES)[0]


def photographed(views: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Views [B, 3, h, w] of radiance as cameras give them, decoded from sRGB; and the gain [B, 3] to them."""
    count = len(views)
    mean = views.mean((2, 3)).clamp_min(1e-4)
    level = mean @ torch.tensor(LUMINANCE)
    gain = 0.2 * torch.exp(0.5 * torch.randn(count, generator=generator)) / level
    balance = torch.exp(0.12 * torch.randn(count, 3, generator=generator))
    balance /= (balance @ torch.tensor(LUMINANCE))[:, None]
    tint = torch.exp(0.25 * torch.randn(count, 3, generator=generator))
    cast = (mean * tint / level[:, None]).clamp(0.2, 5)
    balance = balance * cast ** -(0.8 * torch.rand(count, 1, generator=generator))
    gain = gain[:, None] * balance * tint
    linear = views * gain[:, :, None, None]
    has_shoulder = (torch.rand(count, 1, 1, 1, generator=generator) < 0.4).float()
    linear = torch.lerp(linear, 1 - torch.exp(-1.3 * linear), has_shoulder)
    contrast = torch.exp(0.15 * torch.randn(count, 1, 1, 1, generator=generator))
    noise = 0.01 * torch.randn(linear.shape, generator=generator)
    return (linear.clamp(1e-6, 1) ** contrast + noise * linear.clamp(1e-4, 1).sqrt()).clamp(0, 1), gain


def ball_error(guess: Tensor, truth: Tensor) -> Tensor:
    """Squared relative errors [B] of irradiance [B, N, 3], each under the one scale that fits it best."""
    scale = (guess * truth).sum((1, 2)) / guess.square().sum((1, 2)).clamp_min(1e-12)
    off = scale[:, None, None] * guess - truth
    return off.square().sum((1, 2)) / truth.square().sum((1, 2))


def colour_error(guess: Tensor, truth: Tensor) -> Tensor:
    """Mean difference [B] of the logarithms of r/g and b/g over a ball [B, N, 3]."""
    ratios = [torch.log(one[..., ::2] / one[..., 1:2]).mean(1) for one in (guess + 1e-6, truth + 1e-6)]
    return (ratios[0] - ratios[1]).abs().mean(1)


def train(file: Path) -> None:
    """Draw the maps, train, and write the network in half floats."""
    torch.manual_seed(SEED)
    generator = torch.Generator().manual_seed(SEED)
    drawn = [draw(index, generator) for index in range(MAPS)]
    truths, views, tangents = (torch.cat(parts) for parts in zip(*drawn, strict=True))
    held = len(truths) // 18
    network = PictureLightNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, STEPS, pct_start=0.1)
    for step in range(STEPS):
        at = torch.randint(held, len(truths), (BATCH,), generator=generator)
        flip = torch.rand(BATCH, 1, 1, generator=generator) < 0.5
        grid = truths[at].reshape(BATCH, _TRUTH_ROWS, -1, 3)
        truth = torch.where(flip[..., None], grid.flip(2), grid).flatten(1, 2)
        view = torch.where(flip[..., None], views[at].flip(-1), views[at])
        losses = _losses(network, truth, view, tangents[at], generator)
        optimizer.zero_grad()
        sum(losses).backward()  # type: ignore[union-attr]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 250 == 249:
            network.eval()
            with torch.no_grad():
                parts = _losses(
                    network, truths[:held], views[:held], tangents[:held], torch.Generator().manual_seed(1)
                )
            print(step + 1, " ".join(f"{float(part):.4f}" for part in parts), flush=True)
            network.train()
    save_file({name: values.half() for name, values in network.state_dict().items()}, file)


def _losses(
    network: PictureLightNetwork, truth: Tensor, view: Tensor, tangents: Tensor, generator: torch.Generator
) -> tuple[Tensor, ...]:
    """Terms of the loss: error on the ball, colour, level, map, and the error that is expected."""
    linear, gain = photographed(view, generator)
    truth = truth * gain[:, None]
    guess, log_error = network(linear, tangents, DIRECTIONS)
    lit, truly_lit = ON_BALL @ guess, ON_BALL @ truth
    error = ball_error(lit, truly_lit)
    level = torch.log(lit.mean((1, 2)) + 1e-3) - torch.log(truly_lit.mean((1, 2)) + 1e-3)
    logs = torch.log(guess + 0.02) - torch.log(truth + 0.02)
    per_map = (logs.abs() * SOLID_ANGLES[:, None]).sum(1).mean() / (4 * math.pi)
    expected = (log_error - 0.5 * error.detach().clamp_min(1e-4).log()).abs().mean()
    colour = colour_error(lit, truly_lit).mean()
    return error.mean(), 0.6 * colour, 0.05 * level.abs().mean(), 0.05 * per_map, 0.05 * expected


if __name__ == "__main__":
    train(Path(sys.argv[1]))
