"""Is a photo called sure that can be used, and only such a one?

    python benchmarks/confidence.py [--matte DIR] [--photos FILE ...] [--keep DIR]

Spoils photos of people (overexposed, dark, blurred, cropped, covered, another person pasted in) and compares
the word for each with the truth. *Bad* is a matte whose IoU with the person is under .93, or landmarks that
lie more than 5 % of the eyes' distance from those of the unspoiled photo, or no face. The person is drawn by
hand (`polygons.json` of --matte), known of synthetic people, or the matte of the unspoiled photo for those of
--photos. The scales of `portrait/confidence.py` were set on the scenes of SETTING, and are measured on the
others. --keep holds the facts of each scene, so that a run with other scales takes no time.
"""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _common import SHARED, arguments, required
from _spoiled_photos import Scene, all_scenes, face_near, spoiled

from facerf_cli.image.colour import to_display
from facerf_cli.portrait.confidence import confidence_of, face_facts
from facerf_cli.portrait.segment import segment
from facerf_cli.relighting.models import SHIPPED_NETWORKS

LEAST_IOU, MOST_OFF = 0.93, 0.05
SETTING = ("astronaut", "grace_hopper", "obama", "synthetic 0", "synthetic 1", "synthetic 2", "synthetic 3")


def measure(scene: Scene) -> dict[str, Any]:
    """IoU, landmarks' error and facts of a scene; nothing where no face is found."""
    image = to_display(scene.linear)
    face = face_near(image, scene.landmarks_px.mean(0))
    if face is None or face.view is None:
        return {}
    found = segment(SHIPPED_NETWORKS.people, image, face.landmarks_px)
    mine, true = found.matte[~scene.ignored] > 0.5, scene.person[~scene.ignored]
    iou = float((mine & true).sum() / max((mine | true).sum(), 1))
    off = float(np.linalg.norm(face.landmarks_px - scene.landmarks_px, axis=1).mean() / scene.eyes_px)
    return {"iou": iou, "off": off, "facts": {**face_facts(face.view, scene.linear), **found.facts}}


def measured(name: str, scenes: dict[str, Scene], keep: Path | None) -> dict[str, dict[str, Any]]:
    """Measures of the variants of a scene, by their names; the other person is of the next scene like it."""
    if keep and (path := keep / f"{name}.json").is_file():
        return dict(json.loads(path.read_text()))
    kind = (name in SETTING, name.startswith("synthetic"))
    alike = sorted(one for one in scenes if (one in SETTING, one.startswith("synthetic")) == kind)
    other = scenes[alike[(alike.index(name) + 1) % len(alike)]]
    found = {variant: measure(scene) for variant, scene in spoiled(scenes[name], other)}
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{name}.json").write_text(json.dumps(found))
    return found


def report(rows: list[tuple[str, dict[str, Any]]]) -> None:
    """Print, by variant and of all, how many are good and bad, and how many of them are called sure."""
    counts: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(5, int))
    for variant, row in rows:
        bad = not row or row["iou"] < LEAST_IOU or row["off"] > MOST_OFF
        sure = bool(row) and confidence_of(row["facts"]).word == "sure"
        for of in (variant, "all"):
            counts[of] += [not bad, sure and not bad, bad, sure and bad, not row]
    for of, (good, sure_good, bad, sure_bad, lost) in counts.items():
        print(
            f"{of:24} good {good:3}, sure {sure_good:3}   bad {bad:3} (no face {lost:2}), sure {sure_bad:3}"
        )
    good, sure_good, bad, sure_bad, _ = counts["all"]
    print(f"sure: {sure_good / max(good, 1):.1%} of the good, {sure_bad / max(bad, 1):.1%} of the bad\n")


def main() -> None:
    """Print a table of the scenes that the scales were set on, and one of the others."""
    parser = arguments(__doc__)
    parser.add_argument("--matte", type=Path, default=SHARED / "bench" / "matte")
    parser.add_argument("--photos", type=Path, nargs="*", default=[])
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    scenes = all_scenes(required(options.matte, "outlines drawn by hand", "--matte"), options.photos)
    for setting in (True, False):
        names = sorted(name for name in scenes if (name in SETTING) == setting)
        print("Scales set on" if setting else "Measured on", ", ".join(names))
        rows = [measured(name, scenes, options.keep).items() for name in names]
        report([row for scene in rows for row in scene])


if __name__ == "__main__":
    main()
