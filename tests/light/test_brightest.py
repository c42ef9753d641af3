import torch

from facerf_cli.light.sphere import RigLight, brightest_direction, rig_directions


def _angle_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(torch.rad2deg(torch.dot(a, b).clamp(-1, 1).acos()))


def test_one_light_is_where_it_is() -> None:
    rig = rig_directions()
    for light in (0, 40, 77, 149):
        weights = torch.full((150, 3), 0.01)
        weights[light] = torch.tensor([1.0, 0.8, 0.6])
        assert _angle_deg(brightest_direction(RigLight(rig, weights)), rig[light]) < 2


def test_a_light_shared_by_two_lights_lies_between_them_and_beats_a_brighter_single_one() -> None:
    rig = rig_directions()
    near = (rig @ rig[60]).topk(3).indices
    weights = torch.zeros(150, 3)
    weights[near] = 0.7
    weights[(rig @ rig[60]).argmin()] = 1.0
    found = brightest_direction(RigLight(rig, weights))
    assert _angle_deg(found, torch.nn.functional.normalize(rig[near].sum(0), dim=0)) < 4


def test_green_counts_more_than_blue_and_darkness_has_no_direction() -> None:
    rig = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    light = RigLight(rig, torch.tensor([[0.0, 1.0, 0], [0, 0, 1.0]]))
    assert brightest_direction(light)[0] > 0.99
    assert (brightest_direction(RigLight(rig, torch.zeros(2, 3))) == 0).all()


def test_front_only_leaves_out_what_is_behind() -> None:
    light = RigLight(torch.tensor([[0.0, 0, -1], [0, 0.6, 0.8]]), torch.tensor([[5.0] * 3, [1.0] * 3]))
    assert brightest_direction(light)[2] < -0.9
    assert brightest_direction(light, front_only=True)[2] > 0.7
