"""Beards grow where beards grow, lashes on the lids; things before the face lie outside it."""

import numpy as np
import pytest

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.head.hair import grow_beard, grow_lashes
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, hull_of
from facerf_cli.synth.head.worn import draw_earrings, draw_hand, draw_microphone

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


def test_without_beard_and_moustache_nothing_grows(head: HeadMesh) -> None:
    assert grow_beard(head, {"beard": 0.0, "moustache": 0.0, "goatee": 0.0}, np.random.default_rng(1)) is None


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
