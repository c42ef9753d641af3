"""OLAT stacks: what is written comes back, other programs open it, and what is no stack is refused."""

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.files import olat_stack, write
from facerf_cli.files.olat_stack import (
    StackHeader,
    is_olat_stack,
    read_olat_header,
    read_olats,
    stream_olats,
    write_olat_stack,
)
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.run import memory
from tests.refusals import refused
from tests.stacks import read_olat_stack

LIGHTS, HEIGHT, WIDTH = 5, 24, 17  # not square
DRAW = np.random.default_rng(3)


def header() -> StackHeader:
    directions = DRAW.normal(size=(LIGHTS, 3))
    normals = DRAW.normal(size=(HEIGHT, WIDTH, 3))
    return StackHeader(
        kind="texture",
        directions=directions / np.linalg.norm(directions, axis=-1, keepdims=True),
        rotation=np.linalg.qr(DRAW.normal(size=(3, 3)))[0],
        source=DRAW.random((HEIGHT, WIDTH, 3)),
        seen=DRAW.random((HEIGHT, WIDTH)),
        normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        layout_version=1,
        fit={"model": np.array("builtin"), "alpha": DRAW.normal(size=80), "crop": np.array(3.25)},
        metadata={"facerf:input": "a.jpg", "facerf:synthetic": 1, "Software": "facerf"},
    )


OLATS = torch.from_numpy(DRAW.random((LIGHTS, 3, HEIGHT, WIDTH))).float() * 4


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_olat_stack(tmp_path / "a_olat.exr", header(), iter([OLATS[:2], OLATS[2:]]))
    return tmp_path / "a_olat.exr"


def test_a_stack_survives_its_file(tmp_path: Path) -> None:
    written = header()
    write_olat_stack(tmp_path / "a.exr", written, iter([OLATS[:4], OLATS[4:]]))
    stack = read_olat_stack(tmp_path / "a.exr")
    assert torch.equal(stack.olats, OLATS.half())  # lossless
    read = stack.header
    assert (read.kind, read.layout_version, read.metadata) == ("texture", 1, written.metadata)
    for name in ("directions", "source", "seen", "normals"):
        assert np.abs(getattr(read, name) - getattr(written, name)).max() < 1e-3, name
    assert np.array_equal(read.rotation, written.rotation)  # JSON keeps every digit
    assert str(read.fit["model"]) == "builtin" and np.array_equal(read.fit["alpha"], written.fit["alpha"])


def test_a_part_leaves_little_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, threads, given_back = oiio.get_int_attribute("exr_threads"), [], []
    monkeypatch.setattr(memory, "give_back", lambda: given_back.append(len(threads)))

    def olats() -> Iterator[torch.Tensor]:
        for light in OLATS:
            threads.append(oiio.get_int_attribute("exr_threads"))
            yield light[None]

    write_olat_stack(tmp_path / "a.exr", header(), olats())
    assert threads == [-1] * LIGHTS and oiio.get_int_attribute("exr_threads") == before
    assert given_back == [1, 2, 3, 4, 5]  # after each prediction, before its parts


def test_other_programs_see_a_part_a_light(path: Path) -> None:
    stream = oiio.ImageInput.open(str(path))
    for number in range(LIGHTS):
        assert stream.seek_subimage(number, 0)
        spec = stream.spec()
        assert spec.get_string_attribute("name") == f"light{number:03d}" and spec.format == oiio.HALF
        assert len(spec.getattribute("facerf:direction")) == 3
    assert stream.seek_subimage(LIGHTS, 0) and not stream.seek_subimage(LIGHTS + 1, 0)
    stream.close()
    first = read_image(path)  # any reader of EXR gets the first light
    assert np.allclose(first.pixels, OLATS[0].permute(1, 2, 0), atol=2e-3)
    tool = Path(sys.executable).parent / "oiiotool"
    if not tool.is_file():
        pytest.skip("oiiotool is not installed in the folder of python")
    said = subprocess.run([tool, "--info", path], capture_output=True, text=True, check=True).stdout
    assert f"({LIGHTS + 1} subimages)" in said
    assert b"capDate" not in path.read_bytes()


