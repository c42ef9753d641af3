"""OLAT stacks: a multi-part OpenEXR of half floats with one part per light, which any EXR reader opens.

Parts are named `light000` and so on, and store the light's direction in `facerf:direction` (a unit vector
toward the light in camera space). A light that is missing from a stage's rig leaves a gap in the numbers. The
last part, `source`, contains the input of the prediction: the photo's texture (or its render), the visibility
of each pixel, and normals in camera space. The first part's `facerf:olat` is JSON with the kind of stack, the
head's rotation and the fit, so that a stack can be relit without its photo.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import OpenImageIO as oiio
import torch
from pydantic import Field, PlainValidator
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.documents import Document, Matrix3, checked
from facerf_cli.files.texts import is_regular, parse_json, require_regular
from facerf_cli.files.workarounds import oiio_error, utf8_path
from facerf_cli.files.write import half_floats, new_spec, warn_of_clamped, write_parts
from facerf_cli.image.colour import REC709_CHROMATICITIES
from facerf_cli.run import memory
from facerf_cli.run.logs import one_line

Format = Literal["facerf-olat-1"]
FORMAT: Format = "facerf-olat-1"
COMPRESSION = "zip"  # the smallest lossless compression, and the fastest
# Bytes per pixel of a light that is read (half floats), of a light that is summed (half floats, floats and a
# copy), and of the source (16 half floats, floats and a sum).
_LIGHT_BYTES, _SUM_BYTES, _SOURCE_BYTES = 6, 30, 100
_AT_ONCE = 16  # most lights per batch of a sum
_MOST_LIGHTS = 4096
_MOST_CHANNELS = 16  # per part; other programs may add some
_LENGTH_TOLERANCE = 0.01  # of a direction's length
_SOURCE_CHANNELS = ("R", "G", "B", "seen", "normal.X", "normal.Y", "normal.Z")
_HEADER, _DIRECTION, _LIGHT = "facerf:olat", "facerf:direction", "facerf:light"


@dataclass(frozen=True, eq=False)
class StackHeader:
    """Stack without its OLATs.

    Kinds: 'photo', the photo's person over black in the photo's frame; 'image', the face in its crop;
    'texture', where H = W = T, the texture's side.
    """

    kind: Literal["photo", "texture", "image"]
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    rotation: np.ndarray  # [3, 3] head_to_camera that the lights were predicted for
    source: np.ndarray  # [H, W, 3] linear: the photo, unwrapped, or the face rendered from it
    seen: np.ndarray  # [H, W] in 0..1: the matte, visibility of texels, or coverage of the face
    normals: np.ndarray  # [H, W, 3] camera space; for the photo's pose, or `rotation` (image)
    layout_version: int  # of the UV map
    fit: dict[str, np.ndarray]  # `face.fit.fit_to_arrays`
    metadata: dict[str, Any] = field(default_factory=dict)  # provenance
    rig_lights: tuple[int, ...] = ()  # rig numbers of the parts to write; () counts from 0


def write_olat_stack(path: Path, header: StackHeader, olats: Iterable[Tensor]) -> None:
    """Write OLATs from batches [l, 3, H, W] in the order of the header's directions, as they arrive.

    OpenEXR keeps 1.8 MB per thread and part until it closes a file. So only this thread compresses, and
    memory of the prediction is freed first, since fresh memory costs nothing until it is touched.
    """
    clamped, threads = 0, oiio.get_int_attribute("exr_threads")

    def images() -> Iterator[np.ndarray]:
        count = 0
        for batch in olats:
            count += len(batch)
            memory.give_back()
            yield from batch.permute(0, 2, 3, 1).cpu().numpy()
        if count != len(header.directions):
            raise ValueError(f"{count} lights, not {len(header.directions)}")
        # last, because it may be summed as the lights arrive
        yield np.concatenate([header.source, header.seen[..., None], header.normals], -1)

    def parts() -> Iterator[Callable[[slice], np.ndarray]]:
        nonlocal clamped
        for image in images():
            data, count = half_floats(path, image)
            clamped += count
            yield data.__getitem__

    oiio.attribute("exr_threads", -1)
    try:
        write_parts(path, _specs(header), parts())
    finally:
        oiio.attribute("exr_threads", threads)
    warn_of_clamped(path, clamped)


def _specs(header: StackHeader) -> list[oiio.ImageSpec]:
    height, width = header.seen.shape

    def part(name: str, channels: tuple[str, ...]) -> oiio.ImageSpec:
        spec = new_spec((height, width, len(channels)), "half")
        spec.channelnames = channels
        spec.attribute("name", name)
        spec.attribute("compression", COMPRESSION)
        spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), REC709_CHROMATICITIES)
        for key, value in header.metadata.items():
            spec.attribute(key, value)
        return spec

    specs = []
    numbers = header.rig_lights or range(len(header.directions))
    for number, direction in zip(numbers, header.directions.tolist(), strict=True):
        spec = part(f"light{number:03d}", ("R", "G", "B"))
        spec.attribute(_DIRECTION, oiio.TypeDesc("vector"), tuple(direction))
        spec.attribute(_LIGHT, number)
        specs.append(spec)
    content = {
        "format": FORMAT,
        "kind": header.kind,
        "lights": len(specs),
        "layout_version": header.layout_version,
        "rotation": header.rotation.tolist(),
        "fit": {name: value.tolist() for name, value in header.fit.items()},
    }
    specs[0].attribute(_HEADER, json.dumps(content))
    return [*specs, part("source", _SOURCE_CHANNELS)]


def is_olat_stack(path: Path) -> bool:
    """Return whether a file is an OLAT stack; False if it cannot be opened as an image."""
    is_exr = path.suffix.lower() == ".exr" and is_regular(path)
    stream = oiio.ImageInput.open(utf8_path(path)) if is_exr else None
    if stream is None:
        oiio_error()
        return False
    is_stack = bool(_text_of(stream.spec()))
    stream.close()
    return is_stack


def _text_of(spec: oiio.ImageSpec) -> str:
    """Return the first part's JSON; empty for any other part, and for text that is not UTF-8."""
    try:
        return spec.get_string_attribute(_HEADER)
    except UnicodeDecodeError:
        return ""


