"""Base of networks: settings in checkpoints and their limits, a shared layer, and precision."""

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Self

import torch
import torch.nn.functional as F
from pydantic import Field, TypeAdapter
from torch import Tensor, nn

from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
_BF16_CAPABILITY = 8  # least compute capability of an NVIDIA GPU with bfloat16
_NAMES = {"cpu": "processor", "cuda": "GPU"}

# Settings that a checkpoint may have.
Count = Annotated[int, Field(ge=1, le=4096)]
Side = Annotated[int, Field(ge=8, le=4096)]  # pixels or texels
Grid = Annotated[int, Field(ge=1, le=64)]
VggWidth = Annotated[float, Field(gt=0, le=4)]  # relative to the channels of VGG-16
Landmarks = Annotated[int, Field(ge=68, le=256)]
Classes = Annotated[int, Field(ge=2, le=256)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1, max_length=12)]
WidthsOfFour = Annotated[  # for group normalisation
    tuple[Annotated[int, Field(ge=4, le=512, multiple_of=4)], ...], Field(min_length=3, max_length=6)
]
Blocks = Annotated[tuple[Annotated[int, Field(ge=0, le=8)], ...], Field(min_length=3, max_length=6)]


class SavedNetwork(nn.Module):
    """Network described in a checkpoint by its form and its settings."""

    form: ClassVar[str] = "default"
    kind_of_settings: ClassVar[type[Any]]  # a dataclass

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    def as_metadata(self) -> dict[str, Any]:
        """Return form and settings, for a checkpoint."""
        return {"form": self.form, **asdict(self.settings)}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> Self:
        """Make an untrained network; raises TypeError or ValueError for invalid settings."""
        kind = cls.kind_of_settings
        known = {field.name for field in fields(kind)}
        settings = {name: value for name, value in metadata.items() if name != "form" or name in known}
        if unknown := sorted(settings.keys() - known):
            raise TypeError(f"a network of this form has no {', '.join(unknown)}")
        # from JSON, because strict pydantic accepts its lists as tuples
        return cls(TypeAdapter(kind).validate_json(json.dumps(settings), strict=True))


class Down(nn.Module):
    """Halve the side (unless `first`), then apply a residual convolution."""

    def __init__(self, channels_in: int, channels_out: int, first: bool = False, groups: int = 4) -> None:
        super().__init__()
        self.enter = nn.Conv2d(channels_in, channels_out, 3, stride=1 if first else 2, padding=1)
        self.norm = nn.GroupNorm(groups, channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map features [B, C, H, W] to [B, C', H / 2, W / 2], or to the same side."""
        x = F.silu(self.norm(self.enter(x)))
        result: Tensor = x + F.silu(self.inner(x))
        return result


def mixed_precision(device: torch.device, wanted: bool) -> torch.autocast:
    """Return a context for bfloat16 computations, if that is `wanted`.

    Processors without bfloat16 instructions emulate them a hundred times more slowly, and old GPUs lack them.
    There the network stays in float32, which is logged once.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and _has_bf16(device))


@cache  # logged once
def _has_bf16(device: torch.device) -> bool:
    has: bool = device.type not in ("cpu", "cuda")
    if device.type == "cpu":
        has = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if device.type == "cuda":
        has = torch.cuda.get_device_capability(device)[0] >= _BF16_CAPABILITY
    if not has:
        log.info("this %s has no instructions for bfloat16; networks stay in float32", _NAMES[device.type])
    return has
