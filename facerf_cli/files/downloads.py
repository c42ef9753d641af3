"""Downloads of published files into the user's cache: resumed after a broken connection, then verified.

By hand, since no small library resumes and bounds the size.
"""

import http.client
import logging
import os
import ssl
import time
import urllib.request
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit

import platformdirs
from rich.progress import DownloadColumn

from facerf_cli._version import __version__
from facerf_cli.errors import FacerfError
from facerf_cli.files.atomic import alone_in
from facerf_cli.files.texts import file_sha256
from facerf_cli.run.logs import LOGGER_NAME, one_line, progress_bar

TIMEOUT_S = 30.0  # without any data on a connection
DEADLINE_S = 2 * 3600.0  # of a download in all; the next one continues it
_TRIES = 5  # connections to a server; each continues where the last one broke
_BLOCK = 2**20  # bytes read at a time
_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")  # where http is safe
_NO_NETWORK = (URLError, http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError)

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class PublishedFile:
    """A file on a server, and the digest that verifies it."""

    url: str
    sha256: str  # 64 hex digits
    size_limit: int  # bytes; more are refused

    @property
    def name(self) -> str:
        """The file's name in the cache: the last part of its address."""
        return Path(unquote(urlsplit(self.url).path)).name


def cache_folder() -> Path:
    """Return the folder of downloaded files in this platform's user cache; `facerf doctor` shows it."""
    return platformdirs.user_cache_path("facerf")


def fetch(published: PublishedFile, option: str, cache: Path | None = None) -> Path:
    """Return the file's path in the cache; download it first if it is missing, and verify it every time.

    `option` is the option that replaces the download, such as '--vgg-weights PATH': an error names it, and
    the path to which the user can copy the file. An interrupted download is kept, and the next one continues
    it. Addresses and redirections must be https, or http on this machine. A bar shows progress if stderr is a
    terminal.
    """
    path = (cache or cache_folder()) / published.name
    try:
        if not _is_whole(published, path):
            with alone_in(path.parent, f".{path.name}.lock"):
                if not _is_whole(published, path):  # another process may have fetched it by now
                    log.info("fetching %s to %s", published.url, path)
                    _fetch(published, path)
    except _Refused as error:
        raise FacerfError(
            f"{published.url}: {error}; put the right file at {path}, or give {option}"
        ) from None
    except (_Late, *_NO_NETWORK) as error:
        raise FacerfError(
            f"{published.url}: cannot be fetched ({_reason(error)}); run again with a network, "
            f"put the file at {path}, or give {option}"
        ) from None
    except OSError as error:
        raise FacerfError(
            f"{path}: cannot be kept in the cache ({_reason(error)}); make room there, or give {option}"
        ) from None
    return path


class _Late(Exception):
    """A download reached its deadline."""


class _Refused(Exception):
    """The download is not the published file; the text says why."""


def _fetch(published: PublishedFile, path: Path) -> None:
    """Download to a temporary file, verify it, and rename it to `path`."""
    part = path.with_name(f".{path.name}.part")
    resumed = part.exists()
    try:
        _download(published, part)
        if resumed and not _is_whole(published, part):  # the kept beginning was of another file
            part.unlink()
            _download(published, part)
        if not _is_whole(published, part):
            raise _Refused("the download is not the published file (its SHA-256 differs)")
    except _Refused:
        part.unlink(missing_ok=True)
        raise
    os.replace(part, path)


def _download(published: PublishedFile, part: Path) -> None:
    """Download the rest of `part`; connect again as long as each connection delivers some data."""
    end_s = time.monotonic() + DEADLINE_S
    for attempt in range(1, _TRIES + 1):
        before = _size(part)
        try:
            if _one_connection(published, part, end_s):
                return
            raise ConnectionError("the connection broke off")
        except _NO_NETWORK:
            if _size(part) <= before or attempt == _TRIES:
                raise


def _one_connection(published: PublishedFile, part: Path, end_s: float) -> bool:
    """Append one connection's data to `part`; return whether the file is complete.

    Raises _Late at the deadline.
    """
    begin = _size(part)
    try:
        response = _open(published.url, begin)
    except HTTPError as error:
        error.close()
        if begin and error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            return True  # the file is complete, or too long; the digest decides
        raise
    with response:
        if not response.headers.get("Content-Range", "").startswith(f"bytes {begin}-"):
            begin = 0  # the server ignores the range and sends the whole file
        length = response.headers.get("Content-Length", "")
        total = begin + int(length) if length.isdecimal() else None
        _refuse_beyond(published, total or 0)
        with part.open("ab" if begin else "wb") as file, progress_bar(DownloadColumn()) as progress:
            task = progress.add_task(published.name, total=total, completed=begin)
            while block := response.read1(_BLOCK):
                _refuse_beyond(published, file.tell() + len(block))
                file.write(block)
                progress.advance(task, len(block))
                if time.monotonic() > end_s:
                    raise _Late(f"not whole within {DEADLINE_S / 3600:g} h; the next run continues it")
            return total is None or file.tell() >= total


def _refuse_beyond(published: PublishedFile, size: int) -> None:
    if size > published.size_limit:
        raise _Refused(f"larger than the published file can be ({published.size_limit / 2**20:.0f} MiB)")


def _open(url: str, begin: int) -> http.client.HTTPResponse:
    headers = {"User-Agent": f"facerf/{__version__}"} | ({"Range": f"bytes={begin}-"} if begin else {})
    request = urllib.request.Request(url, headers=headers)
    response: http.client.HTTPResponse = opener_of(url).open(request, None, TIMEOUT_S)
    return response


def opener_of(url: str) -> urllib.request.OpenerDirector:
    """Return an opener of https alone, redirections too; on this machine of http, without a proxy."""
    here = urlsplit(url).hostname in _THIS_MACHINE
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.HTTPHandler if here else urllib.request.ProxyHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPRedirectHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        urllib.request.UnknownHandler,
    ):
        opener.add_handler(handler())
    return opener


def _is_whole(published: PublishedFile, path: Path) -> bool:
    return path.is_file() and file_sha256(path) == published.sha256


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _reason(error: Exception) -> str:
    """Return the cause of a failed download in a few words."""
    if isinstance(error, HTTPError):
        return one_line(f"HTTP {error.code} {error.reason}")
    inner = error.reason if isinstance(error, URLError) else error
    if isinstance(inner, TimeoutError):
        return f"no answer within {TIMEOUT_S:.0f} s"
    if isinstance(inner, OSError) and inner.strerror:
        return f"{inner.filename}: {inner.strerror}" if inner.filename else inner.strerror
    return one_line(str(inner)) or type(inner).__name__
