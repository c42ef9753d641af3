"""The settings of a run: global options, and the options of every command that processes folders."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from facerf_cli.batch.inputs import OF_FILES, NamePattern
from facerf_cli.errors import UsageError
from facerf_cli.option import BATCH, option
from facerf_cli.run import memory
from facerf_cli.run.machine import processors
from facerf_cli.run.workers import Workers

Overwrite = Literal["never", "changed", "always"]
T = TypeVar("T")
NOT_IN_RECIPE = {"in_recipe": False}  # metadata of a field that shapes no output
OUTPUT: dict[str, Any] = {  # the option of a command's output folder
    "flags": ("--output", "-o"),
    "shown_default": False,
    "required": True,
    "typed": Path,
    "in_recipe": False,
}
_DEVICE = re.compile(r"auto|cpu|mps|cuda(:[0-9]{1,3})?")
_SHARD = re.compile(r"([0-9]{1,9})/([0-9]{1,9})")
_MOST_SEED = 2**63 - 1  # torch's
_JOB_BYTES = 2 << 30  # memory for each process that facerf starts unasked
_FILE_SUFFIX = re.compile(
    r"\.(exr|hdr|png|jpe?g|tiff?|webp|gif|bmp|heic|avif|jsonl?|txt|csv|html|pdf|zip|npz|safetensors|glb|obj"
    r"|mp4|mov|m4v|webm|avi|mkv)",
    re.IGNORECASE,
)


def device_name(text: str) -> str:
    """Check the text of `--device`; UsageError if it names no device."""
    if not _DEVICE.fullmatch(text):
        raise UsageError(
            f"--device {text}: not the name of a device; use auto, cpu, cuda, cuda:1 (the second GPU) or mps"
        )
    return text


def _bytes_of(gigabytes: float) -> int:
    if not math.isfinite(gigabytes):
        raise UsageError(f"--memory {gigabytes}: not a size; pass a number of GB")
    return int(gigabytes * 2**30)


@dataclass(frozen=True)
class Settings:
    """Global options; `ctx.obj` of every command.

    Attributes:
        verbose: Log more, and the traceback of errors.
        quiet: Log only errors; show no progress bar.
        log_json: Log to standard error as JSON lines.
        device: Device that computes.
        checkpoints: Checkpoint (.safetensors), or folder of a run, whose best one is used. Repeatable: each
            file replaces the networks that it was trained for.
        seed: Seed of all random numbers.
        memory_bytes: Memory limit of each job, over what it holds at rest. Items that need more are rejected.
        null_separated: Names on standard input end in NUL, as written by find -print0.
        checkpoints_by_default: The checkpoints come from a configuration file, which is for all commands.
    """

    verbose: bool = option(False, in_recipe=False, flags=("--verbose", "-v"))
    quiet: bool = option(False, in_recipe=False, flags=("--quiet", "-q"))
    log_json: bool = option(False, in_recipe=False, flags=("--log-json",))
    device: str = option(
        "auto", metavar="auto|cpu|cuda|cuda:N|mps", in_recipe=False, parse=device_name, default_text="auto"
    )
    checkpoints: tuple[Path, ...] = option(
        (),
        metavar="FILE|RUN",
        flags=("--checkpoint",),
        shown_default="the shipped ones",
        typed=list[Path],
        default_text=(),
        parse=tuple,
    )
    seed: int = option(0, least=0, most=_MOST_SEED)
    memory_bytes: int | None = option(
        None,
        metavar="GB",
        in_recipe=False,
        flags=("--memory",),
        shown_default="half of all",
        least=0.1,
        typed=float | None,
        parse=_bytes_of,
    )
    null_separated: bool = option(False, in_recipe=False, flags=("--null", "-0"))
    checkpoints_by_default: bool = field(default=False, metadata=NOT_IN_RECIPE)

    @property
    def verbosity(self) -> int:
        """-1: errors only; 0: information and warnings; 1: everything."""
        return int(self.verbose) - int(self.quiet)

    def job_bytes(self, jobs: int) -> int:
        """Return the memory budget of each of some jobs."""
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
        devices = ", ".join([*present, *(f"cuda:{gpu}" for gpu in range(1, count["cuda"]))])
        raise UsageError(f"--device {name}: torch has no such device; use one of: {devices}")
    return torch.device(name)


@dataclass(frozen=True)
class Shard:
    """The part of the items that this process takes: every `of`th, from `number` on, which counts from 1."""

    number: int = 1
    of: int = 1

    @staticmethod
    def parse(text: str) -> "Shard":
        """Parse `K/N`; raises UsageError for anything else."""
        match = _SHARD.fullmatch(text)
        if not (match and 1 <= int(match[1]) <= int(match[2])):
            raise UsageError(f"--shard {text}: not a shard; use K/N with K from 1 to N, such as 3/8")
        return Shard(int(match[1]), int(match[2]))

    @property
    def suffix(self) -> str:
        """Suffix of this shard's lock and journal, such as '-3-of-8'; '' without shards."""
        return "" if self.of == 1 else f"-{self.number}-of-{self.of}"

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """Return this process's items."""
        return items[self.number - 1 :: self.of]


