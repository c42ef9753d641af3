import gc
import itertools
import json
import os
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import OpenImageIO as oiio
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_checkpoint, load_networks, save_networks
from facerf_cli.training.loop import Start, drawn_batches, train
from facerf_cli.training.processes import joined_processes
from facerf_cli.training.settings import PRESETS, Adadelta, TrainSettings
from tests.refusals import refused
from tests.toy_faces import toy_objective

TINY = replace(PRESETS["tiny"], steps=24, validate_every=8)


def test_workers_need_no_threads_that_read_images() -> None:
    """A forked process has none of those that OpenImageIO begins on many cores, and would wait for them."""
    before = oiio.get_int_attribute("threads")
    try:
        for workers, threads in ((0, 4), (1, 1)):
            oiio.attribute("threads", 4)
            next(drawn_batches(toy_objective(), 1, range(1), 0, workers))
            assert oiio.get_int_attribute("threads") == threads
    finally:
        oiio.attribute("threads", before)


def rows_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def losses_of(folder: Path) -> list[float]:
    return [row["loss"] for row in rows_of(folder)]


def state_of(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "state.pt", weights_only=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never stopped."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    train(toy_objective(), folder, TINY)
    return folder


def assert_same_run(folder: Path, whole: Path) -> None:
    """To the last digit."""
    assert [row["step"] for row in rows_of(folder)] == list(range(1, 25))
    assert losses_of(folder) == losses_of(whole)
    measured = [[row.get("validation") for row in rows_of(run)] for run in (folder, whole)]
    assert measured[0] == measured[1]
    ours, theirs = state_of(folder), state_of(whole)
    assert all(torch.equal(ours["networks"][k], v) for k, v in theirs["networks"].items())
    assert all(torch.equal(a, b) for a, b in zip(ours["average"], theirs["average"], strict=True))
    assert (folder / "best.safetensors").exists() and ours["best"] == theirs["best"]


def test_training_lowers_the_loss_and_writes_what_a_run_has(whole: Path) -> None:
    losses = torch.tensor(losses_of(whole))
    assert len(losses) == 24 and losses[-6:].mean() < 0.9 * losses[:6].mean()
    names = {path.name for path in whole.iterdir()}
    assert {"last.safetensors", "best.safetensors", "state.pt", "log.jsonl", "tensorboard"} <= names
    assert {f"validation-{step:07d}.png" for step in (8, 16, 24)} <= names
    networks, metadata = load_networks(whole / "last.safetensors", LAYOUT_VERSION)
    assert list(networks) == ["reflectance"] and metadata["licence"] == "MIT"
    assert metadata["training"][0]["steps_done"] == 24 and metadata["training"][0]["batch"] == 2
    row = rows_of(whole)[-1]
    assert metadata["metrics"]["si_mse"] == row["validation"]["si_mse"]
    assert row["terms"].keys() == {"root"} and 0 < row["waiting"] < 1 and row["gradient"] > 0


def test_what_is_saved_is_the_average_and_workers_draw_what_the_loop_would(
    whole: Path, tmp_path: Path
) -> None:
    state = state_of(whole)
    networks, _ = load_networks(whole / "last.safetensors", LAYOUT_VERSION)
    first = next(iter(networks["reflectance"].state_dict().values()))
    assert torch.equal(first, state["average"][0])
    measured = [row["validation"]["si_mse"] for row in rows_of(whole) if "validation" in row]
    assert state["best"] == min(measured)
    _, metadata = load_networks(whole / "best.safetensors", LAYOUT_VERSION)
    assert metadata["metrics"]["si_mse"] == min(measured)
    train(toy_objective(), tmp_path, replace(TINY, workers=1))
    assert losses_of(tmp_path) == pytest.approx(losses_of(whole), rel=1e-6)


def test_best_stays_where_later_ones_are_worse(tmp_path: Path) -> None:
    objective = toy_objective()
    objective.chooses_by = "worse"
    measure, errors = objective.validate, iter([2.0, 1.0, 3.0])
    objective.validate = lambda: replace(measure(), metrics={"worse": next(errors)})  # type: ignore[method-assign]
    train(objective, tmp_path, TINY)
    _, metadata = load_networks(tmp_path / "best.safetensors", LAYOUT_VERSION)
    assert metadata["metrics"]["step"] == 16


@pytest.mark.parametrize("stopped_at", [3, 8, 13])
def test_an_interrupted_run_goes_on_to_the_last_digit(tmp_path: Path, whole: Path, stopped_at: int) -> None:
    def stop(row: dict[str, Any]) -> None:
        if row["step"] == stopped_at:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(toy_objective(), tmp_path, TINY, report=stop)
    train(toy_objective(), tmp_path, TINY, resume=True)
    assert_same_run(tmp_path, whole)


MOMENTS = ("save", "state", "begin")
KILLED = """
import multiprocessing, os, signal, sys, torch
sys.modules["tensorboard"] = None
from facerf_cli.training import loop as training
from tests.training.test_loop import MOMENTS, TINY, toy_objective
from pathlib import Path

def dies(function, at):
    calls = 0
    def wrapped(*arguments, **named):
        nonlocal calls
        calls += 1
        if calls == at:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **named)
    return wrapped

def run(moment, folder):
    if moment == "save":
        training.Trainer._save_state = dies(training.Trainer._save_state, 2)
    elif moment == "state":
        end = dies(lambda: None, 2)
        def torn(content, path, save=torch.save):
            save(content, path)
            os.truncate(path, 1000)
            end()
            save(content, path)
        torch.save = torn
    else:
        training.save_networks = dies(training.save_networks, 1)
    training.train(toy_objective(), Path(folder), TINY)

for moment in MOMENTS:
    child = multiprocessing.get_context("fork").Process(target=run, args=(moment, sys.argv[1] + "/" + moment))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL, moment
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs killed between the log and the state, while the state is written, before there was any state."""
    folder = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-c", KILLED, str(folder)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    return folder


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_run_goes_on_to_the_last_digit(killed: Path, whole: Path, moment: str) -> None:
    train(toy_objective(), killed / moment, TINY, resume=True)
    assert_same_run(killed / moment, whole)
    assert not list((killed / moment).glob(".*part*"))


ENDED = """
import os, signal, sys
sys.modules["tensorboard"] = None
from dataclasses import replace
from facerf_cli.training.loop import train
from tests.training.test_loop import TINY, toy_objective
from pathlib import Path

def end(row):
    if row["step"] == 5:
        os.killpg(0, signal.SIGTERM)

train(toy_objective(), Path(sys.argv[1]), replace(TINY, workers=2), report=end)
"""


def test_a_signal_to_all_of_its_processes_ends_a_run_between_two_steps(tmp_path: Path, whole: Path) -> None:
    """Slurm ends a job so, workers and all."""
    command = [sys.executable, "-c", ENDED, str(tmp_path)]
    here = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=here, capture_output=True, start_new_session=True)
    assert done.returncode == 128 + signal.SIGTERM and not done.stderr, done.stderr.decode()
    assert len(rows_of(tmp_path)) in (5, 6)
    train(toy_objective(), tmp_path, TINY, resume=True)
    assert_same_run(tmp_path, whole)


