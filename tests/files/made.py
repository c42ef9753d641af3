"""Small image files for tests, written as they stand: through OpenImageIO alone, or byte by byte."""

import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from facerf_cli.files.read import read_image
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear

H, W = 16, 24
CORNERS = np.array([[200, 60, 40], [40, 180, 60], [50, 70, 200], [128, 128, 128]], np.uint8)
QUADS = CORNERS.reshape(2, 2, 3).repeat(H // 2, 0).repeat(W // 2, 1)  # no symmetry
LINEAR = srgb_to_linear(QUADS / np.float32(255))
GREY = QUADS[..., 0]
LEVELS = np.random.default_rng(2).integers(0, 256, (24, 40, 3), np.uint8)
_LIGHT = np.array([[0.5, 0.25, 0.125], [0.25, 0.25, 0.25], [0.125, 0.5, 0.25], [1, 1, 1]]).reshape(2, 2, 3)
MAP = _LIGHT.repeat(H // 2, 0).repeat(W // 2, 1)
IPTC = "{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType"
TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
Part = tuple[str, np.ndarray, Sequence[str] | None]  # its name, values [H, W, C] and channels


def levels_of(path: Path, colourspace: str | None = None) -> np.ndarray:
    """What is read of a file, as values of sRGB, or of another space, of 255."""
    return 255 * linear_to_srgb(read_image(path, colourspace).pixels)


def bt2020_of(linear: np.ndarray) -> np.ndarray:
    """BT.2020 code values 0..1, by the matrix of BT.2087 and the camera curve of BT.2020."""
    to_2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
    light = linear @ to_2020.T
    return np.where(light < 0.0181, 4.5 * light, 1.0993 * light**0.45 - 0.0993)


def write_oiio(
    path: Path,
    values: np.ndarray,
    kind: str = "float",
    channels: Sequence[str] | None = None,
    window: tuple[int, ...] = (),
    **attributes: object,
) -> Path:
    """An image [H, W, C]; `__` stands for a colon, `window` is x, y and the whole size."""
    return write_parts(path, [("", values, channels)], kind, window, **attributes)


def write_parts(
    path: Path, parts: Sequence[Part], kind: str = "half", window: tuple[int, ...] = (), **attributes: object
) -> Path:
    """Parts of an EXR; a tuple of an attribute is of floats."""
    specs = []
    for name, values, channels in parts:
        spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
        if window:
            spec.x, spec.y, spec.full_width, spec.full_height = window
        for key, value in attributes.items():
            more = [oiio.TypeDesc(f"float[{len(value)}]")] if isinstance(value, tuple) else []
            spec.attribute(key.replace("__", ":"), *more, value)
        if name:
            spec.attribute("name", name)
        spec.channelnames = tuple(channels or spec.channelnames)
        specs.append(spec)
    stream = oiio.ImageOutput.create(str(path))
    assert stream.open(str(path), tuple(specs) if len(specs) > 1 else specs[0])
    for number, (_, values, _) in enumerate(parts):
        assert not number or stream.open(str(path), specs[number], "AppendSubimage")
        assert stream.write_image(np.ascontiguousarray(values)), stream.geterror()
    assert stream.close()
    return path


def write_deep(path: Path) -> Path:
    """A deep EXR, whose pixels have several samples each."""
    spec, data = oiio.ImageSpec(5, 3, 4, "float"), oiio.DeepData()
    spec.deep, spec.channelnames = True, ("R", "G", "B", "Z")
    data.init(spec)
    for pixel in range(15):
        data.set_samples(pixel, 2)
    stream = oiio.ImageOutput.create(str(path))
    assert stream.open(str(path), spec) and stream.write_deep_image(data) and stream.close()
    return path


def write_png(path: Path, levels: np.ndarray, *chunks: tuple[bytes, bytes]) -> Path:
    """A PNG with chunks after its header."""
    Image.fromarray(levels).save(path)
    data = path.read_bytes()
    added = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    path.write_bytes(data[:33] + added + data[33:])
    return path


def write_psd(path: Path, values: np.ndarray, *numbered: tuple[int, bytes]) -> Path:
    """A flattened PSD of 8 bits, by its specification, with image resources."""
    height, width, _ = values.shape
    resources = b"".join(
        b"8BIM" + struct.pack(">HHI", number, 0, len(data)) + data + bytes(len(data) % 2)
        for number, data in numbered
    )
    head = b"8BPS" + struct.pack(">H6xHIIHHI", 1, 3, height, width, 8, 3, 0)
    body = struct.pack(">I", len(resources)) + resources + struct.pack(">IH", 0, 0)
    path.write_bytes(head + body + np.moveaxis(values, -1, 0).tobytes())
    return path


def write_cineon(path: Path, codes: np.ndarray) -> Path:
    """A Cineon file of three 10-bit code values in each 32-bit word."""
    height, width, _ = codes.shape
    head = bytearray(2048)
    struct.pack_into(">6I", head, 0, 0x802A5FD7, 2048, 1024, 1024, 0, 2048 + 4 * width * height)
    head[24:28], head[193] = b"V4.5", 3
    for channel in range(3):
        numbers = 0, channel + 1, 10, 0, width, height, 0, 0, 1023, 2.046
        struct.pack_into(">4B2I4f", head, 196 + 28 * channel, *numbers)
    head[681] = 5
    red, green, blue = np.moveaxis(codes.astype(np.uint32), -1, 0)
    path.write_bytes(bytes(head) + (red << 22 | green << 12 | blue << 2).astype(">u4").tobytes())
    return path


def _rgbe(light: np.ndarray) -> np.ndarray:
    exponent = np.frexp(light.max(-1, keepdims=True))[1]
    return np.dstack([light * 256.0 / 2.0**exponent, exponent + 128]).astype(np.uint8)


def write_hdr(
    path: Path, light: np.ndarray, head: str = "", order: str = "-Y +X", form: str = "plain"
) -> Path:
    """Rows of a Radiance file in some order of its axes, plain or in the new run-length form."""
    first, second = order.split()
    for axis, sign in ((0, "-Y" in order), (1, "+X" in order)):
        light = light if sign else np.flip(light, axis)
    rows = _rgbe(light if first[1] == "Y" else light.swapaxes(0, 1))
    size = f"{first} {rows.shape[0]} {second} {rows.shape[1]}\n"
    body = b"".join({"plain": bytes, "new": _new_runs}[form](row) for row in rows)
    path.write_bytes(f"#?RADIANCE\n{head}FORMAT=32-bit_rle_rgbe\n\n{size}".encode() + body)
    return path


def _new_runs(row: np.ndarray) -> bytes:
    channels = b"".join(bytes([len(part)]) + bytes(part) for part in row.T)  # each is one run of literals
    return bytes([2, 2, len(row) >> 8, len(row) & 255]) + channels


def properties(data: bytes) -> dict[str, str]:
    """The properties in a file's XMP packet."""
    (packet,) = re.findall(rb"<x:xmpmeta.*?</x:xmpmeta>", data, re.S)
    return ElementTree.fromstring(packet)[0][0].attrib
