import torch

from facerf_cli.synth.appearance.skin import Skin, draw_skin
from facerf_cli.synth.bank.texture_samples import with_occluders
from facerf_cli.synth.random_fields import Window

SIDE, FACES = 64, 40


def _covered() -> tuple[Skin, Skin]:
    bare = draw_skin(FACES, SIDE, torch.Generator().manual_seed(0))
    return bare, with_occluders(bare, Window(SIDE), torch.Generator().manual_seed(1))


def test_some_faces_are_covered_and_most_are_as_they_were() -> None:
    bare, covered = _covered()
    changed = (bare.albedo - covered.albedo).abs().amax((1, 2, 3)) > 1e-3
    assert 0.05 < changed.float().mean() < 0.6


def test_covers_are_dark_leave_the_mouth_free_and_stay_in_bounds() -> None:
    bare, covered = _covered()
    assert covered.albedo.min() > 0 and covered.albedo.max() <= 1
    change = (covered.albedo - bare.albedo).abs().amax((0, 1))
    assert change[: SIDE // 3].max() > 0.05
    assert change[int(0.7 * SIDE) :].max() < 1e-3
    hidden = (covered.roughness - bare.roughness).abs() > 0.01
    assert (covered.albedo.mean(1, keepdim=True)[hidden] < 0.5).float().mean() > 0.9
