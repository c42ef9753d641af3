"""What is said of the faces of a photo."""

from pathlib import Path

from facerf_cli.batch.inputs import Item
from facerf_cli.portrait.find import FaceBox
from facerf_cli.work.photos import _names

ITEM = Item(Path("me.jpg"), Path("out/me"), "me")


def test_one_of_several_faces_has_its_number_and_place() -> None:
    boxes = [FaceBox((10.0, 20.0, 30.0, 60.0), 1.0), FaceBox((100.0, 0.0, 120.4, 20.0), 1.0)]
    assert _names(ITEM, boxes[:1]) == ["me.jpg"]
    assert _names(ITEM, boxes) == [
        "me.jpg: face 0 from the left, at x 20, y 40 px",
        "me.jpg: face 1 from the left, at x 110, y 10 px",
    ]
