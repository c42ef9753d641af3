"""What lies in a folder, a .zip or a .tar, read with bounds."""

import lzma
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from facerf_cli.errors import InputError

DAMAGED = (OSError, EOFError, RuntimeError, zlib.error, lzma.LZMAError, tarfile.TarError, zipfile.BadZipFile)


def members(path: Path) -> Iterator[tuple[str, Callable[[int], bytes]]]:
    """Each file in a folder or archive: its name, and what reads at most so many bytes of it."""
    if path.is_dir():
        for file in sorted(path.rglob("*.obj")):
            with file.open("rb") as stream:
                yield file.as_posix(), stream.read
    elif zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as member:
                    yield name, member.read
    elif path.is_file() and tarfile.is_tarfile(path):
        # One pass: seeking in a compressed tar would decompress it anew for each of its 150 files.
        with tarfile.open(path, "r|*") as tar:
            for entry in tar:
                if entry.isfile() and (content := tar.extractfile(entry)):
                    yield entry.name, content.read
    else:
        wrong = "" if path.exists() else "no such file; "
        raise InputError(f"{path}: {wrong}give the ICT-FaceKit folder, or its .zip or .tar archive")
