"""Means with 95 % intervals, for pictures that come in groups: of a subject, of a head.

Pictures of one person are alike, so it is persons that are drawn again, with all of their pictures (a cluster
bootstrap, percentile intervals: Efron and Tibshirani, *An introduction to the bootstrap*, 1993).
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Key = TypeVar("Key", bound=Hashable)

_RESAMPLES = 10_000
_DRAWN_AT_ONCE = 1 << 22
_SEED = 0
_LOW, _HIGH = 2.5, 97.5  # percent


@dataclass(frozen=True)
class Interval:
    """A mean over pictures, its 95 % interval over groups, and the pictures' own median and spread."""

    mean: float
    median: float
    low: float
    high: float
    sd: float  # over pictures
    pictures: int
    groups: int

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return dict(self.__dict__)


def mean_interval(values: Iterable[tuple[Hashable, float]]) -> Interval | None:
    """The mean over (group, value) pairs and its interval; None where there are none.

    With a single group nothing is known of others: the interval is NaN.
    """
    by_group: dict[Hashable, list[float]] = {}
    for group, value in values:
        by_group.setdefault(group, []).append(value)
    if not by_group:
        return None
    everything = np.concatenate([np.asarray(group, float) for group in by_group.values()])
    low, high = _percentiles(list(by_group.values()))
    mean, median, sd = (float(f(everything)) for f in (np.mean, np.median, np.std))
    return Interval(mean, median, low, high, sd, len(everything), len(by_group))


def _percentiles(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """The interval of the mean over pictures, groups drawn with replacement."""
    if len(groups) < 2:
        return float("nan"), float("nan")
    totals = np.array([sum(group) for group in groups])
    counts = np.array([len(group) for group in groups])
    random, means = np.random.default_rng(_SEED), np.empty(_RESAMPLES)
    for first in range(0, _RESAMPLES, at_once := max(1, _DRAWN_AT_ONCE // len(groups))):
        part = means[first : first + at_once]
        drawn = random.integers(len(groups), size=(len(part), len(groups)))
        part[:] = totals[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.percentile(means, [_LOW, _HIGH])
    return float(low), float(high)


def average(rows: Sequence[Mapping[Key, float]]) -> dict[Key, float]:
    """Values by key, averaged over several mappings of the same keys: pictures over seeds."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
