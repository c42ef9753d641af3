"""Warps that move the features of a face."""

import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.synth.bank.parsing import FeatureWarp

_MODEL = load_face_model("builtin")
_MEAN = _MODEL.vertices(torch.zeros(1, len(_MODEL.identity)), torch.zeros(1, len(_MODEL.expression)))
LANDMARKS = _MODEL.landmarks(_MEAN)[0, :, :2] * torch.tensor([1500.0, -1500.0]) + 300  # pixels


def warps() -> list[FeatureWarp]:
    return [FeatureWarp.draw(LANDMARKS, torch.Generator().manual_seed(seed)) for seed in range(20)]


def test_landmarks_go_where_the_image_shows_them() -> None:
    """The image at p is taken from p + shift(p): from the landmark, where it is shown."""
    for warp in warps():
        shown = warp.shown_at(LANDMARKS)
        torch.testing.assert_close(shown + warp.shift(shown), LANDMARKS, rtol=0, atol=0.1)  # pixels


def test_features_move_and_what_is_far_away_stays() -> None:
    moved = torch.stack([(warp.shown_at(LANDMARKS) - LANDMARKS).norm(dim=-1) for warp in warps()])
    extent = float((LANDMARKS.amax(0) - LANDMARKS.amin(0)).max())
    assert 0.01 * extent < moved[:, 17:].mean() < 0.06 * extent
    far = LANDMARKS.mean(0) + torch.tensor([[-3 * extent, 0.0], [2 * extent, 2 * extent]])
    assert max(float(warp.shift(far).abs().max()) for warp in warps()) < 1e-3
