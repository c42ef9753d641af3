"""What the Geometry Network sees: errors on pictures that it was not trained on, and what its start saves.

    python benchmarks/geometry_network.py CHECKPOINT --pictures PICTURES [--dataset D] [--shared ../shared]

Pictures: held-out heads of a bank (`facerf train --stage geometry` makes BANK/pictures), true landmarks.
Dataset: its people under every tenth light of the rig together, against the landmarks of its fits, which dlib
found. Photos: skimage's astronaut and SHARED/data/photos, against dlib's landmarks as well. Errors are means
in percent of the distance of the outer eye corners in the picture; a detector's contour slides along the
estimated outline, as in the fit, a true one does not. The fit's steps are counted until its cost is within
1 % of the lowest that any start leads to: from the landmarks alone (cold, the mean head in weak perspective),
from the network's head as it is and laid on the landmarks, and, to tell what the network adds to that, from
the mean head laid on the landmarks the same way.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import skimage.data
import torch
from torch import Tensor

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import FitSettings, fit_batch, fit_problem
from facerf_cli.face.fit_start import FitStart, better_start, start_states
from facerf_cli.face.gauss_newton import (
    FitState,
    Problem,
    Residuals,
    damped_step,
    descend,
    jacobian,
    landmark_cost,
    normal_equations,
    prior_cost,
    residuals,
    total_cost,
)
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, LAYOUT_VERSION, OUTER_EYE_CORNERS
from facerf_cli.files.images import read_image
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.raster.camera import crop_camera, project
from facerf_cli.synth.face_crops import RenderedFaces
from facerf_cli.training.geometry_objective import GeometryObjective, GeometryObjectiveSettings

CROP_PX = 256
MOST_STEPS = 40
DETECTOR_NOISE = 0.014  # of the inter-ocular distance, on true landmarks


def eyes_px(landmarks_px: Tensor) -> Tensor:
    left, right = OUTER_EYE_CORNERS
    return (landmarks_px[:, left] - landmarks_px[:, right]).norm(dim=-1)


def sliding_percent(problem: Problem, state: FitState) -> Tensor:
    """Errors [B, 68] with the contour on the estimated outline."""
    distance_px = residuals(problem, state).difference_px.norm(dim=-1)
    return 100 * distance_px / eyes_px(problem.target_px)[:, None]


def costs_by_step(problem: Problem, state: FitState) -> Tensor:
    """The cost [steps + 1, B] after every step from a state."""
    tried: list[Tensor] = []

    def cost(there: FitState, at: Residuals) -> Tensor:
        tried.append(landmark_cost(problem, at) + prior_cost(there))
        return tried[-1]

    def step(there: FitState, at: Residuals, damping: Tensor) -> Tensor:
        normal, gradient = normal_equations(problem, jacobian(problem, there, at), at)
        return damped_step(normal, gradient, there.coordinates, damping)

    descend(lambda there: residuals(problem, there), cost, step, state, MOST_STEPS)
    return torch.stack(tried).cummin(0).values  # a step that costs more is not taken


def steps_needed(problem: Problem, starts: dict[str, FitState]) -> dict[str, Tensor]:
    """Steps from each start until the cost is within 1 % of the lowest, where all starts end there."""
    costs = {name: costs_by_step(problem, state) for name, state in starts.items()}
    ends = torch.stack([cost[-1] for cost in costs.values()])
    enough = 1.01 * ends.amin(0)
    alike = (ends <= enough).all(0)
    print(f"  left out of the steps, for they end elsewhere from some start: {int((~alike).sum())} crops")
    return {name: (cost > enough).sum(0)[alike] for name, cost in costs.items()}


def report(name: str, network: GeometryNetwork, crops: Tensor, landmarks_px: Tensor) -> None:
    """Crops [B, 3, S, S] and a detector's landmarks [B, 68, 2] in their pixels."""
    with torch.no_grad():
        start = FitStart(*network(crops))
    model, camera = load_face_model(), crop_camera(crops.shape[-1])
    trust = torch.ones(landmarks_px.shape[:2], dtype=torch.float64)
    problem, cold = fit_problem(model, landmarks_px.double(), camera, FitSettings(), trust)
    seen, laid = start_states(problem, start)
    percent = sliding_percent(problem, seen)
    print(f"{name}: {len(crops)} crops, sliding contour: all 68 {percent.mean():.2f} %, "
          f"inner 51 {percent[:, len(CONTOUR):].mean():.2f} %, "
          f"worst crop {percent.mean(1).max():.1f} %")  # fmt: skip
    mean_head = FitStart(start.rotation, start.translation_m, 0 * start.alpha, 0 * start.beta)
    needed = steps_needed(
        problem,
        {
            "cold": cold,
            "mean head laid on the landmarks": start_states(problem, mean_head)[1],
            "network as it is": seen,
            "network's head laid on the landmarks": laid,
            "what the fit takes": better_start(problem, cold, start),
        },
    )
    print("  Gauss-Newton steps to within 1 %:", {
        key: f"{steps.double().mean():.2f} (at most {int(steps.max())})" for key, steps in needed.items()
    })  # fmt: skip
    ends = [fit_batch(model, landmarks_px, camera, start=given).error_iod for given in (None, start)]
    worse = 100 * (ends[1] - ends[0])
    print(f"  fit's error cold {100 * ends[0].mean():.3f} %, from the network {100 * ends[1].mean():.3f} %; "
          f"worst change of one {worse.max():+.3f}")  # fmt: skip
    medians = {name: float(total_cost(problem, state).median()) for name, state in
               (("cold", cold), ("network as it is", seen), ("laid on the landmarks", laid))}  # fmt: skip
    print("  median cost at the start:", {name: round(cost, 1) for name, cost in medians.items()})


