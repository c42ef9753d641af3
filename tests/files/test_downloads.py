import hashlib
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from facerf_cli.errors import FacerfError
from facerf_cli.files import downloads
from facerf_cli.files.downloads import PublishedFile, fetch
from tests.kinds import Patch
from tests.refusals import refused

CONTENT = bytes(range(256)) * 2000
DIGEST = hashlib.sha256(CONTENT).hexdigest()
OPTION = "--weights PATH"


@dataclass
class Server:
    """Serves `content` at any path; breaks connections off after `cut` bytes."""

    url: str
    content: bytes = CONTENT
    cut: int | None = None
    lengths: bool = True
    status: int = 200
    location: str = ""
    asked: int = 0  # requests

    def published(self, **changes: Any) -> PublishedFile:
        return replace(PublishedFile(f"{self.url}/models/a%20file.pth", DIGEST, 10**6), **changes)


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server("")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.asked += 1
            if state.location or state.status != 200:
                self.send_response(302 if state.location else state.status)
                self.send_header("Location", state.location)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(200)
            if state.lengths:
                self.send_header("Content-Length", str(len(state.content)))
            self.end_headers()
            with suppress(ConnectionError):  # of the connection that asks for the size alone
                self.wfile.write(state.content[: state.cut])

        def log_message(self, *_: Any) -> None:
            pass

    listener = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{listener.server_port}"
    thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield state
    listener.shutdown()
    listener.server_close()
    thread.join()


def visible(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if not path.name.startswith(".")]


def test_a_file_is_fetched_once_and_again_where_it_is_damaged(
    server: Server, tmp_path: Path, monkeypatch: Patch
) -> None:
    path = fetch(server.published(), OPTION, tmp_path / "new" / "cache")
    assert path == tmp_path / "new" / "cache" / "a file.pth" and path.read_bytes() == CONTENT
    assert visible(path.parent) == ["a file.pth"]
    assert fetch(server.published(), OPTION, path.parent) == path and server.asked == 2
    (tmp_path / "a file.pth").write_bytes(CONTENT[:-1] + b"!")
    monkeypatch.setattr(downloads, "cache_folder", lambda: tmp_path)
    assert fetch(server.published(), OPTION).read_bytes() == CONTENT  # in the user's cache


def test_a_cut_connection_leaves_nothing(server: Server, tmp_path: Path) -> None:
    server.cut = 5000
    refused(FacerfError, "cannot be fetched", fetch, server.published(), OPTION, tmp_path)
    assert not any(tmp_path.iterdir())
    server.cut = None
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT


def test_another_file_than_the_published_one_is_refused(server: Server, tmp_path: Path) -> None:
    server.content = CONTENT[::-1]
    with pytest.raises(FacerfError, match="invalid hash value") as caught:
        fetch(server.published(), OPTION, tmp_path)
    assert OPTION in str(caught.value) and str(tmp_path / "a file.pth") in str(caught.value)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("lengths", [True, False])
def test_more_than_the_file_can_be_is_not_taken(server: Server, tmp_path: Path, lengths: bool) -> None:
    server.lengths = lengths
    words = f"{len(CONTENT) if lengths else 'no stated number of'} bytes; at most 100000"
    refused(FacerfError, words, fetch, server.published(size_limit=100_000), OPTION, tmp_path)
    assert not any(tmp_path.iterdir())


def test_an_error_of_the_server_is_one_line_that_says_what_to_do(server: Server, tmp_path: Path) -> None:
    server.status = 404
    words = f"{server.url}/models/a%20file.pth: ... HTTP Error 404 ... put the file there, or use {OPTION}"
    refused(FacerfError, words, fetch, server.published(), OPTION, tmp_path)
    assert server.asked == 1


def test_offline_is_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/a.pth"
        words = "Connection refused ... run again with a network, put the file there, or use --weights"
        refused(FacerfError, words, fetch, PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)


def test_a_silent_server_is_given_up(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(downloads, "TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/a.pth"
        refused(FacerfError, "timed out", fetch, PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "gopher://example.org/a.pth"])
def test_only_https_is_fetched_from(server: Server, tmp_path: Path, url: str) -> None:
    refused(FacerfError, "cannot be fetched", fetch, PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)
    server.location = url  # as after a redirection
    refused(FacerfError, "not allowed", fetch, server.published(), OPTION, tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_redirection_to_plain_http_is_refused(server: Server, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(downloads, "_THIS_MACHINE", ())
    refused(FacerfError, "is not https", fetch, server.published(), OPTION, tmp_path)


def test_a_cache_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    refused(FacerfError, "File exists ... /cache", fetch, server.published(), OPTION, tmp_path / "cache")


def test_two_at_once_fetch_it_once(server: Server, tmp_path: Path) -> None:
    threads = [threading.Thread(target=fetch, args=(server.published(), OPTION, tmp_path)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert server.asked == 2 and (tmp_path / "a file.pth").read_bytes() == CONTENT
