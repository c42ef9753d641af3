r"""Si-MSE of a checkpoint on the held-out synthetic heads of its bank, by pose and by the light's angle.

    python benchmarks/synthetic.py --bank RUN/bank [--checkpoint RUN/last.safetensors]

Beside it stands its naive twin: the source's own texture, shaded by Lambert's cosine without shadows.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import torch

from facerf_cli.network.losses import si_mse
from facerf_cli.pipeline import load_models
from facerf_cli.stage.bank import load_bank
from facerf_cli.training import TrainSettings

DRAWS, LIGHTS = 16, 8
ANGLES_DEG = (0, 30, 60, 90, 180)  # between the light and the camera


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bank", type=Path, required=True, help="folder that `facerf train` filled")
    parser.add_argument("--fit-with", default="builtin", help="the name of the face model of its views")
    parser.add_argument("--checkpoint", type=Path)
    arguments = parser.parse_args()
    bank = load_bank(arguments.bank / "heads", arguments.bank / f"views-{arguments.fit_with}", {})
    network = load_models(arguments.checkpoint, "builtin", torch.device("cpu")).network
    heads = torch.arange(1, TrainSettings().held_out_heads + 1)
    generator = torch.Generator().manual_seed(2021)
    columns = []
    for _ in range(DRAWS):
        sample = bank.draw(heads, LIGHTS, generator)
        encoded = network.encode(sample.source, sample.normals_source, sample.visible)
        predicted = network.decode(encoded, sample.normals_target, sample.lights)
        cosine = torch.einsum("blc,bcij->blij", sample.lights, sample.normals_target).clamp_min(0)
        lambert = sample.source[:, None] * cosine[:, :, None]
        same_pose = (sample.normals_source - sample.normals_target).abs().amax((1, 2, 3)) < 1e-3
        angle_deg = torch.rad2deg(sample.lights[..., 2].clamp(-1, 1).acos())
        errors = [si_mse(picture, sample.target, sample.weight) for picture in (predicted, lambert)]
        columns.append(torch.stack([*errors, same_pose[:, None].expand_as(angle_deg).float(), angle_deg]))
    ours, lambert, same, angle = torch.cat(columns, 1).flatten(1)
    print(f"{'held-out heads':16}{'n':>6}{'facerf':>10}{'sd':>10}{'Lambert':>10}{'ratio':>8}")
    rows = {"same pose": same > 0.5, "different pose": same < 0.5}
    rows |= {f"{a} to {b} deg": (angle >= a) & (angle < b) for a, b in pairwise(ANGLES_DEG)}
    for name, chosen in rows.items():
        mean, naive = ours[chosen].mean(), lambert[chosen].mean()
        print(
            f"{name:16}{int(chosen.sum()):6}{mean:10.5f}{ours[chosen].std():10.5f}"
            f"{naive:10.5f}{mean / naive:8.2f}"
        )


if __name__ == "__main__":
    main()
