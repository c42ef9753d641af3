import torch
import torch.nn.functional as F

from facerf_cli.stage.appearance.window import Window, mask
from facerf_cli.stage.lids import lid_shadows

SIDE = 128


def _through(*directions: tuple[float, float, float]) -> torch.Tensor:
    return lid_shadows(F.normalize(torch.tensor(directions), dim=-1), SIDE)


def test_a_light_from_the_front_reaches_the_eyes_and_steeper_ones_less_and_less() -> None:
    opening = mask(Window(SIDE), "eyes", 1.5)[0]
    shadows = _through((0, 0, 1), (0, 0.4, 1), (0, 1, 1), (0, 3, 1))
    lit = (shadows * opening).sum((1, 2)) / opening.sum()
    assert lit[0] > 0.9
    assert (lit.diff() < -0.1).all()


def test_skin_is_left_alone() -> None:
    off = mask(Window(SIDE), "eyes", 1.5)[0, 0] == 0
    assert (_through((1, 1, 0.2), (0, -1, 0.1))[:, off] == 1).all()


def test_a_light_from_above_shades_the_upper_half_of_the_eye_and_one_from_below_the_lower() -> None:
    opening = mask(Window(SIDE), "eyes", 1.5)[0, 0]
    rows = opening.amax(1).nonzero()[:, 0]
    middle = int(rows.float().mean())
    for y, darker in ((1.0, slice(rows[0], middle)), (-1.0, slice(middle + 1, int(rows[-1]) + 1))):
        shadow = (1 - _through((0, y, 1))[0]) * opening
        assert shadow[darker].sum() > 0.6 * shadow.sum()


def test_a_mirrored_light_casts_the_mirrored_shadow() -> None:
    left, right = _through((-0.7, 0.2, 1), (0.7, 0.2, 1))
    assert torch.allclose(left, right.flip(-1), atol=1e-4)
