"""The list of mutants fits the code; `python -m tests.mutants` runs them."""

from tests.mutants import PACKAGE, ROOT, read_mutants

MUTANTS = read_mutants()


def test_each_line_to_change_is_there_once() -> None:
    wrong = []
    for mutant in MUTANTS:
        text = (PACKAGE / mutant.file).read_text(encoding="utf-8")
        tests = all((ROOT / path).is_file() for path in mutant.tests.split())
        if text.count(mutant.old) != 1 or mutant.old == mutant.new or not tests:
            wrong.append(f"{mutant.file}: {mutant.name}")
    assert not wrong


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
