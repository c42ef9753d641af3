"""Face models that anyone may download without signing an agreement."""

from pathlib import Path

from facerf_cli.face.importers.ict import ict_content_sha256
from facerf_cli.files.downloads import Published, cache_folder, fetch

_ICT_COMMIT = "da5f95a607f5e6b37755b38d3385d7f2853732e5"
# GitHub packs an archive of a commit anew when it likes, and then its bytes are others; the .obj files inside
# are the same for ever, so the digest is of them.
ICT_FACEKIT = Published(
    f"https://github.com/ICT-VGL/ICT-FaceKit/archive/{_ICT_COMMIT}/ICT-FaceKit-{_ICT_COMMIT}.tar.gz",
    "76eafb7253344ed6dc7f6d92c6f409868f854b029d5a68a2f4e3583c5bc1ebeb",
    512 << 20,
    ict_content_sha256,
)
PUBLISHED = {"ict-facekit": ICT_FACEKIT}


def fetch_face_model(kind: str) -> Path:
    """The archive of a published model in the user's cache, fetched there first where it is not yet."""
    return fetch(PUBLISHED[kind], f"`facerf face-model import {kind}` a copy that you have", _folder())


def cached_face_model(kind: str) -> Path | None:
    """Where a published model lies in the user's cache, if a file of its name does; it is not read."""
    path = _folder() / PUBLISHED[kind].name
    return path if path.is_file() else None


def _folder() -> Path:
    return cache_folder() / "face-models"
