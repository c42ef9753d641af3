"""Who is trained on, validated with and tested with: subjects drawn by their names."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.stage.data.dataset import SPLITS


@dataclass(frozen=True)
class Split:
    """How many subjects go to training, validation and test: counts, or shares of all that sum to 1."""

    parts: tuple[float, float, float]
    are_shares: bool

    @staticmethod
    def parse(text: str) -> "Split":
        """`300/10/40` or `0.8/0.1/0.1`."""
        words = text.split("/")
        advice = f"--split {text!r}: give counts of subjects such as 300/10/40, or shares such as 0.8/0.1/0.1"
        if len(words) == 3 and all(word.isascii() and word.isdecimal() for word in words):
            train, validation, test = (float(word) for word in words)
            return Split((train, validation, test), are_shares=False)
        try:
            train, validation, test = (float(word) for word in words)
        except ValueError:
            raise UsageError(advice) from None
        if not (min(train, validation, test) >= 0 and abs(train + validation + test - 1) < 1e-6):
            raise UsageError(f"{advice} (shares are not negative and sum to 1)")
        return Split((train, validation, test), are_shares=True)

    def counts(self, subjects: int) -> tuple[int, int, int]:
        """How many of so many subjects go where; of shares, none but 0 goes without one if that can be."""
        if not self.are_shares:
            train, validation, test = (int(part) for part in self.parts)
            if train + validation + test > subjects:
                wanted = "/".join(str(int(part)) for part in self.parts)
                raise UsageError(
                    f"--split {wanted}: {train + validation + test} subjects, but the capture has "
                    f"{subjects}; give shares such as 0.8/0.1/0.1"
                )
            return train, validation, test
        exact = np.array(self.parts) * subjects
        counts = np.floor(exact + 1e-9).astype(int)
        order = np.argsort(counts - exact, kind="stable")
        counts[order[: subjects - counts.sum()]] += 1  # the largest remainders
        for part in np.flatnonzero((counts == 0) & (np.array(self.parts) > 0)):
            if counts.max() > 1:
                counts[counts.argmax()] -= 1
                counts[part] = 1
        train, validation, test = counts.tolist()
        return train, validation, test

    def of(self, subjects: Iterable[str], seed: int) -> dict[str, tuple[str, ...]]:
        """The subjects of each split, sorted.

        They are cut from an order that depends on each subject's name and the seed alone, so that a subject
        more or less moves few of the others.
        """
        order = sorted(subjects, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
        ends = np.cumsum([0, *self.counts(len(order))]).tolist()
        parts = (order[first:last] for first, last in pairwise(ends))
        return {split: tuple(sorted(part)) for split, part in zip(SPLITS, parts, strict=True)}
