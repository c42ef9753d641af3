"""The command line as a user meets it: global options, one line for an error, exit codes."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import torch
import typer

from facerf_cli import __version__, main
from facerf_cli.batch.settings import Settings
from facerf_cli.cli.help import Verb
from facerf_cli.cli.options import settings_of
from facerf_cli.errors import FacerfError, InputError, UsageError
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.kinds import Patch, Said

ROOT = Path(main.__file__).parents[1]
ERRORS: dict[str, BaseException] = {
    "input": InputError("a.png: is\nbad"),
    "usage": UsageError("--pose wants three numbers"),
    "facerf": FacerfError("disk full"),
    "bug": ZeroDivisionError("by zero"),
    "stop": KeyboardInterrupt(),
    "system": PermissionError(13, "Permission denied", "/there"),
}
WITHOUT_POLICY = {
    key: os.environ[key] for key in os.environ if key not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
}
SPINS = "import os; atexit.register(lambda: print('spins', os.environ.get('GOMP_SPINCOUNT')))"
seen: list[Settings] = []
RunLine = Callable[..., int]


@pytest.fixture
def run_line(monkeypatch: Patch) -> Iterator[RunLine]:
    """Runs a line with one more verb, `probe`, that notes its settings and raises what it is told."""

    def probe(context: typer.Context, kind: str = "", pose: str = "") -> None:
        seen.append(settings_of(context))
        if kind:
            raise ERRORS[kind]
        print(pose)

    registered = list(main.app.registered_commands)
    main.app.command(cls=Verb)(probe)
    yield lambda *line: main.main(list(line))
    main.app.registered_commands[:] = registered


@pytest.mark.parametrize(("kind", "code", "text"), [
    ("input", 1, "a.png: is bad"), ("usage", 2, "--pose wants three numbers"), ("facerf", 1, "disk full"),
    ("bug", 1, "unexpected ZeroDivisionError: by zero (rerun with -v for the traceback)"),
    ("stop", 130, "interrupted"), ("system", 1, "/there: Permission denied"),
])  # fmt: skip
def test_an_error_is_one_line_and_a_code(
    run_line: RunLine, capsys: Said, kind: str, code: int, text: str
) -> None:
    assert run_line("probe", "--kind", kind) == code
    assert capsys.readouterr() == ("", f"facerf: error: {text}\n")


def test_the_traceback_is_there_for_who_asks_and_logs_may_be_json(run_line: RunLine, capsys: Said) -> None:
    assert run_line("probe", "--kind", "bug", "-v") == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err
    assert run_line("--log-json", "probe", "--kind", "input") == 1
    row = json.loads(capsys.readouterr().err)
    assert row["level"] == "error" and row["message"] == "a.png: is bad" and "time" in row
    assert run_line("probe", "--pose", "-20,5,0") == 0
    assert capsys.readouterr().out == "-20,5,0\n"


@pytest.mark.parametrize("line", [
    ["--device", "cpu", "--seed=7", "--checkpoint", "a.st", "-q", "probe"],
    ["probe", "--device", "cpu", "--seed=7", "--checkpoint", "a.st", "-q"],
    ["--seed", "7", "probe", "-q", "--device=cpu", "--checkpoint=a.st"],
    ["--seed", "1", "--device", "auto", "probe", "--device", "cpu", "--seed=7", "--checkpoint", "a.st", "-q"],
])  # fmt: skip
def test_global_options_stand_anywhere(
    run_line: RunLine, line: list[str], tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_toy_checkpoint(Path("a.st"))
    assert run_line(*line) == 0
    assert seen[-1] == Settings(quiet=True, device="cpu", checkpoints=(Path("a.st"),), seed=7)


def test_global_options_end_at_two_dashes_and_with_the_options_of_a_command(
    run_line: RunLine, capsys: Said
) -> None:
    assert run_line("probe", "--pose", "--seed") == 0 and capsys.readouterr().out == "--seed\n"
    assert run_line("probe", "--", "--seed") == 2 and "extra argument" in capsys.readouterr().err
    assert run_line("-v", "probe", "-q") == 2 and "-v and -q" in capsys.readouterr().err


@pytest.mark.parametrize("package", [version("torch"), "2.13.0"])  # PyPI's CUDA build has no +cu130
def test_version_and_help(package: str, capsys: Said, monkeypatch: Patch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: package)
    assert main.main(["--version"]) == 0
    said = (
        rf"facerf {re.escape(__version__)} \(torch {re.escape(torch.__version__)}, device (cpu|cuda|mps)\)\n"
    )
    assert re.fullmatch(said, capsys.readouterr().out)
    for line in ([], ["--help"], ["-h"], ["doctor", "-h"]):
        assert main.main(line) == 0
        assert "Usage: facerf" in capsys.readouterr().out


def run(code: str, **keywords: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, **keywords)  # type: ignore[call-overload]


def test_help_does_not_import_what_is_heavy() -> None:
    result = run(
        "import sys, typer\nfrom facerf_cli import main\ncode = main.main(['--help'])\n"
        "list(typer.main.get_command(main.app).commands.values())\n"  # as each verb's own help does
        "heavy = {'torch', 'numpy', 'OpenImageIO', 'scipy', 'trimesh', 'skimage', 'colour', 'dlib',"
        " 'pydantic', 'jinja2'}\n"
        "print(code, sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    assert result.stderr == "0 []\n"


def test_a_relight_imports_what_it_needs(tmp_path: Path) -> None:
    lights = ["--light", "60,30", "--envmap", str(ROOT / "examples/maps/studio.exr")]
    line = ["relight", str(ROOT / "examples/astronaut.jpg"), *lights, "-o", str(tmp_path)]
    result = run(
        f"import sys\nfrom facerf_cli import main\nprint(main.main({line}), file=sys.stderr)\n"
        "unneeded = ('scipy.interpolate', 'scipy.spatial', 'scipy.optimize', 'scipy.linalg', 'scipy.fft',"
        " 'scipy.sparse.linalg', 'trimesh', 'PIL', 'jinja2', 'colour',"
        " 'facerf_cli.synth', 'facerf_cli.training', 'facerf_cli.evaluation', 'facerf_cli.dataset',"
        " 'facerf_cli.capture', 'facerf_cli.files.downloads', 'facerf_cli.files.meshes')\n"
        "print([name for name in sorted(sys.modules) if name.startswith(unneeded)], file=sys.stderr)"
    )
    assert result.stderr.splitlines()[-2:] == ["0", "[]"]


def test_a_reader_that_goes_away_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "facerf_cli", "doctor"]
    result = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.parametrize(("policy", "spins"), [({}, "20000"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")])
def test_a_run_ends_with_its_code_and_all_that_was_printed(policy: dict[str, str], spins: str) -> None:
    """Threads wait asleep unless the user says otherwise: turning in circles takes another's processor."""
    result = run(
        f"import atexit, sys; {SPINS}; sys.argv = ['facerf', '--version', '-v', '-q']\n"
        "from facerf_cli.main import run; run()",
        env=WITHOUT_POLICY | {"PYTHONUNBUFFERED": "", **policy},
    )
    assert result.returncode == 0
    assert re.fullmatch(rf"facerf {__version__} .*\nspins {spins}\n", result.stdout)


