"""Files that are not read: each is an error of one line, and nothing else is printed."""

import os
import re
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.olat_stack import is_olat_stack, read_olats
from facerf_cli.files.read import PHOTO_LIMIT_PX, read_image
from facerf_cli.files.write import write_display, write_exr
from tests import icc_profiles
from tests.files import made
from tests.files.made import GREY, LEVELS, LINEAR, MAP, QUADS, write_oiio, write_png
from tests.kinds import Log, Patch, Said
from tests.refusals import refused

HERE = Path(__file__).parent
HEIC, DEEP_AVIF = HERE / "phone.heic", HERE / "deep.avif"
NOT_READABLE, DAMAGED = "not a readable image", r"damaged or cut short; copy it again"
LOG_SCAN = "Cineon log .* convert it to linear values"
WHITE = "white as zero .* save it as PNG"
PSD_VERSION = struct.pack(">IB", 1, 0) + bytes(12)  # of one without its composite


def cut(write: Callable[[Path], object], size: float) -> Callable[[Path], object]:
    """A file without its last bytes (a negative size), or its first ones or a share of them alone."""

    def written(path: Path) -> None:
        write(path)
        data = path.read_bytes()
        path.write_bytes(data[: int(size * len(data)) if isinstance(size, float) else size])

    return written


def copied(source: Path, old: bytes = b"", new: bytes = b"") -> Callable[[Path], object]:
    return lambda path: path.write_bytes(source.read_bytes().replace(old, new))


def text(path: Path) -> None:
    path.write_text("not an image\n" * 20)


def noise(path: Path) -> None:
    """An image that compression hardly shrinks; of names with `16` in 16 bits, with `scans` progressive."""
    values = np.random.default_rng(0).random((120, 160, 1 if path.suffix == ".pgm" else 3)).astype(np.float32)
    if "scans" in path.name:
        Image.fromarray((255 * values[:48, :80]).astype(np.uint8)).save(path, progressive=True)
    else:
        floats = path.suffix in (".exr", ".hdr")
        write_oiio(path, values, "uint16" if "16" in path.name else "float" if floats else "uint8")


