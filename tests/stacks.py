"""Whole OLAT stacks in memory."""

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from facerf_cli.files.olat_stack import StackHeader, read_olat_header, read_olats


@dataclass(frozen=True, eq=False)
class OlatStack:
    """A stack; olats [L, 3, H, W] float16, linear."""

    header: StackHeader
    olats: Tensor


def read_olat_stack(path: Path) -> OlatStack:
    return OlatStack(read_olat_header(path), read_olats(path))