def test_values_beyond_half_are_held_and_nan_is_our_bug(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(write.log, "propagate", True)
    write_olat_stack(tmp_path / "a.exr", header(), iter([OLATS * 1e6]))
    assert "beyond the range of half floats" in caplog.text
    assert read_olat_stack(tmp_path / "a.exr").olats.isfinite().all()
    refused(InputError, "NaN", write_olat_stack, tmp_path / "b.exr", header(), iter([OLATS * torch.nan]))
    refused(ValueError, "2 lights, not", write_olat_stack, tmp_path / "b.exr", header(), iter([OLATS[:2]]))
    assert not list(tmp_path.glob("*b*"))


def test_an_unwritable_place_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FacerfError, match="cannot write"):
        write_olat_stack(tmp_path / "file" / "a.exr", header(), iter([OLATS]))


def rewritten(path: Path, **changes: object) -> Path:
    """The stack's first part alone, its JSON changed."""
    stream = oiio.ImageInput.open(str(path))
    spec, pixels = oiio.ImageSpec(stream.spec()), stream.read_image(0, 0, 0, 3, oiio.HALF)
    stream.close()
    content = json.loads(spec.get_string_attribute("facerf:olat")) | changes
    spec.attribute("facerf:olat", json.dumps(content))
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(pixels)
    output.close()
    return path


@pytest.mark.parametrize(("changes", "message"), [
    ({}, "part 1 is missing"), ({"lights": 10**9}, "lights: "), ({"lights": 0}, "lights: "),
    ({"lights": "many"}, "damaged"), ({"kind": "sound"}, "damaged"), ({"format": "x-9"}, "damaged"),
    ({"rotation": [1, 2]}, "damaged"), ({"rotation": [[float("nan")] * 3] * 3}, "damaged"),
    ({"fit": 7}, "damaged"), ({"layout_version": None}, "damaged"),
])  # fmt: skip
def test_a_doctored_stack_is_refused(path: Path, changes: dict, message: str) -> None:
    refused(InputError, f"{path} ... {message}", read_olat_stack, rewritten(path, **changes))


def test_what_is_no_stack_is_refused(path: Path, tmp_path: Path) -> None:
    write_exr(tmp_path / "plain.exr", np.zeros((4, 5, 3), np.float32))
    (tmp_path / "text.exr").write_text("hello")
    (tmp_path / "cut.exr").write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    for name in ("plain.exr", "text.exr", "none.exr", "cut.exr"):
        refused(InputError, name, read_olat_stack, tmp_path / name)
        assert name == "cut.exr" or not is_olat_stack(tmp_path / name)
    assert is_olat_stack(path)


def test_the_budget_of_memory_bounds_lights_and_source(path: Path) -> None:
    """Lights of 6 bytes a pixel and a source of 100; rows and single lights take their part of that."""
    lights, (_, height, width) = len(read_olats(path)), read_olats(path).shape[1:]
    needed = height * width * (6 * lights + 100)
    memory.set_limit(needed)
    assert len(read_olats(path)) == lights
    memory.set_limit(needed - 1)
    with pytest.raises(InputError, match=f"{lights} lights of {width} x {height} pixels: needs .* --memory"):
        read_olats(path)
    assert len(read_olats(path, slice(0, 1))) == 1 and read_olat_header(path).kind
    memory.set_limit(height * width * 100 - 1)
    for read in (read_olat_header, read_olats):
        refused(InputError, "of memory", read, path)


def test_a_stack_is_summed_in_batches_of_half_the_budget(path: Path) -> None:
    """A light that is summed takes 30 bytes a pixel, the source 100; one light is the least."""
    every, size_px = read_olats(path).float(), math.prod(read_olats(path).shape[2:])
    for limit, first in ((1 << 40, LIGHTS), (size_px * 2 * (100 + 2 * 30), 2), (size_px * 130, 1)):
        memory.set_limit(limit)
        batches = list(stream_olats(path))
        assert len(batches[0]) == first and torch.equal(torch.cat(batches), every)
    memory.set_limit(size_px * 130 - 1)
    refused(InputError, "lights of ... pixels: needs ... fewer pixels", next, stream_olats(path))


def test_a_part_without_direction_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(olat_stack, "_DIRECTION", "facerf:elsewhere")
    refused(InputError, "no direction", read_olat_stack, path)
    refused(InputError, "no direction", read_olat_stack, written_with(path, directions=np.zeros((LIGHTS, 3))))


def written_with(path: Path, **changes: object) -> Path:
    write_olat_stack(path, replace(header(), **changes), iter([OLATS]))
    return path
