"""Published files, fetched once into the user's cache: resumed after a broken connection, verified."""

import hashlib
import http.client
import logging
import os
import ssl
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import IO, Any
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit

import platformdirs
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from facerf_cli import __version__
from facerf_cli.errors import FacerfError
from facerf_cli.logs import LOGGER_NAME, STDERR, one_line

if sys.platform != "win32":
    import fcntl

TIMEOUT_S = 30.0  # of silence on a connection
_TRIES = 5  # connections to a server; each goes on where the last one broke
_BLOCK = 2**20
_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")
_NO_NETWORK = (URLError, http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError)

log = logging.getLogger(LOGGER_NAME)


def file_sha256(path: Path) -> str:
    """A file's SHA-256 in 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Published:
    """A file that someone publishes: its address, its digest in 64 hex digits, the most bytes it may have.

    `digest` is what of the file has that digest: of an archive that its server packs anew now and then, such
    as GitHub's, the contents (a damaged file's digest may be any other text).
    """

    url: str
    sha256: str
    size_limit: int
    digest: Callable[[Path], str] = file_sha256

    @property
    def name(self) -> str:
        """The last part of its address: its name in the cache."""
        return Path(unquote(urlsplit(self.url).path)).name


def cache_folder() -> Path:
    """Where fetched files are kept: the user's cache of this platform, as `facerf doctor` shows it."""
    return platformdirs.user_cache_path("facerf")


def fetch(published: Published, option: str, cache: Path | None = None) -> Path:
    """The file's place in the cache, fetched there first where it is not yet; verified every time.

    `option` is what the user can give in its stead, such as '--vgg-weights PATH': the one line of an error
    says so, and where the file may be put by hand. What a broken fetch got stays beside the file's place, and
    the next one goes on from there. Only https, or http on this machine, through redirections too. A bar
    shows progress where stderr is a terminal.
    """
    path = (cache or cache_folder()) / published.name
    try:
        if _is_whole(published, path):
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(path):
            if not _is_whole(published, path):  # as another process may have made it meanwhile
                log.info("fetching %s to %s", published.url, path)
                _fetch(published, path)
    except _Refused as error:
        raise FacerfError(
            f"{published.url}: {error}; put the right file at {path}, or give {option}"
        ) from None
    except _NO_NETWORK as error:
        raise FacerfError(
            f"{published.url}: cannot be fetched ({_reason(error)}); run again with a network, "
            f"put the file at {path}, or give {option}"
        ) from None
    except OSError as error:
        raise FacerfError(
            f"{path}: cannot be kept in the cache ({_reason(error)}); make room there, or give {option}"
        ) from None
    return path


class _Refused(Exception):
    """What came is not what was wanted; in words."""


def _fetch(published: Published, path: Path) -> None:
    part = path.with_name(f".{path.name}.part")
    resumed = part.exists()
    try:
        _download(published, part)
        if resumed and not _is_whole(published, part):  # its beginning was another file's: all of it anew
            part.unlink()
            _download(published, part)
        if not _is_whole(published, part):
            raise _Refused("what came is not the published file (its SHA-256 is another)")
    except _Refused:
        part.unlink(missing_ok=True)
        raise
    os.replace(part, path)


def _download(published: Published, part: Path) -> None:
    """Fetch what `part` lacks, over new connections for as long as each brings some of it."""
    for _ in range(_TRIES):
        before = _size(part)
        trouble: Exception = ConnectionError("the connection broke off")
        try:
            if _one_connection(published, part):
                return
        except _NO_NETWORK as error:
            trouble = error
        if _size(part) <= before:
            break
    raise trouble


def _one_connection(published: Published, part: Path) -> bool:
    """Append to `part` what one connection brings; whether the server had no more to send."""
    begin = _size(part)
    headers = {"User-Agent": f"facerf/{__version__}"} | ({"Range": f"bytes={begin}-"} if begin else {})
    try:
        response = _open(published.url, headers)
    except HTTPError as error:
        error.close()
        if begin and error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            return True  # all is here, or more; the digest tells
        raise
    with response:
        if not response.headers.get("Content-Range", "").startswith(f"bytes {begin}-"):
            begin = 0  # the server sends all of it, whatever was asked
        length = response.headers.get("Content-Length", "")
        total = begin + int(length) if length.isdecimal() else None
        _refuse_beyond(published, total or 0)
        with part.open("ab" if begin else "wb") as file, _progress(published.name, begin, total) as advance:
            while block := response.read1(_BLOCK):
                _refuse_beyond(published, file.tell() + len(block))
                file.write(block)
                advance(len(block))
            return total is None or file.tell() >= total


def _refuse_beyond(published: Published, size: int) -> None:
    if size > published.size_limit:
        raise _Refused(f"larger than the published file can be ({published.size_limit / 2**20:.0f} MiB)")


class _GuardedRedirects(urllib.request.HTTPRedirectHandler):
    """Follows no redirection to where `_check_address` would not let us begin."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        _check_address(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _open(url: str, headers: dict[str, str]) -> http.client.HTTPResponse:
    handlers: list[urllib.request.BaseHandler] = [_GuardedRedirects()]
    if _check_address(url) in _THIS_MACHINE:
        handlers.append(urllib.request.ProxyHandler({}))  # no proxy to reach ourselves
    request = urllib.request.Request(url, headers=headers)
    response: http.client.HTTPResponse = urllib.request.build_opener(*handlers).open(
        request, timeout=TIMEOUT_S
    )
    return response


def _check_address(url: str) -> str:
    """The host of an address that may be fetched from."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    if not (parts.scheme == "https" or (parts.scheme == "http" and host in _THIS_MACHINE)):
        raise _Refused(f"leads to {parts.scheme}://{host}, and only https is fetched from")
    return host


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other processes from fetching `path`; they wait, then find it there. Not on Windows."""
    with path.with_name(f".{path.name}.lock").open("ab") as file:
        if sys.platform != "win32":
            with suppress(OSError):  # a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def _progress(name: str, begin: int, total: int | None) -> Iterator[Callable[[int], None]]:
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    redirect = sys.stdout.isatty()
    shown = STDERR.is_terminal
    with Progress(*columns, console=STDERR, disable=not shown, redirect_stdout=redirect) as progress:
        task = progress.add_task(name, total=total, completed=begin)
        yield lambda count: progress.advance(task, count)


def _is_whole(published: Published, path: Path) -> bool:
    return path.is_file() and published.digest(path) == published.sha256


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _reason(error: Exception) -> str:
    if isinstance(error, HTTPError):
        return one_line(f"HTTP {error.code} {error.reason}")
    inner = error.reason if isinstance(error, URLError) else error
    if isinstance(inner, TimeoutError):
        return f"no answer within {TIMEOUT_S:.0f} s"
    if isinstance(inner, OSError) and inner.strerror:
        return f"{inner.filename}: {inner.strerror}" if inner.filename else inner.strerror
    return one_line(str(inner)) or type(inner).__name__
