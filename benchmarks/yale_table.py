"""The columns of the Extended Yale B benchmark, what it publishes of others, and a table of both."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

from facerf_cli.evaluation.protocols.yale_b import FIGURES, PEERS
from facerf_cli.evaluation.protocols.yale_b_cases import ANGLES_DEG
from facerf_cli.metrics import average, mean_interval

Row = dict[str, Any]  # a picture: subject, task, source, light, angle_deg, si_mse, ssim

QUOTIENT = "quotient image"  # told more than a single photo may know


@dataclass(frozen=True)
class Column:
    """A mean that is reported: which pictures enter, and what others have there (Si-MSE, SSIM)."""

    name: str
    holds: Callable[[Row], bool]
    peers: dict[str, tuple[float, float | None]]  # SSIM by angle is not published
    quotient: tuple[float, float | None]  # told more than a single photo may know
    aim: float | None = None  # Si-MSE that was set as the goal


def _of(task: str, sources: str, row: Row) -> bool:
    soft = row["source"] != "frontal"
    return row["task"] == task and (sources == "all" or soft == (sources == "soft"))


def _between(low: int, high: int, row: Row) -> bool:
    return _of("A", "frontal", row) and low <= row["angle_deg"] < high


_BINS = list(pairwise(ANGLES_DEG))
_AIMS = (0.0065, 0.0068, 0.0072)


def _at(method: str, column: int) -> tuple[float, float]:
    return FIGURES[method][0][column]


def _at_angle(method: str, place: int) -> tuple[float, None]:
    return FIGURES[method][1][place], None


COLUMNS = [
    Column(
        name,
        partial(_of, task, sources),
        {peer: _at(peer, i) for peer in PEERS},
        _at(QUOTIENT, i),
        _AIMS[i],
    )
    for i, (name, task, sources) in enumerate(
        [("frontal", "A", "frontal"), ("soft", "A", "soft"), ("environment", "B", "all")]
    )
] + [
    Column(
        f"{low}-{high} deg",
        partial(_between, low, high),
        {peer: _at_angle(peer, i) for peer in PEERS},
        _at_angle(QUOTIENT, i),
    )
    for i, (low, high) in enumerate(_BINS)
]


def results(checkpoints: list[str], seeds: list[list[Row]], whole: bool) -> dict[str, Any]:
    """All figures: of every column the seeds' mean with its interval over subjects, each seed, the verdicts.

    `whole` says that all subjects were scored; published figures are of these, so only then is there a bar.
    """
    columns = {column.name: _column(column, seeds, whole) for column in COLUMNS}
    subjects = sorted({row["subject"] for row in seeds[0]})
    return {"checkpoints": checkpoints, "subjects": subjects, "whole": whole, "columns": columns}


def _column(column: Column, seeds: list[list[Row]], whole: bool) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for measure in ("si_mse", "ssim"):
        each = [
            {(row["subject"], row["source"], row["light"]): row[measure] for row in rows if column.holds(row)}
            for rows in seeds
        ]
        interval = mean_interval((key[0], value) for key, value in average(each).items())
        if interval is None:
            continue
        means = [sum(seed.values()) / len(seed) for seed in each]
        found[measure] = interval.as_dict() | {"seeds": means, "spread": max(means) - min(means)}
    if whole and found:
        found["bar"] = _bar(column, found)
        found["past_quotient_image"] = found["si_mse"]["mean"] < column.quotient[0]
        found["aim"] = None if column.aim is None else found["si_mse"]["mean"] <= column.aim
    found["published"] = column.peers | {"quotient image": column.quotient}
    return found


def _bar(column: Column, found: dict[str, Any]) -> dict[str, bool]:
    """Whether it is below every peer in Si-MSE and, where they have one, above in SSIM.

    Asked of the mean, of every seed, and of the worse ends of the intervals.
    """
    error = min(peer[0] for peer in column.peers.values())
    alike = [peer[1] for peer in column.peers.values() if peer[1] is not None]

    def clears(si_mse: float, ssim: float) -> bool:
        return si_mse < error and (not alike or ssim > max(alike))

    seeds = zip(found["si_mse"]["seeds"], found["ssim"]["seeds"], strict=True)
    return {
        "mean": clears(found["si_mse"]["mean"], found["ssim"]["mean"]),
        "every_seed": all(clears(*seed) for seed in seeds),
        "interval": clears(found["si_mse"]["high"], found["ssim"]["low"]),
    }


def table(found: dict[str, Any]) -> str:
    """The figures for reading."""
    count = len(found["subjects"])
    lines = [f"Extended Yale B, {count} subjects: Si-MSE | SSIM, mean [95 % interval over subjects]"]
    for number, checkpoint in enumerate(found["checkpoints"]):
        lines.append(f"  seed {number}: {checkpoint}")
    blocks = [_block(name, column) for name, column in found["columns"].items() if "si_mse" in column]
    for block in blocks:
        lines += ["", *block] if len(block) > 1 else block
    if not found["whole"]:
        lines.append("\nA part of the subjects: the published figures are of all 21, so no bar is held up.")
    return "\n".join(lines)


def _block(name: str, column: dict[str, Any]) -> list[str]:
    error, alike = column["si_mse"], column["ssim"]
    size = f"n={error['pictures']}"
    lines = [
        f"{name:12}{size:11}{error['mean']:.4f} [{error['low']:.4f}, {error['high']:.4f}] | "
        f"{alike['mean']:.3f} [{alike['low']:.3f}, {alike['high']:.3f}]"
    ]
    if len(error["seeds"]) > 1:
        for number, (a, b) in enumerate(zip(error["seeds"], alike["seeds"], strict=True)):
            lines.append(f"  {f'seed {number}':21}{a:.4f} | {b:.3f}")
        lines.append(f"  {'spread of seeds':21}{error['spread']:.4f} | {alike['spread']:.3f}")
    if "bar" not in column:
        return lines
    for peer, (a, published) in column["published"].items():
        lines.append(f"  {peer:21}{a:.4f} | {'not published' if published is None else f'{published:.3f}'}")
    bar = column["bar"]
    verdict = f"  bar: {_yes(bar['mean'])} (every seed: {_yes(bar['every_seed'])}, "
    verdict += f"whole interval: {_yes(bar['interval'])})"
    if column["aim"] is not None:
        verdict += f"; aim: {_yes(column['aim'])}"
    return [*lines, f"{verdict}; past the quotient image: {_yes(column['past_quotient_image'])}"]


def _yes(held: bool) -> str:
    return "yes" if held else "NO"
