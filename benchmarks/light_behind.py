"""Light estimated from a photo, where the face does not see it: zero weights and roughness behind the head.

    python benchmarks/light_behind.py [PHOTO|DIR ...]

The lights behind the head are those that do not reach the face (their mean radiance on it is below a tenth
of the brightest light's). For them, and for all lights, printed are the share of grey weights that are zero,
and the roughness: the mean difference of a weight from the mean of its six neighbours, over the mean of the
weights' sizes. 0 is a light that changes linearly from light to light.

Twins, on the same evidence in the same run: the same least squares with every light solved for, and the
paper's signed least squares.
"""

from pathlib import Path
from unittest.mock import patch

import torch
from _common import arguments, photos, print_header, print_row
from torch import Tensor

from facerf_cli.files.read import read_image
from facerf_cli.light import estimate
from facerf_cli.light.estimate import LightEvidence, estimate_signed_weights, estimate_smooth_weights
from facerf_cli.pipeline import estimate_light, fit_photo
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models

REACHES = 0.1  # as `facerf estimate-light`
NEIGHBOURS = 6
ZERO = 1e-6  # of the largest weight


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    given = parser.parse_args()
    torch.set_num_threads(1)
    models = load_models()
    print_header("photo", "by", "lights behind", "zero behind", "of all", "roughness behind", "of all")
    for path in photos(given.photos):
        evidence = evidence_of(models, path)
        behind = ~reaching(evidence)
        for method, weights in by_each(evidence).items():
            grey = weights.mean(1)
            figures = (zeros(grey, behind), zeros(grey, behind | True))
            rough = (roughness(evidence, grey, behind), roughness(evidence, grey, behind | True))
            shares = (f"{value:.0%}" for value in figures)
            print_row(path.stem, method, int(behind.sum()), *shares, *(f"{value:.2f}" for value in rough))


def evidence_of(models: Models, path: Path) -> LightEvidence:
    """Fit the largest face of a photo and predict it under the single lights of the rig."""
    photo = read_image(path).pixels
    head = fit_photo(models, photo, find_faces(SHIPPED_NETWORKS.people, photo, str(path))[0].landmarks_px)
    return estimate_light(models, head).evidence


def by_each(evidence: LightEvidence) -> dict[str, Tensor]:
    """Estimate weights [L, 3] as `facerf estimate-light` does, and by the twins."""
    olats, photo = evidence.olats[..., evidence.mask], evidence.photo[:, evidence.mask]
    clipped = evidence.clipped[:, evidence.mask]
    with patch.object(estimate, "_REACHES", 0.0):
        all_solved = estimate_smooth_weights(evidence.directions, olats, photo, clipped)
    return {
        "facerf": estimate_smooth_weights(evidence.directions, olats, photo, clipped),
        "every light solved for": all_solved,
        "signed least squares": estimate_signed_weights(olats, photo),
    }


def reaching(evidence: LightEvidence) -> Tensor:
    """Tell which lights [L] bool reach the face."""
    radiance = evidence.olats[..., evidence.mask].mean((1, 2))
    return radiance > REACHES * radiance.max()


def zeros(grey: Tensor, of: Tensor) -> float:
    """Share of weights [L] that are zero among the lights `of` [L] bool."""
    return float((grey[of].abs() < ZERO * grey.abs().max()).double().mean())


def roughness(evidence: LightEvidence, grey: Tensor, of: Tensor) -> float:
    """Mean difference of some weights [L] from the mean of their neighbours, over their mean size."""
    cosines = evidence.directions @ evidence.directions.T
    cosines.fill_diagonal_(-2)
    near = cosines.topk(NEIGHBOURS).indices
    difference = (grey - grey[near].mean(1)).abs()
    return float(difference[of].mean() / grey[of].abs().mean().clamp_min(ZERO))


if __name__ == "__main__":
    main()
