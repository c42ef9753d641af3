"""The settings of a run: global options, and its share of the items."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from facerf_cli.errors import UsageError
from facerf_cli.run import memory

_DEVICE = re.compile(r"auto|cpu|mps|cuda(:[0-9]{1,3})?")
Overwrite = Literal["never", "changed", "always"]
T = TypeVar("T")
NOT_IN_RECIPE = {"in_recipe": False}  # metadata of a field that shapes no output
_SHARE = re.compile(r"[0-9]{1,9}/[0-9]{1,9}")


@dataclass(frozen=True)
class Shard:
    """The share of the items that this process takes: every `of`th, from `number` on, which counts from 1."""

    number: int = 1
    of: int = 1

    @staticmethod
    def parse(text: str) -> "Shard":
        """Parse `K/N`; raises UsageError for anything else."""
        number, slash, of = text.partition("/")
        if not (slash and _SHARE.fullmatch(text) and 1 <= int(number) <= int(of)):
            raise UsageError(f"--shard {text}: not a share; give K/N with K from 1 to N, such as 3/8")
        return Shard(int(number), int(of))

    @property
    def suffix(self) -> str:
        """The end of the names of its own files, since shards run at the same time; '' for the whole."""
        return "" if self.of == 1 else f"-{self.number}-of-{self.of}"

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """This process's items."""
        return items[self.number - 1 :: self.of]


@dataclass(frozen=True)
class Settings:
    """The global options; `ctx.obj` in every verb."""

    verbosity: int = field(default=0, metadata=NOT_IN_RECIPE)  # -1 errors only, 0 notes, 1 everything
    log_json: bool = field(default=False, metadata=NOT_IN_RECIPE)
    device: str = field(default="auto", metadata=NOT_IN_RECIPE)  # as `device_name` takes it
    checkpoints: tuple[Path, ...] = ()  # files; the networks that they lack are the shipped ones
    checkpoints_by_default: bool = field(default=False, metadata=NOT_IN_RECIPE)  # of a configuration file
    seed: int = 0
    null_separated: bool = field(default=False, metadata=NOT_IN_RECIPE)  # names on standard input
    memory_bytes: int | None = field(default=None, metadata=NOT_IN_RECIPE)  # of a job; None: a share of all

    def job_bytes(self, jobs: int) -> int:
        """The budget of memory of each of so many jobs."""
        return memory.default_limit(jobs) if self.memory_bytes is None else self.memory_bytes


def torch_device(settings: Settings) -> Any:
    """Seed torch and return the device of `--device`; `auto` takes cuda, then mps, then cpu."""
    import torch

    torch.manual_seed(settings.seed)
    count = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available()), "cpu": 1}
    present = [kind for kind in count if count[kind]]
    name = present[0] if settings.device == "auto" else settings.device
    kind, _, number = name.partition(":")
    if int(number or 0) >= count[kind]:
        numbered = [f"cuda:{gpu}" for gpu in range(1, count["cuda"])]
        found = ", ".join([*present, *numbered])
        raise UsageError(f"--device {name}: torch finds no such device; give one of: {found}")
    return torch.device(name)


def device_name(text: str) -> str:
    """Return the text of `--device`; UsageError for what names none."""
    if not _DEVICE.fullmatch(text):
        advice = "give auto, cpu, cuda (cuda:1 is the second GPU) or mps"
        raise UsageError(f"--device {text}: not the name of a device; {advice}")
    return text
