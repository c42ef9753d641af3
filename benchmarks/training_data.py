"""Processor time in seconds of the data of the paper's stages, a sample, and of what a start measures.

    python benchmarks/training_data.py --dataset DATASET [--side 512] [--steps 128]

`DATASET` is prepared, with pairs. For `joint` and `reflectance` the mean is over a block of steps in which
each stack is opened once. `reflectance` and `light-features` read in workers and unwrap in the step: both are
given.
"""

import time
from collections.abc import Callable
from pathlib import Path

import torch
from _common import arguments, print_header, print_row, required

from facerf_cli.dataset.crops import open_pairs
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.faces import open_faces
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.features import VggFeatures
from facerf_cli.training.joint import JointObjective, JointSettings
from facerf_cli.training.objective import seeded

LIGHTS, FACES = 8, 4  # of a step of light-features


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("--steps", type=int, default=128, help="of pairs, in which 4 stacks are opened")
    given = parser.parse_args()
    torch.set_num_threads(1)
    folder = required(given.dataset, "a prepared dataset with pairs", "--dataset")
    dataset = read_dataset(folder)
    reader = open_pairs(dataset, "train", given.side)
    print_header("what", "seconds")
    sample_s = per_step(lambda step: reader.draw(1, generator_of(step), step), given.steps)
    print_row("joint: a sample", sample_s)
    alone_s = per_step(lambda step: reader.read(reader.pairs[step : step + 1]), 3)
    print_row("joint: a sample whose stack is opened only for it", alone_s)
    faces = open_faces(folder, dataset.face_model, given.side)
    sample_s = per_step(lambda step: faces.draw_shared(LIGHTS, generator_of(step), 0, step), given.steps)
    print_row(f"reflectance: reading a sample of {LIGHTS} lights", sample_s)
    sample = faces.draw_shared(LIGHTS, generator_of(0), 0, 0)[1]
    print_row("reflectance: unwrapping it in the step", per_step(lambda step: faces.sample(sample), FACES))
    people = faces.people(1)[0]
    drawn = [faces.draw_lights(people[:1], LIGHTS, seeded(0, face)) for face in range(FACES)]
    face_s = per_step(lambda step: faces.draw_lights(people[:1], LIGHTS, seeded(step)), FACES)
    print_row(f"light-features: reading a step of {FACES} faces x {LIGHTS} lights", FACES * face_s)
    unwrapping_s = per_step(lambda step: faces.light_textures(drawn[step]), FACES)
    print_row("light-features: unwrapping it in the step", FACES * unwrapping_s)
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
