"""`facerf evaluate olat`, `reconstruction`, `transfer` and `geometry` on a tiny dataset and a photo."""

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Settings
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.pairs import read_pairs
from facerf_cli.evaluation import comparisons, people
from facerf_cli.evaluation.folders import read_facts
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.evaluation.people import PhotoFaces, bench_of, methods_of
from facerf_cli.face.fit import load_fit
from facerf_cli.face.head import Head
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from facerf_cli.network import checkpoint
from facerf_cli.network.checkpoint import new_network, save_checkpoint, save_networks, use_form
from facerf_cli.network.features import LightNetwork
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.relighting.models import Models
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import load_models_once
from tests.dataset.dataset_fixture import write_small_dataset
from tests.evaluation.method_doubles import Double
from tests.kinds import Folders, Patch, Said
from tests.own_package import NAME as OWN_NETWORK
from tests.own_package import write_own_package

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Folders) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    write_small_dataset(folder, counts=(1, 0, 2), lights=12, crop_px=64)
    assert main(["relight-dataset", str(folder), "--envmaps", "procedural:3", "--per-subject", "6"]) == 0
    return folder


@pytest.fixture
def doubles(monkeypatch: Patch) -> None:
    """Reconstructions by the photo's own texture, which no network delays."""

    def load(options: EvaluateOptions, photo: PhotoOptions) -> tuple[Double, ...]:
        return (Double("field", models=load_models_once(photo)),)

    monkeypatch.setattr(people, "methods_of", load)


def run(protocol: str, *words: str | Path) -> int:
    return main(["--device", "cpu", "evaluate", protocol, *map(str, words)])


def images(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "images.csv").read_text().splitlines()))


