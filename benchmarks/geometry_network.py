"""The Geometry Network: its landmark error on images it was not trained on, and the steps that it saves.

    python benchmarks/geometry_network.py [PHOTO|DIR ...] [--crops RUN/bank/pictures] [--dataset DATASET]

- `--crops`: held-out heads of a bank (`facerf train --stage geometry`), true landmarks with added noise.
- `--dataset`: its people under every tenth light together, against the landmarks of its fits.
- Photos: against the landmarks that are found in them.

Errors are means in percent of the distance of the outer eye corners; the contour slides along the estimated
outline, as in the fit. Steps of the fit are counted until its cost is within 1 % of the least. Naive twin:
the fit that starts from the landmarks alone.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from _common import arguments, best_s, photos, required
from torch import Tensor

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import FitSettings, FitStart, better_start, fit_batch, fit_problem, start_states
from facerf_cli.face.gauss_newton import FitState, Problem, minimise, residuals, total_cost
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.files.read import read_image
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import crop_camera
from facerf_cli.relighting.models import SHIPPED_NETWORKS, load_models
from facerf_cli.synth.bank.face_crops import RenderedFaces
from facerf_cli.training.geometry import GeometryObjective, GeometryObjectiveSettings

CROP_PX = 256
DETECTOR_NOISE = 0.014  # of the inter-ocular distance, added to true landmarks
COUNTED_STEPS, ALL_STEPS = 12, 40
ENOUGH = 1.01  # times the least cost
_ROUNDS = 5


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--checkpoint", type=Path, help="default: the shipped one")
    parser.add_argument("--crops", type=Path, help="folder of the bank's rendered heads")
    parser.add_argument("--held-out", type=int, default=12, help="heads of the bank that were not trained on")
    parser.add_argument("--draws", type=int, default=16, help="of each held-out head")
    parser.add_argument("--dataset", type=Path, help="of prepare-dataset")
    parser.add_argument("--cameras", default="C0,C2,C3", help="of the dataset")
    given = parser.parse_args()
    network = load_models([given.checkpoint] if given.checkpoint else ()).networks.geometry
    if not isinstance(network, GeometryNetwork):
        raise SystemExit(f"{given.checkpoint}: holds no Geometry Network; give another --checkpoint")
    print(f"{sum(p.numel() for p in network.parameters()):,} parameters")
    report("photos", network, *of_photos(photos(given.photos)))
    if given.crops:
        folder = required(given.crops, "", "--crops")
        report("held-out heads", network, *held_out(network, folder, given.held_out, given.draws))
    if given.dataset:
        folder = required(given.dataset, "", "--dataset")
        report("dataset, lit from all sides", network, *captured(folder, given.cameras.split(",")))


def report(name: str, network: GeometryNetwork, crops: Tensor, landmarks_px: Tensor) -> None:
    """Print the figures of crops [B, 3, S, S] and a detector's landmarks [B, 68, 2] in their pixels."""
    model, camera = load_face_model(), crop_camera(crops.shape[-1])
    with torch.no_grad():
        start = FitStart(*network(crops))
    trust = torch.ones(landmarks_px.shape[:2], dtype=torch.float64)
    problem, cold = fit_problem(model, landmarks_px.double(), camera, FitSettings(), trust)
    percent = landmark_percent(problem, start_states(problem, start)[0])
    print(f"{name}: {len(crops)} crops, landmark error of the network {percent.mean():.1f} %, inner 51 "
          f"{percent[:, len(CONTOUR):].mean():.1f} %, worst crop {percent.mean(1).max():.1f} %")  # fmt: skip
    needed = steps_needed(problem, {"landmarks alone": cold, "network": better_start(problem, cold, start)})
    steps = ", ".join(f"{key} {count.double().mean():.2f}" for key, count in needed.items())
    ends = [
        100 * fit_batch(model, landmarks_px, camera, start=begin).error_iod.mean() for begin in (None, start)
    ]
    print(
        f"  Gauss-Newton steps from {steps}; error of the fit {ends[0]:.3f} % and {ends[1]:.3f} %", flush=True
    )
    ways: dict[str, Callable[[], object]] = {
        "network": lambda: network(crops[:1]),
        "step": lambda: fit_batch(model, landmarks_px[:1], camera, FitSettings(steps=1)),
    }
    seconds, _ = best_s(ways, _ROUNDS)
    print(f"  the network takes {seconds['network'] / seconds['step']:.2f} times a fit of one step")


