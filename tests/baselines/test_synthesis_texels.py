"""What a photo's texture tells the baselines."""

import torch

from facerf_cli.baselines.synthesis import SIDE, coarse, shrunk, with_detail
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import region_mask

T = 128


def face_of(texture: torch.Tensor, visible: torch.Tensor | None = None) -> FaceTexture:
    normals = torch.zeros(3, T, T)
    normals[2] = 1
    return FaceTexture(texture, torch.ones(T, T) if visible is None else visible, normals)


def test_unseen_texels_do_not_bleed_into_coarse_ones() -> None:
    texture, visible = torch.full((3, T, T), 0.4), torch.ones(T, T)
    texture[:, :, 64:] = 9.0
    visible[:, 63:] = 0
    radiance, trust = coarse(face_of(texture, visible))
    assert torch.allclose(radiance[:, trust > 0], torch.tensor(0.4))
    assert not trust[:, 32:].any() and trust.shape == (SIDE, SIDE)
    assert float((trust * region_mask("eyes", SIDE)).max()) < 0.3


def test_all_of_the_detail_is_the_true_albedo_where_it_is_bright() -> None:
    true = 0.2 + 0.3 * torch.rand(3, T, T)
    shading = torch.full((3, T, T), 2.0)
    shading[:, :, :10] = 0.0
    guess = torch.full((3, T, T), 0.3).log()
    visible = torch.ones(T, T)
    visible[100:] = 0
    face = face_of(true * shading + 0.1, visible)
    shining = torch.full_like(shading, 0.1)
    whole = with_detail(guess, face, shading, shining, 1.0).exp()
    lit = whole[:, :100, 10:]
    assert float((lit - true[:, :100, 10:]).abs().mean()) < 0.2 * float((true - 0.3).abs().mean())
    assert torch.allclose(whole[:, 100:], guess[:, 100:].exp())  # not seen
    assert torch.allclose(whole[:, :100, :10], guess[:, :100, :10].exp(), atol=1e-4)  # black: nothing to see
    half = with_detail(guess, face, shading, shining, 0.5)
    assert torch.allclose(half - guess, 0.5 * (whole.log() - guess), atol=1e-5)
    assert torch.equal(with_detail(guess, face, shading, shining, 0.0), guess)


def test_no_albedo_is_above_one() -> None:
    guess = torch.full((3, T, T), 0.5).log()
    found = with_detail(
        guess, face_of(torch.full((3, T, T), 7.0)), torch.ones(3, T, T), torch.zeros(3, T, T), 1.0
    )
    assert float(found.max()) <= 0
    assert shrunk(found).shape == (3, SIDE, SIDE)


def test_a_black_photo_is_no_trouble() -> None:
    guess, black = torch.full((3, T, T), 0.5).log(), torch.zeros(3, T, T)
    assert with_detail(guess, face_of(black), black, black, 0.5).isfinite().all()
