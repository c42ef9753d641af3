"""What all protocols of `facerf evaluate` do alike: walk the items, measure, keep rows, sum them up."""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from facerf_cli.commands.evaluation_options import EvaluateOptions
from facerf_cli.commands.inputs import Item
from facerf_cli.commands.options import Settings

if TYPE_CHECKING:
    from facerf_cli.evaluation.cases import Comparison
    from facerf_cli.evaluation.summary import Layout


def run_protocol(
    protocol: "Layout",
    items: Sequence[Item],
    compare: Callable[[Item], "Iterable[Comparison]"],
    options: EvaluateOptions,
    settings: Settings,
) -> int:
    """Measure the items' pictures and write their tables; give the exit code, 0 done, 1 some failed.

    `compare` (a frozen dataclass, for it goes to other processes) yields an item's pictures one after
    another. An item's rows are DIR/cases/ITEM.json, so finished items are skipped and a run that was cut off
    goes on. When all are there: DIR/summary.json, DIR/images.csv, DIR/report.html, and a table on stdout.
    Where an item failed or a prediction is missing, each is named and no summary is written.
    """
    raise NotImplementedError