def read_olat_header(path: Path) -> StackHeader:
    """Read a stack without its OLATs."""
    with _opened(path) as stack:
        stack.require_memory(0)
        document, directions, metadata = stack.document, [], {}
        for entry in stack.stream.spec().extra_attribs:
            is_ours = entry.name.startswith("facerf:") and entry.name not in (_HEADER, _DIRECTION, _LIGHT)
            if is_ours or entry.name in ("Software", "IPTC:DigitalSourceType"):
                metadata[entry.name] = entry.value
        for number in range(document.lights):
            value = stack.spec(number).getattribute(_DIRECTION)
            direction = np.array(value if isinstance(value, tuple) else (), np.float64)
            if direction.shape != (3,) or not abs(np.linalg.norm(direction) - 1) < _LENGTH_TOLERANCE:
                raise InputError(f"{path}: a part of the OLAT stack has no direction; write the stack again")
            directions.append(direction / np.linalg.norm(direction))
        source = stack.pixels(document.lights, _SOURCE_CHANNELS).astype(np.float32)
    return StackHeader(
        kind=document.kind,
        directions=np.array(directions),
        rotation=document.rotation,
        source=source[..., :3],
        seen=source[..., 3],
        normals=source[..., 4:],
        layout_version=document.layout_version,
        fit=document.fit,
        metadata=metadata,
    )


def read_olats(path: Path, lights: slice | Sequence[int] = slice(None), rows: slice = slice(None)) -> Tensor:
    """Read OLATs [l, 3, h, W] float16 of some lights and rows from a stack of any size."""
    with _opened(path) as stack:
        height, width = stack.shape
        numbers = range(stack.document.lights)[lights] if isinstance(lights, slice) else lights
        read_px = len(range(height)[rows])
        stack.require_memory(len(numbers), read_px / max(1, height))
        olats = np.empty((len(numbers), read_px, width, 3), np.float16)
        for index, number in enumerate(numbers):
            olats[index] = stack.pixels(number, ("R", "G", "B"), rows)
    return torch.from_numpy(olats).permute(0, 3, 1, 2)


