"""Tables from rows: means, people, facts, and what is better than the first method."""

import math
from dataclasses import replace

import numpy as np
import pytest

from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.metrics import Interval
from facerf_cli.evaluation.summary import (
    Cell,
    Layout,
    cell_words,
    natural,
    print_tables,
    summarise,
)

LAYOUT = Layout("Toy", ("si_mse", "psnr"), ("pose",))
ERRORS = {"ours": (0.1, 0.2, 0.4, 0.3), "theirs": (0.2, 0.1, 0.8, 0.3)}
PEOPLE = ("a", "a", "b", "b")
POSES = ("same pose", "different pose", "same pose", "different pose")


def rows() -> list[Row]:
    return [
        Row(f"case{n}", PEOPLE[n], method, {"pose": POSES[n], "az": 3.0}, {"si_mse": e[n], "psnr": -e[n]})
        for method, e in ERRORS.items()
        for n in range(4)
    ]


def test_means_and_pairs_by_hand() -> None:
    summary = summarise(LAYOUT, rows())
    assert (summary.images, summary.persons, summary.methods) == (4, 2, ("ours", "theirs"))
    ours, theirs = (summary.groups[0].cells["si_mse"][name] for name in summary.methods)
    assert ours.interval.mean == pytest.approx(0.25)
    assert ours.interval.sd == pytest.approx(np.std(ERRORS["ours"]))
    assert ours.difference is None and theirs.difference.mean == pytest.approx(0.1)
    assert theirs.won == pytest.approx(1.5 / 4)  # one better, one alike, two worse
    # PSNR's more is better: the same wins though every sign is the other way round.
    assert summary.groups[0].cells["psnr"]["theirs"].won == pytest.approx(1.5 / 4)
    # Two people: the interval of the mean spans their own means at most.
    assert 0.15 - 1e-9 <= ours.interval.low <= ours.interval.high <= 0.35 + 1e-9


def test_figures_have_two_digits_of_their_uncertainty() -> None:
    first = Interval(0.006523, 0.006123, 0.00553, 0.00781, 0.00312, 800, 21)
    apart = Interval(0.000812, 0.0008, 0.00071, 0.00093, 0.0003, 800, 21)
    cell = Cell(first, 0, apart, 0.257)
    figures = ["0.0065", "0.0031", "0.0061", "0.0055 to 0.0078", "+0.00081 (+0.00071 to +0.00093)", "26 %"]
    assert cell_words(cell, 5) == figures
    unknown = replace(first, low=math.nan, high=math.nan)
    assert cell_words(Cell(unknown, 0), 5)[0] == "0.00652"


def test_a_table_of_long_names_loses_no_column(capsys: pytest.CaptureFixture[str]) -> None:
    long = [
        replace(row, method=f"{row.method}_of_people", values={"si_mse": row.values["si_mse"] / 100})
        for row in rows()
    ]
    print_tables(summarise(Layout("Toy", ("si_mse",), ("pose",)), long))
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100 and out.count(" won") == 1
    assert out.count(" %") == 1 + 3  # of the interval's column, and the second method's in all groups


def test_without_people_there_are_no_intervals_and_values_that_are_none_are_counted() -> None:
    unknown = [replace(row, person="" if row.case == "case0" else row.person) for row in rows()]
    summary = summarise(LAYOUT, unknown)
    for cell in summary.groups[0].cells["si_mse"].values():
        assert math.isnan(cell.interval.low) and cell.interval.mean > 0
        assert cell.difference is None or math.isnan(cell.difference.high)
    assert (summary.size, summarise(LAYOUT, rows()).size) == ("4 images", "4 images of 2 people")
    # Such as the Si-MSE of images near black, which must not improve the mean.
    found = rows()
    found[0].values["si_mse"] = math.nan
    summary = summarise(LAYOUT, found)
    ours, theirs = summary.groups[0].cells["si_mse"].values()
    assert (ours.interval.mean, ours.interval.images, ours.left_out) == (pytest.approx(0.3), 3, 1)
    assert theirs.difference.images == 3 and theirs.left_out == 0  # only where both are
    assert "Si-MSE excludes 1 image" in summary.layout.notes[-1]
    assert summarise(LAYOUT, rows()).layout == LAYOUT


def test_text_breaks_the_tables_down_and_numbers_do_not() -> None:
    summary = summarise(Layout("Toy", ("si_mse",), ("pose", "not there")), rows())
    assert [(group.fact, group.value) for group in summary.groups] == [
        ("", ""), ("pose", "different pose"), ("pose", "same pose"),
    ]  # fmt: skip
    assert summary.groups[1].cells["si_mse"]["ours"].interval.mean == pytest.approx(0.25)
    assert summary.groups[2].cells["si_mse"]["theirs"].interval.mean == pytest.approx(0.5)
    assert "psnr" in summary.groups[0].cells and "psnr" not in summary.groups[1].cells
    by_all_text = summarise(Layout("Toy"), rows())
    assert repr(by_all_text.groups) == repr(summary.groups)  # NaN is equal to NaN only up to Python 3.12
    many = [replace(row, facts={"map": f"{row.case}.{n}"}) for n, row in enumerate(3 * rows())]
    keyed = [replace(row, case=f"{n}") for n, row in enumerate(many)]
    assert len(summarise(Layout("Toy"), keyed).groups) == 1  # but by none of many values


def test_bins_sort_as_numbers_do() -> None:
    assert sorted(["90 to 180 deg", "5 deg", "30 to 60 deg", "10 deg"], key=natural) == [
        "5 deg", "10 deg", "30 to 60 deg", "90 to 180 deg",
    ]  # fmt: skip
