"""Skin that the photo shows in a coloured shade, under a white light from that side: error of its colour.

    facerf synth-stage --subjects 2 -o CAPTURE
    python benchmarks/coloured_shade.py CAPTURE

A source is a white key from one side and a dim coloured fill from the other; the truth is the capture under
the fill's light alone, in white. The error is the mean change, by size, of log red / green and of log blue /
green over the lit skin of the face. `seen as it is` is the twin: networks that see the colours of the photo.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from _common import arguments, print_header, print_row, required

from facerf_cli.capture.stage_json import read_capture
from facerf_cli.light.sphere import RigLight
from facerf_cli.pipeline import find_for, fit
from facerf_cli.relighting.models import Models, load_models

FILLS = {"white": (1, 1, 1), "blue": (0.5, 0.8, 2), "purple": (1.2, 0.6, 1.6), "green": (0.6, 1.4, 0.8)}
_DIM, _LIT = 0.15, 0.3  # of the fill; and of the truth's mean, above which skin is lit
SEEN_BY = ("facerf_cli.relighting.field", "facerf_cli.relighting.portrait_field")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("capture", type=Path, nargs="?", help="folder of a synthetic light stage")
    folder, models = required(parser.parse_args().capture, "a synthetic capture", "CAPTURE"), load_models()
    pairs = list(sides(folder))
    print_header("fill", "shipped", "seen as it is")
    for name, colour in FILLS.items():
        shipped = np.mean([error(models, *pair, np.float32(colour)) for pair in pairs])
        with (
            mock.patch.multiple(SEEN_BY[0], without_colour_of_shade=same),
            mock.patch.multiple(SEEN_BY[1], without_colour_of_shade=same),
        ):
            twin = np.mean([error(models, *pair, np.float32(colour)) for pair in pairs])
        print_row(name, f"{shipped:.3f}", f"{twin:.3f}")


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


def error(
    models: Models, key: np.ndarray, side: np.ndarray, toward: torch.Tensor, colour: np.ndarray
) -> float:
    """Error of the skin's colour."""
    photo = key + _DIM * colour * side
    person = fit(models, photo, find_for(models.networks.people, "landmarks", photo, "a frame")[0])
    relit = person.image(RigLight(toward[None], torch.ones(1, 3))).pixels
    skin = person.segmentation.layer("skin") > 0.9
    lit = skin & (side.mean(-1) > _LIT * side.mean(-1)[skin].mean())
    found, truth = (np.log(np.maximum(image[lit], 1e-4)) for image in (relit, side))
    change = (found - found[:, 1:2]) - (truth - truth[:, 1:2])
    return float(np.abs(change[:, [0, 2]]).mean())


if __name__ == "__main__":
    main()
