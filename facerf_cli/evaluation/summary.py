"""From a run's rows to its tables: each method overall and by every fact, and against the first method."""

from dataclasses import dataclass

from facerf_cli.evaluation.paper import Published


@dataclass(frozen=True)
class Layout:
    """What a protocol's tables hold.

    `name` is the protocol's on the command line, `title` what it is called in print. Of `metrics` the first
    decides what is best and worst; `by` are the facts, text, that break the tables down. `notes` are said
    beside the figures.
    """

    name: str
    title: str
    metrics: tuple[str, ...] = ("si_mse",)
    by: tuple[str, ...] = ()
    published: tuple[Published, ...] = ()
    notes: tuple[str, ...] = ()
