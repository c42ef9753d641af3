"""Bank of portraits that the Parsing Network is trained on: photos of synthetic people, and their truth.

Each person is photographed by several cameras, and each view under several lights, with other skin and other
clothes. The background stays black; every training sample adds its own (`portrait_crops.py`).
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.synth.appearance.materials import draw_appearance
from facerf_cli.synth.portraits import BakedPortrait, bake_subject, photograph, view_of
from facerf_cli.synth.stage_cameras import StageCamera
from facerf_cli.synth.subjects import draw_subject, subject_model
from facerf_cli.synth.texture_samples import draw_light
from facerf_cli.workers import in_shards

BRIGHTEST = 6.0  # largest stored radiance, over the mean radiance of the person
_LIGHTS = 48
_LAMP_SHARE = 0.25  # of the photos are lit by one small lamp
_OTHER_LOOKS = 2  # further skins and clothes of a person
_LOOK_PX = 256  # texture side of those
_BAKE = BakeSettings(light_samples=1, bounce_samples=4)
# Standard deviations of the camera's yaw, pitch and roll, and their largest values, in degrees.
_POSE_STD_DEG, _POSE_MAX_DEG = (32.0, 12.0, 8.0), (75.0, 35.0, 25.0)
_DISTANCE_M = (0.45, 3.0)
_HEIGHT_M = (0.27, 0.75)  # that an image shows at the distance of the head
_SHIFT = 0.08  # standard deviation of the head's place, as a share of that height
_MIDDLE_M = 0.03  # height of the middle of head and hair over the origin of the head frame


@dataclass(frozen=True)
class PortraitBankSettings:
    """Numbers of photos: `photos` of each of the `views` of a person, of `side_px`."""

    views: int = 5
    photos: int = 6
    side_px: int = 288


def add_portraits(
    folder: Path,
    face_models: list[str],
    people: range,
    jobs: int,
    seed: int,
    settings: PortraitBankSettings = PortraitBankSettings(),
) -> None:
    """Photograph synthetic people into `folder`; keep finished ones. The face models take turns."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [index for index in people if not _path(folder, index).exists()]
    in_shards(partial(_add_shard, folder, face_models, seed, settings), missing, jobs)


def _path(folder: Path, index: int) -> Path:
    return folder / f"{index:05}.safetensors"


def _add_shard(
    folder: Path, face_models: list[str], seed: int, settings: PortraitBankSettings, people: list[int]
) -> None:
    torch.set_num_threads(1)
    for index in people:
        tensors = photos_of(face_models[index % len(face_models)], index, seed, settings)
        with atomic_path(_path(folder, index)) as temporary:
            save_file(tensors, temporary)


@torch.no_grad()
def photos_of(face_model: str, index: int, seed: int, settings: PortraitBankSettings) -> dict[str, Tensor]:
    """Photograph one person: V views, P photos of each, of side S, and their truth.

    pictures [V, P, 3, S, S] uint8: the square root of radiance over `BRIGHTEST` times the person's mean;
    alpha [V, S, S] uint8, of 255; label [V, S, S] uint8: class of most of what is covered; landmarks_px
    [V, 68 + M, 2], NaN for those that a person does not have; rotation [V, 3, 3], head_to_camera.
    """
    random = np.random.default_rng([seed, index, 3])
    generator = torch.Generator().manual_seed(int(random.integers(1 << 62)))
    subject = draw_subject(subject_model(face_model), index, seed, settings.side_px)
    cameras = [_draw_camera(settings.side_px, random) for _ in range(settings.views)]
    turn = pose_to_rotation(*random.uniform(-180, 180, 3).tolist()).double()
    directions = (rig_directions(_LIGHTS).double() @ turn).numpy()
    transport = bake_subject(subject, cameras, directions, _BAKE, index)
    looks = [subject.appearance, *(draw_appearance(_LOOK_PX, generator) for _ in range(_OTHER_LOOKS))]
    views = [view_of(subject, transport, camera) for camera in cameras]
    pictures = [
        torch.stack(
            [
                _picture(view, photograph(view, looks[photo % len(looks)], _light(view, generator)).image)
                for photo in range(settings.photos)
            ]
        )
        for view in views
    ]
    classes = torch.stack([view.classes for view in views])
    return {
        "pictures": torch.stack(pictures),
        "alpha": 255 - classes[..., 0],
        "label": 1 + classes[..., 1:].argmax(-1).byte(),
        "landmarks_px": torch.stack([view.landmarks_px for view in views]),
        "rotation": torch.stack([view.rotation for view in views]),
    }


def _draw_camera(side_px: int, random: np.random.Generator) -> StageCamera:
    """Draw a camera: pose, distance, and how much of the person it shows."""
    limit = np.array(_POSE_MAX_DEG)
    pose_deg = (random.normal(0, _POSE_STD_DEG)).clip(-limit, limit)
    distance_m, height_m = (math.exp(random.uniform(*np.log(ends))) for ends in (_DISTANCE_M, _HEIGHT_M))
    right, up = random.normal(0, _SHIFT, 2).clip(-2 * _SHIFT, 2 * _SHIFT) * height_m
    lens = Camera(side_px * distance_m / height_m, side_px, side_px, side_px / 2, side_px / 2)
    rotation = pose_to_rotation(*pose_deg.tolist())
    return StageCamera(lens, rotation, torch.tensor([right, up - _MIDDLE_M, -distance_m]).float())


def _light(view: BakedPortrait, generator: torch.Generator) -> Tensor:
    """Draw weights [L, 3] of a view's lights: as in training of the field, or one lamp in near darkness."""
    if torch.rand((), generator=generator) >= _LAMP_SHARE:
        return draw_light(view.directions, generator)
    weights = torch.full((len(view.directions), 3), 0.1 * float(torch.rand((), generator=generator)) ** 3)
    weights[torch.multinomial((view.directions[:, 2] + 0.6).clamp_min(0), 1, generator=generator)] += 4.0
    return weights


def _picture(view: BakedPortrait, image: Tensor) -> Tensor:
    """A photo [3, S, S] in bytes, as `photos_of` describes."""
    mean = image.sum() / 3 / ((255.0 - view.classes[..., 0].float()).sum() / 255).clamp_min(1)
    return (255 * (image / (BRIGHTEST * mean.clamp_min(1e-6))).clamp(0, 1).sqrt()).round().byte()
