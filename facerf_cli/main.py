"""The command line: commands, global options, errors to exit codes.

A command is a function in `facerf_cli/cli/`, in the file of its name, and listed with its panel in `_LINES`;
its file is imported when the command runs, or its help is shown. To keep help fast, the modules directly in
`cli/` import nothing heavy (torch, numpy, OpenImageIO, scipy): the work of a command is behind a deferred
import. A test checks this.
"""

import io
import logging
import os
import re
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli._version import __version__
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.cli.help import Verb, Verbs, epilog_of, examples_of
from facerf_cli.cli.options import EPILOG, unwrapped, was_given, with_groups
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, configure_logging, unexpected
from facerf_cli.run.stopping import end_again, end_on_signals, leave

# Panels of the help, one per purpose, and a line for each command, in the order of a user's day.
_LINES = {
    "Relight photos": {
        "demo": "Relight the bundled photo.",
        "relight": "Relight photos with environment maps and single lights.",
        "view": "Make a web page to relight a photo by dragging lights.",
    },
    "Analyse photos": {
        "estimate-light": "Estimate the light of a photo.",
        "predict-olat": "Predict a person under each single light (OLAT).",
        "segment": "Cut people out: matte, hair, skin, clothes; landmarks.",
        "fit-geometry": "Fit a 3D face: mesh, texture, normals.",
    },
    "Generate light": {
        "envmap": "Generate environment maps: skies, rooms, studios, streets.",
    },
    "Train and evaluate": {
        "synth-stage": "Render synthetic people in a light stage.",
        "prepare-dataset": "Prepare a light stage's capture for training.",
        "relight-dataset": "Relight a dataset into training pairs.",
        "train": "Train the networks.",
        "evaluate": "Measure the paper's tables, and other methods.",
    },
    "Maintenance": {
        "doctor": "Show what is installed, and what is missing.",
        "face-model": "Import other face models.",
    },
}
VERBS = {verb: panel for panel, verbs in _LINES.items() for verb in verbs}

# Options that take every following file with these suffixes, so that a shell may expand a pattern there.
SEVERAL = {"--envmap": (".exr", ".hdr")}

# Options of earlier versions, and what replaces them.
_REMOVED = {
    "--ball": "`facerf estimate-light` and `facerf envmap` draw balls",
    "--exposure-group": "pass one --exposure EV for all images",
    "--match-tones": "use --light-wrap, and grade the EXR",
    "--matte-from": "write mattes with `rembg p photos mattes`, and pass --person mattes",
    "--photo": "relight the photo itself, without its stack",
    "--room": "use --ambient",
    "--white": "use --white-balance",
}
_SPINS = "20000"  # OpenMP spin count: idle threads sleep sooner and leave the cores to other programs
_AMERICAN = re.compile(r"^(--(?:in|out)put-)colorspace(?=$|=)")
_LONGEST_PATH = 4096  # bytes, of Linux
_PATIENCE_S = 2.0  # for a run to unwind after SIGTERM
log = logging.getLogger(LOGGER_NAME)


class _Commands(Mapping[str, Any]):
    """All commands by name; each is made when it is first used."""

    def __init__(self, more: Mapping[str, Any]) -> None:
        self._made = dict(more)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*VERBS, *self._made)))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __getitem__(self, name: str) -> Any:
        if name not in self._made and name in VERBS:
            self._made[name] = _command(name)
        return self._made[name]


def _command(name: str) -> Any:
    """Make a command; the file of a command with subcommands has an app."""
    file = import_module(f"facerf_cli.cli.{name.replace('-', '_')}")
    commands = getattr(file, "app", None)
    if commands is None:
        commands = typer.Typer(add_completion=False)
        commands.command(name)(with_groups(getattr(file, name.replace("-", "_"))))
    for entry in commands.registered_commands:
        assert entry.callback is not None
        own = entry.name or entry.callback.__name__.replace("_", "-")
        entry.cls, entry.help = Verb, unwrapped(entry.callback.__doc__ or "")
        entry.epilog = epilog_of(own if own == name else f"{name} {own}", EPILOG)
    command = typer.main.get_command(commands)
    command.name, command.rich_help_panel = name, VERBS[name]  # type: ignore[attr-defined]
    return command


