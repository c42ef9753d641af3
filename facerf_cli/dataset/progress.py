"""Work that is spread over processes, with a progress bar."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from rich.progress import track

from facerf_cli.batch.run import BatchOptions
from facerf_cli.batch.settings import Settings
from facerf_cli.run.logs import STDERR
from facerf_cli.run.workers import spread

T = TypeVar("T")
R = TypeVar("R")


def with_bar(
    work: Callable[[T], R],
    items: Sequence[T],
    title: str,
    batch: BatchOptions,
    settings: Settings,
    died: Callable[[T, Exception], R],
) -> Iterator[R]:
    """Map items by the workers of --jobs or --ray, with a progress bar."""
    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    results = spread(work, items, batch.workers(settings), died)
    return iter(track(results, title, len(items), console=STDERR, transient=True, disable=not shown))
