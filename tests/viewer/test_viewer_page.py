"""A page's text is closed to the network, and its basis gives images back; no browser is needed."""

import base64
import hashlib
import json
import re
from typing import Any

import numpy as np
import torch

from facerf_cli.image.colour import luminance
from facerf_cli.image.strips import fitted, resized
from facerf_cli.light.sphere import golden_spiral, rig_directions
from facerf_cli.viewer.basis import Basis, Brightest, basis_of_stack, evenly_spread
from facerf_cli.viewer.page import IndexEntry, index_page, page, strip_jpeg, strip_of


def text(title: str = "me", photo: str = "me.jpg") -> str:
    return page(title, [photo, "--face", "1"], {"size": [4, 3]}, "c3RyaXA=")


def document_of(made: str) -> dict[str, Any]:
    """The JSON document in a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', made, re.S)
    assert found
    document: dict[str, Any] = json.loads(found[1])
    return document


def basis_of_images(directions: np.ndarray, images: np.ndarray, matte: np.ndarray) -> Basis:
    """The basis of a stack of images [L, H, W, 3] over black."""
    return basis_of_stack(directions, [torch.from_numpy(images).permute(0, 3, 1, 2)], matte, 512)


def test_a_basis_gives_the_images_of_its_lights_back_and_is_black_where_nobody_is() -> None:
    random = np.random.default_rng(2)
    directions = rig_directions(20).numpy()
    albedo = random.uniform(0.05, 0.6, (24, 32, 3))
    images = albedo * np.clip(directions[:, 2], 0.01, 1)[:, None, None, None]
    basis = basis_of_images(directions, images, np.ones((24, 32)))
    assert basis.guide.dtype == basis.ratios.dtype == np.uint8
    for direction, image in zip(directions, images, strict=True):
        np.testing.assert_allclose(basis.image(direction), image, rtol=0.02, atol=2e-3)
    matte = np.zeros((24, 32))
    matte[4:20, 6:26] = 1
    images = np.ones((6, 24, 32, 3)) * matte[..., None]
    basis = basis_of_images(rig_directions(6).numpy(), images, matte)
    assert not basis.guide[matte == 0].any() and np.isfinite(basis.scales).all()
    assert basis.image(np.array([0, 0, 1.0]))[matte == 0].max() == 0


def test_a_stack_becomes_a_basis_and_evenly_spread_lights_are_kept() -> None:
    directions = golden_spiral(40)
    olats = torch.rand(40, 3, 12, 16)
    basis = basis_of_stack(directions, torch.split(olats, 7), np.ones((12, 16)), 512)
    assert basis.guide.shape == (12, 16, 3) and basis.ratios.shape == (40, 12, 16, 3)
    found = basis.image(directions[8])
    np.testing.assert_allclose(found, olats[8].permute(1, 2, 0).numpy(), atol=0.05)
    assert evenly_spread(directions) == list(range(40))
    kept = evenly_spread(golden_spiral(900), 100)
    assert 90 <= len(kept) <= 100 and len(set(kept)) == len(kept)


def test_the_brightest_pixels_have_the_percentiles_of_all_under_every_light() -> None:
    random = np.random.default_rng(4)
    lobes = np.clip(random.normal(size=(12, 3)) @ random.normal(size=(3, 40 * 30)), 0.01, None) ** 3
    images = (lobes.reshape(12, 40, 30, 1) * [0.8, 0.6, 0.5]).astype(np.float32)
    mask = np.ones((40, 30), bool)
    mask[:9] = False
    found = Brightest.of(images, mask, 90.0)
    assert 150 < found.luminances.shape[1] < mask.sum() == found.total
    np.testing.assert_allclose(found.shares.sum(1), 1, rtol=1e-5)
    red = luminance(images * np.array([1, 0, 0], np.float32))
    for light, image in enumerate(images):
        for values, all_values in (
            (found.luminances[light], luminance(image)[mask]),
            (found.luminances[light] * found.shares[:, 0], red[light][mask]),
        ):
            rank = len(values) - 1 - (found.total - 1) * 0.1
            mine = np.interp(rank, np.arange(len(values)), np.sort(values))
            np.testing.assert_allclose(mine, np.percentile(all_values, 90), rtol=1e-4)
    assert Brightest.of(images, mask & False, 90.0).luminances.shape == (12, 0)


def test_the_page_loads_nothing_and_an_index_shows_its_strips() -> None:
    made = text('<b>"me" & you</b></script>', "a b/me's.jpg")
    assert "<b>" not in made and made.count("</script>") == 2
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", made)
    assert "https://" not in made and "http://" not in made
    assert document_of(made)["source"] == "'a b/me'\"'\"'s.jpg' --face 1"
    for element in ("style", "script"):
        body = re.search(rf"<{element}>(.*?)</{element}>", made, re.S)
        assert body
        name = base64.b64encode(hashlib.sha256(body[1].encode()).digest()).decode()
        assert f"{element}-src 'sha256-{name}'" in made
    assert "default-src 'none'" in made
    strip = strip_jpeg([np.full((6, 4, 3), 0.5), np.zeros((6, 4, 3))])
    made = page("me", ["me.jpg"], {}, strip)
    assert strip_of(made) == strip and strip_of("no page") == ""
    listed = index_page([IndexEntry("a<b", "dir/a&b.html", strip)])
    assert "a&lt;b" in listed and 'href="dir/a&amp;b.html"' in listed and strip in listed
    assert fitted(800, 1200, 600) == (400, 600) and fitted(80, 120, 600) == (80, 120)
    ramp = np.broadcast_to(np.arange(12.0)[:, None, None], (12, 8, 3))
    np.testing.assert_allclose(resized(ramp, 6, 4)[1:-1, 0, 0], [2.5, 4.5, 6.5, 8.5], atol=1e-5)
