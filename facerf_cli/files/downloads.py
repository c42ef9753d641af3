"""Downloads of published files by torch.hub into the user's cache, verified by digest."""

import logging
import os
import socket
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import unquote, urlsplit

import platformdirs

from facerf_cli.errors import FacerfError
from facerf_cli.files.atomic import alone_in, hidden_folder
from facerf_cli.files.texts import file_sha256
from facerf_cli.run.logs import LOGGER_NAME, STDERR, one_line

TIMEOUT_S = 30.0  # without data on a connection
_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")  # where http is safe
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class PublishedFile:
    """File on a server with its digest."""

    url: str
    sha256: str  # 64 hex digits
    size_limit: int  # bytes

    @property
    def name(self) -> str:
        """Name in the cache: the last part of its URL."""
        return Path(unquote(urlsplit(self.url).path)).name

    def is_at(self, path: Path) -> bool:
        """Return whether a path is this file, by its digest."""
        return path.is_file() and file_sha256(path) == self.sha256


def cache_folder() -> Path:
    """Return the folder of downloads in the platform's user cache; `facerf doctor` prints it."""
    return platformdirs.user_cache_path("facerf")


def fetch(published: PublishedFile, option: str, cache: Path | None = None) -> Path:
    """Return the file's path in the cache; download it if it is missing, and verify it every time.

    Errors name `option`, which replaces the download, such as '--vgg-weights PATH', and the path to which the
    user can copy the file. URLs and redirections must be https, or http on this machine. A bar is shown if
    stderr is a terminal.
    """
    path = (cache or cache_folder()) / published.name
    if published.is_at(path):
        return path
    from torch.hub import download_url_to_file

    usual_s = socket.getdefaulttimeout()
    try:
        with alone_in(path.parent, f".{path.name}.lock"):
            if not published.is_at(path):  # another process may have fetched it
                log.info("fetching %s to %s", published.url, path)
                socket.setdefaulttimeout(TIMEOUT_S)  # torch.hub has no timeout
                url = _final_address(published)
                with hidden_folder(path) as room:
                    download_url_to_file(url, f"{room}/new", published.sha256, STDERR.is_terminal)
                    os.replace(room / "new", path)
    except (OSError, HTTPException, RuntimeError) as error:  # RuntimeError: another digest
        if isinstance(error, HTTPError):
            error.close()
        raise FacerfError(
            f"{published.url}: cannot be fetched to {path} ({one_line(str(error))}); run again with a "
            f"network, put the file there, or use {option}"
        ) from None
    finally:
        socket.setdefaulttimeout(usual_s)
    return path


def _final_address(published: PublishedFile) -> str:
    """Return the URL after redirections; raises RuntimeError if it is not https or the file too large."""
    with urllib.request.urlopen(published.url, timeout=TIMEOUT_S) as response:
        parts, size = urlsplit(response.url), response.headers.get("Content-Length", "")
        if parts.scheme != "https" and not (parts.scheme == "http" and parts.hostname in _THIS_MACHINE):
            raise RuntimeError(f"{response.url} is not https")
        if not size.isdecimal() or int(size) > published.size_limit:
            raise RuntimeError(f"{size or 'no stated number of'} bytes; at most {published.size_limit}")
        return str(response.url)
