"""Regions lie where their landmarks say, mirror themselves, and cover the chart once."""

import pytest
import torch

from facerf_cli.face.topology import LANDMARK_UV, REGIONS, region_mask

SIDE = 96


def at(mask: torch.Tensor, uv) -> float:
    column, row = (int(c * mask.shape[0]) for c in uv)
    return float(mask[row, column])


@pytest.mark.parametrize("name", REGIONS)
def test_masks_are_symmetric_and_bounded(name):
    mask = region_mask(name, SIDE)
    assert mask.shape == (SIDE, SIDE) and mask.dtype == torch.float32
    assert torch.equal(mask, mask.flip(1))
    assert mask.min() >= 0 and 0.5 < mask.max() <= 1


def test_parts_cover_the_chart_once():
    total = sum(region_mask(part, 256) for part in ("skin", "eyes", "brows", "lips", "nostrils", "neck"))
    assert torch.allclose(total, torch.ones(256, 256), atol=1e-6)


@pytest.mark.parametrize(
    "name, inside, outside",
    [
        ("eyes", LANDMARK_UV[36:42].mean(0), LANDMARK_UV[19]),
        ("eyes", LANDMARK_UV[42:48].mean(0), LANDMARK_UV[27]),
        ("brows", LANDMARK_UV[24] + [0, 0.01], LANDMARK_UV[27]),
        ("lips", LANDMARK_UV[[51, 62]].mean(0), LANDMARK_UV[33]),
        ("mouth", LANDMARK_UV[[62, 66]].mean(0), LANDMARK_UV[[57, 66]].mean(0)),
        ("nostrils", LANDMARK_UV[31] + [0.0145, -0.022], LANDMARK_UV[30]),
        ("neck", LANDMARK_UV[4] + [0, 0.1], LANDMARK_UV[8] - [0, 0.08]),
        ("face", LANDMARK_UV[30], LANDMARK_UV[4] + [-0.08, 0.08]),
        ("skin", (LANDMARK_UV[30] + LANDMARK_UV[2]) / 2, LANDMARK_UV[57] - [0, 0.01]),
    ],
)
def test_masks_lie_where_the_landmarks_say(name, inside, outside):
    mask = region_mask(name, 256)
    assert at(mask, inside) > 0.6 and at(mask, outside) < 0.05


def test_an_unknown_region_is_named():
    with pytest.raises(ValueError, match="ears"):
        region_mask("ears", 8)
