"""`facerf relight-dataset` on a tiny dataset: the tree is the same however it came about."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from tests.dataset.dataset_fixture import write_small_dataset
from tests.folders import rows, tree
from tests.kinds import Folders, Said
from tests.processes import wait_until

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def small(tmp_path_factory: Folders) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    write_small_dataset(folder, counts=(1, 1, 1), lights=12, crop_px=32)
    return folder


@pytest.fixture
def dataset(small: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small, tmp_path / "dataset"))


def line(dataset: Path, *options: str, maps: str = "procedural:3", images: int = 4) -> list[str]:
    return ["relight-dataset", str(dataset), "--envmaps", maps, "--per-subject", str(images), *options]


def test_jobs_lazy_and_the_order_of_runs_make_no_difference(
    dataset: Path, small: Path, tmp_path: Path, capsys: Said
) -> None:
    assert main(line(dataset, "--jobs", "2")) == 0
    streams = capsys.readouterr()
    assert len(streams.out.splitlines()) == 12
    whole = tree(dataset / "relit")
    assert len(whole) == 14 and "0002/00003.exr" in whole
    other = Path(shutil.copytree(small, tmp_path / "other"))
    assert main(line(other, "--lazy")) == 0
    assert capsys.readouterr().out == f"{other}/relit/pairs.jsonl\n"
    lazy = tree(other / "relit")
    assert len(lazy) == 2 and lazy.items() < whole.items()
    assert main(line(other, images=2)) == 0  # fewer, then all
    (other / "relit" / "0001" / "00001.exr").unlink()
    assert main(line(other)) == 0
    assert tree(other / "relit") == whole
    assert {item: row["made"] for item, row in rows(other / "relit").items()} == {
        "0000": 2,
        "0001": 3,
        "0002": 2,
    }
    before = (other / "relit" / "0000" / "00000.exr").stat().st_mtime_ns
    assert main(line(other)) == 0
    assert (other / "relit" / "0000" / "00000.exr").stat().st_mtime_ns == before
    assert main(line(other, "--overwrite", "always", "--memory", "0.1")) == 0
    assert tree(other / "relit") == whole
    assert (other / "relit" / "0000" / "00000.exr").stat().st_mtime_ns != before


def test_killed_at_any_moment_the_same_line_ends_in_the_same_tree(
    dataset: Path, small: Path, tmp_path: Path
) -> None:
    images = 60
    assert main(line(dataset, images=images)) == 0
    killed = Path(shutil.copytree(small, tmp_path / "killed"))
    command = [sys.executable, "-m", "facerf_cli", *line(killed, images=images)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=ENVIRONMENT, start_new_session=True)
    early = killed / "relit" / "0000" / "00004.exr"  # no glob: folders that it looks into come and go
    try:
        wait_until(early.exists, process)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert 0 < len(list((killed / "relit").glob("*/*.exr"))) < 3 * images  # a camera's come together
    assert main(line(killed, images=images)) == 0
    assert tree(killed / "relit") == tree(dataset / "relit")


def test_a_dry_run_writes_nothing(dataset: Path, capsys: Said) -> None:
    assert main(line(dataset, "--dry-run", images=2)) == 0
    streams = capsys.readouterr()
    assert f"{dataset}/olat/0000 -> {dataset}/relit/0000/00001.exr" in streams.out
    assert "6 recipes, 6 sources of 32 px" in streams.err
    assert not (dataset / "relit").exists()


def test_maps_of_a_folder(dataset: Path, tmp_path: Path) -> None:
    for name, height in (("b/one.exr", 5), ("two.exr", 8)):
        write_exr(tmp_path / "maps" / name, np.ones((height, 2 * height, 3), np.float32))
    write_exr(tmp_path / "maps" / ".hidden.exr", np.ones((3, 3, 3), np.float32))
    assert main(line(dataset, maps=str(tmp_path / "maps"), images=8)) == 0
    rows = [json.loads(row) for row in (dataset / "relit" / "pairs.jsonl").read_text().splitlines()]
    assert {row["envmap"] for row in rows} == {
        str(tmp_path / "maps" / name) for name in ("b/one.exr", "two.exr")
    }


def test_the_test_has_maps_that_no_other_split_has(dataset: Path, tmp_path: Path, capsys: Said) -> None:
    def maps_of(*options: str, maps: str) -> dict[str, set[str]]:
        assert main(line(dataset, "--lazy", "--overwrite", "always", *options, maps=maps, images=40)) == 0
        found: dict[str, set[str]] = {"train": set(), "validation": set(), "test": set()}
        for row in map(json.loads, (dataset / "relit" / "pairs.jsonl").read_text().splitlines()):
            found[row["split"]].add(row["envmap"])
        return found

    held_out = maps_of(maps="procedural:5")
    assert held_out["train"] == held_out["validation"] == {f"procedural:{n}:0:256" for n in (1, 2, 3, 4)}
    assert held_out["test"] == {"procedural:0:0:256"}
    given = maps_of("--envmaps-test", "procedural:2", maps="procedural:3")
    assert given["train"] == {f"procedural:{n}:0:256" for n in (0, 1, 2)}
    assert given["test"] == {"procedural:3:0:256", "procedural:4:0:256"}
    for name in ("one.exr", "two.exr"):
        write_exr(tmp_path / "maps" / name, np.ones((5, 10, 3), np.float32))
    (tmp_path / "link.exr").symlink_to(tmp_path / "maps" / "two.exr")
    for maps, test, says in (
        (tmp_path / "maps", tmp_path / "link.exr", "1 maps of --envmaps, such as two.exr"),
        (tmp_path / "maps", tmp_path / "nowhere", "--envmaps-test"),
    ):
        assert main(line(dataset, "--envmaps-test", str(test), maps=str(maps))) == 2
        assert says in capsys.readouterr().err
    assert main(line(dataset, maps=str(tmp_path / "link.exr"))) == 2
    assert "--envmaps-test" in capsys.readouterr().err


def test_what_cannot_be_used_is_one_line(dataset: Path, tmp_path: Path, capsys: Said) -> None:
    def says(code: int, arguments: list[str]) -> str:
        assert main(arguments) == code
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1, lines
        return lines[0]

    assert main(line(dataset, images=1)) == 0
    capsys.readouterr()
    assert "move the folder relit" in says(2, line(dataset, "--seed", "9", images=1))
    stack = dataset / "olat" / "0001" / "C1.exr"
    stack.unlink()
    assert f"{stack}: missing from the dataset" in says(1, line(dataset))


def test_a_damaged_stack_costs_its_own_subject(dataset: Path, tmp_path: Path, capsys: Said) -> None:
    for camera in ("C0", "C1"):
        stack = dataset / "olat" / "0002" / f"{camera}.exr"
        stack.write_bytes(stack.read_bytes()[:-2000])
    code = main(line(dataset, images=1))
    errors = capsys.readouterr().err
    assert code == 1 and "0002/C" in errors and "Traceback" not in errors
    if (dataset / "relit" / "pairs.jsonl").exists():
        assert (dataset / "relit" / "0001" / "00000.exr").exists()
