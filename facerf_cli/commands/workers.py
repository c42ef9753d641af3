"""Items spread over workers: one after another, in processes (`--jobs`), or as tasks of Ray (`--ray`)."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from typing import TypeVar

from facerf_cli.commands.options import Settings
from facerf_cli.commands.process_workers import in_processes

T = TypeVar("T")
R = TypeVar("R")


def spread(
    work: Callable[[T], R],
    items: Sequence[T],
    jobs: int,
    settings: Settings,
    broken: Callable[[T, Exception], R],
    recover: Callable[[T], R | None] = lambda item: None,
) -> Generator[R]:
    """`map(work, items)`, by as many workers as `--jobs` and `--ray` ask for; results in the items' order.

    `broken` gives the result of an item whose worker died under it, and `recover`, where another attempt
    would be made, that of one that turns out to be finished. Workers log through this process; Ctrl-C here
    ends them. Whatever `work` raises is raised here.
    """
    if settings.ray is not None and items:
        from facerf_cli.commands.ray_workers import in_ray

        gpus = int(settings.device == "cuda")
        yield from in_order(in_ray(work, items, settings.ray, jobs, gpus, broken, recover))
    elif jobs > 1 and len(items) > 1:
        yield from in_order(in_processes(work, items, jobs, broken))
    else:
        yield from map(work, items)


def in_order(results: Generator[tuple[int, R]]) -> Generator[R]:
    """Results numbered from 0 as they come, in the order of their numbers."""
    early: dict[int, R] = {}
    following = 0
    with closing(results):
        for number, result in results:
            early[number] = result
            while following in early:
                yield early.pop(following)
                following += 1
