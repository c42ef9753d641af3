"""Folders are matched by name, whole: nothing is left out, and nothing of another size compared."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.comparisons import compare_images
from facerf_cli.evaluation.folders import CaseFiles, case_of, match_cases, write_cases
from facerf_cli.evaluation.measure import Case, Comparison, measure
from facerf_cli.evaluation.options import CompareOptions, Measures, NamedPath
from facerf_cli.files.write import write_exr
from facerf_cli.image.colour import srgb_to_linear
from tests.refusals import refused

OUT = Path("out")
NAMES = ("anna/one", "anna/two", "bert/one")
SHAPE = (6, 9, 3)


def image(name: str) -> np.ndarray:
    """An image of a name, exact in half floats and in 8 bits of linear light."""
    return np.random.default_rng(len(name) + ord(name[0])).integers(0, 256, SHAPE).astype(np.float32) / 256


def match(methods: list[Path], truth: Path, **more: Path) -> list[CaseFiles]:
    folders = tuple(NamedPath(folder.name, folder) for folder in methods)
    return match_cases(CompareOptions(OUT, methods=folders, truth=truth, **more))


def compare(files: CaseFiles) -> Comparison:
    no_bench: Any = None  # folders are compared without networks
    (found,) = compare_images(CompareOptions(OUT), no_bench, [files])
    return found


def save(path: Path, pixels: np.ndarray, alpha: np.ndarray | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        write_exr(path, pixels, alpha)
    elif path.suffix == ".npy":
        np.save(path, pixels)
    else:
        Image.fromarray(pixels.astype(np.uint8)).save(path)


@pytest.fixture
def truths(tmp_path: Path) -> Path:
    for name in NAMES:
        save(tmp_path / f"truth/{name}.exr", image(name))
    (tmp_path / "truth/notes.txt").write_text("no picture")
    return tmp_path / "truth"


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    for name, suffix in zip(NAMES, (".npy", ".exr", ".png"), strict=True):
        pixels = image(name)
        save(tmp_path / f"ours/{name}{suffix}", pixels * 256 if suffix == ".png" else pixels)
    return tmp_path / "ours"


def test_an_image_is_no_person_and_folders_that_are_none_are_refused(truths: Path, ours: Path) -> None:
    described = {"b": Case("b", "bo", {"age": 3.0})}
    assert [case_of(name, described).person for name in ("a", "b", "anna/1/2")] == ["", "bo", "anna"]
    assert case_of("b", described).facts == {"age": 3.0}
    (truths.parent / "empty").mkdir()
    for predictions, words in (
        ([ours, truths.parent / "empty"], "no images"),
        ([truths], "passed twice"),
    ):
        refused(UsageError, words, match, predictions, truths)


def test_images_of_all_formats_meet_their_truths(truths: Path, ours: Path) -> None:
    pairs = match([ours], truths)
    assert [(pair.case.name, pair.case.person) for pair in pairs] == list(
        zip(NAMES, ("anna", "anna", "bert"), strict=True)
    )
    errors = [measure(compare(pair), Measures())[0].values["mse"] for pair in pairs]
    assert errors[:2] == [0, 0] and errors[2] > 0.01  # a PNG is encoded
    for name in NAMES:
        save(truths.parent / f"theirs/{name}.npy", image(name)[..., 0])  # grey
    both = compare(match([ours, truths.parent / "theirs"], truths)[2])
    assert list(both.predictions) == ["ours", "theirs"] and both.mask.all()
    assert both.predictions["theirs"].shape == SHAPE
    decoded = both.predictions["ours"]
    np.testing.assert_allclose(decoded, srgb_to_linear(image(NAMES[2]) * 256 / 255), atol=1e-5)


def test_all_that_is_missing_or_strange_is_said_in_one_line(truths: Path, ours: Path) -> None:
    (ours / "anna/one.npy").unlink()
    (ours / "anna/two.exr").unlink()
    for number in range(5):
        save(ours / f"carl/{number}.npy", image("c"))
    with pytest.raises(InputError) as caught:
        match([ours], truths)
    line = str(caught.value)
    assert "2 of 3 missing (anna/one, anna/two)" in line and "\n" not in line
    assert "5 without a truth (carl/0, carl/1, carl/2, ...)" in line


def test_two_images_of_one_name_are_refused_and_folders_may_lie_in_the_truths(
    truths: Path, ours: Path
) -> None:
    save(ours / "anna/one.exr", image("a"))
    refused(InputError, "anna/one has the files one.exr and one.npy", match, [ours], truths)
    (ours / "anna/one.exr").unlink()
    ours.rename(truths / "ours")
    assert [pair.case.name for pair in match([truths / "ours"], truths)] == list(NAMES)


def test_masks_are_the_images_values_then_alpha_then_all(truths: Path, ours: Path) -> None:
    alpha = np.full(SHAPE[:2], 0.25, np.float32)
    save(truths / "anna/two.exr", image(NAMES[1]), alpha)
    assert np.allclose(compare(match([ours], truths)[1]).mask, 0.25)
    masks = truths.parent / "masks"
    for name in NAMES:
        save(masks / f"{name}.png", np.full(SHAPE[:2], 51))
    with_masks = [compare(pair).mask for pair in match([ours], truths, masks=masks)]
    assert all(np.allclose(mask, 0.2) for mask in with_masks)
    (masks / "anna/one.png").unlink()
    refused(InputError, "masks: 1 of 3 missing", match, [ours], truths, masks=masks)


def test_facts_of_a_list(truths: Path, ours: Path) -> None:
    path = truths.parent / "facts.csv"
    path.write_text(
        "\ufeffname, person, pose, angle\nanna/one, A, same, 5\nanna/two, A, other,\nbert/one,, same, 7.5\n"
    )
    pairs = match([ours], truths, facts=path)
    assert [pair.case.person for pair in pairs] == ["A", "A", "bert"]
    assert [dict(pair.case.facts) for pair in pairs] == [
        {"pose": "same", "angle": 5.0},
        {"pose": "other"},
        {"pose": "same", "angle": 7.5},
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("person\nA\n", "no column 'name'"),
        ("", "no column 'name'"),
        ("name,person\nanna/one,A\n", "2 of 3 missing (anna/two, bert/one"),
        ("name\nanna/one\nanna/one\n", "anna/one has two lines"),
        ("name,name\na,b\n", "two columns of one name"),
        ("name,pose\nanna/one\n", "do not have 2 cells"),
        ("name\nanna/one\0\n", "facts.csv"),
    ],
)
def test_lists_that_cannot_be_used(truths: Path, ours: Path, text: str, words: str) -> None:
    path = truths.parent / "facts.csv"
    path.write_text(text)
    refused(InputError, words, match, [ours], truths, facts=path)


def test_files_that_hold_no_image(truths: Path, ours: Path) -> None:
    path = ours / "anna/one.npy"
    for content, words in (
        (np.zeros(SHAPE, int), "values of type int64"),
        (np.zeros((2, *SHAPE), np.float32), "array of shape"),
        (np.full(SHAPE, np.nan, np.float32), "NaN"),
        (np.array([Path("x")], object), "not an array"),
    ):
        np.save(path, content, allow_pickle=True)
        with pytest.raises(InputError, match=rf"anna/one\.npy: .*{words}"):
            compare(match([ours], truths)[0])
    path.write_text("text")
    refused(InputError, "anna/one.npy: not an array", compare, match([ours], truths)[0])


def test_a_folder_of_cases_has_its_truths_masks_sources_and_facts(truths: Path, ours: Path) -> None:
    folder = truths.parent / "cases"
    for kind in ("source", "mask"):
        for name in NAMES:
            save(folder / f"{kind}/{name}.exr", np.full(SHAPE, 0.5, np.float32))
    truths.rename(folder / "truth")
    write_cases(folder / "cases.csv", [Case(name, "A", {"pose": "p", "yaw_deg": -0.1}) for name in NAMES])
    found = compare(match([ours], folder)[0])
    assert found.case == Case("anna/one", "A", {"pose": "p", "yaw_deg": -0.1})
    assert found.source is not None and (found.source == 0.5).all() and (found.mask == 0.5).all()
