"""Colours in the feature losses of a run of examples/paper/tables.sh: cost of changes, pushes, trainings.

    python benchmarks/feature_colours.py --run RUN [--side 128]

Targets of the validation split are changed: green dimmed or raised, grey, dark, blurred, mirrored. Printed
are the weighted terms of the paper's loss between each and the target: 5 L_p, and the image's distances by
V_f (L_I) and S_f (L_L), which see colours together or their channels apart (`training/losses.py`), masked
where the target is black. Then, for the blurred targets, the descent direction of each term, summed over the
pixels of each colour: a term that prefers no colour pushes all three alike.

Last, small trainings that differ in one thing: a narrow U-Net with heads fitted to landmarks, from the same
weights on the same pairs. Printed is the tint of faces of the validation split: red and blue over green, over
those of the truth. `swapped`: V_f and S_f are the same networks, with the colour channels at their entry in
another order.

Peer, in the same run: L_p.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from _common import arguments, print_header, print_row, required
from torch import Tensor

from facerf_cli.dataset.crops import open_pairs, spread_pairs
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.features import FeatureNetwork, layer_powers
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork, PaperReflectanceSettings
from facerf_cli.training.joint import JointObjective, JointSettings
from facerf_cli.training.loop import seeded
from facerf_cli.training.losses import (
    Features,
    MaskedPair,
    PaperWeights,
    channels_apart,
    colour_shares,
    load_features,
    photometric_loss,
)

TRAINED, MEASURED = 24, 8
STEPS, WIDTHS = 160, (32, 64, *[128] * 6)  # of the small trainings
RGB, GBR, BRG = (0, 1, 2), (1, 2, 0), (2, 0, 1)  # by whose filters red, green and blue enter
TRAININGS = {  # lambda_f, channels apart, order of the filters
    "L_p alone": (0.0, False, RGB),
    "together": (1.0, False, RGB),
    "together, swapped": (1.0, False, GBR),
    "together, swapped otherwise": (1.0, False, BRG),
    "together, lambda_f .1": (0.1, False, RGB),
    "together, lambda_f .1, swapped": (0.1, False, GBR),
    "apart": (1.0, True, RGB),
    "apart, lambda_f .1": (0.1, True, RGB),
}
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
    print_header("training", "tint, red", "tint, blue", "Si-MSE", "5 L_p", "L_I", "L_L")
    for name, variant in TRAININGS.items():
        print_row(name, *small_training(run, dataset, given.side, *variant))


def small_training(
    run: Path, dataset: Dataset, side: int, features: float, apart: bool, order: tuple[int, ...]
) -> list[str]:
    """Train `STEPS` pairs by the paper's optimiser; the tint, Si-MSE and mean terms of the last half."""
    torch.manual_seed(0)
    reflectance = PaperReflectanceNetwork(PaperReflectanceSettings(side=side, widths=WIDTHS))
    networks = [
        load_features(run / "appearance/best.safetensors", "appearance_features"),
        load_features(run / "light/best.safetensors", "light_features"),
    ]
    for network in networks:
        weight = network.trunk.features[0].weight
        weight.copy_(weight[:, list(order)])
    weights = PaperWeights(features=features, channels_apart=apart)
    settings = JointSettings(side, side, weights=weights, validation_pairs=12)
    objective = JointObjective(dataset, load_face_model(), reflectance, None, *networks, settings=settings)
    objective.measure()
    optimiser = torch.optim.Adadelta(reflectance.parameters(), lr=0.05, rho=0.95, eps=1e-8)
    means: dict[str, float] = {}
    for step in range(STEPS):
        terms = objective(objective.draw(1, partial(seeded, 0, step), step))
        optimiser.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        optimiser.step()
        for name, term in terms.items():
            means[name] = means.get(name, 0.0) + (step >= STEPS / 2) * float(term.detach()) / (STEPS / 2)
    found = objective.validate().metrics
    tint = [f"{found[name]:.2f}" for name in ("tint_red", "tint_blue")]
    return [*tint, f"{found['si_mse']:.4f}", *(f"{value:.2f}" for value in means.values())]


def covered(target: Tensor) -> Tensor:
    """Mask [B, 1, S, S] of pixels that are compared."""
    return (target.mean(1, keepdim=True) > COVERED).float()


def photometric(image: Tensor, target: Tensor) -> Tensor:
    """The term 5 L_p."""
    return PaperWeights().photometric * photometric_loss(image, target, covered(target)).mean()


def feature_term(network: FeatureNetwork, training: Tensor, apart: bool) -> Term:
    """The weighted distance by a network whose powers are measured on training targets."""
    powers = layer_powers(network, channels_apart(training, colour_shares(training)) if apart else training)
    features = Features(network, powers, apart)
    return lambda image, target: (
        PaperWeights().features * MaskedPair(image, target, covered(target)).distance(features).mean()
    )


if __name__ == "__main__":
    main()
