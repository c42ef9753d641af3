"""The list of mutants fits the code; `python -m tests.mutants` runs them."""

import pytest

from tests.mutants import PACKAGE, ROOT, Mutant, read_mutants

MUTANTS = read_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: f"{m.file}-{m.name}".replace(" ", "_"))
def test_the_line_to_change_is_there_once(mutant: Mutant) -> None:
    text = (PACKAGE / mutant.file).read_text(encoding="utf-8")
    assert text.count(mutant.old) == 1 and mutant.old != mutant.new
    assert all((ROOT / path).is_file() for path in mutant.tests.split())


def test_there_are_enough_of_every_room() -> None:
    assert len(MUTANTS) >= 60
    assert len({(m.file, m.name) for m in MUTANTS}) == len(MUTANTS)
    rooms = {m.file.split("/")[0] for m in MUTANTS}
    assert {
        "training",
        "network",
        "pipeline.py",
        "face",
        "light",
        "raster",
        "relighting",
        "evaluation",
    } <= rooms
