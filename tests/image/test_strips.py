"""Images in strips: layers that are computed by rows, never many of them at once, as at once."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
import torch.nn.functional as F

from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image import strips as module
from facerf_cli.image.strips import Window, block_means, box_means, enlarged, in_strips, strips
from facerf_cli.portrait.matte import PersonColours, enlarge_matte, shrunk
from tests.kinds import Patch

HEIGHT, WIDTH = 150, 70
DRAW = np.random.default_rng(4)


@pytest.fixture(autouse=True)
def _small_strips(monkeypatch: Patch) -> None:
    monkeypatch.setattr(module, "STRIP_PX", 64 * WIDTH)


def test_strips_cover_all_rows_once_and_means_are_those_of_their_pixels() -> None:
    parts = list(strips((HEIGHT, WIDTH, 3)))
    assert [row for part in parts for row in range(HEIGHT)[part]] == list(range(HEIGHT))
    assert [part.start for part in parts] == [0, 64, 128]
    image = DRAW.integers(0, 256, (23, 17, 3), dtype=np.uint8)
    found = box_means(image.astype(np.float32), 2)
    padded = np.pad(image, ((2, 2), (2, 2), (0, 0)), mode="edge")
    assert found.shape == image.shape
    assert found[0, 16] == pytest.approx(padded[:5, 16:].mean((0, 1))) and found[9, 4] == pytest.approx(
        image[7:12, 2:7].mean((0, 1))
    )
    blocks = block_means(image, 4)
    assert blocks.shape == (5, 4, 3) and blocks[3, 1] == pytest.approx(image[12:16, 4:8].mean((0, 1)))
    maps = DRAW.random((4, 31, 17), np.float32)
    wide = F.interpolate(torch.from_numpy(maps)[None], (HEIGHT, WIDTH), mode="bilinear")[0].numpy()
    np.testing.assert_allclose(enlarged(maps, (HEIGHT, WIDTH)), wide, atol=2e-6)
    np.testing.assert_allclose(enlarged(maps, (HEIGHT, WIDTH), slice(40, 61)), wide[:, 40:61], atol=2e-6)
    image = DRAW.random((HEIGHT, WIDTH, 3), np.float32)
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    small = F.interpolate(planes, (41, 23), mode="area")[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(shrunk(image, (41, 23)), small, atol=1e-6)
    np.testing.assert_allclose(shrunk(image[..., 0], (41, 23)), small[..., 0], atol=1e-6)


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.jpg", "a.tif"])
def test_files_are_written_by_strips_as_by_one(name: str, tmp_path: Path, monkeypatch: Patch) -> None:
    pixels = DRAW.random((HEIGHT, WIDTH, 3), np.float32)
    alpha, normals = DRAW.random((HEIGHT, WIDTH), np.float32), DRAW.random((HEIGHT, WIDTH, 3), np.float32)

    def write(path: Path, of: Callable[[np.ndarray], np.ndarray] = np.asarray) -> bytes:
        if name == "a.exr":
            write_exr(path, of(pixels), of(alpha), {"normal": of(normals), "person.A": of(alpha)})
        elif name == "a.tif":
            write_tiff(path, of(pixels), of(alpha))
        else:
            write_display(path, of(pixels), 0.5, of(alpha))
        return path.read_bytes()

    def mapped(values: np.ndarray) -> np.ndarray:
        found = np.memmap(
            tmp_path / f"{values.ndim}{values.sum()}.values", values.dtype, "w+", shape=values.shape
        )
        found[:] = values
        return found

    by_strips = write(tmp_path / name)
    assert write(tmp_path / f"mapped{name}", mapped) == by_strips
    monkeypatch.setattr(module, "STRIP_PX", 1 << 20)
    assert write(tmp_path / f"whole{name}") == by_strips
    if name == "a.exr":
        with_alpha = pixels * alpha[..., None]
        np.testing.assert_allclose(
            oiio.ImageBuf(str(tmp_path / name)).get_pixels()[..., :3], with_alpha, atol=1e-3
        )


def test_a_read_does_not_depend_on_strips(tmp_path: Path, monkeypatch: Patch) -> None:
    write_display(
        tmp_path / "a.png", DRAW.random((HEIGHT, WIDTH, 3), np.float32), 0.0, DRAW.random((HEIGHT, WIDTH))
    )
    found = read_image(tmp_path / "a.png")
    monkeypatch.setattr(module, "STRIP_PX", 1 << 20)
    at_once = read_image(tmp_path / "a.png")
    assert (found.pixels == at_once.pixels).all() and (found.alpha == at_once.alpha).all()


def test_layers_are_rendered_strip_by_strip(tmp_path: Path) -> None:
    asked: list[slice] = []

    def render(rows: slice) -> dict[str, np.ndarray]:
        asked.append(rows)
        row = np.repeat(np.arange(rows.start, rows.stop, dtype=np.float32)[:, None], WIDTH, 1)
        return {"row": row, "bright": 1e3 * row}

    assert (in_strips(render, HEIGHT, WIDTH)["row"][:, 0] == np.arange(HEIGHT)).all()
    assert asked == [slice(0, 64), slice(64, 128), slice(128, 150)]

    def empty(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return np.memmap(tmp_path / name, np.float16, "w+", shape=shape)

    found = in_strips(render, HEIGHT, WIDTH, empty)
    assert list(found) == ["row", "bright"]
    np.testing.assert_allclose(found["bright"][:, 0], (1e3 * np.arange(HEIGHT)).clip(max=65504), rtol=1e-3)


def test_colours_of_a_person_are_those_of_the_whole_image(monkeypatch: Patch) -> None:
    monkeypatch.setattr("facerf_cli.portrait.matte._COLOURS_PX", 60)
    photo = DRAW.random((HEIGHT, WIDTH, 3), np.float32)
    matte = (DRAW.random((HEIGHT, WIDTH), np.float32) * 3 - 1).clip(0, 1)
    colours = PersonColours(photo, matte)
    assert (colours[33:40] == colours[:][33:40]).all()
    monkeypatch.setattr(module, "STRIP_PX", 1 << 20)
    np.testing.assert_allclose(colours[:], PersonColours(photo, matte)[:], atol=2e-6)


def test_a_matte_is_enlarged_by_strips_as_at_once(monkeypatch: Patch) -> None:
    photo = DRAW.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    rough, guide = DRAW.random((30, 14), np.float32), DRAW.random((30, 14, 3), np.float32)
    found = enlarge_matte(rough, guide, photo)
    monkeypatch.setattr(module, "STRIP_PX", 1 << 20)
    np.testing.assert_allclose(found, enlarge_matte(rough, guide, photo), atol=1e-6)


def test_a_window_says_where_its_parts_lie_in_an_array() -> None:
    image = DRAW.random((20, 30, 3), np.float32)
    one, other = Window(slice(2, 12), slice(5, 25)), Window(slice(8, 20), slice(0, 9))
    part = one.common(other)
    assert part == other.common(one) == Window(slice(8, 12), slice(5, 9)) and part.shape == (4, 4)
    for window in (one, other):
        assert (image[window][part.inside(window)] == image[part]).all()
    framed = one.framed(image[part], part)
    assert framed.shape == (10, 20, 3) and (framed[part.inside(one)] == image[part]).all()
    assert framed.sum() == pytest.approx(image[part].sum())
    apart = one.common(Window(slice(15, 18), slice(26, 30)))
    assert apart.shape == (0, 0) and image[one][apart.inside(one)].size == 0
    assert (one.framed(image[apart], apart) == 0).all()