def test_more_steps_go_on_from_a_finished_run(tmp_path: Path) -> None:
    train(toy_objective(), tmp_path, replace(TINY, steps=4))
    train(toy_objective(), tmp_path, replace(TINY, steps=6), resume=True)
    assert [row["step"] for row in rows_of(tmp_path)] == list(range(1, 7))
    train(toy_objective(), tmp_path, replace(TINY, steps=6), resume=True)  # nothing left to do
    assert len(rows_of(tmp_path)) == 6


def test_a_run_is_not_written_over_nor_resumed_otherwise(tmp_path: Path) -> None:
    train(toy_objective(), tmp_path, replace(TINY, steps=1))
    refused(UsageError, "already contains a run; pass --resume", train, toy_objective(), tmp_path, TINY)
    with pytest.raises(UsageError, match="the run began otherwise: other batch; resume it"):
        train(toy_objective(), tmp_path, replace(TINY, batch=4), resume=True)
    (tmp_path / "state.pt").write_bytes((tmp_path / "state.pt").read_bytes()[:2000])
    refused(InputError, "state.pt: cannot be resumed", train, toy_objective(), tmp_path, TINY, resume=True)


def test_a_loss_that_is_not_finite_stops_with_the_batch_named(tmp_path: Path) -> None:
    people = [batch.people.tolist() for _, batch, _ in first_draws(5)]
    poison = next(head for head in people[4] if all(head not in before for before in people[:4]))
    with pytest.raises(FacerfError) as caught:
        train(toy_objective(poison), tmp_path, replace(TINY, validate_every=2))
    assert str(caught.value) == (
        f"the loss is not finite at step 5 (seed 0, people {people[4]}); "
        f"the last good state is kept in {tmp_path / 'state.pt'}"
    )
    assert state_of(tmp_path)["step"] == len(rows_of(tmp_path)) == 4
    load_networks(tmp_path / "last.safetensors", LAYOUT_VERSION)  # which refuses what is not finite


