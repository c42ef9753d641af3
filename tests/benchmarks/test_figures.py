"""The arithmetic behind the benchmarks' figures: intervals over people, and what clears the bar."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import torch
from loss_curve import curve, draw_chart, read_log
from model_card import ablations, speed, synthetic, table1, yale
from synthetic import LinearImage, drift_of, summary
from synthetic import table as held_out_table
from yale_table import COLUMNS, results, table

from facerf_cli.evaluation.measure import Row
from facerf_cli.evaluation.published import TABLE_1
from facerf_cli.evaluation.summary import Layout, summarise
from facerf_cli.metrics import average, mean_interval, tone_of


def test_interval_is_as_wide_as_that_of_the_groups_means() -> None:
    random = np.random.default_rng(0)
    groups = random.normal(size=40)
    interval = mean_interval((g, groups[g] + 0.01 * random.normal()) for g in range(40) for _ in range(50))
    assert interval is not None and (interval.images, interval.groups) == (2000, 40)
    half = 1.96 * groups.std() / math.sqrt(40)
    np.testing.assert_allclose(interval.high - interval.low, 2 * half, rtol=0.1)
    assert interval.low < interval.mean < interval.high


def test_one_group_tells_nothing_of_others() -> None:
    interval = mean_interval([("a", 1.0), ("a", 3.0)])
    assert interval is not None and interval.mean == 2 and math.isnan(interval.low)
    assert mean_interval([]) is None


def test_seeds_are_averaged_image_by_image() -> None:
    assert average([{"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 2.0}]) == {"a": 2.0, "b": 2.0}


def rows(si_mse: float, ssim: float) -> list[dict[str, Any]]:
    found = []
    for subject in ("p", "q", "r"):
        for angle in (5.0, 20.0, 40.0, 50.0, 79.9):
            found.append(row(subject, "A", "frontal", f"light{angle}", angle, si_mse, ssim))
        found.append(row(subject, "A", "dome", "light", 5.0, si_mse, ssim))
        found.append(row(subject, "B", "frontal", "env_sky", None, si_mse, ssim))
        found.append(row(subject, "B", "win_left", "env_sky", None, si_mse, ssim))
    return found


def row(
    subject: str, task: str, source: str, light: str, angle: float | None, si_mse: float, ssim: float
) -> dict[str, Any]:
    names = {"subject": subject, "task": task, "source": source, "light": light, "angle_deg": angle}
    return names | {"si_mse": si_mse, "ssim": ssim}


@pytest.mark.parametrize(
    ("si_mse", "ssim", "bar", "aim"),
    [
        (0.005, 0.80, True, True),
        (0.010, 0.80, True, False),
        (0.012, 0.80, False, False),  # between the peers
        (0.005, 0.68, False, True),
    ],
)
def test_bar_and_aim_of_the_frontal_column(si_mse: float, ssim: float, bar: bool, aim: bool) -> None:
    column = results(["a"], [rows(si_mse, ssim)], whole=True)["columns"]["frontal"]
    assert column["bar"] == {"mean": bar, "every_seed": bar, "interval": bar} and column["aim"] is aim


def test_every_seed_must_clear_the_bar_itself() -> None:
    found = results(["a", "b"], [rows(0.002, 0.8), rows(0.0118, 0.8)], whole=True)
    bar = found["columns"]["soft"]["bar"]
    assert bar == {"mean": True, "every_seed": True, "interval": True}
    frontal = found["columns"]["frontal"]
    assert frontal["bar"] == {"mean": True, "every_seed": False, "interval": True}
    np.testing.assert_allclose(frontal["si_mse"]["spread"], 0.0098)


def test_columns_hold_their_images_only() -> None:
    counts = {c.name: sum(c.holds(r) for r in rows(0.0, 0.0)) for c in COLUMNS}
    assert counts == {"frontal": 15, "soft": 3, "environment": 6} | {c.name: 3 for c in COLUMNS[3:]}


def test_no_bar_is_held_against_a_part_of_the_subjects() -> None:
    found = results(["a"], [rows(0.001, 0.9)], whole=False)
    assert not any("bar" in column for column in found["columns"].values())
    assert "no bar" in table(found) and "0.0010" in table(found)
    assert "bar: yes" in table(results(["a"], [rows(0.001, 0.9)], whole=True))


@pytest.mark.parametrize(
    ("ita", "tone"),
    [(70, "very light"), (55, "light"), (41, "intermediate"), (28, "tan"), (10, "brown"), (-30, "dark")],
)
def test_tones_are_the_published_classes(ita: float, tone: str) -> None:
    assert tone_of(ita) == tone


def test_drift_is_of_the_relit_skin_not_of_its_exposure() -> None:
    albedo = np.array([0.45, 0.30, 0.22])
    truth = torch.from_numpy(albedo).float().view(3, 1, 1).expand(3, 32, 32)
    weight = torch.ones(32, 32)
    for exposure in (0.2, 1.0, 5.0):  # a picture's own says nothing of the skin
        assert drift_of(exposure * truth, exposure * truth, weight, albedo) == pytest.approx(0, abs=1e-3)
    darker = drift_of(0.6 * truth, truth, weight, albedo)
    redder = drift_of(truth * torch.tensor([1.1, 0.95, 1.0]).view(3, 1, 1), truth, weight, albedo)
    assert darker is not None and darker < -5
    assert redder is not None and abs(redder) < 5  # the angle is of lightness and blue to yellow
    assert drift_of(truth, truth.mean(0, keepdim=True).expand(3, -1, -1), weight, albedo) is None


def test_rows_of_held_out_heads() -> None:
    images = [
        LinearImage(head, same, angle, tone, error, error, 2 * error, drift)
        for head in (1, 2)
        for same, angle, tone, error, drift in (
            (True, 10.0, "tan", 0.001, -2.0),
            (False, 75.0, None, 0.003, None),
        )
    ]
    found = summary(images)
    assert found["rows"]["same pose"]["si_mse"]["mean"] == pytest.approx(0.001)
    assert found["rows"]["60 to 90 deg"]["lambert"]["mean"] == pytest.approx(0.006)
    assert found["tones"]["tan"]["drift_deg"]["mean"] == -2 and found["tones"]["dark"]["si_mse"] is None
    assert found["tones"]["random colours"]["si_mse"]["pictures"] == 2
    assert "random colours" in held_out_table(found | {"checkpoint": "one"})


def test_the_log_is_read_to_where_it_was_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1, "loss": 2.0, "terms": {"root": 1.5}}\n{"step": 2, "loss": 1.0, "validat')
    rows = read_log(path)
    np.testing.assert_equal(curve(rows, "loss"), [[1, 2.0]])
    np.testing.assert_equal(curve(rows, "root"), [[1, 1.5]])
    assert len(curve(rows, "si_mse")) == 0
    assert draw_chart([curve(rows, "loss")], [curve(rows, "si_mse")], ["a"], ("loss", "si_mse")).width == 1100


def test_the_cards_tables_are_rectangular() -> None:
    whole = results(["a", "b"], [rows(0.002, 0.8), rows(0.003, 0.8)], whole=True)
    image = LinearImage(1, True, 10.0, "tan", 0.001, 0.001, 0.002, -2.0)
    heads = summary([image, replace(image, same_pose=False, tone=None, drift_deg=None)])
    figures = {"si_mse": 0.003, "si_mse_clipped": 0.002}
    cases = [
        Row(f"{pose} {method}", "p", method, {"pose": pose}, figures)
        for pose in ("same pose", "different pose")
        for method in ("field", "lambert")
    ]
    people = summarise(Layout("olat", "", tuple(figures), ("pose",), TABLE_1), cases).as_dict()
    clipped = {"clipped": {"mean": 0.002, "sd": 0.001}}
    by_pose = {"rows": {"same pose": clipped, "different pose": clipped}}
    runs = {"steps": 9, "ablations": {"full": by_pose, "mean face": by_pose}}
    rates = {"steps_per_s": 1.0, "bare_steps_per_s": 2.0, "ratio": 0.5, "waiting": 0.1}
    written = [
        yale(whole),
        synthetic(heads),
        table1(json.loads(json.dumps(people))),
        ablations(runs),
        speed({"presets": {"tiny": rates}}),
    ]
    for lines in written:
        parts = "\n".join(lines).split("\n\n")
        for part in parts:
            assert len({line.count("|") for line in part.splitlines()}) == 1 and part.count("\n") >= 2
    with pytest.raises(SystemExit, match="a part"):
        yale(results(["a"], [rows(0.002, 0.8)], whole=False))
