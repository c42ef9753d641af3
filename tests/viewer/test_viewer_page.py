"""A page's text is closed to the network, and its arrays come back; no browser is needed."""

import base64
import hashlib
import json
import re
import zlib
from typing import Any

import numpy as np
import pytest

from facerf_cli.resize import fitted, resized
from facerf_cli.viewer.arrays import ArrayPack
from facerf_cli.viewer.packing import strip_jpeg
from facerf_cli.viewer.page import IndexEntry, index_page, page, strip_of
from facerf_cli.viewer.stage import atlas, factored


def text(title: str = "me", photo: str = "me.jpg") -> str:
    return page(title, photo, {"size": [4, 3]}, "c3RyaXA=")


def document_of(made: str) -> dict[str, Any]:
    """The JSON document in a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', made, re.S)
    assert found
    document: dict[str, Any] = json.loads(found[1])
    return document


def unpacked(document: dict[str, Any], name: str) -> np.ndarray:
    """An array of a page, as its script reads it."""
    entry = document["arrays"][name]
    size = 1 if entry["kind"] == "byte" else 2
    count = int(np.prod(entry["shape"]))
    raw = zlib.decompress(base64.b64decode(document["bytes"]))[entry["at"] :][: size * count]
    words = np.frombuffer(raw, np.uint8).reshape(size, count).T.copy()
    if entry["kind"] == "half":
        return words.view("<f2").reshape(entry["shape"]).astype(float)
    values = words.view("<u1" if size == 1 else "<u2").reshape(-1)
    if entry["kind"] == "index":
        return np.cumsum(values, dtype=np.uint16).reshape(entry["shape"])
    planes = values.reshape(len(entry["low"]), -1).astype(float)
    found = np.array(entry["low"])[:, None] + np.array(entry["step"])[:, None] * planes
    return np.asarray(found.reshape(entry["shape"]))


@pytest.mark.parametrize(("kind", "error"), [("half", 5e-3), ("byte", 0.04), ("short", 2e-4)])
def test_arrays_come_back(kind: Any, error: float) -> None:
    random = np.random.default_rng(2)
    one = random.uniform([[-9.0], [3.0]], [[9.0], [4.0]], (2, 50))  # two planes of other ranges
    pack = ArrayPack()
    pack.add("first", np.zeros((1, 3)), "byte")
    pack.add("one", one, kind)
    found = unpacked(pack.document(), "one")
    assert np.abs(found - one).max() < error
    if kind != "half":
        assert np.abs(found[1] - one[1]).max() < error / 10  # each plane by its own range


def test_indices_come_back_exactly() -> None:
    values = np.array([[0, 65535, 7], [7, 6, 40000]])
    pack = ArrayPack()
    pack.add("index", values, "index")
    np.testing.assert_array_equal(unpacked(pack.document(), "index"), values)


def test_factors_of_enough_rank_give_the_images_back() -> None:
    images = np.einsum("lk,khwc->lhwc", np.random.rand(30, 4), np.random.rand(4, 5, 6, 3)).astype(np.float32)
    maps, coefficients = factored(images, np.ones((5, 6, 1)), 4)
    np.testing.assert_allclose(np.einsum("lk,khwc->lhwc", coefficients, maps), images, atol=1e-5)


def test_weights_decide_what_a_low_rank_keeps() -> None:
    images = np.zeros((2, 1, 2, 3), np.float32)
    images[0, 0, 0], images[1, 0, 1] = 1.0, 0.5
    for weight, kept in (((1, 1), 0), ((1, 4), 1)):
        maps, coefficients = factored(images, np.array(weight, float).reshape(1, 2, 1), 1)
        found = np.einsum("lk,khwc->lhwc", coefficients, maps)
        np.testing.assert_allclose(found[kept], images[kept], atol=1e-6)


def test_maps_lie_in_tiles() -> None:
    maps = np.random.default_rng(1).normal(size=(5, 6, 10, 3))
    data, scales, columns, tile = atlas(maps)
    assert tile == [16, 8]
    for k, one in enumerate(maps):
        part = data[k // columns * 8 :, k % columns * 16 :][:6, :10].astype(float)
        np.testing.assert_allclose((part - 128) / 127 * scales[k], one, atol=scales[k] / 250)


def test_the_page_loads_nothing_and_names_are_escaped() -> None:
    made = text('<b>"me" & you</b></script>', "a b/me's.jpg")
    assert "<b>" not in made and made.count("</script>") == 2
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", made)
    assert "https://" not in made and "http://" not in made
    assert document_of(made)["source"] == "'a b/me'\"'\"'s.jpg'"
    for element in ("style", "script"):
        body = re.search(rf"<{element}>(.*?)</{element}>", made, re.S)
        assert body
        name = base64.b64encode(hashlib.sha256(body[1].encode()).digest()).decode()
        assert f"{element}-src 'sha256-{name}'" in made
    assert "default-src 'none'" in made


def test_an_index_shows_the_strips_of_its_pages() -> None:
    strip = strip_jpeg([np.full((6, 4, 3), 0.5), np.zeros((6, 4, 3))])
    made = page("me", "me.jpg", {}, strip)
    assert strip_of(made) == strip and strip_of("no page") == ""
    listed = index_page([IndexEntry("a<b", "dir/a&b.html", strip)])
    assert "a&lt;b" in listed and 'href="dir/a&amp;b.html"' in listed and strip in listed


def test_frames() -> None:
    assert fitted(800, 1200, 600) == (400, 600) and fitted(80, 120, 600) == (80, 120)
    ramp = np.broadcast_to(np.arange(12.0)[:, None, None], (12, 8, 3))
    np.testing.assert_allclose(resized(ramp, 6, 4)[1:-1, 0, 0], [2.5, 4.5, 6.5, 8.5], atol=1e-5)
