"""Two designs of the portrait field, trained from the start on the same people for the same number of steps.

    python benchmarks/portrait_designs.py --design lobes|maps --bank DIR -o RUN [--steps 1200] [--seed 1]

*lobes* is what ships: normals, whose cosine shades, highlights about normals and strands, and a few coarse
maps (`network/portrait.py`). *maps* has no formula of shading: a light is a sum of fixed maps, with and
without the shadows of the proxy, OLAT_l = A (V'_l sum_k b_k(l) P_k + sum_k b_k(l) U_k)+ +
(V'_l sum_k b_k(l) S_k)+, with 25 maps P at the full side, which begin with the cosine of the proxy's normals,
and 16 maps U and 25 maps S at half of it. Normals and albedo are still learnt, as a help for others. Bank,
draws, losses and encoder are one. Errors of held-out people and times go to `RUN/log.jsonl` and the
terminal.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from _common import arguments, required
from torch import Tensor, nn

from facerf_cli.light.sh import cosine_lobe, sh_basis
from facerf_cli.network.portrait import PortraitInputs, PortraitNetwork
from facerf_cli.synth.bank.portrait_samples import StoredTransport
from facerf_cli.synth.bank.portraits import load_backgrounds
from facerf_cli.training.loop import Row, train
from facerf_cli.training.portrait import PortraitObjective
from facerf_cli.training.settings import AdamW, preset_of

ORDER, AROUND_ORDER = 4, 3
K, K_AROUND = (ORDER + 1) ** 2, (AROUND_ORDER + 1) ** 2
FINE = {"gain": 3, "bias": 3, "normals": 3, "trust": 1, "lit": K}
COARSE = {"around": K_AROUND, "shadow": K, "glow": K}
PROVENANCE = {"heads": "synthetic people", "licence": "MIT"}
LOBES = torch.tensor([cosine_lobe(degree) for degree in range(ORDER + 1) for _ in range(2 * degree + 1)])


class FreeMaps(NamedTuple):
    """Maps [B, C, S, S] of the design *maps*, the last three of half the side."""

    gain: Tensor
    albedo: Tensor
    normals: Tensor
    trust: Tensor
    lit: Tensor
    around: Tensor
    shadow: Tensor
    glow: Tensor

    def shaded(self, lights: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Shading, highlights and corrected visibility [B, L, S, S], as `PortraitMaps.shaded`."""
        basis = sh_basis(lights, ORDER)
        size = self.lit.shape[-2:]

        def over(maps: Tensor) -> Tensor:
            values = torch.einsum("blc,bcij->blij", basis[..., : maps.shape[1]], maps)
            return F.interpolate(values, size=size, mode="bilinear", align_corners=False)

        visible = torch.sigmoid(self.trust * (2 * visible - 1) + over(self.shadow))
        shading = F.relu(visible * over(self.lit) + over(self.around))
        return shading, F.relu(visible * over(self.glow)), visible

    def olats(self, lights: Tensor, visible: Tensor) -> Tensor:
        """Images [B, L, 3, S, S] under single lights of rgb 1."""
        shading, glow, _ = self.shaded(lights, visible)
        return self.albedo[:, None] * shading[:, :, None] + glow[:, :, None]


class FreeNetwork(PortraitNetwork):
    """The Portrait Network's encoder and decoder, with the maps of the design *maps*."""

    def __init__(self) -> None:
        super().__init__()
        outputs = 4 * sum(FINE.values()) + sum(COARSE.values())
        self.predict = nn.Conv2d(self.settings.widths[0], outputs, 1)
        nn.init.normal_(self.predict.weight, std=0.01)

    def forward(self, inputs: PortraitInputs) -> FreeMaps:  # type: ignore[override]
        """Predict maps."""
        predicted = self.predict(self.last(self.doubled(self.halved(inputs.stacked()))[-1])).float()
        fine, coarse = torch.split(predicted, [4 * sum(FINE.values()), sum(COARSE.values())], 1)
        parts = [
            *torch.split(F.pixel_shuffle(fine, 2), list(FINE.values()), 1),
            *torch.split(coarse, list(COARSE.values()), 1),
        ]
        raw = dict(zip((*FINE, *COARSE), parts, strict=True))
        gain = torch.exp(raw["gain"].clamp(-4, 4)) * 1.15 / (inputs.own + 0.15)
        proxy = sh_basis(F.normalize(inputs.normals, dim=1).movedim(1, -1), ORDER).movedim(-1, 1)
        return FreeMaps(
            gain=gain,
            albedo=inputs.image * gain + 0.1 * F.softplus(raw["bias"] - 3),
            normals=F.normalize(inputs.normals + raw["normals"], dim=1),
            trust=4 * F.softplus(raw["trust"] + 0.5),
            lit=proxy * LOBES.view(-1, 1, 1) + 0.3 * raw["lit"],
            around=torch.cat([0.3 * raw["around"][:, :1] + 0.05, 0.3 * raw["around"][:, 1:]], 1),
            shadow=raw["shadow"] * 3,
            glow=0.1 * raw["glow"],
        )


def main() -> None:
    """Train one design."""
    parser = arguments(__doc__)
    parser.add_argument("--design", choices=("lobes", "maps"), default="maps")
    parser.add_argument("--bank", type=Path, help="the folder `bank` of a run of the stage portrait")
    parser.add_argument("-o", dest="run", type=Path, default=Path("portrait_designs"))
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    bank = required(given.bank, "a bank of the stage portrait", "--bank")
    torch.manual_seed(given.seed)
    network = FreeNetwork() if given.design == "maps" else PortraitNetwork()
    backgrounds = load_backgrounds(bank / "backgrounds.safetensors", 60, 240, given.seed)
    source = StoredTransport(bank / "transport", backgrounds, PROVENANCE)
    settings = replace(
        preset_of("default", "portrait"),
        optimizer=AdamW(),
        steps=given.steps,
        validate_every=300,
        seed=given.seed,
    )
    train(PortraitObjective(source, network), given.run / given.design, settings, report=shown)


def shown(row: Row) -> None:
    """Print what a validation found."""
    if "validation" in row:
        print(row["step"], f"{row['seconds']:.0f} s", row["validation"], flush=True)


if __name__ == "__main__":
    main()
