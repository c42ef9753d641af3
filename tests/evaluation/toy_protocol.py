"""A protocol of a few made-up images, to drive the evaluation without networks or faces."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.options import Chosen, EvaluateOptions
from facerf_cli.evaluation.protocols import Protocol
from facerf_cli.evaluation.run import Evaluation
from facerf_cli.evaluation.summary import Layout
from facerf_cli.work.photo_options import PhotoOptions

PEOPLE = ("anna", "bea", "carl")
LAYOUT = Layout("Toy <images> & more", ("si_mse", "psnr", "light_error_deg"), ("pose", "angle"))
HEIGHT, WIDTH = 36, 48
NOISE = {"good": 0.02, "bad <i>": 0.1}


@dataclass(frozen=True)
class Toy:
    """Each item is a person with `cases` images: a blob under a light, and two noisy guesses at it.

    A folder of `notes` gets a file for each item asked for; an item fails while NAME.broken is there.
    """

    cases: int = 4
    notes: Path | None = None


def compare(options: EvaluateOptions, bench: object, content: tuple[Toy, Item]) -> Iterator[Comparison]:
    toy, item = content
    if toy.notes is not None:
        (toy.notes / f"{item.name}.asked").touch()
        if (toy.notes / f"{item.name}.broken").exists():
            raise InputError(f"{item.input_path}: is broken")
    for number in range(toy.cases):
        yield comparison(item.name, number)


def choose(options: EvaluateOptions, inputs: object) -> Chosen:
    return Chosen({})


PROTOCOL = Protocol("toy", choose, compare, LAYOUT)


def comparison(person: str, number: int) -> Comparison:
    draw = np.random.default_rng([PEOPLE.index(person) if person in PEOPLE else 9, number])
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mask = (np.hypot((x - 24) / 18, (y - 18) / 15) < 1).astype(np.float32)
    tone = np.array([0.5, 0.35, 0.25]) * (0.3 + x[..., None] / WIDTH)
    truth = (tone * (0.2 + mask[..., None])).astype(np.float32)
    guesses = {
        name: np.maximum(truth + draw.normal(0, sd * (1 + number), truth.shape), 0).astype(np.float32)
        for name, sd in NOISE.items()
    }
    facts = {
        "pose": "same pose" if number % 2 == 0 else "different pose",
        "angle": f"{30 * (number % 4)}°",
        "light_deg": 30.0 * number,
    }
    extra = {"good": {"light_error_deg": 3.0 + number}, "bad <i>": {"light_error_deg": 9.0 + number}}
    case = Case(f"{person}/{number:02d}", person, facts)
    return Comparison(case, truth, mask, guesses, truth[::-1, ::2], extra=extra)


def items(output: Path, people: tuple[str, ...] = PEOPLE) -> list[Item]:
    folder = output.with_name(f"{output.name}.inputs")
    folder.mkdir(exist_ok=True)
    for person in people:
        (folder / person).write_text(person)
    return [Item(folder / person, output / person, person) for person in people]


def evaluate(output: Path, toy: Toy | None = None, **options: object) -> int:
    return evaluation(output, toy, **options).run()


def evaluation(
    output: Path, toy: Toy | None = None, inputs: list[Item] | None = None, **options: object
) -> Evaluation:
    given = EvaluateOptions(output, **{"reflectance": (), **options})  # type: ignore[arg-type]
    toy = toy or Toy()
    chosen = Chosen({item: (toy, item) for item in (items(output) if inputs is None else inputs)})
    return Evaluation(PROTOCOL, chosen, given, PhotoOptions(Settings()))
