"""ICT-FaceKit fetched over a loopback server: its contents are what is verified, however they are packed."""

import hashlib
import io
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from facerf_cli.errors import FacerfError
from facerf_cli.face.importers import ict as published
from facerf_cli.face.importers.ict import ICT_FACEKIT, cached_face_model, fetch_face_model, ict_content_sha256

CONTENTS = {"generic_neutral_mesh": b"v 1 2 3\n" * 4000, "jawOpen": b"v 3 2 1\n" * 4000}


def archive(
    contents: dict[str, bytes] = CONTENTS, level: int = 9, prefix: str = "ICT-FaceKit-da5f95a"
) -> bytes:
    """A .tar.gz as GitHub packs a commit: the same files, other bytes from one day to another."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:gz", compresslevel=level) as tar:
        for name, data in {f"FaceXModel/{stem}.obj": text for stem, text in contents.items()}.items():
            entry = tarfile.TarInfo(f"{prefix}/{name}")
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
        readme = tarfile.TarInfo(f"{prefix}/README.md")
        readme.size = level
        tar.addfile(readme, io.BytesIO(b"#" * level))
    return file.getvalue()


@dataclass
class Server:
    """Serves `content` anew at every connection, without ranges as GitHub does; breaks off after `cuts`."""

    content: bytes = b""
    cuts: list[int] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    state = Server(archive())

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.asked.append(self.path)
            self.send_response(200)
            self.send_header("Content-Length", str(len(state.content)))
            self.end_headers()
            self.wfile.write(state.content[: state.cuts.pop(0)] if state.cuts else state.content)

        def log_message(self, *_: Any) -> None:
            pass

    listener = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    here = ICT_FACEKIT.url.replace("https://github.com", f"http://127.0.0.1:{listener.server_port}")
    lines = [f"{hashlib.sha256(text).hexdigest()}  {stem}.obj\n" for stem, text in sorted(CONTENTS.items())]
    digest = hashlib.sha256("".join(lines).encode()).hexdigest()
    monkeypatch.setitem(published.PUBLISHED, "ict-facekit", replace(ICT_FACEKIT, url=here, sha256=digest))
    monkeypatch.setattr(published, "cache_folder", lambda: tmp_path)
    yield state
    listener.shutdown()
    listener.server_close()
    thread.join()


def test_it_is_fetched_once_into_the_cache(server: Server, tmp_path: Path) -> None:
    assert cached_face_model("ict-facekit") is None
    path = fetch_face_model("ict-facekit")
    assert path.parent == tmp_path / "face-models" and path.name.startswith("ICT-FaceKit-da5f95a6")
    assert fetch_face_model("ict-facekit") == path == cached_face_model("ict-facekit")
    assert len(server.asked) == 1 and path.read_bytes() == server.content


@pytest.mark.parametrize("packed", [archive(level=1), archive(prefix="ICT-FaceKit-master")])
def test_however_it_is_packed_its_contents_count(server: Server, packed: bytes) -> None:
    assert packed != server.content
    server.content = packed
    assert fetch_face_model("ict-facekit").read_bytes() == packed


OTHERS = {
    "another shape": archive({**CONTENTS, "jawOpen": b"v 3 2 0\n" * 4000}),
    "a shape more": archive({**CONTENTS, "jawLeft": b"v 3 2 1\n"}),
    "a shape less": archive({"jawOpen": CONTENTS["jawOpen"]}),
    "another name": archive({"generic_neutral_mesh": CONTENTS["jawOpen"], "jawOpen": b"v 1 2 3\n" * 4000}),
    "no archive": b"not here",
    "a cut archive": archive()[:-200],
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_contents_are_refused_in_one_line(server: Server, case: str) -> None:
    server.content = OTHERS[case]
    with pytest.raises(FacerfError, match="is not the published file") as refused:
        fetch_face_model("ict-facekit")
    words = str(refused.value)
    assert "\n" not in words and "facerf face-model import ict-facekit" in words
    assert cached_face_model("ict-facekit") is None


def test_a_broken_connection_is_taken_up_again(server: Server) -> None:
    server.cuts = [400]
    assert fetch_face_model("ict-facekit").read_bytes() == server.content
    assert len(server.asked) == 2


def test_a_connection_that_stays_broken_is_one_line_that_says_where_to_put_it(server: Server) -> None:
    server.cuts = [0, 0, 0, 0, 0]
    with pytest.raises(FacerfError, match=r"run again with a network, put the file at .*tar\.gz, or give"):
        fetch_face_model("ict-facekit")


def test_the_published_digest_is_that_of_the_archive_at_hand(shared_data: Path) -> None:
    path = shared_data / "ict_facekit" / "ICT-FaceKit-master.tar.xz"
    assert ict_content_sha256(path) == ICT_FACEKIT.sha256
    assert ICT_FACEKIT.url.startswith("https://github.com/ICT-VGL/ICT-FaceKit/archive/da5f95a607")
