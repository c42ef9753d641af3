"""Hair grows on the scalp, beards where beards grow, lashes on the lids; the face stays visible."""

from dataclasses import replace

import numpy as np
import pytest

from facerf_cli.face.topology import LANDMARKS_M, cylinder_uv
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head.hair import draw_hair, grow_beard, grow_hair, grow_lashes
from facerf_cli.synth.head.hair_styles import (
    ROWS,
    STYLES,
    HairStyle,
    draw_style,
    scalp_cover,
    scalp_margin_m,
    tail_paths,
)
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, hull_of
from facerf_cli.synth.head.worn import draw_earrings, draw_hand, draw_microphone
from tests.kinds import Patch
from tests.refusals import refused

Hairs = dict[str, tuple[HairStyle, HeadMesh]]
HAIRY = tuple(name for name in STYLES if name != "bald")


@pytest.fixture(scope="module")
def hairs(head: HeadMesh) -> Hairs:
    """One example of every style except bald."""
    return {name: grown(head, name) for name in HAIRY}


def grown(head: HeadMesh, name: str, seed: int = 5) -> tuple[HairStyle, HeadMesh]:
    """Every eighth wisp of a style."""
    random = np.random.default_rng(seed)
    style = draw_style(random, name)
    style = replace(style, wisps=style.wisps // 8)
    return style, grow_hair(head, style, random)


def without_tail(head: HeadMesh, style: HairStyle, hair: HeadMesh) -> tuple[HairStyle, HeadMesh]:
    """The hair of a style on the head itself."""
    return style, grow_hair(head, replace(style, tail=""), np.random.default_rng(5)) if style.tail else hair


@pytest.mark.parametrize("name", HAIRY)
def test_every_style_is_a_sound_mesh_rooted_on_the_scalp_alone(
    hairs: Hairs, name: str, head: HeadMesh
) -> None:
    style, hair = hairs[name]
    assert 6_250 < len(hair.vertices) <= 150_000 and len(hair.triangles) <= 150_000
    assert hair.triangles.min() == 0 and hair.triangles.max() == len(hair.vertices) - 1
    assert (hair.part == PARTS.index("hair")).all()
    for field in (hair.vertices, hair.normals, hair.uv, hair.tangents):
        assert np.isfinite(field).all() and field.dtype == np.float32
    for field in (hair.normals, hair.tangents):
        np.testing.assert_allclose(np.linalg.norm(field, axis=-1), 1, atol=1e-4)
    assert hair.uv.min() == 0 and hair.uv.max() == 1
    assert style.name == name
    style, hair = without_tail(head, *hairs[name])
    roots = hair.vertices[hair.uv[:, 1] == 0].astype(float)
    assert (scalp_margin_m(roots, style) > -0.012).all()
    azimuth = np.abs(np.degrees(np.arctan2(roots[:, 0], roots[:, 2])))
    assert (roots[azimuth < 45, 1] > 0.075).all()  # the forehead
    assert (roots[(azimuth > 75) & (azimuth < 97), 1] > 0.03).all()  # the ears
    assert roots[:, 1].min() > -0.09  # the neck


@pytest.mark.parametrize("name", HAIRY)
def test_hair_leaves_the_face_free_and_does_not_pass_through_the_skin(
    hairs: Hairs, name: str, head: HeadMesh
) -> None:
    _, hair = hairs[name]
    x, y, _ = hair.vertices.T
    before = (np.abs(x) < 0.045) & (np.abs(y + 0.005) < 0.045) & (hair.vertices[:, 2] > 0)
    assert not before.any()
    style, hair = without_tail(head, *hairs[name])
    free = hair.vertices[hair.uv[:, 1] > 0.5].astype(float)
    height = hull_of(head).height(free)
    assert np.quantile(height, 0.005) > -0.003
    on_skull = free[:, 1] > 0.06
    most = style.layer_mm + 12 if style.comb != "out" else style.top_mm + 15
    assert np.quantile(height[on_skull], 0.995) < most / 1000


def test_the_same_numbers_give_the_same_hair_of_bounded_size_or_none(
    head: HeadMesh, monkeypatch: Patch
) -> None:
    with monkeypatch.context() as limited:
        limited.setattr("facerf_cli.synth.head.hair.MAX_VERTICES", 25_000)
        many = replace(draw_style(np.random.default_rng(5), "long"), wisps=4_000, segments=7)
        assert 24_000 < len(grow_hair(head, many, np.random.default_rng(5)).vertices) <= 25_000
    first, second, other = (grown(head, "short", seed)[1] for seed in (3, 3, 4))
    for name in ("vertices", "normals", "triangles", "uv", "tangents"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)
    drawn = [draw_style(np.random.default_rng(seed)).name for seed in range(200)]
    assert set(drawn) == set(STYLES)
    bald = drawn.index("bald")
    assert draw_hair(head, np.random.default_rng(bald))[0] is None
    hair, style = draw_hair(head, np.random.default_rng(drawn.index("buzz")))
    assert hair is not None and style.name == "buzz"
    refused(ValueError, "choose one of bald, ", draw_style, np.random.default_rng(0), "mullet")
    assert grow_beard(head, {"beard": 0.0, "moustache": 0.0, "goatee": 0.0}, np.random.default_rng(1)) is None


def test_outer_triangles_face_outward_and_covers_lie_where_roots_are(hairs: Hairs) -> None:
    _, hair = hairs["short"]
    a, b, c = (hair.vertices[hair.triangles[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    outward = (facet * hair.normals[hair.triangles[:, 0]]).sum(-1) / np.linalg.norm(facet, axis=-1)
    assert (outward > 0).mean() > 0.95
    style, hair = hairs["buzz"]
    roots = hair.vertices[hair.uv[:, 1] == 0].astype(float)
    assert scalp_cover(cylinder_uv(roots), style).mean() > 0.8
    assert (scalp_cover(np.array([[0.5, 0.3], [0.3, 0.5], [0.5, 0.9]]), style) == 0).all()


def test_longer_cuts_reach_lower_and_tied_hair_ends_in_its_knot(head: HeadMesh, hairs: Hairs) -> None:
    bald = draw_style(np.random.default_rng(0), "bald")
    assert len(grow_hair(head, bald, np.random.default_rng(0)).vertices) == 0
    lowest = [hairs[name][1].vertices[:, 1].min() for name in ("buzz", "bob", "long")]
    assert lowest[0] > lowest[1] > lowest[2]
    random = np.random.default_rng(3)
    style = replace(draw_style(random, "tied"), tail="", frizz_mm=0.0, curl_mm=0.0)
    hair = grow_hair(head, style, random)
    tips = hair.vertices[hair.uv[:, 1] == 1].astype(float)
    knot = np.median(tips, axis=0)
    assert abs(knot[1] - style.knot_mm / 1000) < 0.01 and knot[2] < -0.06
    assert (np.linalg.norm(tips - knot, axis=-1) < 0.015).mean() > 0.95
    assert hull_of(head).height(hair.vertices.astype(float)).max() < 0.02


@pytest.mark.parametrize("tail", ["ponytail", "bun", "braids"])
def test_tails_hang_where_they_are_tied(head: HeadMesh, tail: str) -> None:
    paths, normals = tail_paths(tail, head.vertices, hull_of(head), 0.06, np.random.default_rng(4))
    assert paths.shape == normals.shape and paths.shape[1:] == (ROWS, 3)
    assert np.isfinite(paths).all()
    first, last = paths[:, 0].mean(0), paths[:, -1]
    if tail == "braids":
        assert {-1.0, 1.0} == set(np.sign(paths[:, 0, 0])) and np.abs(paths[:, 0, 0]).min() > 0.05
        assert last[:, 1].max() < -0.15 and np.ptp(last[last[:, 0] > 0], axis=0).max() < 0.03
    else:
        assert first[2] < -0.07 and hull_of(head).height(paths.reshape(-1, 3)).min() > -0.03
        assert (last[:, 1].mean() < -0.05) == (tail == "ponytail")


FULL = {"beard": 1.0, "moustache": 1.0, "goatee": 0.0}


def test_a_full_beard_covers_chin_and_jaw_and_leaves_lips_and_cheeks_free(head: HeadMesh) -> None:
    beard = grow_beard(head, FULL, np.random.default_rng(1))
    assert beard is not None
    assert (beard.label == class_index("beard")).all() and (beard.part == PARTS.index("hair")).all()
    roots = beard.vertices[beard.uv[:, 1] == 0].astype(float)
    assert roots[:, 1].max() < 0.04 and roots[:, 1].min() > -0.13
    chin, jaw = roots[np.abs(roots[:, 0]) < 0.02], roots[np.abs(roots[:, 0]) > 0.045]
    assert (chin[:, 1] < -0.05).sum() > 200 and len(jaw) > 400
    lips = np.linalg.norm(roots - (LANDMARKS_M[51] + LANDMARKS_M[57]) / 2, axis=-1) < 0.006
    cheeks = (np.abs(np.abs(roots[:, 0]) - 0.035) < 0.008) & (np.abs(roots[:, 1] - 0.005) < 0.008)
    assert lips.sum() < 5 and cheeks.sum() < 0.01 * len(roots)
    assert (hull_of(head).height(beard.vertices.astype(float)) > -0.006).mean() > 0.98


@pytest.mark.parametrize(
    ("traits", "low", "high"), [({"beard": 0.0}, -0.04, 0.01), ({"moustache": 0.0}, -0.13, -0.01)]
)
def test_moustache_and_beard_are_separate(head: HeadMesh, traits: dict, low: float, high: float) -> None:
    found = grow_beard(head, FULL | traits, np.random.default_rng(1))
    assert found is not None
    middle = found.vertices[(found.uv[:, 1] == 0) & (np.abs(found.vertices[:, 0]) < 0.015)]
    assert middle[:, 1].min() > low and middle[:, 1].max() < high


def test_lashes_stand_on_both_lids_of_both_eyes() -> None:
    lashes = grow_lashes(LANDMARKS_M, np.random.default_rng(1))
    roots, tips = (lashes.vertices[lashes.uv[:, 1] == end] for end in (0, 1))
    for ids, upward in (
        ((36, 37, 38, 39), 1),
        ((39, 40, 41, 36), -1),
        ((42, 43, 44, 45), 1),
        ((45, 46, 47, 42), -1),
    ):
        lid = LANDMARKS_M[list(ids)]
        near = np.linalg.norm(roots[:, None] - lid, axis=-1).min(1) < 0.008
        assert near.sum() > 40
        over = np.abs(tips[:, 0] - lid[:, 0].mean()) < 0.008
        rise = tips[over, 1] - lid[1:3, 1].mean()
        assert (rise * upward > 0.001).sum() > 10
    assert tips[:, 2].mean() > roots[:, 2].mean() + 0.002


def test_a_hand_touches_the_head_from_outside(head: HeadMesh) -> None:
    for seed in range(4):
        whole = draw_hand(head, np.random.default_rng(seed))
        hand = whole.vertices[whole.label == class_index("hand")].astype(float)
        height = hull_of(head).height(hand)
        assert 0.001 < height.min() < 0.03 and np.ptp(hand[:, 1]) > 0.08
        assert (whole.label == class_index("garment")).any()


def test_a_microphone_stands_before_the_mouth_and_earrings_hang_from_the_lobes(head: HeadMesh) -> None:
    microphone = draw_microphone(np.random.default_rng(2))
    top = microphone.vertices[microphone.vertices[:, 1].argmax()]
    assert (
        abs(top[0]) < 0.08
        and -0.12 < top[1] < -0.03
        and hull_of(head).height(top[None].astype(float))[0] > 0.01
    )
    lobes = [np.array([-0.075, -0.02, -0.01]), np.array([0.075, -0.02, -0.01])]
    for seed in range(6):
        rings = draw_earrings(lobes, np.random.default_rng(seed))
        for lobe in lobes:
            assert np.linalg.norm(rings.vertices - lobe, axis=-1).min() < 0.02
        assert (rings.label == class_index("ears")).all() and rings.vertices[:, 1].max() < 0.0