class _Verbs(Verbs):
    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _Commands(self.commands)  # type: ignore[assignment]

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Take defaults of all options from `--config`, wherever it stands, or $FACERF_CONFIG."""
        named = re.findall(r"(?:^|\0)--config[=\0]([^\0]*)", "\0".join(args))
        if path := named[-1] if named else os.environ.get("FACERF_CONFIG"):
            extra["default_map"] = read_config(Path(path), self)
        return super().make_context(info_name, args, parent, **extra)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help with a line for each command, without importing its file."""
        commands, make = self.commands, typer.core.TyperCommand
        self.commands = {
            name: make(name, help=line, rich_help_panel=panel)
            for panel, verbs in _LINES.items()
            for name, line in verbs.items()
        }
        super().format_help(ctx, formatter)
        self.commands = commands


app = typer.Typer(
    cls=_Verbs,
    name="facerf",
    help="Relight the people in a photo, under any light from any direction.",
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # --help does without it

        build, device = version("torch"), "cpu"
        if not build.endswith("+cpu"):
            import torch  # which knows its build and its devices, and takes a second

            build, device = torch.__version__, torch_device(Settings())
        print(f"facerf {__version__} (torch {build}, device {device})")
        raise typer.Exit()


def read_config(path: Path, command: Any) -> dict[str, Any]:
    """Read defaults from a TOML file, for typer: a table of options per command, and [global] for all."""
    from facerf_cli.files.texts import read_toml  # --help does without it
    from facerf_cli.training.settings import KINDS  # tables of [train], which it reads itself

    def values(table: Mapping[str, Any], command: Any, typed: str) -> dict[str, Any]:
        options = (option for option in command.params if not option.is_eager)
        names = {word.lstrip("-"): option.name for option in options for word in option.opts}
        names |= {name: name for name in KINDS if typed == "facerf train"}
        defaults: dict[str, Any] = {}
        for name, value in table.items():
            inner = getattr(command, "commands", {}).get(name)
            if name == "global" and isinstance(value, dict):
                defaults |= values(value, command, typed)
            elif inner and isinstance(value, dict):
                defaults[name] = values(value, inner, f"{typed} {name}")
            elif name in names:
                defaults[names[name]] = value
            else:
                where = f"--config {path}: {name}"
                advice = _REMOVED.get(f"--{name}", f"see `{typed} --help-all`")
                raise UsageError(f"{where}: no such command or option; {advice}")
        return defaults

    try:
        return values(read_toml(path, "correct it"), command, "facerf")
    except InputError as error:
        raise UsageError(f"--config {error}") from None


def _global_options(
    context: typer.Context,
    settings: Settings,
    config_file: Annotated[
        Path | None,
        typer.Option(
            "--config",
            is_eager=True,
            metavar="FILE",
            envvar="FACERF_CONFIG",
            help="TOML file with defaults of options (docs/batch.md).",
            show_default=False,
        ),
    ] = None,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Print the versions of facerf and torch, and the device.",
        ),
    ] = False,
) -> None:
    if settings.verbose and settings.quiet:
        raise UsageError("-v and -q: contradict each other; remove one")
    configure_logging(settings.verbosity, settings.log_json)
    files, by_default = settings.checkpoints, not was_given(context, "checkpoints")
    if files:
        from facerf_cli.network.files import checkpoint_file, read_metadata  # --help does without it

        files = tuple(map(checkpoint_file, files))
        for file in () if by_default or context.invoked_subcommand == "doctor" else files:
            read_metadata(file)  # doctor itself reports what is wrong with it
    context.obj = replace(settings, checkpoints=files, checkpoints_by_default=by_default)
    memory.set_limit(context.obj.job_bytes(1))


_global_options = with_groups(_global_options)
_global_options.everyday = {"version"}  # type: ignore[attr-defined]  # so that commands fill the screen
app.callback()(_global_options)


