"""Colours in the feature losses of a run of examples/paper/tables.sh: the cost of changes, and pushes.

    python benchmarks/feature_colours.py --run RUN

Targets of the validation split are changed: green dimmed or raised, grey, dark, blurred, mirrored. Printed
are the weighted terms of the paper's loss between each and the target: 5 L_p, and the image's distances by
V_f (L_I) and S_f (L_L), masked where the target is black. Then, for the blurred targets, the descent
direction of each term, summed over the pixels of each colour: a term that prefers no colour pushes all three
alike.

Peer, in the same run: L_p.
"""

from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from _common import arguments, print_header, print_row, required
from torch import Tensor

from facerf_cli.dataset.crops import open_pairs, spread_pairs
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.network.features import FeatureNetwork, feature_distance, layer_powers
from facerf_cli.training.losses import PaperWeights, load_features, photometric_loss

SIDE, TRAINED, MEASURED = 128, 24, 8
COVERED = 0.01  # mean radiance above which a pixel is compared
CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "green x 0.7 (magenta)": lambda x: x * torch.tensor([1, 0.7, 1]).view(1, 3, 1, 1),
    "green x 1.4": lambda x: x * torch.tensor([1, 1.4, 1]).view(1, 3, 1, 1),
    "grey": lambda x: x.mean(1, keepdim=True).expand(-1, 3, -1, -1),
    "dark x 0.7": lambda x: x * 0.7,
    "blurred": lambda x: F.avg_pool2d(x, 9, 1, 4),
    "mirrored": lambda x: x.flip(-1),
}


def main() -> None:
    """Print both tables."""
    parser = arguments(__doc__)
    parser.add_argument("--run", type=Path)
    run = required(parser.parse_args().run, "a run of examples/paper/tables.sh", "--run")
    torch.set_num_threads(1)
    dataset = read_dataset(run / "dataset")
    training, validation = (open_pairs(dataset, split, SIDE) for split in ("train", "validation"))
    seen = torch.cat([training.read(pair).target for pair in spread_pairs(training, TRAINED, lambda _: True)])
    target = torch.cat(
        [validation.read(pair).target for pair in spread_pairs(validation, MEASURED, lambda _: True)]
    )
    networks = {
        "L_I": load_features(run / "appearance/best.safetensors", "appearance_features"),
        "L_L": load_features(run / "light/best.safetensors", "light_features"),
    }
    powers = {name: layer_powers(network, seen) for name, network in networks.items()}

    def terms(image: Tensor) -> dict[str, Tensor]:
        return weighted_terms(image, target, networks, powers)

    print_header("change", *terms(target))
    for name, change in CHANGES.items():
        with torch.no_grad():
            print_row(name, *(f"{float(term):.3f}" for term in terms(change(target)).values()))
    print()
    print_header("push on the blurred", "red", "green", "blue")
    image = CHANGES["blurred"](target).requires_grad_()
    for name, term in terms(image).items():
        (slope,) = torch.autograd.grad(term, image)
        print_row(name, *(f"{value:.2f}" for value in -slope.sum((0, 2, 3))))


def weighted_terms(
    image: Tensor, target: Tensor, networks: dict[str, FeatureNetwork], powers: dict[str, Tensor]
) -> dict[str, Tensor]:
    """Compare images [B, 3, S, S] by each term at the paper's weight, means over images."""
    mask = (target.mean(1, keepdim=True) > COVERED).float()
    weights = PaperWeights()
    features = {
        name: weights.features * feature_distance(network, image * mask, target * mask, powers[name]).mean()
        for name, network in networks.items()
    }
    return {"5 L_p": weights.photometric * photometric_loss(image, target, mask).mean()} | features


if __name__ == "__main__":
    main()
