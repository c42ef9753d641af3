"""The outline of a person where the network is unsure of it."""

import torch
from torch import Tensor

from facerf_cli.portrait.classes import CLASSES, class_index
from facerf_cli.portrait.segment import with_outline

_SIDE, _BORDER, _EXTENT_PX = 64, 40, 50.0
_UNSURE = slice(_BORDER - 6, _BORDER + 6)  # columns of which the network is unsure


def _image() -> Tensor:
    """A person of one colour on the left, a background of another on the right."""
    image = torch.tensor([0.7, 0.4, 0.3]).view(3, 1, 1).repeat(1, _SIDE, _SIDE)
    image[:, :, _BORDER:] = torch.tensor([0.3, 0.5, 0.3]).view(3, 1, 1)
    return image


def _classes(person: Tensor) -> Tensor:
    """Classes of a person of hair and skin in equal parts, of which a share [h, w] is seen."""
    classes = torch.zeros(len(CLASSES), _SIDE, _SIDE)
    classes[0] = 1 - person
    classes[[class_index("hair"), class_index("skin")]] = person / 2
    return classes


def _seen(share: float) -> Tensor:
    person = torch.zeros(_SIDE, _SIDE)
    person[:, :_BORDER], person[:, _UNSURE] = 1, share
    return _classes(person)


def test_what_the_network_is_unsure_of_goes_to_the_side_of_its_colours() -> None:
    for share in (0.3, 0.7):
        found = 1 - with_outline(_seen(share), _image(), _EXTENT_PX)[0]
        assert found[:, :_BORDER].min() > 0.85
        assert found[:, _BORDER:].max() < 0.15


def test_what_the_network_is_sure_of_stays() -> None:
    classes = _classes((torch.arange(_SIDE) < _BORDER + 10).float().expand(_SIDE, -1))
    torch.testing.assert_close(with_outline(classes, _image(), _EXTENT_PX)[..., 50:], classes[..., 50:])


def test_colours_that_both_sides_share_leave_it_to_the_network() -> None:
    seen = _seen(0.3)
    even = torch.full((3, _SIDE, _SIDE), 0.5)
    middle = with_outline(seen, even, _EXTENT_PX)[0, :, _BORDER - 1 : _BORDER + 1]
    torch.testing.assert_close(middle, seen[0, :, _BORDER - 1 : _BORDER + 1], atol=0.02, rtol=0)


def test_classes_sum_to_1_and_share_the_person_as_before() -> None:
    found = with_outline(_seen(0.7), _image(), _EXTENT_PX)
    torch.testing.assert_close(found.sum(0), torch.ones(_SIDE, _SIDE))
    torch.testing.assert_close(found[class_index("hair")], found[class_index("skin")])


def test_without_sure_pixels_of_both_sides_nothing_changes() -> None:
    for share in (0.0, 0.5, 1.0):
        classes = _classes(torch.full((_SIDE, _SIDE), share))
        torch.testing.assert_close(with_outline(classes, _image(), _EXTENT_PX), classes)


def test_colours_add_no_islands() -> None:
    classes, image = _seen(0.3), _image()
    island = slice(28, 32), slice(56, 60)
    image[:, *island] = image[:, 0, 0].view(3, 1, 1)
    classes[:, *island] = _classes(torch.full((_SIDE, _SIDE), 0.3))[:, *island]
    found = 1 - with_outline(classes, image, _EXTENT_PX)[0]
    assert found[island].max() <= 0.3
    image[:, 28:32, :60] = image[:, 0, 0].view(3, 1, 1)
    classes[:, 28:32, _BORDER:60] = _classes(torch.full((_SIDE, _SIDE), 0.3))[:, 28:32, _BORDER:60]
    found = 1 - with_outline(classes, image, _EXTENT_PX)[0]
    assert found[island].min() > 0.85  # a strand of hair
