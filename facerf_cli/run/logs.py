"""Log lines and JSON rows."""

import logging
import math
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

# Shared by the log and the progress bars, so that they do not overwrite each other.
STDERR = Console(stderr=True)
LOGGER_NAME = "facerf"
_FROM_STDIN = re.compile(r"\S*/facerf-stdin-\w+/stdin/stdin(\.\w+)?")  # see `batch.inputs`
_LONGEST_LINE = 2000  # characters of a message; those of damaged files may be of any length


def json_line(row: Mapping[str, Any]) -> str:
    """Format a row as one line of strict JSON: paths as text, numpy as numbers, NaN and infinity as null.

    Characters that are not printable, and bytes of file names that are not UTF-8, are escaped: a terminal
    would obey some, and other programs would take some for the end of the line.
    """
    import json  # --help does without it

    text = json.dumps(_plain(row), allow_nan=False, ensure_ascii=False)
    if text.isprintable():
        return text
    escapes = {ord(letter): json.dumps(letter)[1:-1] for letter in set(text) if not letter.isprintable()}
    return text.translate(escapes | {0x7F: "\\u007f"})


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return value.as_posix()
    if hasattr(value, "tolist"):  # numpy and torch, scalars and arrays
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class LineFormatter(logging.Formatter):
    """Formats `facerf: warning: …`, without a prefix for information, and an exception's traceback."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = "" if record.levelno <= logging.INFO else f"facerf: {record.levelname.lower()}: "
        text = prefix + printable_line(record.getMessage())
        if not record.exc_info:
            return text
        trace = self.formatException(record.exc_info).split("\n")
        return "\n".join([text, *map(escaped, trace)])


class JsonFormatter(logging.Formatter):
    """Formats a JSON object per line (`--log-json`)."""

    def format(self, record: logging.LogRecord) -> str:
        row = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "message": printable_line(record.getMessage()),
        }
        row |= getattr(record, "spent", {})
        if record.exc_info:
            row["traceback"] = self.formatException(record.exc_info)
        return json_line(row)


class _StderrHandler(logging.Handler):
    """Prints plainly, or above a running progress bar if stderr is a terminal."""

    def emit(self, record: logging.LogRecord) -> None:
        text = self.format(record)
        if STDERR.is_terminal:
            STDERR.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=sys.stderr, flush=True)


def configure_logging(verbosity: int = 0, as_json: bool = False) -> None:
    """Send the log to stderr: verbosity -1 errors only, 0 information and warnings, 1 everything."""
    logger = logging.getLogger(LOGGER_NAME)
    handler = _StderrHandler()
    handler.setFormatter(JsonFormatter() if as_json else LineFormatter())
    logger.handlers[:] = [handler]
    logger.propagate = False
    logger.setLevel({-1: logging.ERROR, 0: logging.INFO}.get(verbosity, logging.DEBUG))


def log_to_queue(queue: Any, level: int) -> None:
    """Send this process's log, from a level on, only to a queue: any object with `put_nowait`."""
    from logging.handlers import QueueHandler  # --help does without it

    logger = logging.getLogger(LOGGER_NAME)
    logger.handlers[:] = [QueueHandler(queue)]
    logger.propagate = False
    logger.setLevel(level)


@contextmanager
def step(name: str) -> Iterator[None]:
    """Log how long a step of the work takes (`-v`), and the processor time of all its threads."""
    log = logging.getLogger(LOGGER_NAME)
    if not log.isEnabledFor(logging.DEBUG):
        yield
        return
    start_s, used_s = time.perf_counter(), time.process_time()
    yield
    seconds, processor_seconds = time.perf_counter() - start_s, time.process_time() - used_s
    spent = {"step": name, "seconds": round(seconds, 3), "processor_seconds": round(processor_seconds, 3)}
    log.debug(
        "step %(step)s: %(seconds)g s, %(processor_seconds)g s of processors", spent, extra={"spent": spent}
    )


def unexpected(error: Exception) -> str:
    """Return the message of an error that is a bug, not the user's fault."""
    return f"unexpected {type(error).__name__}: {error} (rerun with -v for the traceback)"


def one_line(text: str) -> str:
    """Replace line breaks and runs of spaces by single spaces."""
    return " ".join(text.split())


def escaped(text: str) -> str:
    r"""Escape characters that are not printable, as `\x1b` or `\u2028`.

    Names and metadata contain them: a terminal would obey some, and others hide or reverse the rest.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def named(text: str) -> str:
    """Replace the temporary file of an image on standard input by `-`."""
    return _FROM_STDIN.sub("-", text)


def printable_line(text: str) -> str:
    """Return the text as one printable line of limited length, for a log or a report."""
    line = escaped(one_line(named(text[: 4 * _LONGEST_LINE])))
    return line if len(line) <= _LONGEST_LINE else line[: _LONGEST_LINE - 3] + "..."


def counted(number: int, thing: str) -> str:
    """Format a count: `1 light`, `2 lights`; `3 people` of a person."""
    plural = {"person": "people"}.get(thing, thing + "s")
    return f"{number} {thing if number == 1 else plural}"
