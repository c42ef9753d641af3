"""The readers of .hdr and .exr maps find the pixels that OpenImageIO finds. Needs Chromium."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli import viewer
from tests.viewer.browser import chromium, driven

READERS = ("light.js", "readers.js")
_SCRIPT = """
  const results = {};
  for (const [name, data] of Object.entries(%s)) {
    try {
      const map = await readMap(new File([bytesOf(data)], name));
      results[name] = { size: [map.width, map.height], pixels: Array.from(map.pixels) };
    } catch (error) {
      results[name] = { error: error.message };
    }
  }
  return results;
"""


def sky(channels: int = 3) -> np.ndarray:
    """A map [16, 32, C] of six decades, with a black row and runs of equal pixels."""
    random = np.random.default_rng(3)
    found = 10 ** random.uniform(-3, 3, (16, 32, channels)).astype(np.float32)
    found[5], found[7:9, 4:30] = 0, 0.5
    return found


def write(path: Path, pixels: np.ndarray, kind: str, compression: str | None = None) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    if pixels.shape[2] == 1:
        spec.channelnames = ("Y",)
    if compression:
        spec.attribute("compression", compression)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()


def read(folder: Path, names: list[str]) -> dict[str, Any]:
    """What the page's readers make of files."""
    chromium()
    files = {name: base64.b64encode((folder / name).read_bytes()).decode() for name in names}
    parts = [(Path(viewer.__file__).parent / name).read_text(encoding="utf-8") for name in READERS]
    page = f'<html><body data-settled="true"><script>{"".join(parts)}</script></body></html>'
    results: dict[str, Any] = driven(page, _SCRIPT % json.dumps(files), folder)
    return results


def test_maps_have_the_pixels_that_openimageio_reads(tmp_path: Path) -> None:
    write(tmp_path / "rle.hdr", sky(), "float")
    for compression in ("none", "zip", "zips"):
        for kind in ("half", "float"):
            write(tmp_path / f"{compression}_{kind}.exr", sky(), kind, compression)
    write(tmp_path / "alpha.exr", sky(4), "half", "zip")
    write(tmp_path / "grey.exr", sky(1), "float", "zip")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 9
    for name, found in read(tmp_path, names).items():
        truth = oiio.ImageBuf(str(tmp_path / name)).get_pixels(oiio.FLOAT)
        truth = np.repeat(truth, 3, 2) if truth.shape[2] == 1 else truth[..., :3]
        assert found.get("size") == [32, 16], (name, found.get("error"))
        pixels = np.array(found["pixels"]).reshape(16, 32, 3)
        np.testing.assert_allclose(pixels, truth, rtol=1e-6, atol=1e-9, err_msg=name)


def test_what_cannot_be_read_is_refused_in_a_line_that_says_what_to_do(tmp_path: Path) -> None:
    write(tmp_path / "piz.exr", sky(), "half", "piz")
    write(tmp_path / "square.hdr", sky()[:, :16], "float")
    write(tmp_path / "whole.hdr", sky(), "float")
    (tmp_path / "cut.hdr").write_bytes((tmp_path / "whole.hdr").read_bytes()[:300])
    (tmp_path / "text.hdr").write_text("no map")
    found = read(tmp_path, ["piz.exr", "square.hdr", "cut.hdr", "text.hdr"])
    wanted = {
        "piz.exr": "save it with ZIP",
        "square.hdr": "twice as wide as high",
        "cut.hdr": "cut short",
        "text.hdr": "convert it",
    }
    for name, part in wanted.items():
        assert part in found[name]["error"], name
