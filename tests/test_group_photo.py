"""Several people in one image, by compositions with known answers."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from facerf_cli.image.strips import Band, Layer, filled, whole
from facerf_cli.relighting.composition import GroupComposition

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

    size_px, nbytes = SIZE, 0

    def person_and_share(self, relit: float) -> tuple[Band, Band]:
        return np.full((*SIZE, 3), relit).__getitem__, self.matte().__getitem__

    def bands(self, relit: float, ev: float, behind: Any) -> dict[str, Layer]:
        person, matte = np.full((*SIZE, 3), relit), self.matte()
        if self.keeps_alpha:
            return {"rgb": person, "A": matte}
        share = matte[..., None]
        return {"rgb": share * person + (1 - share) * 0.5 * 2**-ev}

    def light_layer(self, relit: float) -> Band:
        return (relit * self.matte()[..., None].repeat(3, -1)).__getitem__

    def layers(self, names: Any, relit: float) -> dict[str, Layer]:
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
    image = filled(group().bands([2.0, 8.0], 1.0, None), *SIZE)
    assert set(image) == {"rgb"}
    np.testing.assert_allclose(image["rgb"][0, :, 0], [2, 2, 0.25, 0.5 * 8 + 0.125, 0.5 * 8 + 0.125, 0.25])


def test_alpha_holds_all_people() -> None:
    image = filled(group(keeps_alpha=True).bands([2.0, 8.0], 0.0, None), *SIZE)
    np.testing.assert_allclose(image["A"][0], [1, 1, 0, 0.5, 0.5, 0])
    np.testing.assert_allclose((image["rgb"] * image["A"][..., None])[0, :, 0], [2, 2, 0, 4, 4, 0])
    assert image["rgb"][0, 3, 0] == 8  # not premultiplied


def test_layers_of_lights_add_up_to_the_image_over_black() -> None:
    people = group()
    one, other, both = (whole(people.light_layer(lit), *SIZE) for lit in ([1.0, 3.0], [1.0, 5.0], [2.0, 8.0]))
    np.testing.assert_allclose(one + other, both)


def test_layers_hold_all_people() -> None:
    layers = filled(group().layers(["albedo"], [2.0, 8.0]), *SIZE)
    np.testing.assert_allclose(layers["person.A"][0], [1, 1, 0, 0.5, 0.5, 0])
    np.testing.assert_allclose(layers["albedo"][0, :, 0], [2, 2, 0, 4, 4, 0])


def test_the_exposure_is_the_first_ones() -> None:
    assert group().exposure_ev([2.0, 8.0], "auto") == 2.0
