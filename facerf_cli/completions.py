"""Shell completion as files: `python -m facerf_cli.completions DIR` writes a script for bash, zsh and fish.

The scripts name no option: at every TAB they ask `facerf` itself, so they change with typer only.
"""

import os
import subprocess
import sys
from pathlib import Path

from facerf_cli.errors import UsageError

FILES = {"bash": "facerf.bash", "zsh": "_facerf", "fish": "facerf.fish"}  # the names that the shells look for
# zsh runs the file at the first TAB; without a call, that TAB would only define the function.
_LAST_LINES = {"zsh": '\n_facerf_completion "$@"'}


def scripts() -> dict[str, str]:
    """File name to script."""
    return {name: _script(shell) for shell, name in FILES.items()}


def _script(shell: str) -> str:
    """The script that typer makes for a shell; `#compdef` must be the first line of a zsh file."""
    environment = os.environ | {"_FACERF_COMPLETE": f"source_{shell}"}
    command = [sys.executable, "-m", "facerf_cli"]
    made = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return made.stdout.strip() + _LAST_LINES.get(shell, "") + "\n"


def main(arguments: list[str]) -> None:
    """Write all scripts into the folder named."""
    if len(arguments) != 1:
        raise UsageError("usage: python -m facerf_cli.completions DIR")
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, script in scripts().items():
        (folder / name).write_text(script, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