def test_table_1_of_held_out_people(folder: Path, tmp_path: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    assert run("olat", folder, "-o", out, "--every", "4", "--network-alone", "--joint-fit") == 0
    assert "lambert" in capsys.readouterr().out
    found = json.loads((out / "summary.json").read_text())
    assert (found["pictures"], found["persons"]) == (3, 2)
    assert found["methods"] == ["field", "lambert", "composite"]
    held_out = [pair for pair in read_pairs(read_dataset(folder)) if pair.split == "test"][::4]
    assert {row["case"] for row in images(out)} == {f"{p.subject}/{p.index:05d}" for p in held_out}
    assert {group["fact"] for group in found["groups"]} >= {"pose", "turn", "angle", "tone"}
    assert run("olat", folder, "-o", out, "--every", "4", "--network-alone", "--joint-fit") == 0
    assert "results are finished and kept" in capsys.readouterr().err


def test_a_checkpoint_of_another_layout_is_said_once(tmp_path: Path, capsys: Said) -> None:
    layout = {"layout_version": 99, "networks": {"reflectance": {"form": "default"}}}
    save_checkpoint(tmp_path / "other.safetensors", {}, layout)
    words = ["-o", tmp_path / "x", "--against", tmp_path / "other.safetensors"]
    assert run("reconstruction", PHOTO, PHOTO.parents[1] / "docs/pictures/rigs.jpg", *words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "other.safetensors: trained for another UV layout" in line


def test_couples_are_read_from_a_list(tmp_path: Path, capsys: Said, monkeypatch: Patch) -> None:
    for name in ("a.jpg", "b.jpg"):
        shutil.copy(PHOTO, tmp_path / name)
    text = f"{tmp_path / 'a.jpg'}\n{tmp_path / 'b.jpg'}\n"
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    assert run("transfer", "--photos", "-", "-o", tmp_path / "out", "--dry-run") == 0
    assert "a--b" in capsys.readouterr().out


def test_what_a_photos_alpha_leaves_out_is_not_compared(tmp_path: Path, capsys: Said) -> None:
    photo = np.asarray(Image.open(PHOTO).convert("RGB"))
    shown = np.zeros(photo.shape[:2], np.uint8)
    shown[:, 220:] = 255  # beside the nose
    path = tmp_path / "half.png"
    Image.fromarray(np.dstack([photo, shown])).save(path)
    photo_options = PhotoOptions(Settings(device="cpu"))
    made, models = bench_of(EvaluateOptions(tmp_path), photo_options), load_models_once(photo_options)
    whole, half = (next(PhotoFaces(()).faces(Item(x, x, x.stem), made)) for x in (PHOTO, path))
    seen, part = whole.fit_with(models), half.fit_with(models)
    crop = part.fit.crop
    column = crop.to_photo(np.stack([np.arange(crop.size_px) + 0.5] * 2, -1))[:, 0]
    left, right = column < 215, column > 225
    assert seen.mask[:, left].max() == 1 and part.mask[:, left].max() == 0
    np.testing.assert_allclose(part.mask[:, right], seen.mask[:, right], atol=0.01)
    assert part.head.face.visible.sum() < 0.8 * seen.head.face.visible.sum()
    mean = replace(models, face=models.face.pose_only())
    assert half.fit_with(mean).mask[:, left].max() == 0
    shown[:, 220:], shown[:9, :9] = 0, 255  # alpha that is 0 everywhere is none
    Image.fromarray(np.dstack([photo, shown])).save(path)
    assert run("reconstruction", path, "-o", tmp_path / "out") == 1
    assert f"{path}: " in capsys.readouterr().err


@pytest.mark.usefixtures("doubles")
def test_photos_are_reconstructed_in_their_crops(tmp_path: Path) -> None:
    for protocol, methods in (("reconstruction", {"field"}), ("geometry", {"all components", "mean face"})):
        out = tmp_path / protocol
        assert run(protocol, PHOTO, "-o", out) == 0
        rows = images(out)
        assert {row["method"] for row in rows} == methods
        assert all(float(row["si_mse"]) < 1e-3 and float(row["face_distance"]) < 0.2 for row in rows)
    assert len({row["si_mse"] for row in rows}) == 2  # the mean face is another geometry


@pytest.mark.usefixtures("doubles")
def test_a_folder_is_a_person_whose_photos_are_taken_two_by_two(tmp_path: Path) -> None:
    person = tmp_path / "ann"
    person.mkdir()
    for name in ("a.jpg", "b.jpg"):
        shutil.copy(PHOTO, person / name)
    assert run("transfer", "--photos", person, "-o", tmp_path / "out") == 0
    rows = images(tmp_path / "out")
    assert list(dict.fromkeys(row["case"] for row in rows)) == ["a_by_b", "b_by_a"]
    assert {row["person"] for row in rows} == {"ann"}
    shutil.copy(PHOTO, person / "c.jpg")
    assert run("transfer", "--photos", person, "-o", tmp_path / "odd") == 2


def test_the_papers_numbers_are_measured_as_far_as_there_are_pairs(
    folder: Path, tmp_path: Path, capsys: Said
) -> None:
    for protocol, says in (
        ("olat", "measuring all 1 maps; the paper measured 160"),
        ("reconstruction", "measuring all 12 sources"),
        ("geometry", "measuring all 12 sources"),
    ):
        capsys.readouterr()
        assert run(protocol, folder, "-o", tmp_path / "out", "--preset", "paper", "--dry-run") == 0
        assert says in capsys.readouterr().err
    assert run("reconstruction", PHOTO, "-o", tmp_path / "out", "--preset", "paper", "--dry-run") == 0
    assert not (tmp_path / "out").exists()


def test_one_table_of_facerf_an_own_network_and_a_folder(
    folder: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    """On cases that are frozen without any checkpoint; own networks are forms of an installed package."""
    write_own_package(tmp_path / "site", monkeypatch)
    face = load_fit(read_dataset(folder).fit_path("0001", "C0")).landmarks_px.double().numpy()
    monkeypatch.setattr(people, "find_faces", lambda *_: [face_at(face)])
    monkeypatch.setattr(comparisons, "find_faces", lambda *_: [face_at(face)])
    frozen, theirs, out = (tmp_path / name for name in ("cases", "theirs", "out"))
    assert run("cases", folder, "-o", frozen, "--every", "3") == 0
    listed = read_facts(frozen / "cases.csv")
    held_out = [pair for pair in read_pairs(read_dataset(folder)) if pair.split == "test"][::3]
    assert set(listed) == {f"{pair.subject}/{pair.index:05d}" for pair in held_out}
    for name in listed:
        assert read_image(frozen / f"light/{name}.exr").pixels.shape == (64, 128, 3)
        if listed[name].facts["pose"] != "same pose":  # as from cameras with crops of two sizes
            for kind in ("truth", "mask"):
                path = frozen / f"{kind}/{name}.exr"
                write_exr(path, read_image(path).pixels.repeat(2, 0).repeat(2, 1))
        truth = read_image(frozen / f"truth/{name}.exr").pixels
        write_exr(theirs / f"{name}.exr", np.broadcast_to(truth.mean((0, 1)), truth.shape))
    line = ["--reflectance", "field", "--method", f"mean={theirs}", "-o", out]
    for form, name in ((OWN_NETWORK, "own"), ("my_lab.networks:Same", "other")):
        use_form(form)
        network, own = new_network("reflectance", form, {}), tmp_path / f"{name}.safetensors"
        save_networks(own, {"reflectance": network}, {"layout_version": LAYOUT_VERSION})
        del checkpoint._CLASSES["reflectance", form]
        line += ["--against", own]
        assert run("compare", frozen, *line) == 1 and f"--form {form}" in capsys.readouterr().err
        line += ["--form", form]
    assert run("compare", frozen, *line) == 0
    found = json.loads((out / "summary.json").read_text())
    assert found["methods"] == ["field", "own", "other", "mean"] and found["pictures"] == len(listed)
    assert {group["fact"] for group in found["groups"]} >= {"pose", "turn", "angle", "tone"}
    assert run("olat", folder, "-o", out, "--form", "no_such:Class") == 2
    assert "--form no_such:Class" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("doubles")
def test_people_of_a_dataset_by_every_protocol(folder: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    assert run("reconstruction", folder, "-o", tmp_path / "r", "--every", "6", "--joint-fit") == 0
    assert all(float(row["light_error_deg"]) <= 180 for row in images(tmp_path / "r"))
    two_maps = shutil.copytree(folder, tmp_path / "d", ignore=shutil.ignore_patterns("relit"))
    words = ["--envmaps", "procedural:3", "--envmaps-test", "procedural:3", "--per-subject", "9", "--lazy"]
    assert main(["relight-dataset", str(two_maps), *words]) == 0
    assert run("transfer", two_maps, "-o", tmp_path / "t", "--every", "9", "--joint-fit") == 0
    assert {row["person"] for row in images(tmp_path / "t")} <= {"0001", "0002"}
    dataset = read_dataset(folder)
    cameras = {f"{p.subject}/{p.index:05d}": (p.subject, p.source_camera) for p in read_pairs(dataset)}

    def find(_: object, image: np.ndarray, name: str) -> list[Face]:
        return [face_at(load_fit(dataset.fit_path(*cameras[name])).landmarks_px.double().numpy())]

    monkeypatch.setattr(people, "find_faces", find)
    assert run("geometry", folder, "-o", tmp_path / "g", "--every", "12", "--jobs", "1") == 0
    assert len(images(tmp_path / "g")) == 2


@pytest.mark.usefixtures("doubles")
def test_a_photo_without_a_face_fails_and_no_summary_is_written(tmp_path: Path, capsys: Said) -> None:
    write_exr(tmp_path / "black.exr", np.zeros((80, 60, 3), np.float32))
    assert run("reconstruction", tmp_path / "black.exr", "-o", tmp_path / "out") == 1
    assert "black.exr: no face" in capsys.readouterr().err
    assert not (tmp_path / "out" / "summary.json").exists()


def test_the_papers_estimator_of_light_can_be_chosen(tmp_path: Path, monkeypatch: Patch) -> None:
    """Signed least squares, then features: it reaches every method, and the light of every image."""
    photo = PhotoOptions(Settings(device="cpu"))
    (method,) = methods_of(EvaluateOptions(tmp_path, non_negative=False, refine="features"), photo)
    (plain,) = methods_of(EvaluateOptions(tmp_path), photo)
    assert not method.estimator.non_negative and isinstance(method.estimator.features, LightNetwork)
    assert plain.estimator.non_negative and plain.estimator.features is None
    asked = []

    def estimate(models: Models, head: Head, **given: Any) -> Any:
        asked.append(given["estimator"])
        return SimpleNamespace(light=None)

    monkeypatch.setattr(people, "estimate_light", estimate)
    monkeypatch.setattr(people, "reflectance_of", lambda *given: None)
    method.explain(None)  # type: ignore[arg-type]
    assert asked == [method.estimator]
