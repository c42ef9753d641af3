"""MODEL_CARD.md's tables from what the benchmarks wrote with --json, so that no figure is typed.

    python benchmarks/model_card.py yale.json synthetic.json olat/summary.json ablations.json speed.json

Prints Markdown, a table a file, each told by what it holds: what a benchmark wrote with --json, or the
summary of a `facerf evaluate`. A figure is given with its 95 % interval.
"""

import argparse
import json
from pathlib import Path
from typing import Any

Table = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", type=Path, nargs="+", help="written by --json")
    for path in parser.parse_args().files:
        found = json.loads(path.read_text())
        for key, write in WRITERS.items():
            if key in found:
                print("\n".join(write(found)) + "\n")
                break
        else:
            raise SystemExit(f"{path}: not what a benchmark writes with --json")


def _interval(part: Table, digits: int) -> str:
    """A mean with its interval, zeros before the point left out."""
    mean, low, high = (f"{part[key]:.{digits}f}".replace("0.", ".", 1) for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]"


def yale(found: Table) -> list[str]:
    """Extended Yale B: a row a column of the benchmark."""
    if not found["whole"]:
        raise SystemExit("Extended Yale B: a part of the subjects; published figures are of all of them")
    lines = [
        f"| {len(found['subjects'])} subjects, {len(found['checkpoints'])} seeds | n | Si-MSE | SSIM "
        "| Si-MSE by seed | DPR | GeomConsistentFR | quotient image | bar | aim |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, column in found["columns"].items():
        error, alike, published = column["si_mse"], column["ssim"], column["published"]
        seeds = " · ".join(f"{mean:.4f}".lstrip("0") for mean in error["seeds"])
        others = [
            f"{a:.4f}".lstrip("0") + ("" if b is None else f" / {b:.3f}".replace("0.", "."))
            for a, b in published.values()
        ]
        verdicts = [_word(column.get("bar", {}).get("mean")), _word(column.get("aim"))]
        cells = [name, error["pictures"], _interval(error, 4), _interval(alike, 3), seeds, *others, *verdicts]
        lines.append(_row(cells))
    return lines


def synthetic(found: Table) -> list[str]:
    """Held-out heads: by pose and angle, then by skin tone."""
    head = "| n | Si-MSE | its median | sd | Lambert | Si-MSE, both clipped at 1 |"
    lines = [f"| held-out heads {head}", "|---" * 7 + "|"]
    lines += [_row([name, *_errors(row)]) for name, row in found["rows"].items() if row["si_mse"]]
    lines += ["", f"| skin {head} tone drift, degrees of ITA | its size |", "|---" * 9 + "|"]
    for name, row in found["tones"].items():
        if row["si_mse"]:
            drift = row["drift_deg"]
            shown = (
                "" if drift is None else f"{drift['mean']:+.1f} [{drift['low']:+.1f}, {drift['high']:+.1f}]"
            )
            size = "" if drift is None else f"{row['drift_size_deg']['mean']:.1f}"
            lines.append(_row([name, *_errors(row), shown, size]))
    return lines


def _errors(row: Table) -> list[Any]:
    ours = row["si_mse"]
    spread = [f"{ours['median']:.5f}", f"{ours['sd']:.5f}", f"{row['lambert']['mean']:.5f}"]
    return [ours["pictures"], _interval(ours, 5), *spread, _interval(row["clipped"], 5)]


def evaluation(found: Table) -> list[str]:
    """What `facerf evaluate` wrote, by its protocol."""
    return table1(found) if found["protocol"] == "olat" else comparison(found)


def comparison(found: Table) -> list[str]:
    """Methods over all pictures, and over each column of Extended Yale B: a row a method."""
    head = "Si-MSE (sd) | its median | 95 % interval | less the first | won | Face dis (sd) | SSIM"
    people = "1 person" if found["persons"] == 1 else f"{found['persons']} people"
    count = f"{found['pictures']} pictures, {people}"
    lines = [f"| {count} | | {head} |", "|---" * 9 + "|"]
    for group in found["groups"]:
        if group["fact"] not in (None, "column"):
            continue
        error, alike = group["metrics"]["si_mse"], group["metrics"].get("ssim", {})
        for method, cell in error.items():
            apart = cell.get("less_the_first")
            paired = ["", ""] if apart is None else [_signed(apart), f"{100 * apart['won']:.0f} %"]
            own = [f"{cell['mean']:.5f} ({cell['sd']:.5f})", f"{cell['median']:.5f}"]
            own.append(_span(cell, ".5f"))
            face = group["metrics"].get("face_distance", {}).get(method)
            shown = "" if face is None else f"{face['mean']:.3f} ({face['sd']:.3f})"
            ssim = f"{alike[method]['mean']:.3f}" if method in alike else ""
            lines.append(_row([group["value"] or "all", method, *own, *paired, shown, ssim]))
    return lines


def _signed(part: Table) -> str:
    return f"{part['mean']:+.5f} {_span(part, '+.5f')}".strip()


def _span(part: Table, form: str) -> str:
    """An interval; of one person there is none."""
    return "" if part["low"] is None else f"[{part['low']:{form}}, {part['high']:{form}}]"


def table1(found: Table) -> list[str]:
    """The paper's Table 1, and Table 3 where another checkpoint stands beside: a row a method and pose."""
    lines = [
        f"| {found['persons']} synthetic people | | n | Si-MSE (sd) | truth clipped at white (sd) "
        "| 95 % interval | the paper's Table 1, on its own data (sd) |",
        "|---|---|---|---|---|---|---|",
    ]
    paper = {tuple(row["group"]): row for row in found["published"] if row["source"] == "Table 1"}
    for group in found["groups"]:
        if group["fact"] != "pose":
            continue
        whole, clipped = (group["metrics"][name] for name in ("si_mse", "si_mse_clipped"))
        published = paper["pose", group["value"]]
        for method, clip in clipped.items():
            both = [f"{part['mean']:.5f} ({part['sd']:.5f})" for part in (whole[method], clip)]
            beside = f"{published['mean']:.5f} ({published['sd']:.5f})" if method == "field" else ""
            cells = [*both, f"[{clip['low']:.5f}, {clip['high']:.5f}]", beside]
            lines.append(_row([group["value"], method, clip["pictures"], *cells]))
    return lines


def ablations(found: Table) -> list[str]:
    """The paper's ablations: a column a run."""
    names = list(found["ablations"])
    lines = [
        _row([f"Si-MSE, truth clipped at white (sd); {found['steps']} steps each", *names]),
        "|---" * (len(names) + 1) + "|",
    ]
    for row in ("same pose", "different pose"):
        cells = [found["ablations"][name]["rows"][row]["clipped"] for name in names]
        lines.append(_row([row, *(f"{cell['mean']:.5f} ({cell['sd']:.5f})" for cell in cells)]))
    return lines


def speed(found: Table) -> list[str]:
    """Steps per second of training."""
    lines = [
        "| preset | steps a second | bare loop | ratio | waiting on data |",
        "|---|---|---|---|---|",
    ]
    for name, row in found["presets"].items():
        rates = [f"{row['steps_per_s']:.2f}", f"{row['bare_steps_per_s']:.2f}", f"{row['ratio']:.2f}"]
        lines.append(_row([name, *rates, f"{100 * row['waiting']:.1f} %"]))
    return lines


def _row(cells: list[Any]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _word(held: bool | None) -> str:
    return "" if held is None else "yes" if held else "no"


WRITERS = {
    "columns": yale,
    "tones": synthetic,
    "groups": evaluation,
    "ablations": ablations,
    "presets": speed,
}

if __name__ == "__main__":
    main()
