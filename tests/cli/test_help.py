"""The help: verbs in the order of a day, options in panels, texts of a line or two at any width."""

import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from facerf_cli.cli import manual
from facerf_cli.cli.help import examples_of
from facerf_cli.main import app, main
from tests.kinds import Patch, Said

# Options whose value is a small language, which their help explains.
LANGUAGES = {"envmap", "light", "light_from", "reflectance", "aov", "background"}
MOST, MOST_OF_LANGUAGE = 140, 260  # characters: two lines of help, or four
FEW = 8  # options that need no panels


def commands() -> Iterator[tuple[str, Any]]:
    """Every verb, and every protocol of evaluate and face-model, by name."""
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        yield from getattr(command, "commands", {name: command}).items()


COMMANDS = dict(commands())
ROOT = typer.main.get_command(app)
CONTEXT = typer.Context(ROOT)
MAN = Path(__file__).parents[2] / "man"


def test_the_order_is_that_of_a_day(capsys: Said, monkeypatch: Patch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["--help"]) == 0
    boxed = (line for line in capsys.readouterr().out.splitlines() if line.startswith(("│", "╭")))
    lines = [line.strip("│╭─╮ ") for line in boxed]
    first = [line.split()[0] for line in lines if line]
    order = ["Relight", "relight", "Analyse", "estimate-light", "predict-olat", "segment", "fit-geometry"]
    order += ["Generate", "envmap", "Train", "synth-stage", "prepare-dataset"]
    order += ["relight-dataset", "train", "evaluate", "Maintenance", "doctor", "face-model"]
    assert [word for word in first if word in order] == order


@pytest.mark.parametrize("name", COMMANDS)
def test_help_texts_are_short_and_options_of_a_long_help_stand_in_panels(name: str) -> None:
    long = [
        option.name
        for option in COMMANDS[name].params
        if len(option.help or "") > (MOST_OF_LANGUAGE if option.name in LANGUAGES else MOST)
    ]
    assert not long
    options = [option for option in COMMANDS[name].params if option.param_type_name == "option"]
    bare = {option.name for option in options if not option.rich_help_panel and not option.required}
    assert len(options) <= FEW or bare <= {"output"}
    panels = list(dict.fromkeys(option.rich_help_panel for option in options if option.rich_help_panel))
    assert "Batch" not in panels[:-1]


def test_help_and_man_pages_have_panels_and_paragraphs(tmp_path: Path) -> None:
    help_text = COMMANDS["estimate-light"].help
    assert "\n" not in help_text.replace("\n\n", "") and help_text.count("\n\n") == 3
    page = manual.pages()["facerf-estimate-light.1"]
    panels = [line.removeprefix(".SS ") for line in page.splitlines() if line.startswith(".SS ")]
    assert panels == ["Light", "Image", "Face", "Method", "Batch"]
    top = manual.pages()["facerf.1"]
    assert top.index("fBrelight\\fR") < top.index(".SS Generate") < top.index("fBenvmap\\fR")
    assert manual._text(".a-b\\c") == "\\&.a\\-b\\ec"
    (tmp_path / "facerf-gone.1").touch()
    manual.main([str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == set(manual.pages())


def _shown(capsys: Said, *line: str) -> list[str]:
    """The lines of a help."""
    assert main(list(line)) == 0
    return capsys.readouterr().out.splitlines()


def _named(lines: list[str]) -> set[str]:
    """The options that a help lists; a name in angles or a metavar may follow."""
    return {word for line in lines if line.startswith("│") for word in line.split()[:3] if word[:2] == "--"}


def test_help_has_the_dozen_options_of_everyday_use_and_says_how_to_see_all(
    capsys: Said, monkeypatch: Patch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    brief, full = _shown(capsys, "relight", "--help"), _shown(capsys, "relight", "--help-all")
    assert len(brief) < 90 and 150 < len(full) < 200
    assert {"--output", "--light", "--background", "--face", "--jobs"} < _named(brief)
    assert len(_named(brief)) <= 16 and "--shard" not in _named(brief)
    left = len(_named(full)) - len(_named(brief))
    assert f" {left} more options: facerf relight --help-all, or man facerf-relight." in map(
        str.rstrip, brief
    )
    assert not any("more options" in line for line in full)
    monkeypatch.setenv("COLUMNS", "80")
    assert "--device" not in _named(_shown(capsys)) and "--device" in _named(_shown(capsys, "--help-all"))


@pytest.mark.parametrize("path", [path for path, _ in manual._walk(CONTEXT, ROOT, ()) if path])
def test_help_all_and_the_man_page_have_every_option(
    path: tuple[str, ...], capsys: Said, monkeypatch: Patch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    full = " ".join(_shown(capsys, *path, "--help-all"))
    page = manual.pages()[f"{'-'.join(('facerf', *path))}.1"]
    command: Any = ROOT
    for name in path:
        command = command.commands[name]
    assert path == () or not {option.name for option in command.params} & {one.name for one in ROOT.params}
    for option in command.params:
        if option.param_type_name == "option":
            assert option.opts[0] in full and manual._text(option.opts[0]) in page


@pytest.mark.parametrize(
    ("line", "near"),
    {
        "relight me.jpg --backround none": "--background",
        "relight me.jpg --ligth 40,20": "--light",
        "--devise cpu doctor": "--device",
        "rlight": "'relight'",
        "evaluate olta": "'olat'",
    }.items(),
)
def test_what_is_mistyped_gets_the_near_name(line: str, near: str, capsys: Said) -> None:
    assert main(line.split()) == 2
    assert near in capsys.readouterr().err.partition("see '")[0]


def test_man_is_in_step_with_the_app() -> None:
    assert {path.name: path.read_text() for path in MAN.glob("*.1")} == manual.pages(), "run `make man`"


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
@pytest.mark.parametrize("name", sorted(path.name for path in MAN.glob("*.1")))
def test_groff_has_no_complaint(name: str) -> None:
    result = subprocess.run(
        ["groff", "-man", "-Tascii", "-ww", str(MAN / name)], capture_output=True, text=True, check=True
    )
    assert result.stderr == "" and "OPTIONS" in result.stdout


@pytest.mark.parametrize("path", [path for path, _ in manual._walk(CONTEXT, ROOT, ()) if path])
def test_each_verb_has_one_or_two_examples_of_options_that_it_has(path: tuple[str, ...]) -> None:
    command: Any = ROOT
    for name in path:
        command = command.commands[name]
    if hasattr(command, "commands"):
        return
    known = {name for option in (*command.params, *ROOT.params) for name in option.opts}
    lines = examples_of(" ".join(path))
    assert len(lines) in (1, 2) and command.epilog.endswith(f"  {lines[-1]}")
    for line in lines:
        words = shlex.split(line)[1 + len(path) :]
        assert not {word for word in words if word[0] == "-"} - known
    page = manual.pages()[f"facerf-{'-'.join(path)}.1"]
    assert ".SH EXAMPLES" in page and ".SH EXIT STATUS" in page