def flipped(path: Path) -> None:
    data = bytearray(write_png(path, LEVELS).read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def compressed(kind: int) -> Callable[[Path], object]:
    """A TIFF that names a compression."""

    def written(path: Path) -> None:
        tifffile.imwrite(path, QUADS, compression=None)
        with tifffile.TiffFile(path, mode="r+b") as file:
            file.pages[0].tags["Compression"].overwrite(kind)

    return written


def xyz(path: Path) -> None:
    made.write_hdr(path, MAP)
    path.write_bytes(path.read_bytes().replace(b"rgbe", b"xyze"))


def old_runs(path: Path) -> None:
    """A pixel of grey and, as 255 times 1, 1, 1, N, that many of it."""
    made.write_hdr(path, np.full((2, 256, 3), 0.25))
    header = path.read_bytes()[: -2 * 256 * 4]
    path.write_bytes(header + 2 * (b"\x80\x80\x80\x7f" + b"\1\1\1\xff"))


def inks_with_alpha(path: Path) -> None:
    values = np.full((6, 9, 5), 99, np.uint8)
    profile = icc_profiles.press_profile()
    tifffile.imwrite(path, values, photometric="separated", extrasamples=["unassalpha"], iccprofile=profile)


def hdr_png(transfer: int) -> Callable[[Path], object]:
    return lambda path: write_png(path, QUADS, (b"cICP", bytes([9, transfer, 0, 1])))


CODES = b"nclx\0\x0c\0\x0d"
HDR_LINE = "Radiance .* save it as EXR"
REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    **dict.fromkeys(("a.png", "a.jpg", "a", "a b#%04d.png", "a.heic", "a.avif"), (text, NOT_READABLE)),
    "a.exr": (text, r"save it as .* \(EXR Error: File is not an OpenEXR file\)$"),
    "empty.jpg": (Path.touch, "the file is empty"),
    "missing.png": (lambda path: None, "no such file"),
    "folder.png": (Path.mkdir, "is a folder"),
    "deep.exr": (made.write_deep, "deep data .* oiiotool --flatten"),
    "a.cin": (lambda path: made.write_cineon(path, LEVELS.astype(int)), LOG_SCAN),
    **{
        f"{curve}.dpx": (
            lambda path, curve=curve: write_oiio(path, LEVELS, "uint16", dpx__Transfer=curve),
            LOG_SCAN,
        )
        for curve in ("Logarithmic", "Printing density")
    },
    "runs.hdr": (old_runs, "old-style runs.* save it as EXR"),
    "white8.tif": (lambda path: tifffile.imwrite(path, GREY, photometric="miniswhite"), WHITE),
    "white16.tif": (
        lambda path: tifffile.imwrite(path, GREY.astype(np.uint16), photometric="miniswhite"),
        WHITE,
    ),
    "inks.tif": (inks_with_alpha, "CMYK .* with alpha, .* convert it to RGB"),
    **{
        name: (copied(HERE / name), "premultiplied alpha .* save it as PNG")
        for name in ("multiplied.jxl", "multiplied16.jxl")
    },
    "last.jpg": (cut(noise, -1), "cut short"),
    # Its reader says so when the file is opened, since all scans are read at once.
    **{f"{share}scans.jpg": (cut(noise, share), DAMAGED) for share in (0.3, 0.9)},
    **{
        f"{share}{name}": (cut(noise, share), f"({NOT_READABLE}|damaged|empty)")
        for share in (0.0, 0.02, 0.5, 0.99)
        for name in ("a.jpg", "a.png", "16.png", "a.exr", "a.hdr", "a.tif", "a.pgm")
    },
    "bit.png": (flipped, "a checksum of the PNG file is wrong; copy it again"),
    **{f"{size}.heic": (cut(copied(HEIC), size), f"({NOT_READABLE}|damaged)") for size in (13, 200, -300)},
    **{f"{size}.avif": (cut(copied(DEEP_AVIF), size), DAMAGED) for size in (30, 150, -30, -1)},
    "PQ.avif": (copied(DEEP_AVIF, CODES, b"nclx\0\x09\0\x10"), r"HDR \(PQ\) .* convert it to SDR"),
    "PQ.png": (hdr_png(16), r"HDR \(PQ\) .* convert it to SDR"),
    "HLG.png": (hdr_png(18), r"HDR \(HLG\) .* convert it to SDR"),
    **{
        f"{line}.hdr": (lambda path, line=line: made.write_hdr(path, MAP, f"{line}\n"), HDR_LINE)
        for line in ("EXPOSURE=no", "EXPOSURE=0", "COLORCORR=1 2", "PRIMARIES=.3 .3", "EXPOSURE=nan")
    },
    "wide.hdr": (lambda path: made.write_hdr(path, MAP, "PIXASPECT=0.5\n"), "PIXASPECT .* save it as EXR"),
    **{
        f"{order}.hdr": (
            lambda path, order=order: made.write_hdr(path, MAP, "", order),
            "column order .* save it as EXR",
        )
        for order in ("-X -Y", "+X +Y")
    },
    "xyz.hdr": (xyz, NOT_READABLE),
    "lab.tif": (
        lambda path: tifffile.imwrite(path, QUADS, photometric="cielab"),
        "CIELAB .* convert it to RGB",
    ),
    **{f"{n}.tif": (compressed(n), "not supported; save it with another") for n in (50000, 34925, 50002)},
    "side.dpx": (lambda path: write_oiio(path, LEVELS, "uint8", Orientation=6), "save it upright"),
    "a.psd": (
        lambda path: made.write_psd(path, LEVELS, (1039, b"odd"), (1057, PSD_VERSION)),
        "PSD without a composite .* Maximize Compatibility",
    ),
}


@pytest.mark.parametrize("name", list(REFUSED))  # else its functions keep modules alive at the end
def test_what_is_not_read_says_why(tmp_path: Path, name: str, capfd: Said, caplog: Log) -> None:
    path, (write, says) = tmp_path / name, REFUSED[name]
    write(path)
    with pytest.raises(InputError, match=says) as caught:
        read_image(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "") and caplog.text == ""
    assert "supported" not in says or "damaged" not in str(caught.value)


