"""A person's matte from a file: it is the matte from end to end."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image
from skimage.data import astronaut as photograph

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.files.read import LinearImage
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import resized
from facerf_cli.main import main
from facerf_cli.portrait.parse import CLASSES
from facerf_cli.relighting.fitting import fit_photo, reflectance_of
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import fit_faces, load_models_once, person_matte, read_matte, read_photo
from tests.exr_layers import exr_layers
from tests.folders import rows as rows_of
from tests.kinds import Folders, Log, Said
from tests.refusals import refused

HEIGHT, WIDTH = 192, 224
CHEAP = ("--reflectance", "field", "--lights", "12", "--light", "70,20", "--format", "exr")
EIGHT_BITS = 0.5 / 255 + 1e-3  # with the step of half floats


def ellipse(shift: float = 0.0, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A soft ellipse around the head, which no network would see."""
    y, x = (np.mgrid[:height, :width] + 0.5) / np.array([height, width]).reshape(2, 1, 1)
    off = np.hypot((x - 0.5 - shift) / 0.4, (y - 0.5) / 0.48)
    return ((1 - off) / 0.05 + 0.5).clip(0, 1).astype(np.float32)


def save(path: Path, matte: np.ndarray, alpha: np.ndarray | None = None) -> Path:
    """Write values as they are, which `write_display` encodes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_display(path, srgb_to_linear(np.repeat(matte[..., None], 3, -1)), 0.0, alpha)
    return path


@pytest.fixture(scope="module")
def given(tmp_path_factory: Folders) -> Path:
    """A folder with two photos of one person, a little apart, and a matte of each in another."""
    folder = tmp_path_factory.mktemp("person")
    for number in range(2):
        pixels = photograph()[10 : 10 + HEIGHT, 110 + 2 * number : 110 + 2 * number + WIDTH]
        linear = srgb_to_linear((pixels / np.float32(255)).astype(np.float32))
        (folder / "plates").mkdir(exist_ok=True)
        write_display(folder / f"plates/me.{number:04d}.png", linear, 0.0)
        save(folder / f"mattes/me.{number:04d}.png", ellipse(0.02 * number))
    return folder


@pytest.fixture
def item(tmp_path: Path) -> Item:
    return Item(tmp_path / "me.png", tmp_path / "out/me", "me")


def facerf(verb: str, *line: object) -> int:
    return main([verb, *map(str, line)])


def test_the_classes_are_completed_inside_the_given_matte(given: Path, tmp_path: Path) -> None:
    photo, matte = given / "plates/me.0000.png", given / "mattes/me.0000.png"
    assert facerf("segment", photo, "--person", matte, "-o", tmp_path) == 0
    layers = exr_layers(tmp_path / "me.0000_segment.exr")
    assert np.abs(layers["person.A"] - ellipse()).max() < EIGHT_BITS
    total = sum(layers[f"class.{name}"] for name in CLASSES[1:])
    assert np.abs(total - ellipse()).max() < 0.01  # half floats


def test_a_relit_person_is_that_of_the_matte_and_another_matte_multiplies_it(
    given: Path, tmp_path: Path
) -> None:
    part = np.ones((HEIGHT, WIDTH), np.float32)
    part[:, : WIDTH // 2] = 0.25
    save(tmp_path / "part.png", part)
    line = (given / "plates/me.0000.png", "--person", given / "mattes", "--light", "70,20", "--format", "exr")
    line = (*line, "--lights", "12", "--background", "none", "--matte", tmp_path / "part.png")
    assert facerf("relight", *line, "-o", tmp_path / "out") == 0
    layers = exr_layers(tmp_path / "out/me_light_70_20.0000.exr")
    assert np.abs(layers["A"] - part * ellipse()).max() < 2 * EIGHT_BITS
    assert (layers["A"] == layers["person.A"]).all()


def test_an_inverted_matte_fails_in_photos_and_shots(given: Path, tmp_path: Path, capsys: Said) -> None:
    photo = given / "plates/me.0000.png"
    for number in range(2):
        save(tmp_path / f"inverted/me.{number:04d}.png", 1 - ellipse(0.02 * number))
    for line in ((photo,), (given / "plates", "--sequence")):
        assert facerf("segment", *line, "--person", tmp_path / "inverted", "-o", tmp_path / "out") == 1
        said = " ".join(capsys.readouterr().err.split())
        assert "inverted" in said and "me.0000.png" in said
    assert not list((tmp_path / "out").glob("*_person.png"))


def test_frames_of_a_sequence_are_rated_and_landmarks_off_the_face_fail_it(
    given: Path, tmp_path: Path, capsys: Said
) -> None:
    line = ("segment", given / "plates", "--sequence")
    assert facerf(*line, "-o", tmp_path / "out") == 0
    rows = list(rows_of(tmp_path / "out").values())
    assert [row["certainty"] for row in rows] == ["sure", "sure"]
    points = read_landmarks(tmp_path / "out/me.0000_landmarks.json")
    (tmp_path / "half.json").write_text(json.dumps((points / 2).tolist()))
    capsys.readouterr()
    assert facerf(*line, "--landmarks", tmp_path / "half.json", "-o", tmp_path / "half") != 0
    said = " ".join(capsys.readouterr().err.split())
    assert "half.json" in said and "0.50" in said


def test_the_portrait_field_is_of_the_given_person() -> None:
    options = PhotoOptions(Settings(device="cpu"))
    models, photo = load_models_once(options), head_photo()
    face = fit_faces(Item(Path("me.png"), Path("me"), "me"), photo, options)[0]
    head = fit_photo(models, photo.pixels, face.found.landmarks_px)  # type: ignore[attr-defined]
    field = reflectance_of(models, head, "portrait", True, photo=photo.pixels, matte=ellipse())
    assert isinstance(field, PortraitField)
    person = field.person
    assert (person.segmentation.matte == ellipse()).all()
    square = person.square.apply(np.dstack([ellipse()] * 3))[..., 0]
    inside = person.square.valid(HEIGHT, WIDTH) > 0
    assert np.abs(1 - person.classes[0].numpy() - square)[inside].mean() < 0.02


def test_a_stack_holds_the_given_matte_at_its_size(given: Path, tmp_path: Path) -> None:
    line = ("--person", given / "mattes", "--lights", "0,0", "--size", "112", "-o", tmp_path)
    assert facerf("predict-olat", given / "plates/me.0000.png", *line) == 0
    seen = read_olat_header(tmp_path / "me.0000_olat.exr").seen
    assert np.abs(seen - resized(ellipse(), 96, 112)).max() < EIGHT_BITS
    stack = (tmp_path / "me.0000_olat.exr", "--person", given / "mattes/me.0000.png")
    assert facerf("relight", *stack, *CHEAP, "-o", tmp_path / "again") == 1


def head_photo() -> LinearImage:
    pixels = photograph()[10 : 10 + HEIGHT, 110 : 110 + WIDTH]
    return LinearImage(srgb_to_linear((pixels / np.float32(255)).astype(np.float32)))


def test_what_the_matte_leaves_out_is_not_taken_for_skin(tmp_path: Path, item: Item) -> None:
    photo, half = head_photo(), np.ones((HEIGHT, WIDTH), np.float32)
    half[:, : WIDTH // 2] = 0
    visible = []
    for name, matte in (("white", np.ones_like(half)), ("half", half)):
        options = PhotoOptions(Settings(device="cpu"), person=save(tmp_path / f"{name}.png", matte))
        visible.append(fit_faces(item, photo, options)[0].head.face.visible)
    plain = fit_faces(item, photo, PhotoOptions(Settings(device="cpu")))[0].head.face.visible
    assert torch.equal(visible[0], plain)
    assert 0.2 * plain.sum() < visible[1].sum() < 0.8 * plain.sum()


def test_each_frame_of_a_sequence_has_its_own_matte(given: Path, tmp_path: Path, capsys: Said) -> None:
    line = (given / "plates", "--sequence", "--person", given / "mattes")
    assert facerf("relight", *line, "--light", "70,20", "--format", "exr", "-o", tmp_path) == 0
    assert facerf("segment", *line, "-o", tmp_path) == 0
    for number in range(2):
        frame = f"{number:04d}"
        relit = exr_layers(tmp_path / f"me_light_70_20.{frame}.exr")["person.A"]
        cut = exr_layers(tmp_path / f"me.{frame}_segment.exr")["person.A"]
        for found in (relit, cut):
            assert np.abs(found - ellipse(0.02 * number)).max() < EIGHT_BITS
    mattes = save(tmp_path / "few/me.0000.png", ellipse()).parent
    line = (given / "plates", "--sequence", "--person", mattes)
    assert facerf("segment", *line, "-o", tmp_path / "again") == 1
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("--person has no") == 1 and str(mattes / "me.0001") in said.replace(" ", "")
    assert (tmp_path / "again/me.0000_segment.exr").is_file()


@pytest.mark.parametrize("name", ["plate.exr", "cut.png"])
def test_alpha_that_is_0_everywhere_over_colour_is_none(tmp_path: Path, name: str, caplog: Log) -> None:
    """A renderer's plate in EXR holds colour that alpha 0 has not multiplied; a PNG's never is."""
    colour = np.linspace(0.25, 0.75, 5 * 4 * 3, dtype=np.float32).reshape(5, 4, 3)
    path, options = tmp_path / name, PhotoOptions(Settings())
    for opaque in ((0, 0, 0), (0, 0, 1)):
        alpha = np.resize(np.array(opaque, np.float32), (5, 4))
        spec = oiio.ImageSpec(4, 5, 4, "half" if path.suffix == ".exr" else "uint16")
        spec.attribute("oiio:UnassociatedAlpha", 1)
        stream = oiio.ImageOutput.create(str(path))
        assert stream.open(str(path), spec)
        assert stream.write_image(np.dstack([colour, alpha]))
        stream.close()
        caplog.clear()
        photo = read_photo(Item(path, tmp_path / "out", "me"), options)
        frame = read_photo(Item(path, tmp_path / "out", "me"), options, in_shot=True)
        assert frame.alpha is not None and (frame.alpha == alpha).all()
        assert (photo.pixels == frame.pixels).all() and photo.pixels.min() > 0.04
        said = f"{path}: transparent everywhere"
        assert (photo.alpha is None) == (said in caplog.text) == (not alpha.any())


@pytest.mark.parametrize(
    ("mode", "white", "said"),
    [
        ("L", 1, True),  # 0 and 1 of 8 bits
        ("I;16", 1, True),
        ("P", 1, True),  # an index, whose colour is Pascal VOC's of people
        ("RGB", (255, 0, 0), True),
        ("1", 1, False),
        ("L", 255, False),
    ],
)
def test_a_label_is_read_as_white(
    tmp_path: Path, item: Item, mode: str, white: Any, said: bool, caplog: Log
) -> None:
    mask, path = Image.new(mode, (WIDTH, HEIGHT)), tmp_path / "mask.png"
    if mode == "P":
        mask.putpalette((0, 0, 0, 192, 128, 128))
    mask.paste(white, (20, 0, 100, HEIGHT))
    mask.save(path)
    photo, truth = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
    truth[:, 20:100] = 1
    matte = person_matte(item, photo, PhotoOptions(Settings(), person=path))
    assert (matte == truth).all()
    assert (f"{path}: contains black and one colour" in caplog.text) == said
    if mode in ("L", "I;16", "1"):
        assert (read_matte(item, path, (HEIGHT, WIDTH)) == truth).all()


@pytest.mark.parametrize("levels", [(0, 1, 2), (0, 100, 229), (100, 100, 100)])
def test_a_matte_that_is_nowhere_white_is_none(tmp_path: Path, item: Item, levels: tuple[int, ...]) -> None:
    """Labels of several classes, and greys, do not say who the person is; in a shot a frame may be faint."""
    stripes = np.resize(np.array(levels, np.uint8), (HEIGHT, WIDTH))
    path, photo = tmp_path / "grey.png", np.zeros((HEIGHT, WIDTH, 3))
    Image.fromarray(stripes).save(path)
    options = PhotoOptions(Settings(), person=path)
    refusal = f"grey.png: ... {max(levels)} of 255 ... make it white"
    refused(InputError, refusal, person_matte, item, photo, options)
    faint = person_matte(item, photo, options, in_shot=True)
    assert faint is not None and np.abs(faint - stripes / 255).max() < 1e-6  # of float32
    assert np.abs(read_matte(item, path, (HEIGHT, WIDTH)) - stripes / 255).max() < 1e-6  # a strength


def test_a_black_matte_that_limits_is_said(tmp_path: Path, item: Item, caplog: Log) -> None:
    path = tmp_path / "black.png"
    Image.new("L", (WIDTH, HEIGHT)).save(path)
    for in_shot in (True, False):  # the person may leave a frame
        assert not read_matte(item, path, (HEIGHT, WIDTH), in_shot).any()
        assert (
            f"black.png: the matte is black and masks out all of {item.input_path}" in caplog.text
        ) != in_shot


def test_a_matte_of_the_same_aspect_is_resampled_and_alpha_that_varies_is_one(
    tmp_path: Path, item: Item
) -> None:
    photo, small = np.zeros((HEIGHT, WIDTH, 3)), ellipse(0, HEIGHT // 2, WIDTH // 2)
    options = PhotoOptions(Settings(), person=save(tmp_path / "small.png", small))
    found = person_matte(item, photo, options)
    assert found is not None and found.shape == (HEIGHT, WIDTH)
    assert np.abs(found - resized(small, HEIGHT, WIDTH)).max() < EIGHT_BITS
    assert np.abs(found - ellipse()).mean() < 0.01
    options = PhotoOptions(Settings(), person=save(tmp_path / "wide.png", ellipse(0, 60, 120)))
    refused(InputError, "wide.png: ... 120 x 60 ... 224 x 192", person_matte, item, photo, options)
    options = PhotoOptions(Settings(), person=save(tmp_path / "turned.png", ellipse(0, WIDTH, HEIGHT)))
    refused(InputError, "turned.png: ... upright", person_matte, item, photo, options)
    options = PhotoOptions(Settings(), person=save(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH))))
    refused(InputError, "black.png: ... make it white", person_matte, item, photo, options)
    photo, white = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH), np.float32)
    for name, grey, alpha in (("cut", white, ellipse()), ("opaque", ellipse(), white)):
        options = PhotoOptions(Settings(), person=save(tmp_path / f"{name}.png", grey, alpha))
        found = person_matte(item, photo, options)
        assert found is not None and np.abs(found - ellipse()).max() < EIGHT_BITS


def test_a_matte_of_one_person_is_not_for_all_faces(given: Path, tmp_path: Path, capsys: Said) -> None:
    line = ("--person", given / "mattes", "--face", "all", "-o", tmp_path / "out")
    assert facerf("segment", given / "plates", *line) == 2
    assert "shows one person" in " ".join(capsys.readouterr().err.split())
