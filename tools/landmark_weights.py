"""Weights by which the points of MediaPipe's mesh give the 68 landmarks as the face model has them.

    python -m tools.landmark_weights FOLDER FILE [--people 24]

The points of the mesh that are commonly taken for the 68 landmarks lie elsewhere than the vertices that stand
for them in the face model, along the jaw by 8 % of the face's extent. So synthetic people are photographed,
whose landmarks are known. Each landmark becomes a sum of the mesh's points; its weights sum to 1, so that it
moves, turns and grows with them. They are found by ridge regression (Hoerl and Kennard, 1970) from the
common points; the ridge was chosen by leaving people out, whose errors are printed. FOLDER keeps the meshes.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.numpy import load_file, save_file

from facerf_cli.face.topology import MIRROR_68
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.portrait.mesh import COMMON_68, MESH_POINTS, OUTER_CORNERS, mesh_near
from facerf_cli.portrait.parse import Square
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.portraits import (
    BRIGHTEST,
    PortraitBankSettings,
    background_of,
    heaps_of,
    photos_of,
)

SETTINGS = PortraitBankSettings(views=4, photos=2, side_px=288)
SEED = 77
MEAN = 0.35  # linear, of the person in a photo
SIDES = 1.5  # of the square in which the mesh is found, in extents of the landmarks
RIDGE, RIDGES = 3.0, (0.03, 0.3, 1.0, 3.0, 10.0)  # the one that is used, and those that are tried
FOLDS = 5


class Faces(NamedTuple):
    """Faces [N], level and of one size: points of the mesh [N, P, 2], landmarks [N, 68, 2], person [N]."""

    points: np.ndarray
    landmarks: np.ndarray
    person: np.ndarray

    def where(self, chosen: np.ndarray) -> "Faces":
        """Those that are chosen [N]."""
        return Faces(*(part[chosen] for part in self))


def main() -> None:
    """Photograph people, print the errors on people that were left out, write the weights of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--people", type=int, default=24)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    found = [faces_of(options.folder / f"{index:05}.safetensors", index) for index in range(options.people)]
    faces = Faces(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    print(f"{len(faces.person)} faces; median error in extents of the face:")
    print(f"common points: {np.median(errors_of(common(), faces)):.4f}")
    for ridge in RIDGES:
        print(f"ridge {ridge}: {np.median(np.concatenate(left_out(faces, ridge))):.4f}")
    weights = fitted(with_mirrored(faces), RIDGE)
    save_file({"weights": weights.astype(np.float16)}, options.file)


def faces_of(path: Path, index: int) -> Faces:
    """Faces in photos of one synthetic person; kept in a file."""
    if not path.exists():
        points, landmarks = zip(*meshes(index), strict=True)
        save_file({"points": np.stack(points), "landmarks": np.stack(landmarks)}, path)
    kept = load_file(path)
    level = [leveled(*pair) for pair in zip(kept["points"], kept["landmarks"], strict=True)]
    points, landmarks = zip(*level, strict=True)
    return Faces(np.stack(points), np.stack(landmarks), np.full(len(level), index))


@torch.no_grad()
def meshes(index: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points of the mesh [P, 2] and landmarks [68, 2] in photos of one person, in pixels."""
    photos = photos_of("builtin", index, SEED, SETTINGS)
    generator = torch.Generator().manual_seed(index)
    (backgrounds,) = heaps_of(1, SEED + index)
    for view, alpha, places in zip(
        photos["pictures"], photos["alpha"].float() / 255, photos["landmarks_px"].numpy(), strict=True
    ):
        for picture in view:
            person = BRIGHTEST * (picture.float() / 255).square()
            behind = background_of(backgrounds, SETTINGS.side_px, generator)
            linear = (MEAN * (person + (1 - alpha) * behind)).clamp(0, 1)
            image = (255 * linear_to_srgb(linear.permute(1, 2, 0).numpy())).round().astype(np.uint8)
            mesh = mesh_near(SHIPPED_NETWORKS.people, image, Square.around(places[:68], SIDES))
            if mesh is not None:
                yield mesh.points_px[:MESH_POINTS, :2], places[:68]


def leveled(points: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and landmarks around the points' mean, the eyes level, in extents of the face."""
    right, down = points[OUTER_CORNERS[1]] - points[OUTER_CORNERS[0]]
    turn = np.array([[right, -down], [down, right]]) / np.hypot(right, down)
    extent = np.ptp(points[COMMON_68] @ turn, axis=0).max()
    return (points - points.mean(0)) @ turn / extent, (landmarks - points.mean(0)) @ turn / extent


def with_mirrored(faces: Faces) -> Faces:
    """The faces and their mirror images; which points mirror each other follows from the mean face."""
    mean = faces.points.mean(0)
    middle = mean[list(OUTER_CORNERS), 0].mean()
    flipped = mean * (-1, 1) + (2 * middle, 0)
    twin = np.linalg.norm(flipped[:, None] - mean, axis=-1).argmin(1)
    other = faces.points[:, twin] * (-1, 1), faces.landmarks[:, MIRROR_68] * (-1, 1), faces.person
    return Faces(*(np.concatenate(pair) for pair in zip(faces, other, strict=True)))


def common() -> np.ndarray:
    """Weights [68, P] of the points that are commonly taken for the landmarks."""
    weights = np.zeros((68, MESH_POINTS))
    weights[np.arange(68), COMMON_68] = 1
    return weights


def fitted(faces: Faces, ridge: float) -> np.ndarray:
    """Weights [68, P] of sum 1, of least squares with a ridge around the common ones."""
    columns = faces.points.transpose(0, 2, 1).reshape(-1, MESH_POINTS)
    wanted = faces.landmarks.transpose(0, 2, 1).reshape(-1, 68) - columns @ common().T
    balanced = columns - columns.mean(1, keepdims=True)  # weights that are added sum to 0
    gram = balanced @ balanced.T + ridge * np.eye(len(balanced))
    return np.asarray(common() + (balanced.T @ np.linalg.solve(gram, wanted)).T)


def left_out(faces: Faces, ridge: float) -> list[np.ndarray]:
    """Errors of landmarks of people by weights that were fitted to others."""
    errors = []
    for fold in range(FOLDS):
        out = faces.person % FOLDS == fold
        errors.append(errors_of(fitted(with_mirrored(faces.where(~out)), ridge), faces.where(out)))
    return errors


def errors_of(weights: np.ndarray, faces: Faces) -> np.ndarray:
    """Distances [N, 68] of weighted points from the landmarks, in extents."""
    return np.asarray(np.linalg.norm(weights @ faces.points - faces.landmarks, axis=-1))


if __name__ == "__main__":
    main()
