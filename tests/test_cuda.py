"""Relighting and training on an NVIDIA GPU; tests/test_on_device.py finds much of it without one."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import facerf_cli as facerf
from facerf_cli.main import main
from facerf_cli.training.settings import Stage
from tests.training.joint_dataset import write_joint_dataset

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device"),
]
ROOT = Path(__file__).parents[1]
STEPS = 20
ON_CROPS = ("joint", "appearance-features", "portrait")  # stages that the small dataset trains


@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_a_relit_photo_is_that_of_a_cpu(device: str) -> None:
    photo, light = facerf.read_image(ROOT / "examples/astronaut.jpg"), facerf.Light.single(60, 30)
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.max_memory_allocated()
    relit, expected = (
        facerf.fit(facerf.load_models(device=where), photo).relight(light) for where in (device, "cpu")
    )
    assert torch.cuda.max_memory_allocated() > before
    # convolutions in TF32 have 10 bits, the Reflectance Network in bfloat16 8
    assert np.abs(relit - expected).mean() < 0.01 * expected.mean()


def line(folder: Path, stage: str, steps: int = STEPS) -> list[str]:
    """A short training in a folder, on its dataset or on a bank of few people."""
    if stage in ON_CROPS:
        write_joint_dataset(folder / "data", crop_px=192 if stage == "portrait" else 48)
        data = ["--dataset", str(folder / "data")]
        data += [] if stage == "portrait" else ["--texture-size", "32"]
    else:
        data = ["--heads", "7"]
    words = f"train --stage {stage} --preset tiny --steps {steps} --validate-every {steps} --device cuda"
    return [*words.split(), "-o", str(folder / "run"), *data]


def losses(folder: Path) -> list[float]:
    return [json.loads(row)["loss"] for row in (folder / "run/log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("stage", get_args(Stage))
def test_every_stage_trains_on_the_gpu(tmp_path: Path, stage: str) -> None:
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.max_memory_allocated()
    assert main(line(tmp_path, stage)) == 0
    assert len(losses(tmp_path)) == STEPS and torch.cuda.max_memory_allocated() > before


def test_a_run_is_resumed_on_the_gpu(tmp_path: Path) -> None:
    command = line(tmp_path, "joint", 3)
    assert main(command) == 0
    assert main([*command, "--steps", "6", "--resume"]) == 0
    assert len(losses(tmp_path)) == 6


def test_all_gpus_train_one_run(tmp_path: Path) -> None:
    """One GPU has one process, without NCCL."""
    count = torch.cuda.device_count()
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    command = [*run, "-m", "facerf_cli", *line(tmp_path, "joint"), "--batch", str(2 * count)]
    subprocess.run(
        command, check=True, env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    )
    assert len(losses(tmp_path)) == STEPS
