import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.read import read_image
from facerf_cli.files.texts import file_sha256
from facerf_cli.main import main
from facerf_cli.network import checkpoint
from facerf_cli.network.checkpoint import load_checkpoint, load_networks
from facerf_cli.network.files import SHIPPED
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.parse import LANDMARKS
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.proxies import seen_path
from facerf_cli.training import run as training_run
from facerf_cli.training.settings import Adadelta, Constant, PaperWeights, TrainSettings
from tests.dataset.dataset_fixture import write_small_dataset
from tests.folders import rows
from tests.kinds import Folders, Patch, Said
from tests.own_package import FORMS, write_own_package
from tests.training.joint_dataset import write_joint_dataset

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"


def test_a_run_has_its_folder_to_itself(tmp_path: Path, monkeypatch: Patch) -> None:
    held: list[Path] = []

    @contextmanager
    def alone(folder: Path, name: str) -> Iterator[None]:
        held.append(folder)
        yield

    monkeypatch.setattr(training_run, "alone_in", alone)
    assert main(["train", "-o", str(tmp_path / "run"), "--heads-from", "nobody.npz"]) == 1
    assert held == [tmp_path / "run"]


@pytest.mark.slow
def test_the_form_is_apart_from_the_preset(tmp_path: Path) -> None:
    write_small_dataset(tmp_path / "data", counts=(1, 1, 1), lights=30, crop_px=64)
    line = ["--dataset", str(tmp_path / "data"), "--texture-size", "32", "--steps", "1"]
    line += ["--workers", "0"]  # forked from a process that has computed with torch, a worker may hang
    assert main(["train", "-o", str(tmp_path / "run"), "--preset", "tiny", "--form", "paper", *line]) == 0
    networks, metadata = load_networks(tmp_path / "run/last.safetensors", LAYOUT_VERSION)
    assert metadata["networks"]["reflectance"]["form"] == "paper" and "reflectance" in networks


@pytest.mark.slow
def test_the_configuration_of_a_run_repeats_it(run: Path, tmp_path: Path, capsys: Said) -> None:
    """Its weights to the last digit, from nothing but RUN/config.toml; the command line comes first."""
    config, bank = ["--config", str(run / "config.toml")], ["--bank", str(run / "bank")]
    assert "learning_rate = 0.002" in (run / "config.toml").read_text()
    assert main(["train", *config, "-o", str(tmp_path / "again"), *bank]) == 0
    first, again = (load_checkpoint(folder / "last.safetensors")[0] for folder in (run, tmp_path / "again"))
    assert all(torch.equal(again[name], tensor) for name, tensor in first.items())
    line = ["train", *config, "-o", str(tmp_path / "other"), *bank, "--steps", "1", "--learning-rate", "0.5"]
    assert main(line) == 0
    _, metadata = load_checkpoint(tmp_path / "other/last.safetensors")
    assert metadata["training"][-1]["optimizer"]["learning_rate"] == 0.5
    capsys.readouterr()
    assert main(["train", *config]) == 2
    assert "pass --resume" in capsys.readouterr().err


def test_a_configuration_reaches_loss_and_optimizer(tmp_path: Path, monkeypatch: Patch) -> None:
    dataset = write_joint_dataset(tmp_path / "data")
    (tmp_path / "c.toml").write_text("[train.loss]\nphotometric = 0\n")
    line = ["train", "-o", str(tmp_path / "run"), "--preset", "tiny", "--stage", "joint"]
    line += ["--geometry", "landmarks", "--dataset", str(dataset.folder), "--texture-size", "32"]
    assert main([*line, "--steps", "1", "--workers", "0", "--config", str(tmp_path / "c.toml")]) == 0
    (row,) = map(json.loads, (tmp_path / "run/log.jsonl").read_text().splitlines())
    assert row["terms"] == {"photometric": 0.0}
    assert "photometric = 0" in (tmp_path / "run/config.toml").read_text()
    seen: list[TrainSettings] = []
    monkeypatch.setattr(training_run, "run_training", lambda options, training, typed: seen.append(training))
    (tmp_path / "c.toml").write_text(
        "[train]\nstage = 'joint'\ndataset = 'd'\nema-decay = 0\n[train.loss]\nfeatures = 0.1\n"
        "[train.optimizer]\nname = 'Adadelta'\neps = 1e-6\n[train.schedule]\nname = 'Constant'\n"
    )
    assert main(["--config", str(tmp_path / "c.toml"), "train", "-o", str(tmp_path / "run")]) == 0
    (training,) = seen
    assert training.loss == PaperWeights(features=0.1) and training.ema_decay is None
    assert training.optimizer == Adadelta(eps=1e-6) and training.schedule == Constant()


