import json
from pathlib import Path

import torch

from facerf_cli.network.reflectance import ReflectanceSettings
from facerf_cli.network.saved import load_networks
from facerf_cli.stage.bank import Bank
from facerf_cli.training import TrainSettings, train

NETWORK = ReflectanceSettings(
    side=32, encoder_widths=(8, 12, 16), decoder_widths=(8, 12, 16), template_channels=2, rig_lights=20
)


def test_training_lowers_the_loss_and_writes_a_checkpoint_that_loads(bank: Bank, tmp_path: Path) -> None:
    settings = TrainSettings(
        batch=2, lights=3, warmup_steps=5, learning_rate=4e-3, max_steps=60, held_out_heads=4, bf16=False
    )
    path = train(bank, tmp_path, settings, NETWORK)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    losses = torch.tensor([row["loss"] for row in rows])
    assert len(losses) == 60
    assert losses[-10:].mean() < 0.9 * losses[:10].mean()
    networks, metadata = load_networks(path, 1)
    assert networks["reflectance"].settings == NETWORK and metadata["metrics"]["si_mse"] > 0
    assert metadata["licence"] == "MIT"
    assert (tmp_path / "validation.png").stat().st_size > 1000
    train(
        bank,
        tmp_path / "more",
        TrainSettings(batch=1, lights=1, max_steps=1, held_out_heads=4),
        NETWORK,
        path,
    )
    assert (tmp_path / "more" / "last.safetensors").exists()