def landmark_percent(problem: Problem, state: FitState) -> Tensor:
    """Errors [B, 68] of a state, with the contour on the estimated outline."""
    left, right = OUTER_EYE_CORNERS
    eyes_px = (problem.target_px[:, left] - problem.target_px[:, right]).norm(dim=-1)
    return 100 * residuals(problem, state).difference_px.norm(dim=-1) / eyes_px[:, None]


def steps_needed(problem: Problem, starts: dict[str, FitState]) -> dict[str, Tensor]:
    """Count steps from each start until the cost is low enough, for faces that end alike from all starts."""
    costs = {
        name: torch.stack(
            [total_cost(problem, minimise(problem, state, n)) for n in (*range(COUNTED_STEPS), ALL_STEPS)]
        )
        for name, state in starts.items()
    }
    ends = torch.stack([cost[-1] for cost in costs.values()])
    enough = ENOUGH * ends.amin(0)
    alike = (ends <= enough).all(0)
    if not alike.all():
        print(f"  {int((~alike).sum())} crops are not counted: their fits end elsewhere from some start")
    return {name: (cost > enough).sum(0)[alike] for name, cost in costs.items()}


def of_photos(paths: list[Path]) -> tuple[Tensor, Tensor]:
    """Crops and landmarks of photos."""
    crops, landmarks = [], []
    for path in paths:
        photo = read_image(path).pixels
        landmarks_px = find_faces(SHIPPED_NETWORKS.people, photo, str(path))[0].landmarks_px
        crop = from_landmarks(landmarks_px, CROP_PX)
        crops.append(torch.from_numpy(crop.apply(photo)).permute(2, 0, 1))
        landmarks.append(torch.from_numpy(crop.to_crop(landmarks_px)).float())
    return torch.stack(crops), torch.stack(landmarks)


def held_out(network: GeometryNetwork, folder: Path, count: int, draws: int) -> tuple[Tensor, Tensor]:
    """Print the errors on held-out heads of a bank; their crops, and their landmarks with noise."""
    settings = GeometryObjectiveSettings(held_out_heads=count, held_out_draws=draws)
    objective = GeometryObjective(RenderedFaces(folder, {}), network, settings)
    metrics = objective.validate().metrics
    print(
        "held-out heads, true landmarks:", ", ".join(f"{key} {value:.2f}" for key, value in metrics.items())
    )
    batch = objective._held_out()
    left, right = OUTER_EYE_CORNERS
    eyes_px = (batch.landmarks_px[:, left] - batch.landmarks_px[:, right]).norm(dim=-1)
    noise = torch.randn(batch.landmarks_px.shape, generator=torch.Generator().manual_seed(0))
    return batch.crops, batch.landmarks_px + DETECTOR_NOISE * eyes_px[:, None, None] * noise


def captured(folder: Path, cameras: list[str]) -> tuple[Tensor, Tensor]:
    """Crops of a dataset's people under every tenth light, and the landmarks of its fits."""
    dataset = read_dataset(folder)
    crops, landmarks = [], []
    for subject in dataset.subjects:
        for camera in cameras:
            path = dataset.fit_path(subject, camera)
            if not path.exists():
                continue
            with np.load(path) as fit:
                landmarks.append(torch.from_numpy(fit["landmarks_px"]).float())
            olats = read_olats(dataset.stack_path(subject, camera), slice(0, None, 10))
            crops.append(olats.float().mean(0))
    return torch.stack(crops), torch.stack(landmarks)


if __name__ == "__main__":
    main()
