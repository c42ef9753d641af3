"""The paper's Table 1 on a prepared dataset: Si-MSE of pictures of held-out people, same and different pose.

    python benchmarks/table1.py --dataset DATASET [--split test] [--checkpoint FILE] [--json FILE]

Every pair of the split (`facerf relight-dataset`) is taken as a user's photo is: the source picture is
unwrapped by its fit, one light is predicted, and the texture is rendered into the target camera's crop. The
error is of the linear picture inside the masked interior of the face, after the best single scale; once as
the picture is, where a glint on a spectacle frame may outweigh the face, and once with the truth clipped at
white (1: a white wall that faces the lamp), as a camera's is. Beside it stands the source's own texture under
Lambert's cosine. The paper's figures are of other people, photographed in a light stage: they are printed for
orientation, not as a bar.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.fit import FaceFit, fit_from_arrays, fit_landmarks
from facerf_cli.face.interior import interior_mask
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.files.images import read_image
from facerf_cli.files.olat_stack import StackHeader, read_olat_header, read_olats
from facerf_cli.intervals import mean_interval
from facerf_cli.network.losses import si_mse
from facerf_cli.pipeline import FaceTexture, Models, explain_photo, load_models, predict_olat, turn_to
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, sample_texture, unwrap
from facerf_cli.stage.data.dataset import SPLITS, Dataset, read_dataset
from facerf_cli.stage.data.recipes import Pair, picture_path, read_pairs

PAPER = {"same pose": (0.00070, 0.00059), "different pose": (0.00084, 0.00088)}  # its Table 1: mean, sd
_SIDE = 256  # of textures, as the verbs have it
_INSIDE = 0.9  # of the pixels that a texel shows, the share that must be face


@dataclass(frozen=True)
class How:
    """What a picture goes through."""

    refit: bool = False  # fitted by its own landmarks alone
    held_to_photo: bool = True  # `pipeline.explain_photo`, as the verbs have it


@dataclass(frozen=True)
class Measured:
    """One pair's errors."""

    subject: str
    same_pose: bool
    si_mse: float
    clipped: float  # the same, of a truth that is clipped at white
    lambert: float  # clipped, too


def main() -> None:
    given = _arguments()
    dataset = read_dataset(given.dataset)
    models = load_models(given.checkpoint, given.face_model, torch.device("cpu"))
    if models.face.name != dataset.face_model and not given.refit:
        raise SystemExit(f"{given.dataset}: fitted with {dataset.face_model}; give --face-model, or --refit")
    pairs = pairs_of(dataset, given.split)
    how = How(given.refit, not given.network_alone)
    measured = list(measure(models, dataset, pairs[:: given.every], how))
    found = summary(measured) | {
        "checkpoint": str(given.checkpoint or "shipped"),
        "split": given.split,
        "how": asdict(how),
        "people": len({m.subject for m in measured}),
    }
    print(table(found))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="of prepare-dataset and relight-dataset")
    add("--split", default="test", choices=[*SPLITS, "all"], help="all: of a dataset never trained on")
    add("--checkpoint", type=Path, help="default: the one shipped")
    add("--face-model", default="builtin", help="that the dataset was fitted with")
    add("--refit", action="store_true", help="fit each picture's landmarks alone, not a person's all at once")
    add("--network-alone", action="store_true", help="do not hold the field to the photo, as the verbs do")
    add("--every", type=int, default=1, help="take every Nth pair only")
    add("--json", type=Path, help="write all figures here")
    return parser.parse_args()


def pairs_of(dataset: Dataset, split: str) -> list[Pair]:
    """A split's pairs, or all."""
    pairs = [pair for pair in read_pairs(dataset) if split in ("all", pair.split)]
    if not pairs:
        raise SystemExit(f"{dataset.folder}: no pairs in the split {split}; run facerf relight-dataset")
    return pairs


@torch.no_grad()
def measure(models: Models, dataset: Dataset, pairs: list[Pair], how: How) -> Iterator[Measured]:
    """The errors of pairs."""
    for subject, of_subject in groupby(pairs, lambda pair: pair.subject):
        stacks = {camera: dataset.stack_path(subject, camera) for camera in dataset.cameras[subject]}
        views = {
            camera: _view(models, read_olat_header(stack), how.refit) for camera, stack in stacks.items()
        }
        for pair in of_subject:
            path = picture_path(dataset, *pair.key)
            yield _measure_pair(models, pair, path, stacks[pair.target_camera], views, how)


