"""Colours in the feature losses of a run of examples/paper/tables.sh: cost of changes, pushes, best images.

    python benchmarks/feature_colours.py --run RUN [--side 128]

Targets of the validation split are changed: green dimmed or raised, grey, dark, blurred, mirrored. Printed
are the weighted terms of the paper's loss between each and the target: 5 L_p, and the image's distances by
V_f (L_I) and S_f (L_L), which see colours together or their channels apart (`training/losses.py`), masked
where the target is black. Then, for the blurred targets, the descent direction of each term, summed over the
pixels of each colour: a term that prefers no colour pushes all three alike.

Last, what a network predicts that knows the face and not the light: the one image that costs least on average
over all targets of a person and camera. Printed is its tint: red and blue over green, over the targets' own.
S_f of several seeds are untrained; their filters are random.

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
from facerf_cli.network.features import FeatureNetwork, LightNetwork, LightSettings, layer_powers
from facerf_cli.training.losses import (
    Features,
    MaskedPair,
    PaperWeights,
    channels_apart,
    load_features,
    photometric_loss,
)

TRAINED, MEASURED = 24, 8
LIGHTS, STEPS, BATCH, SEEDS = 40, 100, 8, 4  # of the best image, and untrained S_f
COVERED = 0.01  # mean radiance above which a pixel is compared
CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "green x 0.7 (magenta)": lambda x: x * torch.tensor([1, 0.7, 1]).view(1, 3, 1, 1),
    "green x 1.4": lambda x: x * torch.tensor([1, 1.4, 1]).view(1, 3, 1, 1),
    "grey": lambda x: x.mean(1, keepdim=True).expand(-1, 3, -1, -1),
    "dark x 0.7": lambda x: x * 0.7,
    "blurred": lambda x: F.avg_pool2d(x, 9, 1, 4),
    "mirrored": lambda x: x.flip(-1),
}


Term = Callable[[Tensor, Tensor], Tensor]  # images and targets [B, 3, S, S] to a mean cost


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--side", type=int, default=128)
    given = parser.parse_args()
    run = required(given.run, "a run of examples/paper/tables.sh", "--run")
    torch.set_num_threads(1)
    dataset = read_dataset(run / "dataset")
    training, validation = (open_pairs(dataset, split, given.side) for split in ("train", "validation"))
    seen = torch.cat([training.read(pair).target for pair in spread_pairs(training, TRAINED, lambda _: True)])
    target = torch.cat(
        [validation.read(pair).target for pair in spread_pairs(validation, MEASURED, lambda _: True)]
    )
    networks: dict[str, FeatureNetwork] = {
        "L_I": load_features(run / "appearance/best.safetensors", "appearance_features"),
        "L_L": load_features(run / "light/best.safetensors", "light_features"),
    }
    terms = {"5 L_p": photometric} | {
        f"{name} {'apart' if apart else 'together'}": feature_term(network, seen, apart)
        for name, network in networks.items()
        for apart in (False, True)
    }
    print_header("change", *terms)
    for name, change in CHANGES.items():
        with torch.no_grad():
            print_row(name, *(f"{float(term(change(target), target)):.3f}" for term in terms.values()))
    print()
    print_header("push on the blurred", "red", "green", "blue")
    image = CHANGES["blurred"](target).requires_grad_()
    for name, term in terms.items():
        (slope,) = torch.autograd.grad(term(image, target), image)
        print_row(name, *(f"{value:.2f}" for value in -slope.sum((0, 2, 3))))
    print()
    person = next(iter(spread_pairs(validation, 1, lambda _: True)))
    alike = [
        p for p in validation.pairs if (p.subject, p.target_camera) == (person.subject, person.target_camera)
    ]
    lit = torch.cat([validation.read(pair).target for pair in alike[:LIGHTS]])
    print_header("least cost over the lights of a face", "tint, red", "tint, blue")
    print_row("5 L_p", *tint_of_best([photometric], lit))
    for seed in range(SEEDS):
        torch.manual_seed(seed)
        untrained = LightNetwork(LightSettings(side=given.side)).eval().requires_grad_(False)
        for apart in (False, True):
            term = feature_term(untrained, seen, apart)
            name = f"5 L_p + untrained L_L, seed {seed} {'apart' if apart else 'together'}"
            print_row(name, *tint_of_best([photometric, term], lit))


def covered(target: Tensor) -> Tensor:
    """Mask [B, 1, S, S] of pixels that are compared."""
    return (target.mean(1, keepdim=True) > COVERED).float()


def photometric(image: Tensor, target: Tensor) -> Tensor:
    """The term 5 L_p."""
    return PaperWeights().photometric * photometric_loss(image, target, covered(target)).mean()


def feature_term(network: FeatureNetwork, training: Tensor, apart: bool) -> Term:
    """The weighted distance by a network whose powers are measured on training targets."""
    powers = layer_powers(network, channels_apart(training, training) if apart else training)
    features = Features(network, powers, apart)
    return lambda image, target: (
        PaperWeights().features * MaskedPair(image, target, covered(target)).distance(features).mean()
    )


def tint_of_best(terms: list[Term], targets: Tensor) -> list[str]:
    """Red and blue over green of the one image that costs least, over those of the targets."""
    torch.manual_seed(0)
    root = (0.25 + 0.01 * torch.randn(1, *targets.shape[1:])).requires_grad_()  # of radiance; grey
    optimiser = torch.optim.Adam([root], 0.02)
    for step in range(STEPS):
        optimiser.param_groups[0]["lr"] = 0.02 * (1 - step / STEPS)
        some = targets[torch.randint(len(targets), (BATCH,))]
        cost = torch.stack([term((root**2).expand_as(some), some) for term in terms]).sum()
        optimiser.zero_grad()
        cost.backward()
        optimiser.step()
    face = covered(targets.mean(0, keepdim=True))
    colours = [(image * face).sum((0, 2, 3)) for image in (root.detach() ** 2, targets)]
    red, green, blue = (colours[0] / colours[1]).tolist()
    return [f"{red / green:.2f}", f"{blue / green:.2f}"]


if __name__ == "__main__":
    main()
