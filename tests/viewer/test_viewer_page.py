"""A page's numbers against known answers, by its numpy twin; its text is closed to the network."""

import base64
import hashlib
import re

import numpy as np
import pytest

from facerf_cli.colour import anchored_exposure_ev
from facerf_cli.resize import fitted, resized
from facerf_cli.viewer.basis import ExposureSamples, brightness_of, factored
from facerf_cli.viewer.frame import PersonBox
from facerf_cli.viewer.packing import PageMap, packed, strip_jpeg
from facerf_cli.viewer.page import IndexEntry, index_page, page, strip_of
from tests.oracles.viewer_page import Page, direction, document_of, encoded
from tests.viewer import toy_basis as toy

WHITE = np.ones(3)
SKY = PageMap("sky", np.full((4, 8, 3), 0.5, np.float32), "facerf envmap -o maps", "maps/sky.exr")


def twin() -> Page:
    return Page(document_of(text()))


def text(title: str = "me", photo: str = "me.jpg") -> str:
    return page(title, photo, packed(toy.basis(), [SKY]), "c3RyaXA=")


@pytest.mark.parametrize(
    ("azimuth", "elevation", "rgb"), [(0, 0, (1, 1, 1)), (75, 20, (1, 0.5, 0.2)), (160, -30, (2, 2, 2))]
)
def test_a_light_shades_the_hemisphere_as_in_closed_form(
    azimuth: float, elevation: float, rgb: tuple[float, ...]
) -> None:
    lights = [(direction(azimuth, elevation), np.array(rgb))]
    drawn = twin().shown(twin().sums(lights), 0.0)
    error = np.abs(drawn - 255 * encoded(toy.truth(lights, 0.0)))
    # Steps of 8 bits in detail and maps, and the rig's spacing of 18 degrees.
    assert error[toy.matte() > 0].mean() < 2.5
    assert error[toy.matte() == 0].mean() < 1.5


def test_lights_add_up() -> None:
    one, two = (direction(60, 10), WHITE), (direction(-100, 40), np.array([0.2, 0.4, 1.0]))
    both = twin().sums([one, two])
    np.testing.assert_allclose(both, twin().sums([one]) + twin().sums([two]), atol=1e-12)


def test_exposure_is_that_of_relight() -> None:
    known = toy.basis().samples
    light = 17
    wanted = anchored_exposure_ev(
        known.skin[light][None], known.plate_skin[None], np.ones((1, 8)), np.ones((1, 8))
    )
    ev = twin().exposure_ev(twin().sums([(toy.basis().directions[light], WHITE)]))
    assert abs(ev - wanted) < 0.03  # factors have 7 bits


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


def test_a_light_from_behind_counts_for_more_than_its_radiance() -> None:
    points = np.ones((9, 4, 3), np.float32) * np.array([1, 1, 1, 1, 1, 1, 0.1, 0.05, 0])[:, None, None]
    found = brightness_of(ExposureSamples(points, points, points[0], points[0]))
    assert found[0] == pytest.approx(1) and 0.1 < found[6] < 0.6 and found[8] > 0.1


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
    made = page("me", "me.jpg", packed(toy.basis(), []), strip)
    assert strip_of(made) == strip and strip_of("no page") == ""
    listed = index_page([IndexEntry("a<b", "dir/a&b.html", strip)])
    assert "a&lt;b" in listed and 'href="dir/a&amp;b.html"' in listed and strip in listed


def test_frames() -> None:
    matte = np.zeros((20, 30))
    matte[4:9, 10:25] = 1
    assert PersonBox.around(matte) == PersonBox(10, 4, 15, 5) and PersonBox.around(matte * 0) == PersonBox(
        0, 0, 30, 20
    )
    assert fitted(800, 1200, 600) == (400, 600) and fitted(80, 120, 600) == (80, 120)
    ramp = np.broadcast_to(np.arange(12.0)[:, None, None], (12, 8, 3))
    np.testing.assert_allclose(resized(ramp, 6, 4)[1:-1, 0, 0], [2.5, 4.5, 6.5, 8.5], atol=1e-5)
