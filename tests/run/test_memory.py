"""The budget of memory: what readers ask for before they decode, and who is refused."""

import os
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.face import morphable
from facerf_cli.face.fit import load_fit
from facerf_cli.face.morphable import MAX_ARRAYS, load_face_model
from facerf_cli.files.read import read_image
from facerf_cli.network.checkpoint import load_checkpoint, save_checkpoint
from facerf_cli.run import memory
from tests import astronaut
from tests.kinds import Patch
from tests.refusals import refused

HEIGHT, WIDTH = 30, 50


def image(path: Path, channels: list[str], kind: str = "half") -> Path:
    spec = oiio.ImageSpec(WIDTH, HEIGHT, len(channels), kind)
    spec.channelnames = tuple(channels)
    spec.alpha_channel = channels.index("A") if "A" in channels else -1
    stream = oiio.ImageOutput.create(str(path))
    assert stream.open(str(path), spec)
    values = np.zeros((HEIGHT, WIDTH, len(channels)), np.float32) + np.arange(len(channels)) / len(channels)
    assert stream.write_image(values.astype(np.float32)) and stream.close()
    return path


def test_a_limit_is_a_share_of_what_the_process_may_use(monkeypatch: Patch) -> None:
    monkeypatch.setattr(memory, "memory_bytes", lambda: 4 << 30)
    assert memory.default_limit() == 2 << 30 and memory.default_limit(4) == 512 << 20


def test_a_refusal_names_what_is_needed_and_counts_what_is_held() -> None:
    memory.set_limit(1 << 30)
    memory.require("a.exr", 1 << 30, "crop it")
    words = "a.exr: ... 1.01 GB ... 1.00 GB ... pass --memory 1.01 or crop it"
    refused(InputError, words, memory.require, "a.exr", (1 << 30) + 1, "crop it")
    memory.set_limit(1 << 30)
    with memory.holding(1 << 29):
        assert memory.left_bytes() == 1 << 29
        memory.require("a.exr", 1 << 29, "crop it")
        refused(InputError, "1.25 GB ... 1.00 GB", memory.require, "a.exr", 3 << 28, "crop it")
    memory.require("a.exr", 1 << 30, "crop it")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries have no malloc_trim")
def test_freed_memory_is_given_back() -> None:
    """64 MB in small blocks, of which one in a thousand stays in use: the others' pages go."""

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    blocks = [bytes(4000) for _ in range(16_000)]
    kept = blocks[::1000]
    full_mb = resident_mb()
    del blocks
    memory.give_back()
    assert resident_mb() < full_mb - 40 and len(kept) == 16


@pytest.mark.parametrize(
    ("name", "channels", "kind", "bytes_px"),
    [
        ("grey.png", ["Y"], "uint8", 1 + 12),
        ("a.png", ["R", "G", "B", "A"], "uint16", 8 + 16),
        ("a.exr", ["R", "G", "B"], "half", 12 + 12),
        ("many.exr", ["R", "G", "B", *(f"other{n:03d}.R" for n in range(300))], "half", 12 + 12),
    ],
)
def test_an_image_asks_for_the_channels_that_it_shows(
    tmp_path: Path, name: str, channels: list[str], kind: str, bytes_px: int
) -> None:
    path, needed = image(tmp_path / name, channels, kind), HEIGHT * WIDTH * bytes_px
    memory.set_limit(needed)
    assert read_image(path).pixels.shape == (HEIGHT, WIDTH, 3)
    memory.set_limit(needed - 1)
    with pytest.raises(InputError, match=rf"{name}: {WIDTH} x {HEIGHT} pixels: needs .* of memory"):
        read_image(path)


def test_an_image_asks_for_what_its_reader_makes_of_it(tmp_path: Path) -> None:
    path = image(tmp_path / "a.png", ["R", "G", "B"], "uint8")
    memory.set_limit(HEIGHT * WIDTH * (12 + 50))
    read_image(path, kept_px=50)
    refused(InputError, "of memory", read_image, path, kept_px=51)


def bomb(path: Path, members: int, bytes_each: int) -> Path:
    """An .npz that is a thousand times smaller than its arrays."""
    np.savez_compressed(path, **{f"a{n}": np.zeros(bytes_each, np.uint8) for n in range(members)})
    assert path.stat().st_size < members * bytes_each / 100
    return path


def test_arrays_of_a_file_count_together_and_many_are_refused(tmp_path: Path, monkeypatch: Patch) -> None:
    path = bomb(tmp_path / "a.npz", 8, 1 << 20)
    monkeypatch.setattr(zipfile.ZipExtFile, "read", _read_little(zipfile.ZipExtFile.read))
    monkeypatch.setattr(morphable, "_MAX_BYTES", 7 << 20)
    refused(InputError, "a.npz: not a facerf face model ... too large", load_face_model, path)
    with pytest.raises(InputError, match=f"{MAX_ARRAYS + 1} arrays, more than {MAX_ARRAYS}"):
        load_face_model(bomb(tmp_path / "a.npz", MAX_ARRAYS + 1, 1 << 16))


def test_a_fit_is_small(tmp_path: Path, monkeypatch: Patch) -> None:
    path = bomb(tmp_path / "fit.npz", 1, 1 << 20)
    monkeypatch.setattr(zipfile.ZipExtFile, "read", _read_little(zipfile.ZipExtFile.read))
    refused(InputError, "fit.npz: not a fit ... too large", load_fit, path)


def _read_little(read):
    def checked(self, size=-1):
        assert 0 <= size <= 1 << 16, "an array was read"
        return read(self, size)

    return checked


def test_a_checkpoint_asks_for_its_networks(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, {}, {})
    memory.set_limit(3 * path.stat().st_size)
    load_checkpoint(path)
    memory.set_limit(3 * path.stat().st_size - 1)
    refused(InputError, "a.safetensors: needs", load_checkpoint, path)


@pytest.mark.slow
def test_a_large_photo_stays_under_its_ceiling(tmp_path: Path) -> None:
    """The rule of `work/plan.py` holds: 12 megapixels, over what the process has at rest."""

    def peak_bytes(width: int) -> int:
        photo = tmp_path / f"{width}.jpg"
        small = Image.fromarray((astronaut.photo()[:384].clip(0, 1) * 255).astype(np.uint8))
        small.resize((width, width * 3 // 4)).save(photo)
        line = [sys.executable, "-m", "facerf_cli", "relight", str(photo), "--light", "75,20"]
        process = subprocess.Popen([*line, "-o", str(tmp_path / "out"), "--memory", "0.5"])
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        return usage.ru_maxrss * 1024

    assert peak_bytes(4000) - peak_bytes(590) < 0.5 * (1 << 30)
