"""Which of an item's strips are kept: the worst, the best and some that are neither, never all."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.strips import Strip
from facerf_cli.evaluation.summary import shown_as

_WORST, _WORST_OF_OTHERS, _BEST, _TYPICAL = 8, 2, 2, 2
_SAMPLE = 16  # of which the most typical ones are taken


@dataclass(frozen=True, eq=False)
class _Entry:
    height: float
    case: str
    strip: Strip


@dataclass(eq=False)
class StripKeeper:
    """Fed an item's pictures one after another, it holds a bounded number of strips.

    By `metric`: the worst of the first method, fewer of each other one, the best, and, from an even sample of
    all, those nearest to the median.
    """

    metric: str
    _worst: dict[str, list[_Entry]] = field(default_factory=dict)  # by method
    _best: list[_Entry] = field(default_factory=list)
    _sample: list[_Entry] = field(default_factory=list)
    _all: list[float] = field(default_factory=list)
    _stride: int = 1

    def offer(self, rows: Sequence[Row], make: Callable[[], Strip]) -> None:
        """A picture's rows, one a method; its strip is made only where it is kept."""
        made = cache(make)
        for index, row in enumerate(rows):
            badness = self._badness(row)
            if not math.isfinite(badness):
                continue
            worst = self._worst.setdefault(row.method, [])
            _insert(worst, badness, row.case, made, _WORST if index == 0 else _WORST_OF_OTHERS)
            if index == 0:
                _insert(self._best, -badness, row.case, made, _BEST)
                self._take_sample(badness, row.case, made)

    def kept(self) -> dict[str, Strip]:
        """The strips by case, in the order of the cases' names."""
        entries = [*self._best, *(entry for worst in self._worst.values() for entry in worst)]
        if self._all:
            median = sorted(self._all)[len(self._all) // 2]
            entries += sorted(self._sample, key=lambda entry: abs(entry.height - median))[:_TYPICAL]
        return {entry.case: entry.strip for entry in sorted(entries, key=lambda entry: entry.case)}

    def _take_sample(self, badness: float, case: str, made: Callable[[], Strip]) -> None:
        """Keep every `_stride`-th picture, and twice that stride when they are too many."""
        if len(self._all) % self._stride == 0:
            self._sample.append(_Entry(badness, case, made()))
        self._all.append(badness)
        if len(self._sample) > _SAMPLE:
            del self._sample[1::2]
            self._stride *= 2

    def _badness(self, row: Row) -> float:
        value = row.values.get(self.metric, math.nan)
        return value if shown_as(self.metric).lower_is_better else -value


def _insert(highest: list[_Entry], height: float, case: str, made: Callable[[], Strip], most: int) -> None:
    """Keep the `most` highest, the highest first; of equals the earlier one."""
    if len(highest) < most or height > highest[-1].height:
        highest.append(_Entry(height, case, made()))
        highest.sort(key=lambda entry: -entry.height)
        del highest[most:]
