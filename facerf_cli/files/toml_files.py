"""TOML files that users write: bounded, and read without running anything."""

import tomllib
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError
from facerf_cli.files.regular import require_regular


def read_toml(path: Path, limit_bytes: int, too_long: str, advice: str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Raises InputError, which says `too_long` of a file over the limit, and `advice` of one that is no TOML.
    """
    require_regular(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(limit_bytes + 1)
        if len(data) > limit_bytes:
            raise InputError(f"{path}: {too_long}")
        return tomllib.loads(data.decode())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except (ValueError, RecursionError) as error:  # also of the decoding
        raise InputError(f"{path}: not TOML ({error}); {advice}") from None
