import errno
import hashlib
import io
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.error import URLError

import pytest

from facerf_cli.errors import FacerfError
from facerf_cli.files import downloads
from facerf_cli.files.downloads import PublishedFile, fetch, opener_of
from tests.kinds import Patch
from tests.refusals import refused

CONTENT = bytes(range(256)) * 2000
DIGEST = hashlib.sha256(CONTENT).hexdigest()
OPTION = "--weights PATH"


@dataclass
class Server:
    """Serves `content` at any path; breaks the first connections off after `cuts` bytes each."""

    url: str
    content: bytes = CONTENT
    cuts: list[int] = field(default_factory=list)
    ranges: bool = True
    lengths: bool = True
    status: int = 200
    location: str = ""
    asked: list[str | None] = field(default_factory=list)  # the Range of each request

    def published(self, **changes: Any) -> PublishedFile:
        return replace(PublishedFile(f"{self.url}/models/a%20file.pth", DIGEST, 10**6), **changes)


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server("")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers["Range"]
            state.asked.append(wanted)
            if state.location or state.status != 200:
                self.send_response(302 if state.location else state.status)
                self.send_header("Location", state.location)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            begin = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and state.ranges else 0
            if begin >= len(state.content):
                self.send_error(416)
                return
            self.send_response(206 if begin else 200)
            if begin:
                size = len(state.content)
                self.send_header("Content-Range", f"bytes {begin}-{size - 1}/{size}")
            if state.lengths:
                self.send_header("Content-Length", str(len(state.content) - begin))
            self.end_headers()
            cut = begin + state.cuts.pop(0) if state.cuts else None
            self.wfile.write(state.content[begin:cut])

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


def test_a_file_is_fetched_once_and_again_where_it_is_damaged(server: Server, tmp_path: Path) -> None:
    path = fetch(server.published(), OPTION, tmp_path / "new" / "cache")
    assert path == tmp_path / "new" / "cache" / "a file.pth" and path.read_bytes() == CONTENT
    assert visible(path.parent) == ["a file.pth"]
    assert fetch(server.published(), OPTION, path.parent) == path and server.asked == [None]
    (tmp_path / "a file.pth").write_bytes(CONTENT[:-1] + b"!")
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT


def test_the_default_place_is_the_users_cache(server: Server, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(downloads, "cache_folder", lambda: tmp_path)
    assert fetch(server.published(), OPTION).parent == tmp_path


@pytest.mark.parametrize("ranges", [True, False])
def test_a_cut_connection_goes_on_where_it_broke(server: Server, tmp_path: Path, ranges: bool) -> None:
    server.cuts, server.ranges = [1000, 300_000], ranges
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT
    assert server.asked == [None, "bytes=1000-", "bytes=301000-" if ranges else "bytes=300000-"]


def test_what_a_broken_fetch_got_is_kept_for_the_next(server: Server, tmp_path: Path) -> None:
    server.cuts = [5000, 0]
    refused(FacerfError, "the connection broke off", fetch, server.published(), OPTION, tmp_path)
    assert visible(tmp_path) == []
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT
    assert server.asked[-1] == "bytes=5000-"


@pytest.mark.parametrize("left", [b"of another version", CONTENT + b"and more", CONTENT])
def test_a_beginning_of_another_file_is_thrown_away(server: Server, tmp_path: Path, left: bytes) -> None:
    (tmp_path / ".a file.pth.part").write_bytes(left)
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT
    assert len(server.asked) == (1 if left == CONTENT else 2)


def test_another_file_than_the_published_one_is_refused(server: Server, tmp_path: Path) -> None:
    server.content = CONTENT[::-1]
    with pytest.raises(FacerfError, match="not the published file") as caught:
        fetch(server.published(), OPTION, tmp_path)
    assert OPTION in str(caught.value) and str(tmp_path / "a file.pth") in str(caught.value)
    assert visible(tmp_path) == [] and not (tmp_path / ".a file.pth.part").exists()


@pytest.mark.parametrize("lengths", [True, False])
def test_more_than_the_file_can_be_is_not_taken(server: Server, tmp_path: Path, lengths: bool) -> None:
    server.lengths = lengths
    refused(FacerfError, "larger than", fetch, server.published(size_limit=100_000), OPTION, tmp_path)
    assert visible(tmp_path) == [] and not (tmp_path / ".a file.pth.part").exists()


def test_an_error_of_the_server_is_one_line_that_says_what_to_do(server: Server, tmp_path: Path) -> None:
    server.status = 404
    with pytest.raises(FacerfError) as caught:
        fetch(server.published(), OPTION, tmp_path)
    words = str(caught.value)
    assert words == (
        f"{server.url}/models/a%20file.pth: cannot be fetched (HTTP 404 Not Found); "
        f"run again with a network, put the file at {tmp_path / 'a file.pth'}, or give --weights PATH"
    )
    assert len(server.asked) == 1


def test_offline_is_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/a.pth"
        with pytest.raises(
            FacerfError, match=r"\(Connection refused\); run again .* --weights PATH$"
        ) as caught:
            fetch(PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)
    assert "\n" not in str(caught.value)


def test_a_silent_server_is_given_up(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(downloads, "TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/a.pth"
        refused(FacerfError, "no answer within", fetch, PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)


@pytest.mark.parametrize("url", ["http://example.org/a.pth", "file:///etc/passwd", "ftp://example.org/a.pth"])
def test_only_https_is_fetched_from(server: Server, tmp_path: Path, url: str) -> None:
    refused(FacerfError, "unknown url type", fetch, PublishedFile(url, DIGEST, 10**6), OPTION, tmp_path)
    with pytest.raises(URLError, match="unknown url type"):  # as after a redirection
        opener_of("https://example.org/a.pth").open(url)
    server.location = url.replace("http:", "gopher:")
    with pytest.raises(FacerfError, match=r"unknown url type|not allowed"):
        fetch(server.published(), OPTION, tmp_path)


def test_a_cache_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    with pytest.raises(FacerfError, match=r"in the cache \(.*cache: File exists\); make room .* PATH$"):
        fetch(server.published(), OPTION, tmp_path / "cache")


def test_a_full_disk_is_named_and_what_came_is_kept(
    server: Server, tmp_path: Path, monkeypatch: Patch
) -> None:
    class Full(io.FileIO):
        def write(self, data: Any) -> int:
            if self.tell() + len(data) > 200_000:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super().write(data)

    server.cuts = [5000]
    with monkeypatch.context() as small:
        usual = Path.open

        def opened(path: Path, mode: str = "r", **how: Any) -> Any:
            full = path.suffix == ".part"
            return Full(path, mode.replace("b", "")) if full else usual(path, mode, **how)

        small.setattr(Path, "open", opened)
        refused(FacerfError, "in the cache ... make room", fetch, server.published(), OPTION, tmp_path)
    assert fetch(server.published(), OPTION, tmp_path).read_bytes() == CONTENT
    assert server.asked[:2] == [None, "bytes=5000-"] and server.asked[2] not in server.asked[:2]


def test_two_at_once_fetch_it_once(server: Server, tmp_path: Path) -> None:
    threads = [threading.Thread(target=fetch, args=(server.published(), OPTION, tmp_path)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(server.asked) == 1 and (tmp_path / "a file.pth").read_bytes() == CONTENT


def test_a_server_that_drips_is_given_up_and_what_came_is_kept(
    server: Server, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(downloads, "DEADLINE_S", -1.0)
    refused(FacerfError, "the next run continues it", fetch, server.published(), OPTION, tmp_path)
    assert len(server.asked) == 1 and (tmp_path / ".a file.pth.part").stat().st_size