def test_time_ends_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = itertools.count(time.monotonic(), 0.01)  # a look at the clock takes 10 ms
    monkeypatch.setattr(time, "monotonic", lambda: next(looks))
    train(toy_objective(), tmp_path, replace(TINY, steps=None, max_seconds=0.5))
    rows = rows_of(tmp_path)
    assert 0.5 <= rows[-1]["seconds"] < 1 and rows[-1]["rate"] < rows[len(rows) // 2]["rate"]
    assert "validation" in rows[-1]


def test_workers_say_what_went_wrong_in_one_line(tmp_path: Path) -> None:
    objective = toy_objective()

    def broken(*_: Any) -> None:
        raise InputError("head 7 is gone")

    objective.draw = broken  # type: ignore[method-assign,assignment]
    with pytest.raises(InputError, match=r"^head 7 is gone$"):
        train(objective, tmp_path, replace(TINY, workers=1))


def test_other_networks_and_their_past_are_carried_over(tmp_path: Path, whole: Path) -> None:
    other = toy_objective().networks["reflectance"]
    save_networks(
        tmp_path / "both.safetensors",
        {"spare": other},
        {"layout_version": LAYOUT_VERSION, "licence": "of others", "training": [{"steps_done": 7}]},
    )
    tensors, metadata = load_checkpoint(tmp_path / "both.safetensors")
    start = Start({"spare": other}, metadata)
    train(toy_objective(), tmp_path / "run", replace(TINY, steps=2), start)
    after, described = load_checkpoint(tmp_path / "run" / "last.safetensors")
    spare = {name: tensor for name, tensor in tensors.items() if name.startswith("spare.")}
    assert spare and all(torch.equal(after[name], tensor) for name, tensor in spare.items())
    assert described["licence"] == "MIT; of others"
    assert [leg["steps_done"] for leg in described["training"]] == [7, 2]


def first_draws(count: int) -> list[Any]:
    draws = drawn_batches(toy_objective(), 1, range(TINY.batch), seed=0, workers=0)
    return [next(draws) for _ in range(count)]


def _one_of_two(rank: int, folder: Path, settings: TrainSettings) -> None:
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
    torch.set_num_threads(1)
    with joined_processes():
        group = weakref.ref(dist.group.WORLD)
        train(toy_objective(), folder, settings)
    gc.collect()
    assert group() is None  # or its threads outlive the interpreter, and abort the process


def test_two_processes_learn_what_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Not AdamW, which makes steps of the rounding where a gradient is nothing else.
    settings = replace(TINY, batch=4, steps=10, optimizer=Adadelta(learning_rate=2.0))
    train(toy_objective(), tmp_path / "one", settings)
    for name, value in (("MASTER_ADDR", "127.0.0.1"), ("MASTER_PORT", _free_port()), ("WORLD_SIZE", 2)):
        monkeypatch.setenv(name, str(value))
    other = mp.get_context("spawn").Process(target=_one_of_two, args=(1, tmp_path / "two", settings))
    other.start()
    threads = torch.get_num_threads()
    for name in ("RANK", "LOCAL_RANK"):
        monkeypatch.setenv(name, "0")  # taken back afterwards
    _one_of_two(0, tmp_path / "two", settings)
    torch.set_num_threads(threads)
    other.join()
    assert other.exitcode == 0
    assert losses_of(tmp_path / "two") == pytest.approx(losses_of(tmp_path / "one"), rel=1e-5)
    assert losses_of(tmp_path / "two")[-1] < 0.9 * losses_of(tmp_path / "two")[0]
    one, two = (state_of(tmp_path / name)["networks"] for name in ("one", "two"))
    for name, weights in one.items():
        if weights.is_floating_point():
            assert float((two[name] - weights).norm()) < 3e-5 * float(weights.norm()) + 1e-12, name


def test_a_batch_in_parts_has_the_gradients_of_the_whole(tmp_path: Path) -> None:
    settings = replace(TINY, batch=4, steps=6, optimizer=Adadelta(learning_rate=2.0))
    train(toy_objective(), tmp_path / "whole", settings)
    train(toy_objective(), tmp_path / "parts", replace(settings, accumulate=4))
    assert losses_of(tmp_path / "parts") == pytest.approx(losses_of(tmp_path / "whole"), rel=1e-5)
    assert losses_of(tmp_path / "parts")[-1] < 0.97 * losses_of(tmp_path / "parts")[0]


def _free_port() -> int:
    import socket

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def test_a_batch_is_shared_in_equal_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facerf_cli.training.loop.process_count", lambda: 3)
    monkeypatch.setattr("facerf_cli.training.loop.distributed", lambda objective, _: objective)
    refused(UsageError, "--batch 2: 3 processes cannot share it", train, toy_objective(), tmp_path, TINY)


def test_the_papers_preset_is_the_papers(tmp_path: Path) -> None:
    paper = PRESETS["paper"]
    train(toy_objective(), tmp_path, replace(paper, steps=3))
    group = state_of(tmp_path)["optimizer"]["param_groups"][0]
    assert (group["lr"], group["rho"], group["eps"]) == (0.05, 0.95, 1e-8)
    assert paper.batch == 1 and paper.gradient_clip is None and paper.ema_decay is None and not paper.bf16
    assert {row["rate"] for row in rows_of(tmp_path)} == {0.05}
    networks, _ = load_networks(tmp_path / "last.safetensors", LAYOUT_VERSION)
    for name, tensor in networks["reflectance"].named_parameters():
        assert torch.equal(tensor, state_of(tmp_path)["networks"][f"reflectance.{name}"])


@pytest.mark.parametrize("terms", [torch.zeros(()), {}, {"loss": torch.zeros(2)}, {"loss": 1.0}])
def test_a_forward_without_terms_of_a_loss_is_refused(tmp_path: Path, terms: Any) -> None:
    objective = toy_objective()
    objective.forward = lambda batch: terms  # type: ignore[method-assign]
    refused(UsageError, "TextureObjective.forward: no terms of a loss", train, objective, tmp_path, TINY)


def test_mixed_precision_reaches_the_objective(tmp_path: Path) -> None:
    objective = toy_objective()
    train(objective, tmp_path, replace(TINY, bf16=True, steps=2))
    assert objective.bf16 and all(row["gradient"] > 0 for row in rows_of(tmp_path))


def test_a_long_gradient_is_clipped(tmp_path: Path) -> None:
    first, moved = toy_objective().networks.state_dict(), []
    for clip in (None, 1e-10):  # far below AdamW's eps, which hides smaller gradients' length no more
        objective = toy_objective()
        train(objective, tmp_path / str(clip), replace(TINY, gradient_clip=clip, steps=2))
        now = objective.networks.state_dict()
        moved.append(
            sum(float((now[name].float() - tensor.float()).norm()) for name, tensor in first.items())
        )
    assert moved[1] < 0.1 * moved[0]
    assert rows_of(tmp_path / "None")[0]["gradient"] == rows_of(tmp_path / "1e-10")[0]["gradient"]
