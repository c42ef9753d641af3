"""Shell scripts whose `facerf` and `python FILE.py` run in this process, which has the networks loaded."""

import os
import runpy
import select
import subprocess
import sys
from pathlib import Path

from facerf_cli.main import main

# Each command has a pipe for its answer: of one for all, the next command could find the end of this one's.
_ASK = """#!/bin/sh
told=$SHELL_ASKS.$$
mkfifo "$told"
{ printf '%s\\0' "$told" "${0##*/}" "$@"; echo; } > "$SHELL_ASKS"
read -r code < "$told"
rm "$told"
exit "$code"
"""


def run_shell(folder: Path, *command: str | Path, **variables: str | Path) -> list[list[str]]:
    """Run a script with `facerf` and `python` of this process; return their command lines.

    Its first failing command, or an exit code other than 0, fails the test. One command runs at a time.
    """
    asks = folder / "asks"
    os.mkfifo(asks)
    for name in ("facerf", "python"):
        (folder / name).write_text(_ASK)
        (folder / name).chmod(0o755)
    environment = os.environ | {key: str(value) for key, value in variables.items()}
    environment |= {"SHELL_ASKS": str(asks), "PATH": f"{folder}:{os.environ['PATH']}"}
    seen: list[list[str]] = []
    text = b""
    stream = os.open(asks, os.O_RDWR | os.O_NONBLOCK)
    shell = subprocess.Popen([*map(str, command)], env=environment)
    try:
        while shell.poll() is None:
            if not select.select([stream], [], [], 0.1)[0]:
                continue
            text += os.read(stream, 1 << 16)
            if not text.endswith(b"\n"):
                continue
            (told, *words), text = text.decode().removesuffix("\0\n").split("\0"), b""
            seen.append(words)
            code = _run(words)
            Path(told).write_text(f"{code}\n")
            assert code == 0, words
    finally:
        os.close(stream)
        shell.kill()
        code = shell.wait()
    assert code == 0
    return seen


def _run(words: list[str]) -> int:
    if words[0] == "facerf":
        return main(words[1:])
    before, sys.argv = sys.argv, words[1:]
    try:
        runpy.run_path(words[1], run_name="__main__")
    finally:
        sys.argv = before
    return 0