TINY = ["--preset", "tiny", "--heads", "7", "--validate-every", "3", "--device", "cpu"]
TINY += ["--jobs", "1", "--workers", "0"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: Folders) -> Path:
    """A run of four steps on a bank of its own."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", "-o", str(folder), *TINY, "--steps", "4", "--learning-rate", "0.002"]) == 0
    return folder


def steps_of(folder: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (folder / "log.jsonl").read_text().splitlines()]


def test_a_run_by_the_command(run: Path) -> None:
    networks, metadata = load_networks(run / "best.safetensors", LAYOUT_VERSION)
    assert list(networks) == ["reflectance"]
    heads = "7 synthetic heads drawn from builtin (facerf's own (see LICENSE))"
    assert metadata["provenance"]["heads"] == heads
    assert steps_of(run) == [1, 2, 3, 4] and (run / "validation-0000003.png").exists()
    assert metadata["training"][-1]["optimizer"]["learning_rate"] == 0.002
    rows = [json.loads(row) for row in (run / "log.jsonl").read_text().splitlines()]
    assert ["validation" in row for row in rows] == [False, False, True, True]


@pytest.mark.slow
def test_a_run_goes_on_by_the_command_and_is_not_written_over(
    run: Path, tmp_path: Path, capsys: Said
) -> None:
    bank = ["--bank", str(run / "bank")]
    line = ["train", "-o", str(tmp_path / "run"), *TINY, *bank]
    assert main([*line, "--steps", "2"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'run' / 'last.safetensors'}\n"
    assert main([*line, "--steps", "3", "--resume"]) == 0
    assert steps_of(tmp_path / "run") == [1, 2, 3]
    capsys.readouterr()
    assert main([*line, "--steps", "3"]) == 2
    assert "pass --resume" in capsys.readouterr().err
    assert main([*line, "--steps", "4", "--resume", "--mean-face"]) == 2
    assert "the run began with other data" in capsys.readouterr().err


@pytest.mark.parametrize(
    "stage", [pytest.param("geometry", marks=pytest.mark.slow), "light-features", "reflectance", "diffuse-sh"]
)
def test_a_stage_carries_over_the_networks_of_others(run: Path, tmp_path: Path, stage: str) -> None:
    line = ["train", "-o", str(tmp_path / "run"), "--stage", stage, *TINY, "--bank", str(run / "bank")]
    assert main([*line, "--steps", "1", "--start-from", str(run / "last.safetensors")]) == 0
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert set(networks) == {"reflectance", stage.replace("-", "_")}
    assert [leg["steps_done"] for leg in metadata["training"]] == [4, 1]
    before, _ = load_checkpoint(run / "last.safetensors")
    after, _ = load_checkpoint(tmp_path / "run" / "last.safetensors")
    same = all(torch.equal(after[name], tensor) for name, tensor in before.items())
    assert same != (stage == "reflectance")


@pytest.mark.slow
def test_own_networks_and_losses_of_an_installed_package(
    run: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    """They train, are saved, and are refused where --form does not name them."""
    write_own_package(tmp_path / "site", monkeypatch)
    line = ["train", *TINY, "--bank", str(run / "bank"), "--steps", "1"]
    own = ["--form", "my_lab.networks:Darker"]
    assert main([*line, "-o", str(tmp_path / "plain")]) == 0
    assert main([*line, "-o", str(tmp_path / "run"), *own, "--objective", "my_lab.networks:Doubled"]) == 0
    first = [
        json.loads((tmp_path / name / "log.jsonl").read_text().splitlines()[0]) for name in ("plain", "run")
    ]
    assert first[1]["loss"] > 1.2 * first[0]["loss"]  # of other first weights, twice
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert type(networks["reflectance"]).__name__ == "Darker"
    assert metadata["training"][-1]["objective"] == "Doubled"
    monkeypatch.setattr(checkpoint, "_CLASSES", dict(FORMS))
    relight = ["relight", str(PHOTO), "--light", "40,20", "-o", str(tmp_path / "out")]
    relight += ["--checkpoint", str(tmp_path / "run/last.safetensors"), "--reflectance", "field"]
    capsys.readouterr()
    assert main(relight) == 1
    assert "--form my_lab.networks:Darker" in capsys.readouterr().err
    assert main([*relight, *own]) == 0
    assert main([*line, "-o", str(tmp_path / "other"), "--objective", "my_lab.networks:Darker"]) == 2
    assert "not a subclass of facerf_cli.training.texture:TextureObjective" in capsys.readouterr().err


def test_the_mean_faces_fits_are_poses_and_its_runs_have_no_normals(run: Path, tmp_path: Path) -> None:
    line = ["train", "-o", str(tmp_path / "run"), *TINY, "--bank", str(run / "bank"), "--steps", "1"]
    assert main([*line, "--mean-face", "--without-normals"]) == 0
    views = [load_file(run / "bank" / f"views-builtin{kind}" / "00002.safetensors") for kind in ("", "-mean")]
    assert not torch.equal(views[0]["warp"], views[1]["warp"])
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert networks["reflectance"].settings.normals is False
    assert metadata["provenance"]["fitted_with"].startswith("builtin-mean")


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: Folders) -> tuple[list[str], np.ndarray]:
    """Words that relight a photo, and the image that the shipped networks give."""
    folder = tmp_path_factory.mktemp("shipped")
    landmarks_px = find_faces(SHIPPED_NETWORKS.people, read_image(PHOTO).pixels, "astronaut")[0].landmarks_px
    points = folder / "points.json"
    points.write_text(json.dumps(landmarks_px.tolist()))
    line = ["relight", str(PHOTO), "--landmarks", str(points), "--light", "40,20", "--exposure", "0"]
    assert main([*line, "-o", str(folder)]) == 0
    return line, read_image(folder / "astronaut_light_40_20.exr").pixels


def require_served(tmp_path: Path, name: str, shipped: tuple[list[str], np.ndarray]) -> None:
    """Relight a photo with the network that a run trained; the shipped ones give another image."""
    line, image = shipped
    assert main([*line, "--checkpoint", str(tmp_path / "run"), "-o", str(tmp_path / "trained")]) == 0
    relit = read_image(tmp_path / "trained/astronaut_light_40_20.exr").pixels
    assert abs(relit - image).max() > 0.01
    (row,) = rows(tmp_path / "trained").values()
    path = tmp_path / "run/best.safetensors"
    assert row["networks"].pop(name) == {"file": str(path), "sha256": file_sha256(path)}
    assert row["networks"].pop("mediapipe")["file"] == "mediapipe.safetensors"
    assert set(row["networks"]) == {"reflectance", "parsing", "portrait"} - {name}
    assert all(served["file"] == SHIPPED[other].name for other, served in row["networks"].items())


@pytest.mark.slow
def test_the_parsing_network_trains_on_a_bank_of_portraits(
    tmp_path: Path, shipped: tuple[list[str], np.ndarray]
) -> None:
    """Its people are made up here; `tests/synth/bank/test_people.py` has a real one."""
    bank = tmp_path / "bank"
    (bank / "people").mkdir(parents=True)
    save_file({"backgrounds": torch.full((2, 3, 16, 16), 90).byte()}, bank / "backgrounds.safetensors")
    for person in range(5):
        person_of = {
            "images": torch.full((1, 3, 96, 96), 120).byte(),
            "alpha": torch.full((96, 96), 255).byte(),
            "label": torch.ones(96, 96).byte(),
            "landmarks_px": 30 + 36 * torch.rand(LANDMARKS, 2),
        }
        save_file(person_of, bank / "people" / f"photo_{person:05}_0.safetensors")
    line = ["train", "-o", str(tmp_path / "run"), "--stage", "parsing", "--preset", "tiny", "--heads", "5"]
    assert main([*line, "--bank", str(bank), "--steps", "5", "--workers", "0"]) == 0
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert list(networks) == ["parsing"] and "CC0" in metadata["licence"]
    assert metadata["provenance"]["heads"].startswith("synthetic people drawn from builtin")
    require_served(tmp_path, "parsing", shipped)


@pytest.mark.slow
def test_the_portrait_network_trains_on_a_bank_of_people(
    people_folder: Path, tmp_path: Path, shipped: tuple[list[str], np.ndarray]
) -> None:
    """One person, baked and seen, stands for five."""
    bank, baked = tmp_path / "bank", people_folder / "00001_0.safetensors"
    (bank / "people").mkdir(parents=True)
    save_file({"backgrounds": torch.full((2, 3, 16, 16), 90).byte()}, bank / "backgrounds.safetensors")
    for person in range(5):
        path = bank / "people" / f"{person:05}_0.safetensors"
        shutil.copy(baked, path)
        shutil.copy(seen_path(baked), seen_path(path))
    line = ["train", "-o", str(tmp_path / "run"), "--stage", "portrait", "--preset", "tiny", "--heads", "5"]
    assert main([*line, "--bank", str(bank), "--steps", "1", "--workers", "0"]) == 0
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert list(networks) == ["portrait"] and "CC0" in metadata["licence"]
    require_served(tmp_path, "portrait", shipped)


@pytest.mark.slow
def test_the_portrait_network_trains_on_a_dataset(tmp_path: Path, monkeypatch: Patch) -> None:
    # in other processes: tests/dataset/test_portraits.py
    monkeypatch.setattr("facerf_cli.dataset.squares.in_shards", lambda work, items, jobs: work(items))
    dataset = write_small_dataset(tmp_path / "dataset", (1, 1, 0), 1, lights=6, crop_px=192)
    line = ["train", "-o", str(tmp_path / "run"), "--stage", "portrait", "--preset", "tiny", "--workers", "0"]
    assert main([*line, "--dataset", str(dataset.folder), "--steps", "5"]) == 0
    networks, metadata = load_networks(tmp_path / "run" / "last.safetensors", LAYOUT_VERSION)
    assert list(networks) == ["portrait"] and metadata["provenance"]["trained_on"] == "dataset, 1 subjects"


def test_feature_networks_of_another_scale_are_refused(tmp_path: Path, capsys: Said) -> None:
    dataset = write_joint_dataset(tmp_path / "data")
    line = ["train", "--preset", "tiny", "--dataset", str(dataset.folder), "--steps", "1", "--workers", "0"]
    light = ["--light-features", str(tmp_path / "light/last.safetensors")]
    looks = ["--appearance-features", str(tmp_path / "looks/last.safetensors")]
    light_of = ["--stage", "light-features", "--texture-size", "48", "-o", str(tmp_path / "light")]
    assert main([*line, *light_of]) == 0
    looks_of = ["--stage", "appearance-features", "--texture-size", "40", "-o", str(tmp_path / "looks")]
    assert main([*line, *looks_of]) == 0
    joint = [*line, "--stage", "joint", "-o", str(tmp_path / "joint")]
    assert main([*joint, *light, "--texture-size", "40"]) == 1
    assert "was trained on images of 48 px, here they have 40" in capsys.readouterr().err
    assert main([*joint, *looks, "--texture-size", "48"]) == 1
    assert "was trained on images of 40 px, here they have 48" in capsys.readouterr().err
    assert main([*joint, "--texture-size", "64"]) == 1
    assert "its crops have 48 px, the networks need 64" in capsys.readouterr().err
    assert main([*joint, *light, "--texture-size", "48", "--geometry", "landmarks"]) == 0
    _, metadata = load_checkpoint(tmp_path / "joint/last.safetensors")
    assert (metadata["geometry"], metadata["texture_side"], metadata["crop_px"]) == ("landmarks", 48, 48)
    assert set(metadata["source_colours"]) == {"mean", "covariance"}
    again = [*line, "--stage", "light-features", "--start-from", light[1], "-o", str(tmp_path / "again")]
    assert main([*again, "--texture-size", "40"]) == 1
    assert "trained on images of 48 px, here they have 40" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ((), True),
        (("--form", "paper"), False),
        (("--preset", "tiny"), False),
        (("--form", "paper", "--bf16"), True),
    ],
)
def test_the_papers_form_trains_in_full_precision_by_default(
    line: tuple[str, ...], expected: bool, tmp_path: Path, monkeypatch: Patch
) -> None:
    seen: list[TrainSettings] = []
    monkeypatch.setattr(training_run, "run_training", lambda options, training, typed: seen.append(training))
    assert main(["train", "-o", str(tmp_path / "run"), "--heads-from", "builtin", *line]) == 0
    assert seen[0].bf16 is expected
