"""A small capture of a light stage: built-in heads with painted skins, by Lambert's law, three cameras."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture, vertex_normals
from facerf_cli.synth.appearance.skin import draw_skin

SIDE_PX, SUPER = 160, 2
YAWS_DEG = (-24.0, 4.0, 40.0)  # the last is too far round for the detector
FOCAL_PX, DISTANCE_M = 3.6 * SIDE_PX * 1.1, 1.1
WORLD_FROM_HEAD = pose_to_rotation(20.0, 3.0, -2.0).double()  # how the subjects sit in the stage
HEAD_WORLD = torch.tensor([0.01, 1.3, 0.02], dtype=torch.float64)
BLACK_LEVEL = 0.01


@dataclass(frozen=True, eq=False)
class Truth:
    """Who was photographed: the vertices in the world [V, 3] float64, and the skin's albedo."""

    vertices_world: Tensor
    albedo: Tensor  # [3, T, T]


def write_capture(
    folder: Path, subjects: int = 2, lights: int = 12, seed: int = 3, **changes: Any
) -> dict[str, Truth]:
    """Write a capture whose stage.json has `changes`; give the truth by subject."""
    directions = rig_directions(lights).double()
    intensities = 1 + 0.5 * torch.rand(lights, 3, generator=torch.Generator().manual_seed(seed))
    turns = [pose_to_rotation(yaw_deg, 0, 0).double() @ WORLD_FROM_HEAD.mT for yaw_deg in YAWS_DEG]
    description = describe(directions, intensities, turns) | changes
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stage.json").write_text(json.dumps(description))
    truths = {f"{index:04d}": _someone(index, seed) for index in range(subjects)}
    for subject, truth in truths.items():
        for number, turn in enumerate(turns):
            place = folder / subject / f"C{number}"
            place.mkdir(parents=True, exist_ok=True)
            olats = photograph(truth, turn, directions)
            for light, image in enumerate(olats):
                write_exr(place / f"L{light:03d}.exr", image * intensities[light].numpy() + BLACK_LEVEL)
    return truths


def describe(directions: Tensor, intensities: Tensor, turns: list[Tensor]) -> dict[str, Any]:
    """The content of stage.json."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()  # to OpenCV's axes
    cameras = []
    for number, turn in enumerate(turns):
        pose = torch.cat([turn, _shift(turn)[:, None]], 1)
        k = [[FOCAL_PX, 0, SIDE_PX / 2 + 2], [0, FOCAL_PX, SIDE_PX / 2 - 1], [0, 0, 1]]
        camera = {"id": f"C{number}", "width": SIDE_PX, "height": SIDE_PX, "K": k}
        cameras.append(camera | {"world_to_camera": (flip @ pose).tolist()})
    return {
        "format": "facerf-stage-1",
        "colour_space": "lin_rec709",
        "black_level": BLACK_LEVEL,
        "axes": "opencv",
        "unit": "m",
        "pattern": "{subject}/{camera}/{light}.exr",
        "lights": [
            {"id": f"L{number:03d}", "direction": direction, "intensity": intensity}
            for number, (direction, intensity) in enumerate(
                zip(directions.tolist(), intensities.tolist(), strict=True)
            )
        ],
        "cameras": cameras,
        "provenance": {"made_by": "a test"},
    }


def photograph(truth: Truth, turn: Tensor, directions: Tensor) -> np.ndarray:
    """Pictures [L, H, W, 3] by the camera that sees the world turned by [3, 3]."""
    vertices = (truth.vertices_world @ turn.mT + _shift(turn)).float()
    camera = Camera(
        FOCAL_PX * SUPER,
        SIDE_PX * SUPER,
        SIDE_PX * SUPER,
        SUPER * (SIDE_PX / 2 + 2),
        SUPER * (SIDE_PX / 2 - 1),
    )
    triangles = grid_triangles()
    fragments = rasterize(vertices, triangles, camera)
    attributes = torch.cat([grid_uv(), vertex_normals(vertices, triangles)], 1)
    uv, normals = interpolate(attributes, triangles, fragments).split([2, 3], -1)
    skin = sample_texture(truth.albedo, uv).permute(2, 0, 1) * fragments.covered
    in_camera = (directions @ turn.mT).float()
    cosine = torch.einsum("lc,hwc->lhw", in_camera, torch.nn.functional.normalize(normals, dim=-1))
    images = skin * cosine.clamp(min=0)[:, None]
    return torch.nn.functional.avg_pool2d(images, SUPER).permute(0, 2, 3, 1).numpy()


def _shift(turn: Tensor) -> Tensor:
    return torch.tensor([0.0, -0.01, -DISTANCE_M], dtype=torch.float64) - turn @ HEAD_WORLD


def _someone(index: int, seed: int) -> Truth:
    model = load_face_model()
    generator = torch.Generator().manual_seed(100 * seed + index)
    alpha = 0.6 * torch.randn(1, len(model.identity), generator=generator)
    head = model.vertices(alpha, torch.zeros(1, len(model.expression)))[0].double()
    albedo = draw_skin(1, 256, generator).albedo[0]
    return Truth(head @ WORLD_FROM_HEAD.mT + HEAD_WORLD, albedo)