def stream_olats(path: Path) -> Iterator[Tensor]:
    """Yield the OLATs of a stack of any length in batches [l, 3, H, W] float32, to be summed.

    A batch takes at most half of the memory budget, which must fit one light and the source.
    """
    with _opened(path) as stack:
        (height, width), lights = stack.shape, stack.document.lights
        what = f"{path}: lights of {width} x {height} pixels"
        memory.require(what, height * width * (_SUM_BYTES + _SOURCE_BYTES), "a stack of fewer pixels")
        fit = (memory.left_bytes() // 2 // (height * width) - _SOURCE_BYTES) // _SUM_BYTES
        at_once = max(1, min(_AT_ONCE, fit))
    for first in range(0, lights, at_once):  # reopened because OpenEXR keeps memory per part that was read
        yield read_olats(path, range(first, min(first + at_once, lights))).float()


def _arrays(value: Any) -> dict[str, np.ndarray]:
    if not isinstance(value, dict):
        raise ValueError("use an object of arrays")
    return {name: np.array(entry) for name, entry in value.items()}


class _StackDocument(Document):
    format: Format
    kind: Literal["photo", "texture", "image"]
    lights: Annotated[int, Field(ge=1, le=_MOST_LIGHTS)]
    layout_version: int
    rotation: Matrix3
    fit: Annotated[dict[str, np.ndarray], PlainValidator(_arrays)]


@dataclass(frozen=True, eq=False)
class _Stack:
    """Open file, its first part's JSON, and the shape (H, W) that all parts must have."""

    path: Path
    stream: oiio.ImageInput
    document: _StackDocument
    shape: tuple[int, int]

    def require_memory(self, lights: int, fraction: float = 1.0) -> None:
        """Check the memory for some lights, or a fraction of their rows, and for the source."""
        height, width = self.shape
        what = f"{self.path}: {lights} lights of {width} x {height} pixels"
        needed = height * width * (fraction * lights * _LIGHT_BYTES + _SOURCE_BYTES)
        memory.require(what, int(needed), "a stack of fewer lights or pixels")

    def spec(self, number: int) -> oiio.ImageSpec:
        if not self.stream.seek_subimage(number, 0):
            raise InputError(f"{self.path}: damaged OLAT stack: part {number} is missing; write it again")
        return self.stream.spec()

    def pixels(self, number: int, channels: tuple[str, ...], rows: slice = slice(None)) -> np.ndarray:
        """Read the named channels [h, W, C] of a part, or of some of its rows."""
        spec = self.spec(number)
        names = list(spec.channelnames)
        is_sound = (spec.height, spec.width) == self.shape and set(channels) <= set(names)
        if not is_sound or len(names) > _MOST_CHANNELS or spec.deep or spec.tile_width:
            raise InputError(
                f"{self.path}: damaged OLAT stack: part {number} has another size or layout; write it again"
            )
        first, past, _ = rows.indices(spec.height)
        window = (spec.y + first, spec.y + past, 0)
        values = self.stream.read_scanlines(number, 0, *window, 0, spec.nchannels, oiio.HALF)
        if values is None:
            raise InputError(f"{self.path}: damaged or cut short: {one_line(oiio_error(self.stream))}")
        values = values.reshape(past - first, spec.width, spec.nchannels)
        values = values[..., [names.index(name) for name in channels]]
        if not np.isfinite(values).all():
            raise InputError(f"{self.path}: part {number} of the OLAT stack contains NaN or infinite values")
        return values


@contextmanager
def _opened(path: Path) -> Iterator[_Stack]:
    advice = "use a stack that `facerf predict-olat` wrote"
    require_regular(path, advice)
    stream = oiio.ImageInput.open(utf8_path(path))
    if stream is None:
        raise InputError(f"{path}: not an OLAT stack ({one_line(oiio_error())}); {advice}")
    try:
        spec = stream.spec()
        text = _text_of(spec)
        if not text:
            raise InputError(f"{path}: not an OLAT stack; {advice}")
        try:
            document = checked(_StackDocument, parse_json(text), _HEADER)
        except (ValueError, InputError) as error:
            kind = "damaged OLAT stack, or of another version"
            raise InputError(f"{path}: {kind} ({error}); {advice}") from None
        yield _Stack(path, stream, document, (spec.height, spec.width))
    finally:
        oiio_error(stream)
        stream.close()
