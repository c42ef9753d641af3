"""The Geometry Network: its landmark error on images it was not trained on.

    python benchmarks/geometry_network.py [PHOTO|DIR ...] [--crops RUN/bank/people] [--dataset DATASET]

- `--crops`: held-out people of a bank (`facerf train --stage geometry`), true landmarks with added noise.
- `--dataset`: its people under every tenth light together, against the landmarks of its fits.
- Photos: against the landmarks that are found in them.

Errors are means in percent of the distance of the outer eye corners; the contour slides along the estimated
outline, as in the fit. Naive twin: the fit to the landmarks.
"""

from pathlib import Path

import numpy as np
import torch
from _common import arguments, photos, required
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, OUTER_EYE_CORNERS
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.files.read import read_image
from facerf_cli.network.batch import concatenate
from facerf_cli.network.geometry import GeometryEstimate, GeometryNetwork
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import crop_camera
from facerf_cli.relighting.models import SHIPPED_NETWORKS, load_models
from facerf_cli.synth.bank.geometry_crops import GeometryPhotos
from facerf_cli.training.geometry import GeometryObjective, GeometryObjectiveSettings
from facerf_cli.training.joint import LANDMARKS, chosen, pose_heads

CROP_PX = 256
DETECTOR_NOISE = 0.014  # of the inter-ocular distance, added to true landmarks


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--checkpoint", type=Path, help="default: the shipped one")
    parser.add_argument("--crops", type=Path, help="folder of the bank's people")
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


@torch.no_grad()
def report(name: str, network: GeometryNetwork, crops: Tensor, landmarks_px: Tensor) -> None:
    """Print the figures of crops [B, 3, S, S] and a detector's landmarks [B, 68, 2] in their pixels."""
    fit = fit_batch(load_face_model(), landmarks_px, crop_camera(crops.shape[-1]))
    fitted = GeometryEstimate(*(x.float() for x in (fit.rotation, fit.translation_m, fit.alpha, fit.beta)))
    print(f"{name}: {len(crops)} crops")
    for way, estimate in (("network", network(crops)), ("fit to landmarks", fitted)):
        percent = landmark_percent(estimate, landmarks_px, crops.shape[-1])
        inner = percent[:, [landmark not in CONTOUR for landmark in LANDMARKS]]
        print(f"  landmark error of the {way} {percent.mean():.1f} %, inner {inner.mean():.1f} %, "
              f"worst crop {percent.mean(1).max():.1f} %", flush=True)  # fmt: skip


def landmark_percent(estimate: GeometryEstimate, landmarks_px: Tensor, side_px: int) -> Tensor:
    """Errors [B, L] of an estimate in crops of a side, with the contour on the estimated outline."""
    found_px = pose_heads(load_face_model(), estimate).landmarks_px(landmarks_px, crop_camera(side_px))
    left, right = OUTER_EYE_CORNERS
    eyes_px = (landmarks_px[:, left] - landmarks_px[:, right]).norm(dim=-1)
    return 100 * (found_px - chosen(landmarks_px, LANDMARKS)).norm(dim=-1) / eyes_px[:, None]


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
    settings = GeometryObjectiveSettings(held_out_people=count, held_out_draws=draws)
    backgrounds = load_file(folder.parent / "backgrounds.safetensors")["backgrounds"]
    objective = GeometryObjective(GeometryPhotos(folder, backgrounds, {}), network, settings)
    metrics = objective.validate().metrics
    print(
        "held-out heads, true landmarks:", ", ".join(f"{key} {value:.2f}" for key, value in metrics.items())
    )
    batch = concatenate(objective.held_out_samples())
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
