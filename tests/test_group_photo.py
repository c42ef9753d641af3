"""Several people in one image, by compositions with known answers."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from facerf_cli.composite import RelitRows
from facerf_cli.group_photo import GroupComposition
from facerf_cli.strips import whole

SIZE = (4, 6)


@dataclass
class Plain:
    """A person of one grey, who covers some columns by a share, before a background of 0.5."""

    columns: slice
    share: float
    keeps_alpha: bool = False

    def matte(self) -> np.ndarray:
        matte = np.zeros(SIZE)
        matte[:, self.columns] = self.share
        return matte

    def person(self, relit: float) -> tuple[np.ndarray, np.ndarray]:
        return np.full((*SIZE, 3), relit), self.matte()

    def rows(self, relit: float, ev: float, behind: Any) -> RelitRows:
        person, matte = self.person(relit)
        if self.keeps_alpha:
            return RelitRows(person, matte)
        share = matte[..., None]
        return RelitRows(share * person + (1 - share) * 0.5 * 2**-ev)

    def light_layer(self, relit: float) -> np.ndarray:
        person, matte = self.person(relit)
        return person * matte[..., None]

    def layers(self, names: Any, relit: float) -> dict[str, np.ndarray]:
        return {
            "person.A": self.matte(),
            "albedo": np.full((*SIZE, 3), relit) * (self.matte() > 0)[..., None],
        }

    def exposure_ev(self, relit: float, rule: str) -> float:
        return relit


def group(keeps_alpha: bool = False) -> Any:
    left, right = Plain(slice(0, 2), 1.0, keeps_alpha), Plain(slice(3, 5), 0.5)
    return GroupComposition([left, right])  # type: ignore[list-item]


def test_each_person_is_relit_and_the_background_is_the_first_ones() -> None:
    image = group().rows([2.0, 8.0], 1.0, None).whole()
    assert image.alpha is None
    np.testing.assert_allclose(image.pixels[0, :, 0], [2, 2, 0.25, 0.5 * 8 + 0.125, 0.5 * 8 + 0.125, 0.25])


def test_alpha_holds_all_people() -> None:
    image = group(keeps_alpha=True).rows([2.0, 8.0], 0.0, None).whole()
    np.testing.assert_allclose(image.alpha[0], [1, 1, 0, 0.5, 0.5, 0])
    np.testing.assert_allclose((image.pixels * image.alpha[..., None])[0, :, 0], [2, 2, 0, 4, 4, 0])
    assert image.pixels[0, 3, 0] == 8  # not premultiplied


def test_layers_of_lights_add_up_to_the_image_over_black() -> None:
    people = group()
    apart = whole(people.light_layer([1.0, 3.0])) + whole(people.light_layer([1.0, 5.0]))
    np.testing.assert_allclose(apart, people.light_layer([2.0, 8.0]))


def test_layers_hold_all_people() -> None:
    layers = group().layers(["albedo"], [2.0, 8.0])
    np.testing.assert_allclose(whole(layers["person.A"])[0], [1, 1, 0, 0.5, 0.5, 0])
    np.testing.assert_allclose(whole(layers["albedo"])[0, :, 0], [2, 2, 0, 4, 4, 0])


def test_the_exposure_is_the_first_ones() -> None:
    assert group().exposure_ev([2.0, 8.0], "auto") == 2.0
