"""`--memory` is a ceiling: what needs more is refused in one line, and jobs share what there is."""

from pathlib import Path

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import Outcome, _run_one
from facerf_cli.batch.settings import Settings
from facerf_cli.main import main
from facerf_cli.run import memory
from tests.kinds import Patch, Said


def said(capsys: Said) -> str:
    """Standard error in one line, whatever the width of the terminal."""
    return " ".join(capsys.readouterr().err.split())


def test_a_photo_beyond_the_budget_is_refused_before_it_is_decoded(
    tmp_path: Path, capsys: Said, monkeypatch: Patch
) -> None:
    photo = tmp_path / "large.pgm"
    photo.write_bytes(b"P5\n7000 5000\n255\n")  # a header alone: decoding it would be another error
    line = ["relight", str(photo), "-o", str(tmp_path / "out"), "--light", "40,20"]
    assert main([*line, "--memory", "0.5"]) == 1
    assert "7000 x 5000 pixels: needs 0.98 GB of memory, and 0.50 GB are allowed; pass --memory 0.98" in said(
        capsys
    )
    assert main([*line, "--memory", "0.98"]) == 1 and "cut short" in said(capsys)
    assert main([*line, "--memory", "inf"]) == 2 and main([*line, "--memory", "0"]) == 2


def test_jobs_have_a_share_each_and_items_give_theirs_back(monkeypatch: Patch) -> None:
    assert Settings().job_bytes(4) == memory.default_limit(4)
    assert Settings(memory_bytes=7).job_bytes(4) == 7
    seen = []
    item = Item(Path("a"), Path("a"), "a")
    _run_one(lambda item: seen.append(memory.limit_bytes()), None, 12345, item)  # type: ignore[arg-type]
    assert seen == [12345]
    given: list[str] = []
    monkeypatch.setattr(memory, "give_back", lambda: given.append("back"))
    for process in (lambda item: Outcome([]), lambda item: 1 / 0):
        _run_one(process, None, 1 << 30, Item(Path("a"), Path("a"), "a"))
    assert given == ["back", "back"]
