"""A person whom the photo shows in coloured light, under a white light: error of their colours.

    facerf synth-stage --subjects 4 --size 192 --cameras 4 --seed 14 -o CAPTURE
    python benchmarks/coloured_shade.py CAPTURE

A source is a key from one side and a dim fill from the other, each of a colour; the truth is the capture
under the fill's light alone, in white. The error is the mean change, by size, of log red / green and of log
blue / green over what the light reaches of each class. `seen as it is` is the twin for the skin: networks
that see the colours of the photo.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from _common import arguments, print_header, print_row, required

from facerf_cli.capture.layouts import read_capture
from facerf_cli.light.sphere import RigLight
from facerf_cli.person import fit
from facerf_cli.pipeline import find_for
from facerf_cli.relighting.models import Models, load_models

WHITE, WARM, COOL = (1, 1, 1), (1.5, 0.9, 0.55), (0.75, 1, 1.4)
LIGHTS = {  # of the key, of the fill
    "white": (WHITE, WHITE),
    "blue fill": (WHITE, (0.5, 0.8, 2)),
    "purple fill": (WHITE, (1.2, 0.6, 1.6)),
    "green fill": (WHITE, (0.6, 1.4, 0.8)),
    "orange fill": (WHITE, (1.8, 0.7, 0.25)),
    "warm": (WARM, WARM),
    "cool": (COOL, COOL),
}
CLASSES = ("skin", "neck", "hair", "garment")
_DIM, _LIT = 0.15, 0.3  # of the fill; and of the truth's mean, above which a class is lit
_LEAST_PX = 50  # of a class
SEEN_BY = ("facerf_cli.relighting.field", "facerf_cli.relighting.portrait_field")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("capture", type=Path, nargs="?", help="folder of a synthetic light stage")
    folder, models = required(parser.parse_args().capture, "a synthetic capture", "CAPTURE"), load_models()
    pairs = list(sides(folder))
    print_header("light", *CLASSES, "skin, seen as it is")
    for name, light in LIGHTS.items():
        shipped = np.nanmean([errors(models, *pair, *np.float32(light)) for pair in pairs], 0)
        with (
            mock.patch.multiple(SEEN_BY[0], without_colour_of_shade=same),
            mock.patch.multiple(SEEN_BY[1], without_colour_of_shade=same),
        ):
            twin = np.mean([errors(models, *pair, *np.float32(light))[0] for pair in pairs])
        print_row(name, *(f"{value:.3f}" for value in (*shipped, twin)))


def same(image: torch.Tensor, skin: torch.Tensor) -> torch.Tensor:
    """Factors that change nothing."""
    return torch.ones_like(image)


def sides(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray, torch.Tensor]]:
    """Frames under a key and under a light from the other side, and its direction, both ways round."""
    capture = read_capture(folder)
    name, camera = next(iter(capture.cameras.items()))
    toward = capture.directions_world @ camera.rotation.numpy().T
    left, right = (int(((toward - [x, 0.3, 0.5]) ** 2).sum(1).argmin()) for x in (-0.8, 0.8))
    for subject, (key, fill) in itertools.product(capture.subjects, ((left, right), (right, left))):
        frames = [capture.frame(subject, name, light) for light in (key, fill)]
        yield *frames, torch.from_numpy(toward[fill]).float()


def errors(
    models: Models, key: np.ndarray, side: np.ndarray, toward: torch.Tensor, *colours: np.ndarray
) -> list[float]:
    """Errors of the colours of `CLASSES`; NaN of one that is not seen."""
    photo = colours[0] * key + _DIM * colours[1] * side
    person = fit(
        models, photo, white=None, face=find_for(models.networks.people, "landmarks", photo, "a frame")[0]
    )
    relit = person.image(RigLight(toward[None], torch.ones(1, 3))).pixels
    return [error(relit, side, person.segmentation.layer(name) > 0.9) for name in CLASSES]


def error(relit: np.ndarray, truth: np.ndarray, shown: np.ndarray) -> float:
    """Error of the colour of what is `shown` [H, W] and lit."""
    if shown.sum() < _LEAST_PX:
        return float("nan")
    lit = shown & (truth.mean(-1) > _LIT * truth.mean(-1)[shown].mean())
    found, wanted = (np.log(np.maximum(image[lit], 1e-4)) for image in (relit, truth))
    change = (found - found[:, 1:2]) - (wanted - wanted[:, 1:2])
    return float(np.abs(change[:, [0, 2]]).mean())


if __name__ == "__main__":
    main()