def test_headers_of_what_is_not_read_and_layers_that_are_not_there(tmp_path: Path) -> None:
    """A file that is no image has none; one whose pixels alone are not read has."""
    text(tmp_path / "a.png")
    cut(copied(HEIC), 200)(tmp_path / "a.heic")
    assert all(read_header(tmp_path / name) is None for name in ("a.png", "b.png", "", "a.heic"))
    hdr_png(16)(tmp_path / "hdr.png")
    cut(copied(DEEP_AVIF), -1)(tmp_path / "cut.avif")
    assert read_header(tmp_path / "hdr.png") and read_header(tmp_path / "cut.avif")
    assert read_image(tmp_path / "hdr.png", "sRGB").pixels == pytest.approx(LINEAR, abs=1e-6)
    assert oiio.geterror() == ""
    # OpenImageIO's flat readers return memory as it lies.
    refused(InputError, "not an OLAT stack", read_olats, made.write_deep(tmp_path / "a.exr"))
    write_exr(tmp_path / "a.exr", QUADS / np.float32(255), layers={"albedo": QUADS / np.float32(255)})
    write_png(tmp_path / "a.png", QUADS)
    refused(InputError, "a.exr: ... it has rgba, albedo", read_image, tmp_path / "a.exr", layer="specular")
    refused(InputError, "has no layer 'x'; it has none", read_image, tmp_path / "a.png", layer="x")


def test_a_name_that_is_not_utf8_is_an_error(tmp_path: Path) -> None:
    name = tmp_path / os.fsdecode(b"\xff.exr")
    name.write_bytes(b"not an image")
    for read in (read_header, read_image, is_olat_stack):
        refused(InputError, "not UTF-8; rename", read, name)
    refused(InputError, "not UTF-8", write_display, name.with_suffix(".png"), np.zeros((2, 2, 3), np.float32))


def test_a_hundred_megapixels_are_refused_before_decoding(tmp_path: Path) -> None:
    path = tmp_path / "a.pgm"
    path.write_bytes(b"P5\n10000 10000\n255\n")  # a header alone: decoding it would be another error
    refused(InputError, "limit is 64 megapixels", read_image, path, limit_px=PHOTO_LIMIT_PX)
    refused(InputError, "cut short", read_image, path, limit_px=10**8)
    for small in (HEIC, DEEP_AVIF):
        with pytest.raises(InputError, match=r"\d\d x \d\d pixels; the limit"):
            read_image(small, limit_px=383)


def test_a_raw_file_is_never_read_as_its_thumbnail(tmp_path: Path) -> None:
    """By its suffix, or by what it holds: a thumbnail first, a mosaic, a CR2."""
    tifffile.imwrite(tmp_path / "a.nef", QUADS)
    tifffile.imwrite(tmp_path / "thumbnail.tif", QUADS, subfiletype=1)
    with tifffile.TiffWriter(tmp_path / "pages.tif") as pages:
        pages.write(QUADS)
        pages.write(QUADS.repeat(2, 0).repeat(2, 1))
    tifffile.imwrite(tmp_path / "mosaic.tif", GREY, photometric=32803)
    tifffile.imwrite(tmp_path / "cr2.tif", QUADS, byteorder="<")
    data = (tmp_path / "cr2.tif").read_bytes()
    (at,) = struct.unpack_from("<I", data, 4)  # the directory moves behind the mark
    moved = data[:4] + struct.pack("<I", len(data)) + b"CR\2\0" + data[12:] + data[at:]
    (tmp_path / "cr2.tif").write_bytes(moved)
    (tmp_path / "a.cr3").write_bytes(b"\0\0\0\x18ftypcrx \0\0\0\1crx isom" + bytes(100))
    for path in sorted(tmp_path.iterdir()):
        refused(InputError, "camera raw ... develop it to EXR", read_image, path)
        assert read_header(path) is None


def test_what_is_not_installed_is_named(monkeypatch: Patch) -> None:
    monkeypatch.setattr("PIL.AvifImagePlugin.SUPPORTED", False)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    for path, says in ((HEIC, "pip install 'facerf[heic]'"), (DEEP_AVIF, "pip install -U pillow")):
        with pytest.raises(InputError, match=re.escape(f"{path.name}: ") + ".*" + re.escape(says)):
            read_image(path)
        assert read_header(path) is None