def run() -> None:
    """Run the `facerf` script."""
    os.environ["PYTHONSAFEPATH"] = "1"  # no child imports what lies in the working directory
    end_on_signals(_PATIENCE_S)
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its systems are too small for threads
    _prepare_streams()
    memory.collect_seldom()
    memory.reuse_freed()
    try:
        code = main(sys.argv[1:])
    except SystemExit as stop:  # raised by a signal; the interpreter's own exit would report leaks
        code = stop.code if isinstance(stop.code, int) else 1
    leave(code)


def _prepare_streams() -> None:
    """Open streams that are closed, and pass names through unchanged in any encoding."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # else the next file would take its number
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
        if isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(encoding=sys.getfilesystemencoding(), errors="surrogateescape")


def main(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code; an error becomes one line on stderr."""
    configure_logging(as_json="--log-json" in arguments)
    try:
        _check_surroundings()
        spelt = [_AMERICAN.sub(r"\1colourspace", argument) for argument in arguments]
        line = repeat_options(spelt or ["--help"])
        try:
            code = app(args=line, prog_name="facerf", standalone_mode=False)
        finally:
            end_again()
        sys.stdout.flush()
        if code == 130:  # typer turns Ctrl-C into this exit code
            return _fail(None, "interrupted", 130)
        return code if isinstance(code, int) else 0
    except UsageError as error:
        return _fail(error, str(error), 2)
    except FacerfError as error:
        return _fail(error, str(error), 1)
    except BrokenPipeError:
        return _end_quietly()
    except KeyboardInterrupt:  # outside of typer, which has its own code for it
        return _fail(None, "interrupted", 130)
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # typer turns it into an exit
            return _end_quietly()
        raise
    except OSError as error:
        return _fail(error, f"{error.filename or 'system'}: {error.strerror or error}", 1)
    except typer.Abort:
        return _fail(None, "aborted", 1)
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(
            error, "exit_code"
        ):  # typer's: the command line is wrong
            message = error.format_message().replace("Value error, ", "")  # pydantic's prefix
            return _fail(None, f"{message} {_see_help(error)}", error.exit_code)
        return _fail(error, unexpected(error), 1)


def _check_surroundings() -> None:
    """Raise UsageError for a working folder or an environment that makes libraries fail on import."""
    if len(os.fsencode(os.getcwd())) >= _LONGEST_PATH:
        raise UsageError(f"working folder: its path is longer than {_LONGEST_PATH} bytes; use another one")
    if not (epoch := os.environ.get("SOURCE_DATE_EPOCH", "0")).isdecimal():
        raise UsageError(f"SOURCE_DATE_EPOCH {epoch!r}: not a number of seconds; unset it")


def _end_quietly() -> int:
    """Redirect stdout, which its reader has closed, so that Python's last flush does not fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stdout__.fileno())  # type: ignore[union-attr]
    return 128 + signal.SIGPIPE


def repeat_options(arguments: Sequence[str]) -> list[str]:
    """Turn `--envmap a.exr b.exr`, as a shell expands a pattern, into `--envmap a.exr --envmap b.exr`."""
    line: list[str] = []
    option, value_next = None, False
    for argument in arguments:
        if argument in SEVERAL:
            option, value_next = argument, True
        elif value_next:
            value_next = False
        elif option and argument.lower().endswith(SEVERAL[option]):
            line.append(option)
        else:
            option = None
        line.append(argument)
    return line


def _see_help(error: Any) -> str:
    context = getattr(error, "ctx", None)
    path = context.command_path if context else "facerf"
    is_no_command = path == "facerf" and "No such command" in error.format_message()
    advice = f"a command comes first, as in {examples_of('relight')[0]}" if is_no_command else ""
    advice = _REMOVED.get(getattr(error, "option_name", ""), advice)
    return f"({advice}{'; ' if advice else ''}see '{path} --help')"


def _fail(error: BaseException | None, message: str, code: int) -> int:
    trace = error if error is not None and log.isEnabledFor(logging.DEBUG) else None
    log.error("%s", message, exc_info=trace)
    return code
