"""Mixed precision of networks, where the device has instructions for it."""

import logging
from functools import cache

import torch

from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)


def mixed_precision(device: torch.device, wanted: bool) -> torch.autocast:
    """Context in which a network computes in bfloat16, if that is `wanted`.

    A processor without instructions for bfloat16 emulates them and is a hundred times slower: there the
    network stays in float32, and a line says so once.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and _has_bf16(device.type))


@cache
def _has_bf16(device_type: str) -> bool:
    has: bool = device_type != "cpu" or torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if not has:
        log.info("this processor has no instructions for bfloat16; networks stay in float32")
    return has
