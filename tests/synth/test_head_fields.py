import torch
import torch.nn.functional as F

from facerf_cli.synth.bank.texture_samples import lid_shadows
from facerf_cli.synth.random_fields import Window, mask

SIDE = 128


def _through(*directions: tuple[float, float, float]) -> torch.Tensor:
    return lid_shadows(F.normalize(torch.tensor(directions, dtype=torch.float32), dim=-1), SIDE)


def test_a_light_from_the_front_reaches_the_eyes_and_steeper_ones_less_and_less() -> None:
    opening = mask(Window(SIDE), "eyes", 1.5)[0]
    shadows = _through((0, 0, 1), (0, 0.4, 1), (0, 1, 1), (0, 3, 1))
    lit = (shadows * opening).sum((1, 2)) / opening.sum()
    assert lit[0] > 0.9
    assert (lit.diff() < -0.1).all()


def test_skin_is_left_alone() -> None:
    off = mask(Window(SIDE), "eyes", 1.5)[0, 0] == 0
    assert (_through((1, 1, 0.2), (0, -1, 0.1))[:, off] == 1).all()


def test_a_light_from_above_shades_higher_than_one_from_below() -> None:
    opening = mask(Window(SIDE), "eyes", 1.5)[0]
    shadow = (1 - _through((0, 1, 1), (0, -1, 1))) * opening
    rows = torch.arange(SIDE)[:, None]
    above, below = (shadow * rows).sum((1, 2)) / shadow.sum((1, 2))
    assert above + 1 < below


def test_a_mirrored_light_casts_the_mirrored_shadow() -> None:
    left, right = _through((-0.7, 0.2, 1), (0.7, 0.2, 1))
    assert torch.allclose(left, right.flip(-1), atol=1e-4)