def _measure_pair(
    models: Models, pair: Pair, path: Path, stack: Path, views: dict[str, "View"], how: How
) -> Measured:
    """The errors of one pair: `path` is its source, `stack` holds its target."""
    source, target = views[pair.source_camera], views[pair.target_camera]
    fit, face = source.fit, source.texture_of(path)
    if not torch.equal(fit.alpha, target.fit.alpha):  # not of one joint fit: the source's face in that pose
        target = View.of(models, target.header, replace(target.fit, alpha=fit.alpha, beta=fit.beta))
    light = torch.from_numpy(target.header.directions[pair.target_light]).float()
    turn = turn_to(fit, target.fit.rotation)
    quotient = explain_photo(models, face) if how.held_to_photo else None
    predicted = next(predict_olat(models, face, light[None], turn, quotient=quotient))[0]
    cosine = torch.einsum("c,dc,dij->ij", light, turn, face.normals).clamp_min(0)
    truth = read_olats(stack, slice(pair.target_light, pair.target_light + 1))[0].float()
    white = truth.clamp(max=1)
    wanted = ((predicted, truth), (predicted, white), (face.texture * cosine, white))
    errors = (target.error(*pictures) for pictures in wanted)
    return Measured(pair.subject, pair.source_camera == pair.target_camera, *errors)


def _view(models: Models, header: StackHeader, refit: bool) -> "View":
    """A stack's crop seen with the dataset's fit, or with one of its own landmarks."""
    fit = fit_from_arrays(header.fit)
    if refit:
        fit = fit_landmarks(models.face, fit.landmarks_px.double().numpy(), fit.crop)
    return View.of(models, header, fit)


@dataclass(frozen=True, eq=False)
class View:
    """A stack's crop, and what of the fitted face each of its pixels sees."""

    header: StackHeader
    fit: FaceFit
    vertices: Tensor  # [V, 3] camera space
    uv: Tensor  # [H, W, 2]
    mask: Tensor  # [1, H, W] in 0..1

    @staticmethod
    def of(models: Models, header: StackHeader, fit: FaceFit) -> "View":
        """A stack seen with a fit."""
        vertices = fit.vertices_camera(models.face)
        fragments = rasterize(vertices, grid_triangles(), fit.camera)
        uv = interpolate(grid_uv(), grid_triangles(), fragments)
        seen = torch.from_numpy(header.seen).float()
        return View(header, fit, vertices, uv, interior_mask(vertices, fragments, uv, _SIDE) * seen)

    def texture_of(self, path: Path) -> FaceTexture:
        """A source picture in the chart, as `pipeline.unwrap_face` has a photo."""
        if not path.is_file():
            raise SystemExit(f"{path}: no such source; run facerf relight-dataset without --lazy")
        planes = np.dstack([read_image(path).pixels, self.header.seen]).astype(np.float32)
        picture = torch.from_numpy(planes).permute(2, 0, 1)
        unwrapped, visible = unwrap(picture, self.vertices, grid_triangles(), self.fit.camera, _SIDE)
        visible = visible * (unwrapped[3] > _INSIDE)
        normals = normal_map(self.vertices, grid_triangles(), _SIDE)
        return FaceTexture(inpaint(unwrapped[:3], visible), visible, normals)

    def error(self, texture: Tensor, truth: Tensor) -> float:
        """Si-MSE of a texture [3, T, T] rendered into the crop, to a picture [3, H, W]."""
        picture = sample_texture(texture, self.uv).permute(2, 0, 1)
        return float(si_mse(picture[None, None], truth[None, None], self.mask[None]))


def summary(measured: list[Measured]) -> dict[str, Any]:
    """Figures by pose, and each person's mean."""
    rows: dict[str, dict[str, Any]] = {}
    for name, same in (("same pose", True), ("different pose", False)):
        chosen = [m for m in measured if m.same_pose is same]
        if not chosen:
            continue
        rows[name] = {
            measure: interval.as_dict()
            for measure in ("si_mse", "clipped", "lambert")
            if (interval := mean_interval((m.subject, getattr(m, measure)) for m in chosen))
        }
        rows[name]["people"] = {
            subject: float(np.mean([m.clipped for m in chosen if m.subject == subject]))
            for subject in sorted({m.subject for m in chosen})
        }
    return {"rows": rows, "paper": PAPER}


def table(found: dict[str, Any]) -> str:
    """The figures for reading."""
    head = f"{'':16}{'n':>5}  {'Si-MSE (sd)':18}{'truth clipped at white (sd) [95 %]':40}{'median':>8}"
    lines = [f"{found['people']} synthetic people, split {found['split']}, {found['checkpoint']}"]
    lines.append(f"{head}{'Lambert':>9}   the paper, on its own data (sd)")
    for name, row in found["rows"].items():
        whole, ours, (mean, sd) = row["si_mse"], row["clipped"], found["paper"][name]
        lines.append(
            f"{name:16}{ours['pictures']:5}  {whole['mean']:.5f} ({whole['sd']:.5f}) "
            f" {ours['mean']:.5f} ({ours['sd']:.5f}) [{ours['low']:.5f}, {ours['high']:.5f}]   "
            f"{ours['median']:8.5f}{row['lambert']['mean']:9.5f}   {mean:.5f} ({sd:.5f})"
        )
    for name, row in found["rows"].items():
        if len(row["people"]) <= 12:
            each = ", ".join(f"{person} {mean:.5f}" for person, mean in row["people"].items())
            lines.append(f"  {name}, clipped, by person: {each}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