@pytest.mark.parametrize(
    ("stdout", "code", "said"),
    [
        (">&-", 0, ""),
        pytest.param(
            ">/dev/full",
            1,
            "facerf: error: system: No space left on device\n",
            marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux"),
        ),
    ],
)
def test_a_stdout_that_takes_nothing(stdout: str, code: int, said: str) -> None:
    line = ["sh", "-c", f'exec "$0" -m facerf_cli --version {stdout}', sys.executable]
    result = subprocess.run(line, capture_output=True, text=True, cwd=ROOT)
    assert (result.returncode, result.stderr) == (code, said)


@pytest.mark.parametrize(
    ("closed", "code", "said"),
    [("", 0, ""), (">&-", 0, ""), ("2>&-", 0, ""), ("<&-", 2, "-: no inputs found")],
)
def test_names_in_any_encoding_and_streams_that_are_closed(
    tmp_path: Path, closed: str, code: int, said: str
) -> None:
    """A list with a byte order mark, and a name that the encoding of the streams lacks."""
    (tmp_path / "日本.jpg").touch()
    dry_run = f'exec "$0" -m facerf_cli segment - -o {tmp_path}/out --dry-run {closed}'
    command, listed = ["sh", "-c", dry_run, sys.executable], f"\ufeff{tmp_path}/日本.jpg\r\n"
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    result = subprocess.run(command, input=listed.encode(), capture_output=True, cwd=ROOT, env=environment)
    assert result.returncode == code and said in result.stderr.decode()
    outputs = result.stdout.decode().splitlines()
    assert len(outputs) == (4 if closed in ("", "2>&-") else 0)
    assert all(f"{tmp_path}/日本.jpg -> {tmp_path}/out/日本_" in line for line in outputs)


@pytest.mark.parametrize(
    ("words", "offered"), [("facerf do", "doctor"), ("facerf relight --composite ", "photo\nface")]
)
def test_shell_completion(words: str, offered: str) -> None:
    protocol = {
        "_FACERF_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(words.count(" ")),
    }
    result = run(
        "import sys; sys.argv = ['facerf']; from facerf_cli.main import run; run()", env=os.environ | protocol
    )
    assert offered in result.stdout and result.stderr == ""


def test_ctrl_c_outside_of_a_verb_is_one_line(monkeypatch: Patch, capsys: Said) -> None:
    def pressed(line: object) -> list[str]:
        raise KeyboardInterrupt

    monkeypatch.setattr(main, "repeat_options", pressed)
    assert main.main(["doctor"]) == 130
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(("change", "said"), [
    ({"argument": "9" * 26}, "'--seed'"),
    ({"SOURCE_DATE_EPOCH": "yesterday"}, "SOURCE_DATE_EPOCH 'yesterday': not a number of seconds"),
    ({"folder": "/d" * 2048}, "working folder: its path is longer than 4096 bytes"),
])  # fmt: skip
def test_what_libraries_fail_on_is_one_line(
    run_line: RunLine, capsys: Said, monkeypatch: Patch, change: dict[str, str], said: str
) -> None:
    if folder := change.pop("folder", None):
        monkeypatch.setattr(main.os, "getcwd", lambda: folder)
    seed = change.pop("argument", "0")
    for name, value in change.items():
        monkeypatch.setenv(name, value)
    assert run_line("probe", "--seed", seed) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_signal_ends_the_process_without_what_libraries_say_at_its_end(monkeypatch: Patch) -> None:
    def ended_by_a_signal(line: list[str]) -> int:
        sys.exit(143)

    left: list[int] = []
    monkeypatch.setattr(main, "main", ended_by_a_signal)
    monkeypatch.setattr(main, "end_on_signals", lambda patience_s: None)
    monkeypatch.setattr(main, "leave", left.append)
    monkeypatch.setattr(main.memory, "collect_seldom", lambda: None)
    monkeypatch.setattr(main.memory, "reuse_freed", lambda: None)
    monkeypatch.setattr(os, "environ", dict(os.environ))  # `run` sets variables for its children
    main.run()
    assert left == [143]
