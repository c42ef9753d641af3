"""`--shard` and `--ray` on the command line, and what shards leave: reports of their own, one summary."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import typer

from facerf_cli import main
from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import sums_up
from facerf_cli.batch.settings import BatchOptions, Settings, Shard, default_job_count, torch_device
from facerf_cli.errors import UsageError
from facerf_cli.run import ray_workers
from facerf_cli.run.logs import configure_logging
from facerf_cli.run.workers import Workers, spread
from tests.batch.toy_batch import outputs_of, run
from tests.folders import rows
from tests.refusals import refused

FOLDER_VERBS = {
    "relight", "estimate-light", "predict-olat", "fit-geometry", "synth-stage",
    "prepare-dataset", "relight-dataset", "evaluate olat", "evaluate reconstruction", "evaluate transfer",
    "evaluate geometry", "evaluate yale-b", "evaluate cases", "evaluate compare", "segment", "view",
}  # fmt: skip


def test_every_verb_that_walks_folders_has_both() -> None:
    command: Any = typer.main.get_command(main.app)
    verbs = {name: verb for name, verb in command.commands.items() if not hasattr(verb, "commands")}
    group = command.commands["evaluate"].commands
    verbs |= {f"evaluate {name}": verb for name, verb in group.items()}
    options = {name: {option for each in verb.params for option in each.opts} for name, verb in verbs.items()}
    assert {name for name, has in options.items() if {"--shard", "--ray"} <= has} == FOLDER_VERBS
    assert not [
        name for name, has in options.items() if {"--shard", "--ray"} & has and name not in FOLDER_VERBS
    ]


def test_workers_are_those_of_the_options() -> None:
    for jobs, expected in ((1, 1), (None, 0)):
        options = BatchOptions(ray="local", jobs=jobs)
        assert options.workers(Settings()) == Workers(expected, "local", None, 1)
    assert BatchOptions().workers(Settings()) == Workers(1, None, None, 1)


@pytest.mark.parametrize(
    ("items", "a_process", "processors", "gigabytes", "settings", "jobs"),
    [
        (7, 4, 2, 16, Settings(device="cpu"), 1),
        (8, 4, 2, 16, Settings(device="cpu"), 2),
        (99, 4, 16, 16, Settings(device="cpu"), 8),  # 2 GB for each
        (40, 4, 16, 64, Settings(device="cpu"), 10),
        (99, 0, 16, 64, Settings(device="cpu"), 1),
        (99, 4, 16, 64, Settings(device="cpu", memory_bytes=1 << 30), 1),
        (99, 4, 16, 64, Settings(device="cuda"), 1),
    ],
)
def test_processes_start_unasked_where_they_pay(
    monkeypatch: pytest.MonkeyPatch,
    items: int,
    a_process: int,
    processors: int,
    gigabytes: int,
    settings: Settings,
    jobs: int,
) -> None:
    monkeypatch.setattr("facerf_cli.batch.settings.processors", lambda: processors)
    monkeypatch.setattr("facerf_cli.run.memory.default_limit", lambda jobs=1: gigabytes << 30)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    assert default_job_count(items, a_process, settings) == jobs


def test_a_folder_gets_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[int] = []

    def counted(work: Any, items: Any, workers: Workers, died: Any, title: str) -> Any:
        seen.append(workers.jobs)
        return (work(item) for item in items)

    monkeypatch.setattr("facerf_cli.batch.run.spread", counted)
    monkeypatch.setattr("facerf_cli.batch.run.default_job_count", lambda items, *_: 10 * items)
    (tmp_path / "photos").mkdir()
    for name in "ab":
        (tmp_path / "photos" / f"{name}.png").write_bytes(b"good")
    assert [run(tmp_path / "photos", tmp_path / f"out{jobs}", jobs=jobs) for jobs in (None, 3)] == [0, 0]
    assert seen == [20, 3]


@pytest.mark.parametrize("text", ["", "1", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3", "1.0/2", "½/2"])
def test_a_wrong_share(text: str) -> None:
    refused(UsageError, "--shard ... : not a shard; use K/N with K from 1 to N", Shard.parse, text)


@pytest.mark.parametrize("of", [1, 2, 3, 7])
def test_shards_share_the_items_out(of: int) -> None:
    shares = [Shard.parse(f"{number}/{of}").share(range(5)) for number in range(1, of + 1)]
    assert sorted(item for share in shares for item in share) == list(range(5))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    configure_logging()
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in "abcde":
        (folder / f"{name}.png").write_bytes(name.encode())
    return folder


def test_shards_do_their_own_and_a_run_without_takes_their_rows(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (photos / "b.png").write_bytes(b"bad")
    out = tmp_path / "out"
    assert run(photos, out, Shard(1, 2)) == 0 and run(photos, out, Shard(2, 2)) == 1
    first, second = (rows(out, f".facerf-{number}-of-2.jsonl") for number in (1, 2))
    assert set(first) == {"a", "c", "e"} and set(second) == {"b", "d"}
    (photos / "b.png").write_bytes(b"good")
    assert run(photos, out, report=True) == 0
    whole = rows(out, "report.jsonl")
    assert {name: whole[name] for name in "acde"} == first | {"d": second["d"]}
    assert whole["b"]["status"] == "done"
    assert (tmp_path / "written").read_text().split() == ["a", "c", "e", "d", "b"]
    assert run(photos, tmp_path / "out", Shard(6, 9)) == 0
    assert not (out / ".facerf-6-of-9.jsonl").exists()
    capsys.readouterr()
    assert run(photos, tmp_path / "dry", Shard(2, 2), dry_run=True) == 0
    assert [Path(line.split(" -> ")[0]).name for line in capsys.readouterr().out.splitlines()] == [
        "b.png",
        "d.png",
    ]


def test_the_last_shard_sums_up(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    configure_logging()
    items = [Item(tmp_path / name, tmp_path / name, name) for name in "abc"]
    options = BatchOptions(tmp_path)
    shard = replace(options, shard=Shard(2, 2))
    assert sums_up(items, outputs_of, options)
    for item in items:
        assert not sums_up(items, outputs_of, shard)
        outputs_of(item)[0].write_bytes(b"x")
    assert "there is no summary" in capsys.readouterr().err
    assert sums_up(items, outputs_of, shard)
    assert not sums_up(items, outputs_of, replace(shard, overwrite="always"))


def test_one_of_several_gpus_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    found = [str(torch_device(Settings(device=name))) for name in ("auto", "cuda", "cuda:1", "cpu")]
    assert found == ["cuda", "cuda", "cuda:1", "cpu"]
    refused(UsageError, "--device cuda:2: ... use ... cuda:1", torch_device, Settings(device="cuda:2"))


@pytest.mark.parametrize(
    ("device", "there", "wanted"), [("auto", 8.0, 1), ("auto", 0.0, 0), ("cuda:1", 0.0, 1), ("cpu", 8.0, 0)]
)
def test_a_task_of_a_cluster_has_a_gpu_where_one_is_wanted(
    device: str, there: float, wanted: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, int] = {}

    def remote(**needs: int) -> None:
        asked.update(needs)
        raise InterruptedError

    ray = SimpleNamespace(cluster_resources=lambda: {"CPU": 4.0, "GPU": there}, remote=remote)
    monkeypatch.setattr(ray_workers, "connect", lambda *_: ray)
    workers = BatchOptions(ray="auto").workers(Settings(device=device))
    with pytest.raises(InterruptedError):
        list(spread(str, ["item"], workers, lambda item, error: ""))
    assert asked["num_gpus"] == wanted
