"""Whole OLAT stacks in memory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from facerf_cli.files.olat_stack import StackHeader, read_olat_header, read_olats


@dataclass(frozen=True, eq=False)
class OlatStack:
    """A stack; olats [L, 3, H, W] float16, linear."""

    header: StackHeader
    olats: Tensor


def read_olat_stack(path: Path) -> OlatStack:
    return OlatStack(read_olat_header(path), read_olats(path))


def header_of(
    directions: Any, seen: np.ndarray, grey: float = 0.0, normal: float = 0.0, kind: Any = "image"
) -> StackHeader:
    """A header of an even source, seen [H, W], under lights from directions [L, 3] in head space."""
    even = np.full((*seen.shape, 3), grey, np.float32)
    return StackHeader(kind, np.asarray(directions), np.eye(3), even, seen, np.full_like(even, normal), 1, {})
