"""Processor time in seconds of the data of the paper's stages, a sample, and of what a start measures.

    python benchmarks/training_data.py --dataset DATASET [--side 512] [--steps 128]

`DATASET` is prepared, with pairs that were written. Of lazy pairs the mean over a block of steps counts, in
which each stack is opened once. `light-features` reads in workers and unwraps in the step: both are given.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch
from _common import arguments, print_header, print_row, required

from facerf_cli.dataset import crops
from facerf_cli.dataset.crops import open_pairs
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.light_crops import open_light_stacks
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.features import VggFeatures
from facerf_cli.training.joint import JointObjective, JointSettings
from facerf_cli.training.objective import seeded

LIGHTS, FACES = 8, 4  # of a step of light-features


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("--steps", type=int, default=128, help="of lazy pairs, in which 4 stacks are opened")
    given = parser.parse_args()
    torch.set_num_threads(1)
    folder = required(given.dataset, "a prepared dataset with pairs", "--dataset")
    dataset = read_dataset(folder)
    reader = open_pairs(dataset, "train", given.side)
    print_header("what", "seconds")
    print_row("joint, written: a sample", per_step(lambda step: reader.draw(1, generator_of(step), step), 16))
    with patch.object(crops, "image_path", lambda *key: Path("none")):
        lazy = replace(reader)
        found = per_step(lambda step: lazy.draw(1, generator_of(step), step), given.steps)
        print_row("joint, lazy: a sample", found)
        found = per_step(lambda step: lazy.read(lazy.pairs[step]), 3)
    print_row("joint, lazy: a sample, were its stack opened for it alone", found)
    stacks = open_light_stacks(folder, dataset.face_model)
    heads = stacks.heads(1)[0]
    drawn = [stacks.draw(heads[:1], LIGHTS, seeded(0, face)) for face in range(FACES)]
    face = per_step(lambda step: stacks.draw(heads[:1], LIGHTS, seeded(step)), FACES)
    print_row(f"light-features: reading a step of {FACES} faces x {LIGHTS} lights", FACES * face)
    unwrapping = per_step(lambda step: drawn[step].unwrapped(given.side), FACES)
    print_row("light-features: unwrapping it in the step", FACES * unwrapping)
    settings = JointSettings(given.side, given.side)
    networks = (torch.nn.Linear(1, 1), torch.nn.Linear(1, 1), VggFeatures(), VggFeatures())
    networks[0].rig_lights = 0  # type: ignore[assignment]
    objective = JointObjective(dataset, load_face_model(), *networks, settings=settings)
    print_row("joint: two VGG-16 measured at the start", per_step(lambda step: objective.measure(), 1))


def generator_of(step: int) -> Callable[..., torch.Generator]:
    """As the loop gives to `Objective.draw`."""
    return lambda index, step=step: seeded(0, step, index)


def per_step(act: Callable[[int], object], steps: int) -> float:
    """Mean processor time of an act in seconds."""
    begun = time.process_time()
    for step in range(steps):
        act(step)
    return round((time.process_time() - begun) / steps, 3)


if __name__ == "__main__":
    main()
