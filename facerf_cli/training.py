"""Training of the Reflectance Network, on the synthetic bank or a prepared dataset, top to bottom."""

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import FacerfError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.images import write_display
from facerf_cli.network.losses import root_loss, si_mse
from facerf_cli.network.reflectance import ReflectanceNetwork, ReflectanceSettings
from facerf_cli.network.saved import load_networks, save_networks
from facerf_cli.stage.samples import Sample, SampleSource

DEFAULT_NETWORK = ReflectanceSettings()
CPU = torch.device("cpu")


@dataclass(frozen=True)
class TrainSettings:
    """The `default` preset: AdamW under a cosine schedule, and a running average of the weights."""

    batch: int = 4
    lights: int = 4
    learning_rate: float = 1.5e-3
    warmup_steps: int = 150
    weight_decay: float = 1e-4
    gradient_clip: float = 1.0
    ema_decay: float = 0.998
    max_seconds: float = 3600.0
    max_steps: int = 1_000_000  # whichever of the two comes first; the rate falls toward it
    validate_every: int = 500
    held_out_heads: int = 12
    bf16: bool = True
    seed: int = 0


def train(
    source: SampleSource,
    folder: Path,
    settings: TrainSettings = TrainSettings(),
    network_settings: ReflectanceSettings = DEFAULT_NETWORK,
    start_from: Path | None = None,
    device: torch.device = CPU,
    report: Callable[[dict[str, float]], None] = lambda row: None,
) -> Path:
    """Train on what `source` draws until the time is up; returns the checkpoint, `folder/last.safetensors`.

    `start_from` is a checkpoint whose weights to begin with, and whose settings hold then. Samples are drawn
    on the CPU, the network runs on `device`. Rows go to `report` and `folder/log.jsonl`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    network = _network(source, network_settings, start_from, device)
    average = {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=(0.9, 0.98)
    )
    heads, held_out = source.heads(settings.held_out_heads)
    validation = _held_out_samples(source, held_out)
    begin, step = time.monotonic(), 0

    def finish(row: dict[str, float]) -> Path:
        row["si_mse"] = _validate(average, network.settings, validation, folder / "validation.png")
        return _save(folder / "last.safetensors", average, network.settings, settings, source, row)

    with (folder / "log.jsonl").open("a") as log:
        for step, drawn in enumerate(_draws(source, heads, settings), 1):
            _set_rate(optimizer, settings, step - 1, drawn.seconds)
            loss = _step(network, optimizer, drawn.sample.to(device), settings)
            if not math.isfinite(loss):
                raise FacerfError(f"the loss is not finite at step {step - 1} (heads {drawn.heads.tolist()})")
            _update_average(average, network, min(settings.ema_decay, step / (step + 10)))
            row = {"step": step, "seconds": drawn.seconds, "loss": loss, "drawing": drawn.drawing}
            if step % settings.validate_every == 0:
                finish(row)
            log.write(json.dumps(row) + "\n")
            log.flush()
            report(row)
    return finish({"step": step, "seconds": time.monotonic() - begin})


@dataclass(frozen=True)
class _Draw:
    """A sample, and when it came."""

    sample: Sample
    heads: Tensor  # [B]
    seconds: float  # since the first
    drawing: float  # the share of these that went into drawing


def _draws(source: SampleSource, heads: Tensor, settings: TrainSettings) -> Iterator[_Draw]:
    """Samples of random heads until the time or the steps are up."""
    generator = torch.Generator().manual_seed(settings.seed)
    begin, drawing_s = time.monotonic(), 0.0
    for _ in range(settings.max_steps):
        start_s = time.monotonic() - begin
        if start_s >= settings.max_seconds:
            return
        chosen = heads[torch.randint(len(heads), (settings.batch,), generator=generator)]
        sample = source.draw(chosen, settings.lights, generator)
        drawing_s += time.monotonic() - begin - start_s
        yield _Draw(sample, chosen, start_s, drawing_s / (start_s + 1e-6))


def _network(
    source: SampleSource, settings: ReflectanceSettings, start_from: Path | None, device: torch.device
) -> ReflectanceNetwork:
    """The network to train, with the mean face that the source knows."""
    network: Any = ReflectanceNetwork(settings)
    if start_from:
        network = load_networks(start_from, LAYOUT_VERSION)[0]["reflectance"]
    network.set_mean_face(*source.mean_face())
    moved: ReflectanceNetwork = network.to(device, memory_format=torch.channels_last)
    return moved


def _step(
    network: ReflectanceNetwork, optimizer: torch.optim.Optimizer, sample: Sample, settings: TrainSettings
) -> float:
    """One step down the gradient; the loss before it. A loss that is not finite moves nothing."""
    loss = _loss(network, sample, settings.bf16)
    if loss.isfinite():
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), settings.gradient_clip)
        optimizer.step()
    return float(loss.detach())


def _set_rate(optimizer: torch.optim.Optimizer, settings: TrainSettings, step: int, elapsed: float) -> None:
    """Linear warm-up, then a half cosine over the allotted time or steps down to 2 %."""
    warm = min(1.0, (step + 1) / settings.warmup_steps)
    done = min(1.0, max(elapsed / settings.max_seconds, step / settings.max_steps))
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    for group in optimizer.param_groups:
        group["lr"] = settings.learning_rate * warm * (0.02 + 0.98 * cosine)


def _loss(network: ReflectanceNetwork, sample: Sample, bf16: bool) -> Tensor:
    with torch.autocast(sample.source.device.type, torch.bfloat16, enabled=bf16):
        encoded = network.encode(sample.source, sample.normals_source, sample.visible)
        root = network.decode_root(encoded, sample.normals_target, sample.lights)
    # The network divides by its own measure of exposure, which the fill of unseen texels does not enter.
    return root_loss(root.float(), sample.target / encoded.exposure[:, None], sample.weight)


@torch.no_grad()
def _update_average(average: dict[str, Tensor], network: ReflectanceNetwork, decay: float) -> None:
    for name, tensor in network.state_dict().items():
        if tensor.is_floating_point():
            average[name].lerp_(tensor, 1 - decay)


def _held_out_samples(source: SampleSource, heads: Tensor) -> list[Sample]:
    generator = torch.Generator().manual_seed(12345)
    return [source.draw(chunk, 6, generator) for chunk in torch.split(heads, 4) for _ in range(4)]


@torch.no_grad()
def _validate(
    weights: dict[str, Tensor], network_settings: ReflectanceSettings, samples: list[Sample], sheet: Path
) -> float:
    """Mean Si-MSE of held-out heads, and a contact sheet: source, then truth over prediction a light."""
    network = ReflectanceNetwork(network_settings)
    network.load_state_dict(weights)
    errors, rows = [], []
    for sample in samples:
        encoded = network.encode(sample.source, sample.normals_source, sample.visible)
        predicted = network.decode(encoded, sample.normals_target, sample.lights)
        errors.append(si_mse(predicted, sample.target, sample.weight).mean())
        rows.append(_sheet_row(sample, predicted))
    write_display(sheet, np.concatenate(rows[:5]), exposure=1.0)
    return float(torch.stack(errors).mean())


def _sheet_row(sample: Sample, predicted: Tensor) -> np.ndarray:
    """Two rows of pictures [2T, (L + 1) T, 3] of a sample's first face."""
    mask = (sample.weight[0] > 0).float()
    truth = torch.cat([sample.source[0], *(sample.target[0] * mask)], -1)
    guess = torch.cat([sample.source[0] * sample.visible[0], *(predicted[0] * mask)], -1)
    picture: np.ndarray = torch.cat([truth, guess], -2).permute(1, 2, 0).numpy()
    return picture


def _save(
    path: Path,
    weights: dict[str, Tensor],
    network_settings: ReflectanceSettings,
    settings: TrainSettings,
    source: SampleSource,
    row: dict[str, float],
) -> Path:
    metadata: dict[str, Any] = {
        "layout_version": LAYOUT_VERSION,
        "licence": source.provenance["licence"],
        "provenance": source.provenance,
        "training": asdict(settings),
        "metrics": row,
    }
    network = ReflectanceNetwork(network_settings)
    network.load_state_dict(weights)
    save_networks(path, {"reflectance": network}, metadata)
    return path
