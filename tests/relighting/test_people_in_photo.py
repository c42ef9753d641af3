"""People in a photo: composites of people with known answers, and the depth of a person."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.face.view import photo_camera
from facerf_cli.files.read import LinearImage
from facerf_cli.image.strips import Window
from facerf_cli.portrait.find import Face, choose_face
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.portrait.proxy import Proxy
from facerf_cli.raster.camera import PIXEL_CENTRE, project
from facerf_cli.relighting.memory import beside_people, require_people
from facerf_cli.relighting.people_in_photo import PeopleInPhoto, Surface
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.run import memory
from facerf_cli.run.memory import batches
from facerf_cli.work import photos
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import PhotoFace
from tests.refusals import refused

SIZE = (4, 6)
POINTS = np.arange(136.0).reshape(68, 2)


class Grey(float):
    """A light, by the grey of a person under it."""

    original_rgb = None


def greys(*values: float) -> list[Any]:
    return [Grey(value) for value in values]


@dataclass
class Plain:
    """A person of one grey, who covers some columns by a share, before a background of 0.5.

    As photographed they have the background's grey.
    """

    columns: slice
    strength: float

    size_px, nbytes, photo = SIZE, 0, np.full((*SIZE, 3), 0.5)
    own = photo

    @property
    def matte(self) -> np.ndarray:
        matte = np.zeros(SIZE)
        matte[:, self.columns] = self.strength
        return matte

    def alpha_rows(self, rows: slice) -> np.ndarray:
        return self.matte[rows]

    def precompute(self, relit: float, layers: Any) -> Any:
        return relit, layers

    def render(self, window: Window, own: np.ndarray, lights: list[Any]) -> Iterator[dict[str, np.ndarray]]:
        matte = self.matte[window.rows]
        whole = matte[..., None]
        for grey, layers in lights:
            found = {
                "class.skin": matte,
                "depth": grey * (whole > 0),
                "albedo": grey * whole.repeat(3, -1),
            }
            yield {"rgb": np.full(own.shape, grey)} | (found if layers else {})

    def exposure_ev(self, relit: float, rule: str) -> float:
        return relit


def group(background: Any = "photo") -> Any:
    left, right = Plain(slice(0, 2), 1.0), Plain(slice(3, 5), 0.5)
    return PeopleInPhoto([left, right], background)  # type: ignore[list-item]


def test_each_person_is_relit_over_the_photo_and_alpha_and_layers_hold_all() -> None:
    people = group()
    image = people.rendered(RenderRequest(greys(2, 8), ev=1.0))
    assert set(image) == {"rgb"} and people.alpha() is None
    np.testing.assert_allclose(image["rgb"][0, :, 0], [2, 2, 0.25, 0.5 * 8 + 0.125, 0.5 * 8 + 0.125, 0.25])
    people = group("none")
    pixels, alpha = people.rendered(RenderRequest(greys(2, 8)))["rgb"], people.alpha()
    np.testing.assert_allclose(alpha[0], [1, 1, 0, 0.5, 0.5, 0])
    np.testing.assert_allclose((pixels * alpha[..., None])[0, :, 0], [2, 2, 0, 4, 4, 0])
    assert pixels[0, 3, 0] == 8  # not premultiplied
    people = group()
    one, other, both = (people.light_layer(lit) for lit in (greys(1, 3), greys(1, 5), greys(2, 8)))
    np.testing.assert_allclose(one + other, both)
    # Shares and colours add up, before others and the background; no depth lies between two people.
    far, near, faint = Plain(slice(0, 4), 1.0), Plain(slice(3, 5), 0.6), Plain(slice(1, 2), 0.4)
    people = PeopleInPhoto([far, near, faint])  # type: ignore[list-item]
    layers = people.rendered(RenderRequest(greys(2, 8, 4), layers=["all"]))
    for shares in (people.matte, layers["class.skin"]):
        np.testing.assert_allclose(shares[0], [1, 1, 1, 1, 0.6, 0])
    np.testing.assert_allclose(layers["depth"][0, :, 0], [2, 2, 2, 8, 8, 0])
    np.testing.assert_allclose(
        layers["albedo"][0, :, 2], [2, 0.4 * 4 + 0.6 * 2, 2, 0.6 * 8 + 0.4 * 2, 0.6 * 8, 0]
    )
    assert group().exposure_ev([2.0, 8.0], "auto") == 2.0


def test_people_that_do_not_fit_together_are_refused_and_faces_are_fitted_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    faces = [PhotoFace(f"_face{k}", "a.png", Face((k, 0, k + 1, 1), 1.0, POINTS)) for k in range(3)]
    fitted: list[float] = []
    monkeypatch.setattr(photos, "find_people", lambda *_: list(faces))
    monkeypatch.setattr(photos, "head_of", lambda _models, _pixels, face, *_: fitted.append(face.box_px[0]))
    monkeypatch.setattr(photos, "fitted_face", lambda face, *_: face)
    item, image = Item(Path("a.png"), Path("a"), "a"), LinearImage(np.zeros((4, 6, 3), np.float32))
    options = PhotoOptions(Settings(), face="all")
    each = photos.fit_each(item, image, options)
    assert next(each).tag == "_face2" and fitted == [2]
    memory.set_limit(100 << 20)
    refused(InputError, "3 people in one image: needs ... --composite face", require_people, 3, (4, 6))


@pytest.mark.parametrize(("which", "numbers"), [("largest", [1]), ("1", [1]), ("0", [0]), ("all", [0, 1])])
def test_a_chosen_face_keeps_its_number_from_the_left(
    monkeypatch: pytest.MonkeyPatch, which: str, numbers: list[int]
) -> None:
    faces = [Face((k, 0, k + side, side), 1.0, POINTS, number=k) for k, side in ((0, 1), (1, 3))]
    monkeypatch.setattr(photos, "load_models_once", lambda *_: None)
    monkeypatch.setattr(photos, "find_faces", lambda models, photo, which, *_: choose_face(faces, which, "a"))
    item, image = Item(Path("a.png"), Path("a"), "a"), LinearImage(np.zeros((4, 6, 3), np.float32))
    people = photos.find_people(item, image, PhotoOptions(Settings(), face=which), matte=None)
    assert [face.number for face in people] == numbers


def test_people_leave_less_memory_for_lights_at_once() -> None:
    memory.set_limit(1 << 30)
    alone = len(batches(100, 4 << 20))
    with beside_people(8, (400, 600)):
        assert len(batches(100, 4 << 20)) > 2 * alone
    with beside_people(1, (400, 600)):
        assert len(batches(100, 4 << 20)) == alone


def test_a_person_is_drawn_in_its_own_rows_alone() -> None:
    """In a crowd each face would else cost the whole photo."""
    drawn: list[int] = []

    class Below(Plain):
        @property
        def matte(self) -> np.ndarray:
            return super().matte * (np.arange(SIZE[0]) > 1)[:, None]

        def render(self, window: Window, *given: Any) -> Iterator[dict[str, np.ndarray]]:
            drawn.append(window.rows.start)
            return super().render(window, *given)

    people = PeopleInPhoto([Plain(slice(0, 2), 1.0), Below(slice(1, 4), 0.5)])  # type: ignore[list-item]
    render = people.renderer(RenderRequest(greys(0.2, 0.8), {"key": greys(0.2, 0.8)}))
    rows = [render(slice(row, row + 1)) for row in range(SIZE[0])]
    assert drawn == [2, 3]
    for name in ("rgb", "key"):
        assert rows[0][name][0, 1] == pytest.approx(0.2) and rows[2][name][0, 1] == pytest.approx(0.5)


PHOTO_PX = 200, 300  # of the photo
CLASSES_PX = 50, 75  # of the classes
CROP = Crop(100.0, 50.0, 100.0, 64)
HEAD_M, BODY_M = 1.0, 1.2
ROWS = slice(0, PHOTO_PX[0])


@pytest.fixture(scope="module")
def surface() -> Surface:
    """A near card, the head, above a far one, whose upper end it hides; hair and cloth go on at the right."""
    near, far = card(HEAD_M, -0.05, 0.02), card(BODY_M, -0.12, -0.01)
    triangles = torch.tensor([[0, 1, 2], [0, 2, 3]])
    proxy = Proxy.of(torch.cat([near, far]), torch.cat([triangles, triangles + 4]))
    label = torch.zeros(CLASSES_PX, dtype=torch.long)
    label[:30, 20:70], label[30:, 20:70] = class_index("hair"), class_index("garment")
    classes = torch.nn.functional.one_hot(label, len(CLASSES)).permute(2, 0, 1).float()
    person = SimpleNamespace(
        proxy=proxy, fit=SimpleNamespace(crop=CROP), segmentation=SimpleNamespace(classes=classes)
    )
    return Surface(cast(Any, person), PHOTO_PX)


def card(depth_m: float, low: float, high: float) -> torch.Tensor:
    """Corners [4, 3] of a card before the camera, between two heights at the depth of 1 m."""
    corners = [[-0.05, low, -1], [0.05, low, -1], [0.05, high, -1], [-0.05, high, -1]]
    return torch.tensor(corners) * depth_m


def test_depth_and_positions_lie_on_the_surfaces_row_by_row(surface: Surface) -> None:
    """Neither where one hides the other nor beyond them: hair goes on with the head, cloth with the body."""
    depth_m = surface.depth_m(ROWS)[..., 0]
    near, far = (np.abs(depth_m - known) < 1e-3 for known in (HEAD_M, BODY_M))
    assert (near | far)[:, 80:280].all()
    row_of_edge = round(photo_camera(CROP, *PHOTO_PX).cy_px + 0.05 * photo_camera(CROP, *PHOTO_PX).focal_px)
    assert near[:row_of_edge, 140:160].all() and far[row_of_edge:, 140:160].all()  # the cards
    assert near[:112, 200:280].all() and far[128:, 200:280].all()  # beyond them, by classes
    places_px = project(torch.from_numpy(surface.position_m(ROWS)), photo_camera(CROP, *PHOTO_PX))
    x, y = np.meshgrid(*(np.arange(length) + PIXEL_CENTRE for length in PHOTO_PX[::-1]))
    np.testing.assert_allclose(places_px, np.stack([x, y], -1), atol=1e-3)
    np.testing.assert_allclose(surface.depth_m(slice(64, 96)), surface.depth_m(ROWS)[64:96], atol=1e-6)
