"""The closed loop: a photo relit by a known light, that light estimated back, both compared.

    python benchmarks/closed_loop.py [PHOTO|DIR ...] [--maps ../shared/data/hdri] [--way texture picture]
        [--refine] [--signed] [--json FILE]

Lights are maps, each as it is and turned by 120 degrees, and lamps drawn from a seed: a coloured key light
and a dim one in front. `texture` relights the face in the chart and estimates from that texture. `picture`
does what a user would: `facerf relight`, its 8-bit PNG into `facerf estimate-light`, which finds and fits the
face anew; where the detector takes something else for the face the case is said and left out.

- angle: between the brightest directions (`light/rig_latlong.py`), in degrees.
- weights: |estimate - truth| / |truth| over the 150 lights' rgb weights. How bright a light is cannot be told
  from how bright the skin is, so also after the one factor that fits best (scaled). SH: the same of the
  coefficients up to order 2, which is about what a matt face can tell.
- `seen` is over lights whose brightest direction lies before the plane of the face (z > 0). What shines from
  behind it grazes the face's rim or does not reach it at all: there the problem has no one answer.
"""

import argparse
import io
import json
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.cli.batch import Item
from facerf_cli.cli.light_options import LIGHT_FEATURES
from facerf_cli.cli.options import Settings
from facerf_cli.cli.photo_options import PhotoOptions, fit_faces, load_models_once, read_photo
from facerf_cli.face.landmarks import find_faces
from facerf_cli.files.images import read_image
from facerf_cli.files.light_files import read_light
from facerf_cli.light.envmap import rotated_weights
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import (
    RigLight,
    azel_to_direction,
    brightest_direction,
    direction_to_azel,
    rig_directions,
)
from facerf_cli.main import main as facerf
from facerf_cli.metrics import light_error_deg
from facerf_cli.pipeline import (
    FaceTexture,
    explain_photo,
    light_evidence,
    predict_olat,
    refine_photo_light,
    weigh_batches,
)
from facerf_cli.training.pretrained import load_light_features

PHOTOS = [Path("examples/astronaut.jpg"), Path("../shared/data/photos")]
TURNS_DEG = (0, 120)  # evenly spaced from 0, as --rotate FROM:TO:N has them
LAMPS, FILL = 6, 0.15
MEASURES = ("angle", "weights", "weights scaled", "SH", "SH scaled")
RIG = rig_directions()
_MOVED_PX = 30.0  # further from where it was, it is another face


@dataclass(frozen=True, eq=False)
class Known:
    """A light [150, 3] over the rig, and how `facerf relight` is asked for it."""

    name: str  # of relight's picture
    weights: Tensor
    option: tuple[str, str]


def main() -> None:
    given = _arguments()
    torch.set_num_threads(1)
    lights = [*maps(given.maps), *lamps(given.seed)]
    rows = []
    for photo in (path for entry in given.photos for path in _photos(entry)):
        for way in given.way:
            estimates = in_texture if way == "texture" else through_image
            for light, found in estimates(photo, lights, given):
                rows.append({"way": way, "photo": photo.stem, "light": light.name, **compared(found, light)})
                print(
                    way, photo.stem, light.name, *(f"{rows[-1][name]:.3g}" for name in MEASURES), flush=True
                )
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    for way in given.way:
        table(way, [row for row in rows if row["way"] == way])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("photos", type=Path, nargs="*", default=PHOTOS, help="photos, or folders of them")
    add("--maps", type=Path, default=Path("../shared/data/hdri"))
    add("--way", nargs="+", choices=("texture", "picture"), default=["texture", "picture"])
    add("--refine", action="store_true", help="by the features of S_f")
    add("--signed", action="store_true", help="the paper's plain least squares")
    add("--seed", type=int, default=0, help="of the lamps")
    add("--json", type=Path)
    return parser.parse_args()


