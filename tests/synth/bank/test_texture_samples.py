"""Fields of baked heads, and what is painted before the face."""

import torch
import torch.nn.functional as F

from facerf_cli.synth.appearance.skin import draw_skin
from facerf_cli.synth.bank.texture_samples import lid_shadows, with_occluders
from facerf_cli.synth.random_fields import Window, mask
from facerf_cli.synth.shading import Skin

SIDE = 128


def _through(*directions: tuple[float, float, float]) -> torch.Tensor:
    return lid_shadows(F.normalize(torch.tensor(directions, dtype=torch.float32), dim=-1), SIDE)


def test_light_from_the_front_reaches_the_eyes_and_a_mirrored_one_casts_the_mirrored_shadow() -> None:
    opening = mask(Window(SIDE), "eyes", 1.5)[0]
    shadows = _through((0, 0, 1), (0, 0.4, 1), (0, 1, 1), (0, 3, 1))
    lit = (shadows * opening).sum((1, 2)) / opening.sum()
    assert lit[0] > 0.9
    assert (lit.diff() < -0.1).all()
    off = mask(Window(SIDE), "eyes", 1.5)[0, 0] == 0
    assert (_through((1, 1, 0.2), (0, -1, 0.1))[:, off] == 1).all()
    shadow = (1 - _through((0, 1, 1), (0, -1, 1))) * opening
    rows = torch.arange(SIDE)[:, None]
    above, below = (shadow * rows).sum((1, 2)) / shadow.sum((1, 2))
    assert above + 1 < below
    left, right = _through((-0.7, 0.2, 1), (0.7, 0.2, 1))
    assert torch.allclose(left, right.flip(-1), atol=1e-4)


PAINTED_SIDE, FACES = 64, 40


def _covered() -> tuple[Skin, Skin]:
    bare = draw_skin(FACES, PAINTED_SIDE, torch.Generator().manual_seed(0))
    return bare, with_occluders(bare, Window(PAINTED_SIDE), torch.Generator().manual_seed(1))


def test_some_faces_are_covered_by_dark_covers_that_leave_the_mouth_free() -> None:
    bare, covered = _covered()
    changed = (bare.albedo - covered.albedo).abs().amax((1, 2, 3)) > 1e-3
    assert 0.05 < changed.float().mean() < 0.6
    assert covered.albedo.min() > 0 and covered.albedo.max() <= 1
    change = (covered.albedo - bare.albedo).abs().amax((0, 1))
    assert change[: PAINTED_SIDE // 3].max() > 0.05
    assert change[int(0.7 * PAINTED_SIDE) :].max() < 1e-3
    hidden = (covered.roughness - bare.roughness).abs() > 0.01
    assert (covered.albedo.mean(1, keepdim=True)[hidden] < 0.5).float().mean() > 0.9
