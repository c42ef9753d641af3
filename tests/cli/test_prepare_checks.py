"""`facerf prepare-dataset --checks`: findings stop subjects or leave frames out, and are written down."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from facerf_cli.capture.findings import LEAST_LIGHTS, Finding
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.main import main
from tests.kinds import Folders, Patch, Said
from tests.worlds import write_capture

LIGHTS = 12
Plant = Callable[..., None]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: Folders) -> Path:
    folder = tmp_path_factory.mktemp("stage") / "capture"
    write_capture(folder, subjects=2, lights=LIGHTS)
    return folder


@pytest.fixture
def plant(monkeypatch: Patch) -> Plant:
    """Have the checks find these, whatever is there."""

    def planted(*findings: Finding) -> None:
        def check_subject(capture: Said, subject: str) -> list[Finding]:
            return [found for found in findings if found.subject == subject]

        monkeypatch.setattr("facerf_cli.dataset.prepare_capture.check_subject", check_subject)

    return planted


def prepare(capture: Path, output: Path, *line: str) -> int:
    return main(["prepare-dataset", str(capture), "-o", str(output), "--crop", "64", *line])


def frame(light: int, subject: str = "0000", camera: str = "C1") -> Finding:
    words = "is black"
    return Finding("error", "black", subject, words, camera, f"L{light:03d}", {"share": 0.1})


ORDER = Finding("error", "order", "0001", "the lamps are in another order", "C0")
CLIPPED = Finding("warning", "clipped", "0001", "3 frames are clipped", "C0")


@pytest.mark.slow
def test_broken_frames_are_left_out_and_errors_stop_their_subject(
    capture: Path, tmp_path: Path, capsys: Said, plant: Plant
) -> None:
    plant(frame(4), ORDER, CLIPPED)
    assert prepare(capture, tmp_path) == 1
    said = capsys.readouterr().err
    assert "0000: 1 light left out (L004: C1: black)" in said
    assert "0001/C0: order: the lamps are in another order" in said and "subject stopped" in said
    dataset = read_dataset(tmp_path)
    assert dataset.subjects == ("0000",) and 4 not in dataset.lights_of("0000")
    rows = [json.loads(line) for line in (tmp_path / "findings.jsonl").read_text().splitlines()]
    assert rows == [found.row() for found in (frame(4), ORDER, CLIPPED)]
    page = (tmp_path / "index.html").read_text()
    assert all(words in page for words in (ORDER.words, CLIPPED.words, "C1/L004"))
    plant()
    assert prepare(capture, tmp_path, "--overwrite", "always") == 0  # nothing of the old findings is left
    assert (tmp_path / "findings.jsonl").read_text() == "" and ORDER.words not in capsys.readouterr().err
    dataset = read_dataset(tmp_path)
    assert all(len(dataset.lights_of(name)) == LIGHTS for name in dataset.subjects)


@pytest.mark.slow
def test_warnings_stop_strict_runs_and_too_many_broken_frames_all(
    capture: Path, tmp_path: Path, capsys: Said, plant: Plant
) -> None:
    plant(CLIPPED)
    assert prepare(capture, tmp_path / "strict", "--strict") == 1
    assert (
        "0001/C0: clipped: 3 frames are clipped; without --strict it is a warning" in capsys.readouterr().err
    )
    assert read_dataset(tmp_path / "strict").subjects == ("0000",)
    plant(*(frame(light) for light in range(LIGHTS - LEAST_LIGHTS + 1)))
    assert prepare(capture, tmp_path / "broken") == 1
    assert "0000: 9 of 12 lights have a sound frame" in capsys.readouterr().err
    plant(ORDER, frame(4))
    assert prepare(capture, tmp_path / "off", "--checks", "off") == 0
    dataset = read_dataset(tmp_path / "off")
    assert all(len(dataset.lights_of(name)) == LIGHTS for name in dataset.subjects)
    assert not (tmp_path / "off/findings").exists()


@pytest.mark.parametrize(
    ("findings", "line", "code"),
    [
        ([ORDER, frame(4)], [], 1),
        ([frame(4), CLIPPED], [], 0),
        ([CLIPPED], ["--strict"], 1),
        ([], ["--strict"], 0),
    ],
)
def test_only_checks_write_their_findings_and_nothing_else(
    capture: Path,
    tmp_path: Path,
    capsys: Said,
    plant: Plant,
    findings: list[Finding],
    line: list[str],
    code: int,
) -> None:
    plant(*findings)
    assert prepare(capture, tmp_path / "out", "--checks", "only", *line) == code
    said = capsys.readouterr()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["findings.jsonl"]
    rows = [json.loads(text) for text in (tmp_path / "out/findings.jsonl").read_text().splitlines()]
    assert sorted(map(str, rows)) == sorted(str(found.row()) for found in findings)
    assert all(found.words in said.err for found in findings) and "findings.jsonl" in said.out


def test_real_checks_in_processes_find_the_missing_frame(capture: Path, tmp_path: Path, capsys: Said) -> None:
    hidden = capture / "0001/C2/L002.exr"
    hidden.rename(tmp_path / "hidden.exr")
    try:
        assert prepare(capture, tmp_path / "out", "--checks", "only", "--jobs", "2") == 0
    finally:
        (tmp_path / "hidden.exr").rename(hidden)
    rows = [json.loads(line) for line in (tmp_path / "out/findings.jsonl").read_text().splitlines()]
    assert {"0001/C2/L002"} == {
        f"{row['subject']}/{row['camera']}/{row['light']}" for row in rows if row["check"] == "missing"
    }