def _photos(entry: Path) -> list[Path]:
    """A photo, or those of a folder."""
    if entry.is_dir():
        return sorted(path for path in entry.iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    return [entry]


def maps(folder: Path) -> Iterator[Known]:
    for path in sorted((*folder.glob("*.hdr"), *folder.glob("*.exr"))):
        envmap = torch.from_numpy(read_image(path).pixels)
        for frame, weights in enumerate(rotated_weights(envmap, RIG, TURNS_DEG)):
            yield Known(f"{path.stem}.{frame:04d}", weights, ("--envmap", str(path)))


def lamps(seed: int) -> Iterator[Known]:
    """Key lights at lights of the rig, most of them before the face, and a dim one in front."""
    random = np.random.default_rng(seed)
    front = int((RIG @ azel_to_direction(0.0, 10.0)).argmax())
    for _ in range(LAMPS):
        azimuth, elevation = random.uniform(-120, 120), random.uniform(-20, 60)
        key = int((RIG @ azel_to_direction(azimuth, elevation)).argmax())
        colour = [round(float(part), 2) for part in (1.0, random.uniform(0.6, 1), random.uniform(0.4, 1))]
        weights = torch.zeros(len(RIG), 3)
        weights[key] += torch.tensor(colour)
        weights[front] += FILL
        words = [
            [f"{float(value):.4g}" for value in (*direction_to_azel(RIG[light]), *rgb)]
            for light, rgb in ((key, colour), (front, [FILL] * 3))
        ]
        name = "light_" + "+".join("_".join(part) for part in words)
        yield Known(name, weights, ("--light", ";".join(",".join(part) for part in words)))


def in_texture(photo: Path, lights: list[Known], given: argparse.Namespace) -> Iterator[tuple[Known, Tensor]]:
    """Relit and estimated in the chart; the field is held to its photo, as `facerf relight` has it."""
    options = PhotoOptions(Settings())
    models = load_models_once(options)
    item = Item(photo, Path(photo.stem), photo.stem)
    face = fit_faces(item, read_photo(item, options), options)[0].texture
    olats = predict_olat(models, face, RIG, quotient=explain_photo(models, face))
    features = load_light_features(LIGHT_FEATURES)
    for light, texture in zip(
        lights, weigh_batches(olats, torch.stack([light.weights for light in lights])), strict=True
    ):
        relit = FaceTexture(texture, face.visible, face.normals)
        evidence = light_evidence(models, relit, RIG)
        weights = evidence.least_squares(not given.signed)
        if given.refine:
            weights = refine_photo_light(evidence, weights, features, not given.signed).weights
        yield light, weights


def through_image(
    photo: Path, lights: list[Known], given: argparse.Namespace
) -> Iterator[tuple[Known, Tensor]]:
    """Through an 8-bit PNG of the whole photo and the two commands."""
    how = ["--refine", "features"] * given.refine + ["--signed"] * given.signed
    with tempfile.TemporaryDirectory() as scratch:
        relit, out = Path(scratch) / "relit", Path(scratch) / "out"
        options = list(dict.fromkeys(light.option for light in lights))
        turns = f"0:{len(TURNS_DEG) * TURNS_DEG[1]}:{len(TURNS_DEG)}"
        _run(
            "relight",
            str(photo),
            "-o",
            str(relit),
            "--rotate",
            turns,
            *(word for two in options for word in two),
        )
        exposures_ev = json.loads((relit / "report.jsonl").read_text())["exposure_ev"]
        for exr in relit.glob("*.exr"):
            exr.unlink()
        _run("estimate-light", str(relit), "-o", str(out), "--width", "64", *how)
        where = _face_centre_px(photo)
        for light in lights:
            name = f"{photo.stem}_{light.name}"
            if np.linalg.norm(_face_centre_px(relit / f"{name}.png") - where) > _MOVED_PX:
                print(f"picture {photo.stem} {light.name}: the detector took something else for the face")
                continue
            found = read_light(out / f"{name}_light.json").weights
            yield light, found / 2 ** exposures_ev[name]


def _face_centre_px(photo: Path) -> np.ndarray:
    """Of the face that the verbs take, [2]."""
    return find_faces(read_image(photo).pixels, str(photo))[0].landmarks_px.mean(0)


def _run(*line: str) -> None:
    with redirect_stdout(io.StringIO()):  # the paths of what it wrote
        if facerf(["-q", *line]):
            raise SystemExit(f"facerf {line[0]} {line[1]}: failed")


def compared(found: Tensor, light: Known) -> dict[str, float | bool]:
    truth, estimate = RigLight(RIG, light.weights), RigLight(RIG, found)
    toward = brightest_direction(truth)
    coefficients = rig_coefficients(estimate, 2), rig_coefficients(truth, 2)
    return {
        "seen": bool(toward[2] > 0),
        "angle": light_error_deg(brightest_direction(estimate).numpy(), toward.numpy()),
        "weights": _off(found, light.weights),
        "weights scaled": _off_scaled(found, light.weights),
        "SH": _off(*coefficients),
        "SH scaled": _off_scaled(*coefficients),
    }


def _off(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).norm() / truth.norm())


def _off_scaled(found: Tensor, truth: Tensor) -> float:
    return _off(found * (found * truth).sum() / found.square().sum().clamp_min(1e-12), truth)


def table(way: str, rows: list[dict]) -> None:
    print(f"\n{way}: {len(rows)} cases    (median, mean, 90th percentile)")
    for name, chosen in (("all", rows), ("seen", [row for row in rows if row["seen"]]),
                         ("behind", [row for row in rows if not row["seen"]])):  # fmt: skip
        print(f"  {name}, {len(chosen)} cases")
        for measure in MEASURES if chosen else ():
            values = np.array([row[measure] for row in chosen])
            of_all = np.median(values), values.mean(), np.quantile(values, 0.9)
            print(f"    {measure:16s}", *(f"{value:8.2f}" for value in of_all))


if __name__ == "__main__":
    main()
