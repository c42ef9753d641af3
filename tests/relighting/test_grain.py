"""What of the photo's detail a relit image keeps."""

import numpy as np
import pytest

from facerf_cli.relighting import grain as module
from facerf_cli.relighting.grain import Grain

SIDE, MAP_PX = 96, 4.0
random = np.random.default_rng(0)
PORES = np.exp(0.02 * random.standard_normal((SIDE, SIDE))).astype(np.float32)
SMOOTH = np.linspace(0.2, 1, SIDE, dtype=np.float32)[None, :, None].repeat(SIDE, 0).repeat(3, 2)
ALL = np.ones((SIDE, SIDE), np.float32)
NOTHING = np.zeros((SIDE, SIDE, 1), np.float32)


def read(grain: Grain, relit: np.ndarray, rows: slice = slice(0, SIDE)) -> np.ndarray:
    """Some rows of an image with the detail."""
    seen = grain.observe(rows)
    return grain.given(relit[seen.wide], seen)


def given(
    relit: np.ndarray,
    guided: np.ndarray,
    coarse: np.ndarray,
    share: np.ndarray = ALL,
    sharpened: np.ndarray = NOTHING,
) -> np.ndarray:
    flat = np.stack([guided, coarse], -1)
    grain = Grain(flat.__getitem__, share, MAP_PX, sharpened.__getitem__)
    return read(grain, relit)


def test_a_smooth_image_gets_the_photos_pores_and_no_edges_of_its_light() -> None:
    found = given(SMOOTH, ALL, PORES)[8:-8, 8:-8] / SMOOTH[8:-8, 8:-8]
    wanted = np.log(PORES[8:-8, 8:-8]).std()
    assert 0.85 * wanted < np.log(found).std() < 1.05 * wanted
    assert np.corrcoef(np.log(found[..., 0]).ravel(), np.log(PORES[8:-8, 8:-8]).ravel())[0, 1] > 0.95
    shadow = np.where(np.arange(SIDE) < SIDE // 2, 0.3, 1).astype(np.float32)[None].repeat(SIDE, 0)
    found = given(SMOOTH, ALL, shadow)
    assert np.abs(found / SMOOTH - 1).max() < 0.1


def test_no_line_is_drawn_where_a_relit_image_is_sharp_itself() -> None:
    """Skin before cloth of a twentieth of its albedo: of the light that both send back cloth has a fifth."""
    cloth = (np.arange(SIDE) < SIDE // 2)[None].repeat(SIDE, 0)
    photo = np.where(cloth, 0.05, 1).astype(np.float32)
    relit = np.where(cloth, 0.2, 1).astype(np.float32)[..., None].repeat(3, -1)
    lines, none = (given(relit, photo, photo, sharpened=part) / relit for part in (NOTHING, 1 + NOTHING))
    assert np.abs(np.log(lines)).max() > 0.5
    assert np.abs(np.log(none)).max() < 0.02
    pores = given(relit, photo * PORES, photo * PORES, sharpened=1 + NOTHING)[8:-8, 8:30]
    assert np.log(pores).std() > 0.85 * np.log(PORES).std()  # far from the edge they are


def test_hair_and_what_is_nearly_black_stay_as_they_are() -> None:
    half = ALL.copy()
    half[:, : SIDE // 2] = 0
    assert np.array_equal(given(SMOOTH, ALL, PORES, half)[:, : SIDE // 2], SMOOTH[:, : SIDE // 2])
    dark = np.where(half > 0, 1, 0.001).astype(np.float32)
    left = slice(0, SIDE // 2 - 8)
    assert np.array_equal(given(SMOOTH, dark, dark * PORES)[:, left], SMOOTH[:, left])


def test_images_add_up_and_strips_show_no_borders() -> None:
    other = np.ascontiguousarray(SMOOTH.transpose(1, 0, 2))
    grain = Grain(np.stack([ALL, PORES], -1).__getitem__, ALL, MAP_PX, NOTHING.__getitem__)
    both, one, two = (read(grain, image) for image in (SMOOTH + other, SMOOTH, other))
    np.testing.assert_allclose(both, one + two, rtol=1e-5)
    parts = [read(grain, SMOOTH + other, rows) for rows in (slice(0, 37), slice(37, SIDE))]
    np.testing.assert_allclose(np.concatenate(parts), both, rtol=1e-5)


def test_a_photo_that_is_read_in_strips_shows_no_borders(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = given(SMOOTH, PORES, PORES**2)
    monkeypatch.setattr(module, "_STRIP_PX", 32 * SIDE)
    np.testing.assert_allclose(given(SMOOTH, PORES, PORES**2), at_once, rtol=1e-6)


def test_only_the_strips_that_show_the_person_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """A crowd's photo is large, and each of its people small."""
    asked: list[int] = []
    share = ALL.copy()
    share[:40] = 0
    truth = given(SMOOTH, PORES, PORES**2, share)
    monkeypatch.setattr(module, "STRIP_PX", 32 * SIDE)
    monkeypatch.setattr(module, "_STRIP_PX", 32 * SIDE)

    def flat(rows: slice) -> np.ndarray:
        asked.append(rows.start)
        return np.stack([PORES, PORES**2], -1)[rows]

    found = read(Grain(flat, share, MAP_PX, NOTHING.__getitem__), SMOOTH)
    assert asked == [32, 64]
    np.testing.assert_allclose(found, truth, rtol=1e-6)  # as strips of the same photo differ
    assert np.array_equal(found[:30], SMOOTH[:30])