def folder_not_file(output: Path, other: str = "") -> Path:
    """Return the folder that `-o` names; UsageError for the name of a file, unless such a folder exists.

    `other` lists the suffixes of files that are allowed.
    """
    if _FILE_SUFFIX.fullmatch(output.suffix) and not output.is_dir():
        kinds = f", or a file with the suffix {other}" if other else ""
        folder = f"use a folder, such as -o {output.with_suffix('')}"
        raise UsageError(f"-o {output}: names a file; {folder}{kinds}")
    return output


@dataclass(frozen=True)
class BatchOptions:
    """Options of every command that processes folders.

    Attributes:
        output: Folder that the results are written to.
        overwrite: Whether to replace existing results: never; if inputs, options or networks changed; or
            always.
        dry_run: List the inputs and outputs; write nothing.
        jobs: Number of items that are processed in parallel.
        shard: Process only every Nth item, from the Kth on; other machines process the rest.
        ray: Run as tasks of Ray on a cluster (HOST:PORT of its head, or auto) or on this machine (local).
        name: Pattern of output names, of {dir}, {parent}, {stem}, {ext} and {frame:04}; each result adds its
            own ending.
        report: Also write report.jsonl: a row per item with its outputs and facts, or its error.
        file: The single file that `-o` names.
        in_a_row: Number of neighbouring items that a process takes.
        print_outputs: Whether names of outputs are printed to standard output.
    """

    output: Path = option(Path(), metavar="DIR", parse=folder_not_file, **OUTPUT)
    overwrite: Overwrite = option("changed", in_recipe=False, panel=BATCH, everyday=True)
    dry_run: bool = option(False, in_recipe=False, panel=BATCH)
    jobs: int | None = option(
        None,
        in_recipe=False,
        flags=("--jobs", "-j"),
        shown_default="auto",
        least=1,
        panel=BATCH,
        everyday=True,
    )
    shard: Shard = option(
        Shard(), metavar="K/N", in_recipe=False, shown_default="all items", parse=Shard.parse, panel=BATCH
    )
    ray: str | None = option(None, metavar="ADDRESS", in_recipe=False, shown_default=False, panel=BATCH)
    name: NamePattern | None = option(
        None,
        metavar="PATTERN",
        in_recipe=False,
        shown_default="{dir}/{stem}.{frame}",
        parse=lambda text: NamePattern.parse(text, "--name", OF_FILES),
        panel=BATCH,
    )
    report: bool = option(False, in_recipe=False, panel=BATCH)
    file: Path | None = field(default=None, metadata=NOT_IN_RECIPE)
    in_a_row: int = field(default=1, metadata=NOT_IN_RECIPE)
    print_outputs: bool = field(default=True, metadata=NOT_IN_RECIPE)

    def workers(self, settings: Settings, default_jobs: int = 1) -> Workers:
        """Return the workers that `--jobs`, `--ray` and `--device` ask for, or `default_jobs` processes."""
        jobs = self.jobs or (default_jobs if self.ray is None else 0)
        gpus = None if settings.device == "auto" else int(settings.device.startswith("cuda"))
        with_bar = settings.verbosity >= 0 and not settings.log_json
        return Workers(jobs, self.ray, gpus, self.in_a_row, with_bar)


def default_job_count(items: int, items_per_process: int, settings: Settings) -> int:
    """Return the number of processes without `--jobs`: a photo uses two processors only by half.

    One with a GPU, and with `--memory`, which limits each process.
    """
    if items_per_process == 0 or settings.memory_bytes is not None:
        return 1
    jobs = min(items // items_per_process, processors(), memory.default_limit() // _JOB_BYTES)
    return jobs if jobs > 1 and torch_device(settings).type == "cpu" else 1
