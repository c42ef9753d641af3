"""Whether the synthetic stage's people pass for faces: dlib's detector on the frontal, fully lit pictures.

    facerf synth-stage -o out/capture --subjects 60
    python benchmarks/synth_stage.py out/capture

A face counts as found where the detector finds exactly one. The landmark error is the mean distance to the
true landmarks over that of the outer eye corners; by skin tone (ITA classes) too.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from facerf_cli.face.landmarks import detect_landmarks, to_display
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.files.images import read_image
from facerf_cli.raster.camera import project
from facerf_cli.synth.stage_cameras import stage_cameras

ITA_CLASSES = (
    (55, "very light"),
    (41, "light"),
    (28, "intermediate"),
    (10, "tan"),
    (-30, "brown"),
    (-91, "dark"),
)
GOOD_SHARE, GOOD_ERROR = 0.98, 0.05


def landmark_errors(subject: Path) -> tuple[float, float] | None:
    """Mean error of all 68 points and of the 51 inner ones, in inter-ocular distances; None if unfound."""
    lit = np.mean([read_image(path).pixels for path in sorted((subject / "C0").glob("*.exr"))], 0)
    faces = detect_landmarks(to_display(lit))
    if len(faces) != 1:
        return None
    record = json.loads((subject / "subject.json").read_text())
    shot = stage_cameras(lit.shape[0])[0]
    world = torch.tensor(record["landmarks_world"], dtype=torch.float32)
    truth = project(world @ shot.head_to_camera.T + shot.translation_m, shot.camera).numpy()
    left, right = OUTER_EYE_CORNERS
    errors = np.linalg.norm(faces[0].landmarks_px - truth, axis=-1) / np.linalg.norm(
        truth[left] - truth[right]
    )
    return float(errors.mean()), float(errors[len(CONTOUR) :].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("capture", type=Path)
    folders = sorted(path.parent for path in parser.parse_args().capture.glob("*/subject.json"))
    rows: dict[str, list[tuple[float, float] | None]] = {"all": []}
    for folder in folders:
        ita_deg = json.loads((folder / "subject.json").read_text())["traits"]["ita_deg"]
        tone = next(name for bound, name in ITA_CLASSES if ita_deg > bound)
        result = landmark_errors(folder)
        if result is None:
            print(f"{folder.name}: not found ({tone})")
        for name in ("all", tone):
            rows.setdefault(name, []).append(result)
    print(f"{'':14} people  found   68 points  51 inner")
    for name in ("all", *(name for _, name in ITA_CLASSES if name in rows)):
        found = [result for result in rows[name] if result]
        every, inner = np.mean(found, 0) if found else (np.nan, np.nan)
        share = len(found) / len(rows[name])
        print(f"{name:14} {len(rows[name]):6}  {share:5.1%}  {every:9.2%}  {inner:8.2%}")
    found = [result for result in rows["all"] if result]
    good = len(found) >= GOOD_SHARE * len(folders) and np.mean(found, 0)[0] <= GOOD_ERROR
    print(f"asked: {GOOD_SHARE:.0%} found, error up to {GOOD_ERROR:.0%}: {'held' if good else 'MISSED'}")


if __name__ == "__main__":
    main()
