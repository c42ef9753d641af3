import pytest
import torch

from facerf_cli.light.estimate import estimate_light
from facerf_cli.light.sphere import rig_directions


def _shaded_ball(lights: int = 24) -> torch.Tensor:
    """Lambert's pictures [L, 3, N] of a ball with a coloured albedo."""
    normals = rig_directions(600)
    normals = normals[normals[:, 2] > 0.1]
    albedo = 0.2 + 0.6 * torch.rand(3, len(normals), generator=torch.Generator().manual_seed(0))
    cosines = (rig_directions(lights) @ normals.T).clamp_min(0)
    return cosines[:, None] * albedo


def test_weights_that_made_a_picture_are_found_again() -> None:
    olats = _shaded_ball()
    weights = torch.zeros(24, 3)
    facing = rig_directions(24)[:, 2].topk(4).indices
    weights[facing] = torch.tensor([[3.0, 2.0, 1.0], [0.5, 0.5, 0.5], [0.0, 1.0, 0.0], [2.0, 0.1, 0.3]])
    picture = torch.einsum("lc,lcn->cn", weights, olats)
    found = estimate_light(olats, picture)
    assert (found >= 0).all()
    remade = torch.einsum("lc,lcn->cn", found, olats)
    assert (remade - picture).norm() < 0.03 * picture.norm()
    assert (found[facing] - weights[facing]).norm() < 0.25 * weights.norm()


def test_a_clipped_and_covered_picture_gives_the_same_light() -> None:
    olats = _shaded_ball()
    weights = torch.full((24, 3), 0.2)
    picture = torch.einsum("lc,lcn->cn", weights, olats)
    spoilt = picture.clone()
    spoilt[:, ::10] = 0.0  # hair
    remade = torch.einsum("lc,lcn->cn", estimate_light(olats, spoilt), olats)
    assert (remade - picture).norm() < 0.05 * picture.norm()


def test_a_black_picture_has_no_light() -> None:
    olats = _shaded_ball()
    assert estimate_light(olats, torch.zeros(3, olats.shape[-1])).abs().max() == 0


@pytest.mark.filterwarnings("error")
def test_where_nothing_is_seen_there_is_no_light() -> None:
    found = estimate_light(torch.zeros(24, 3, 0), torch.zeros(3, 0))
    assert found.shape == (24, 3) and (found == 0).all()
