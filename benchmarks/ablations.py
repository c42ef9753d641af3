"""The paper's ablations at one budget: without normal maps, with the mean face alone, and with everything.

    python benchmarks/ablations.py --bank RUN/bank [--heads-from PATH] --steps 600 --dataset DATASET

Each is trained from scratch by `facerf train` on the same baked heads, with the same seed, schedule and
number of steps, then measured (1) as the paper does, on pictures of held-out people, each fitted by its own
landmarks with the face model that the run was trained with (`facerf evaluate olat --refit --network-alone`
does so for the full method and the one without normal maps: the paper's Table 3), and (2) on
held-out heads in the chart of their fits (`synthetic.py`), where a wrong shape costs less, for the truth is
seen through the same fit. What is interrupted goes on; a finished run is not trained again.
"""

import argparse
import json
import subprocess
import sys
from itertools import groupby
from pathlib import Path
from typing import Any

import synthetic
import torch

from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import read_pairs
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.people import Person
from facerf_cli.evaluation.protocols.olat import compare_olats
from facerf_cli.metrics import mean_interval, si_mse_clipped
from facerf_cli.pipeline import Models, load_models

RUNS = {"without normal maps": ["--without-normals"], "mean face": ["--mean-face"], "full": []}
_MEAN_FACE = "builtin-mean"  # the face model that `facerf train --mean-face` leaves in the bank


def main() -> None:
    given = _arguments()
    bank = given.output / "bank"
    link_bank(given.bank, bank, given.heads)
    found: dict[str, Any] = {}
    for name, options in RUNS.items():
        folder = given.output / name.replace(" ", "-")
        checkpoint = train(folder, bank, options, given)
        found[name] = measure(checkpoint, bank, name == "mean face", given)
        print(f"{name}: measured", file=sys.stderr, flush=True)
    result = {
        "preset": given.preset,
        "steps": given.steps,
        "heads": given.heads,
        "seed": given.seed,
        "ablations": found,
    }
    print(table(result))
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--bank", type=Path, required=True, help="folder that `facerf train` filled")
    add("--heads-from", default="builtin", help="the face model that the bank's heads were drawn from")
    add("--heads", type=int, default=60, help="of the bank, the mean face and those held out among them")
    add("--preset", default="default", choices=["default", "tiny"], help="tiny: to try this script out")
    add("--steps", type=int, default=400, help="of each run")
    add("--seed", type=int, default=0)
    add("--dataset", type=Path, help="prepared, with pairs; nobody in it is trained on")
    add("--every", type=int, default=1, help="measure every Nth pair only")
    add("--draws", type=int, default=20, help="samples of each held-out head")
    add("-o", "--output", type=Path, default=Path("out/ablations"), help="folder of the runs")
    add("--json", type=Path, help="write all figures here")
    given = parser.parse_args()
    if given.heads < synthetic.HELD_OUT + 4:
        parser.error(f"--heads: {synthetic.HELD_OUT + 4} at the least")
    return given


def link_bank(bank: Path, small: Path, heads: int) -> None:
    """A bank of the first heads of another, and of the views that these have."""
    names = [path.name for path in sorted((bank / "heads").glob("*.safetensors"))][:heads]
    if len(names) < heads:
        raise SystemExit(f"{bank}: {len(names)} heads, {heads} are wanted; give --heads")
    for kind in ("heads", "views-builtin"):
        (small / kind).mkdir(parents=True, exist_ok=True)
        for name in names:
            link = small / kind / name
            if (bank / kind / name).exists() and not link.exists():
                link.symlink_to((bank / kind / name).resolve())


def train(folder: Path, bank: Path, options: list[str], given: argparse.Namespace) -> Path:
    """Train, go on with, or find a run."""
    words = [sys.executable, "-m", "facerf_cli", "-q", "--seed", str(given.seed), "train"]
    words += [
        "--preset",
        given.preset,
        "-o",
        str(folder),
        "--bank",
        str(bank),
        "--heads",
        str(given.heads),
        *options,
    ]
    words += ["--heads-from", given.heads_from]
    words += ["--steps", str(given.steps), "--validate-every", str(max(1, given.steps // 3)), "--jobs", "1"]
    if (folder / "state.pt").exists():
        words.append("--resume")
    if subprocess.run(words, stdout=sys.stderr).returncode:
        raise SystemExit(f"{folder}: facerf train failed")
    return folder / "last.safetensors"


def measure(checkpoint: Path, bank: Path, mean_face: bool, given: argparse.Namespace) -> dict[str, Any]:
    """The errors of a run: `rows` on pictures where there is a dataset, `chart` on held-out heads."""
    fitted_with = _MEAN_FACE if mean_face else "builtin"
    face_model = bank / f"{_MEAN_FACE}.npz" if mean_face else "builtin"
    models = load_models(checkpoint, face_model, torch.device("cpu"))
    heads = synthetic.held_out_bank(bank, fitted_with, synthetic.HELD_OUT)
    images = list(synthetic.measure(models.network, *heads, given.draws, 6))
    chart = synthetic.summary(images)["rows"]
    found = {"chart": chart, "rows": chart, "people": 0}
    if given.dataset:
        found |= on_people(models, read_dataset(given.dataset), given.every)
    return found


def on_people(models: Models, dataset: Dataset, step: int) -> dict[str, Any]:
    """The errors on pictures of held-out people, every `step`th pair, each fitted by its own landmarks."""
    pairs = [pair for pair in read_pairs(dataset) if pair.split == "test"][::step]
    if not pairs:
        raise SystemExit(f"{dataset.folder}: no pairs in the split test; run facerf relight-dataset")
    method, rows = Method("field", "field", models), []
    for subject, own in groupby(pairs, lambda pair: pair.subject):
        person = Person(models.face, dataset, subject, refit=True)
        for found in compare_olats(person, own, [method], held_to_photo=False):
            error = si_mse_clipped(found.predictions["field"], found.truth, found.mask)
            rows.append((found.case.facts["pose"], subject, error))
    intervals = {
        name: mean_interval((subject, error) for pose, subject, error in rows if pose == name)
        for name in ("same pose", "different pose")
    }
    by_pose = {name: {"clipped": found.as_dict()} for name, found in intervals.items() if found}
    return {"rows": by_pose, "people": len({subject for _, subject, _ in rows})}


def table(result: dict[str, Any]) -> str:
    """The figures for reading, in the shape of the paper's tables."""
    names = list(result["ablations"])
    lines = [f"{result['steps']} steps each on {result['heads']} heads, seed {result['seed']}: "]
    lines[0] += "Si-MSE, truth clipped at white (sd)"
    people = result["ablations"][names[0]]["people"]
    parts = [("chart", "held-out heads, in the chart")]
    if people:
        parts.insert(0, ("rows", f"pictures of {people} held-out people"))
    for part, title in parts:
        lines.append(f"{title:34}" + "".join(f"{name:>24}" for name in names))
        for row in ("same pose", "different pose"):
            cells = [result["ablations"][name][part][row]["clipped"] for name in names]
            lines.append(f"  {row:32}" + "".join(f"{c['mean']:13.5f} ({c['sd']:.5f})  " for c in cells))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
