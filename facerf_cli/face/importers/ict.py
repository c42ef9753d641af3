"""Importer of ICT-FaceKit (Li et al., 'Learning Formation of Physically-Based Face Attributes', 2020)."""

import re
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from facerf_cli.face.importers.source import SourceModel, refusal
from facerf_cli.face.morphable import EXPRESSION_STD
from facerf_cli.files.texts import require_regular

_IDS = (
    "1225 1888 1052 367 1719 1722 2199 1447 966 3661 4390 3927 3924 2608 3272 4088 3443 "
    "268 493 1914 2044 1401 3615 4240 4114 2734 2509 978 4527 4942 4857 1140 2075 1147 "
    "4269 3360 1507 1542 1537 1528 1518 1511 3742 3751 3756 3721 3725 3732 5708 5695 2081 "
    "0 4275 6200 6213 6346 6461 5518 5957 5841 5702 5711 5533 6216 6207 6470 5517 5966"
)
LANDMARK_IDS = np.array(_IDS.split(), dtype=np.int64)  # from its README
VERTICES, _NEUTRAL = 26719, "generic_neutral_mesh"
_OUTER_SURFACE = np.r_[0:11248, 21451:24591]  # vertices of face, head and neck, and of the eyeballs
_LICENCE = "MIT, Copyright (c) 2020 USC Institute for Creative Technologies"
_MAX_OBJ_BYTES, _MAX_BYTES = 64 << 20, 2 << 30  # of one .obj and of all


def read_ict_facekit(path: Path) -> SourceModel:
    """Read ICT-FaceKit's folder, .zip or .tar; raises InputError for anything else."""
    with refusal(path, "ICT-FaceKit"):
        return ict_source(dict(_objs(path)))


def ict_source(raw: dict[str, bytes]) -> SourceModel:
    """Build the model from the contents of the .obj files by stem, and convert centimetres to metres."""
    identities = sorted(stem for stem in raw if re.fullmatch(r"identity\d+", stem))
    expressions = sorted(raw.keys() - {*identities, _NEUTRAL})
    if _NEUTRAL not in raw or not identities or not expressions:
        raise ValueError("it lacks files of FaceXModel: the neutral mesh, identities or expressions")
    mean = _vertices(_NEUTRAL, raw[_NEUTRAL])

    def offsets(stems: list[str]) -> np.ndarray:
        return np.stack([_vertices(stem, raw[stem]) - mean for stem in stems])

    triangles = _triangles(raw[_NEUTRAL])
    return SourceModel(
        name="ict-facekit",
        licence=_LICENCE,
        mean=mean,
        identity=offsets(identities),
        expression=offsets(expressions) * EXPRESSION_STD,
        expression_names=tuple(expressions),
        triangles=triangles[np.isin(triangles, _OUTER_SURFACE).all(1)],
        known=dict(enumerate(mean[LANDMARK_IDS])),
    )


def _vertices(stem: str, text: bytes) -> np.ndarray:
    """Parse the vertices [N, 3] of an .obj, in metres."""
    lines = [line[2:] for line in text.splitlines() if line.startswith(b"v ")]
    vertices_cm = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(len(lines), -1)[:, :3]
    if vertices_cm.shape != (VERTICES, 3) or not np.isfinite(vertices_cm).all():
        raise ValueError(f"{stem}.obj has {len(lines)} vertices, not {VERTICES}, or some are not finite")
    return vertices_cm / 100


def _triangles(text: bytes) -> np.ndarray:
    """Parse the polygons of an .obj as triangles [F, 3]."""
    triangles = []
    for line in text.splitlines():
        if line.startswith(b"f "):
            corners = [int(token.split(b"/")[0]) - 1 for token in line.split()[1:]]
            triangles += [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
    return np.array(triangles)


def _objs(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the stem and the content of each .obj file; raises ValueError for too large files."""
    total = 0
    for name, read in _members(path):
        if match := re.search(r"FaceXModel/([A-Za-z0-9_]+)\.obj$", name):
            text = read(_MAX_OBJ_BYTES + 1)
            total += len(text)
            if len(text) > _MAX_OBJ_BYTES or total > _MAX_BYTES:
                raise ValueError(f"{name} is too large")
            yield match[1], text


def _members(path: Path) -> Iterator[tuple[str, Callable[[int], bytes]]]:
    """Yield the name of each file of a folder or archive, and a function that reads up to n bytes."""
    if path.is_dir():
        for file in sorted(path.rglob("*.obj")):
            with file.open("rb") as stream:
                yield file.as_posix(), stream.read
    elif zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as member:
                    yield name, member.read
    else:
        require_regular(
            path, "use ICT-FaceKit's folder, .zip or .tar, FLAME's .pkl or .npz, or Basel's .mat or .h5"
        )
        # One pass, because seeking would decompress the tar for each of its 150 files.
        with tarfile.open(path, "r|*") as tar:
            for entry in tar:
                if entry.isfile() and (content := tar.extractfile(entry)):
                    yield entry.name, content.read