def report_held_out(network: GeometryNetwork, folder: Path, draws: int) -> None:
    objective = GeometryObjective(
        RenderedFaces(folder, {}), network, GeometryObjectiveSettings(held_out_draws=draws)
    )
    metrics = objective.validate().metrics
    print("held-out heads, true landmarks:", {key: round(value, 2) for key, value in metrics.items()})
    batch = objective._held_out()
    noise = torch.randn(batch.landmarks_px.shape, generator=torch.Generator().manual_seed(0))
    noise_px = DETECTOR_NOISE * eyes_px(batch.landmarks_px)[:, None, None]
    report("held-out heads, noisy landmarks", network, batch.crops, batch.landmarks_px + noise_px * noise)


def captured(folder: Path, cameras: list[str], subjects: int) -> tuple[Tensor, Tensor]:
    dataset = read_dataset(folder)
    crops, landmarks = [], []
    for subject in dataset.subjects[:subjects]:
        for camera in cameras:
            path = dataset.fit_path(subject, camera)
            if not path.exists():
                continue
            with np.load(path) as fit:
                landmarks.append(torch.from_numpy(fit["landmarks_px"]).float())
            olats = read_olats(dataset.stack_path(subject, camera), slice(0, None, 10))
            crops.append(olats.float().mean(0))
    return torch.stack(crops), torch.stack(landmarks)


def photos(shared: Path) -> tuple[Tensor, Tensor]:
    images = [("astronaut", (skimage.data.astronaut() / 255.0) ** 2.2)]
    for path in sorted((shared / "data/photos").glob("*.jpg")):
        images.append((path.stem, read_image(path).pixels))
    crops, landmarks = [], []
    for name, pixels in images:
        linear = np.asarray(pixels, np.float32)
        (face,) = choose_face(detect_landmarks(to_display(linear)), "largest", name)
        crop = from_landmarks(face.landmarks_px, CROP_PX)
        crops.append(torch.from_numpy(crop.apply(linear)).permute(2, 0, 1))
        landmarks.append(torch.from_numpy(crop.to_crop(face.landmarks_px)).float())
    return torch.stack(crops), torch.stack(landmarks)


def milliseconds(network: GeometryNetwork) -> float:
    crop = torch.rand(1, 3, CROP_PX, CROP_PX)
    with torch.no_grad():
        network(crop)
        begin = time.process_time()
        for _ in range(20):
            network(crop)
    return 1000 * (time.process_time() - begin) / 20


def milliseconds_of_a_step() -> float:
    model, camera = load_face_model(), crop_camera(CROP_PX)
    vertices = model.vertices(torch.zeros(1, len(model.identity)), 0.5 * torch.ones(1, len(model.expression)))
    landmarks_px = project(model.landmarks(vertices) + torch.tensor([0.0, 0.0, -1.0]), camera)
    spent = []
    for steps in (1, 1, 41):  # the first one warms up
        begin = time.process_time()
        fit_batch(model, landmarks_px, camera, FitSettings(steps=steps))
        spent.append(time.process_time() - begin)
    return 1000 * (spent[2] - spent[1]) / 40


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--subjects", type=int, default=44)
    parser.add_argument("--cameras", default="C0,C2,C3")
    parser.add_argument("--shared", type=Path)
    parser.add_argument("--draws", type=int, default=16, help="of each held-out head")
    given = parser.parse_args()
    network = load_networks(given.checkpoint, LAYOUT_VERSION)[0]["geometry"].eval()
    assert isinstance(network, GeometryNetwork)
    print(f"{sum(p.numel() for p in network.parameters()):,} parameters, "
          f"{milliseconds(network):.1f} ms of processor time a crop on "
          f"{torch.get_num_threads()} thread(s); "
          f"a step of one face's fit {milliseconds_of_a_step():.1f} ms")  # fmt: skip
    if given.images:
        report_held_out(network, given.images, given.draws)
    if given.dataset:
        report(
            "dataset, lit all round",
            network,
            *captured(given.dataset, given.cameras.split(","), given.subjects),
        )
    if given.shared:
        report("photos", network, *photos(given.shared))


if __name__ == "__main__":
    main()
