"""Photos of synthetic people with their truth, and backgrounds to lay behind them.

Each person is photographed by several cameras, and each view under several lights, with other skin and other
clothes. The background stays black; every training sample adds its own (`parsing.py`): a view of a sky, or
shapes that cover each other, which have the statistics of natural images (Lee et al., *Occlusion models for
natural images*, 2001). A network that has seen them takes no pattern of a background for a person.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pose_to_rotation
from facerf_cli.synth.appearance.materials import Appearance, draw_appearance
from facerf_cli.synth.bank import Files, fill
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.texture_samples import draw_light
from facerf_cli.synth.camera import turned
from facerf_cli.synth.portraits import BakedPortrait, bake_subject, images_under, materials_of, view_of
from facerf_cli.synth.random_fields import Random, Uniform, generators
from facerf_cli.synth.sky.skies import draw_sky
from facerf_cli.synth.subjects import Subject, draw_subject
from facerf_cli.synth.views import StageCamera

BACKGROUND_PX, BACKGROUND_MAPS, BACKGROUND_HEAPS = 320, 60, 240  # side, and numbers of a bank
_MAP_PX = 768  # width of the maps
_VIEWS = 4  # of each map
_ANGLE = (0.35, 0.9)  # tangent of half the angle that a view shows
_SHAPES = (40, 260)
_RADIUS = (0.015, 0.5)  # of a shape, in sides of the image
_WHITE = 4.0  # radiance, over the image's mean, that is stored as white


def load_backgrounds(path: Path, maps: int, heaps: int, seed: int) -> Tensor:
    """Read the backgrounds [N, 3, S, S] of a bank, or draw and save them; uint8, the root of radiance."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = torch.cat([*(views_of_map(index, seed) for index in range(maps)), heaps_of(heaps, seed)])
        with atomic_path(path) as temporary:
            save_file({"backgrounds": drawn}, temporary)
    return load_file(path)["backgrounds"]


def views_of_map(index: int, seed: int) -> Tensor:
    """Photograph a procedural environment map [4, 3, S, S] in several directions, as `load_backgrounds`."""
    radiance = torch.from_numpy(draw_sky(index, seed, _MAP_PX)[0])
    return views_of(radiance, _VIEWS, torch.Generator().manual_seed(seed * 7919 + index))


def views_of(radiance: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Photograph an environment map [H, W, 3] `count` times, [N, 3, S, S], as `load_backgrounds`."""
    uniform = Uniform(generator)
    views = []
    for _ in range(count):
        tangent = uniform(*_ANGLE) * (2 * (torch.arange(BACKGROUND_PX) + PIXEL_CENTRE) / BACKGROUND_PX - 1)
        down, right = torch.meshgrid(tangent, tangent, indexing="ij")
        azimuth = uniform(-math.pi, math.pi) + right.atan()
        elevation = uniform(-0.25, 0.2) - (down / (1 + right.square()).sqrt()).atan()
        wrapped = torch.remainder(azimuth / math.pi + 1, 2) - 1
        grid = torch.stack([wrapped, -elevation / (math.pi / 2)], -1)[None]
        seen = F.grid_sample(
            radiance.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False
        )
        views.append(_stored(seen[0]))
    return torch.stack(views)


def heaps_of(count: int, seed: int) -> Tensor:
    """Draw heaps of shapes [N, 3, S, S] that cover each other, as `load_backgrounds`."""
    generator = torch.Generator().manual_seed(seed * 7919 + 1_000_003)
    return torch.stack([_stored(_heap(generator)) for _ in range(count)])


def _stored(radiance: Tensor) -> Tensor:
    return (255 * (radiance / (_WHITE * radiance.mean().clamp_min(1e-6))).clamp(0, 1).sqrt()).round().byte()


def _heap(generator: torch.Generator) -> Tensor:
    """Draw one heap [3, S, S]; all its shapes share a palette."""
    uniform = Uniform(generator)
    at = (torch.arange(BACKGROUND_PX) + PIXEL_CENTRE) / BACKGROUND_PX
    image = _material(generator, uniform(0.02, 0.6) * torch.exp(uniform(-0.3, 0.3, 3, 1, 1)))
    palette = uniform(0.01, 0.9, 5, 1) ** 1.5 * torch.exp(0.35 * torch.randn(5, 3, generator=generator))
    boxes = float(torch.rand((), generator=generator))  # share of rectangles
    smallest, largest = (math.log(radius) for radius in _RADIUS)
    upright = torch.rand((), generator=generator) < 0.5
    for _ in range(int(torch.randint(*_SHAPES, (), generator=generator))):
        radius = torch.exp(uniform(smallest, largest) * uniform(0.6, 1))
        x0, y0 = uniform(-0.1, 1.1, 2)
        tilt = uniform(-0.05, 0.05) if upright else uniform(0, math.pi)
        long, wide = radius, radius * uniform(0.25, 1)
        low_y, high_y, low_x, high_x = (
            int((BACKGROUND_PX * v).clamp(0, BACKGROUND_PX))
            for v in (y0 - 1.5 * radius, y0 + 1.5 * radius, x0 - 1.5 * radius, x0 + 1.5 * radius)
        )
        if high_y <= low_y or high_x <= low_x:
            continue
        y, x = torch.meshgrid(at[low_y:high_y] - y0, at[low_x:high_x] - x0, indexing="ij")
        along, across = turned(x, y, tilt)
        along, across = along / long, across / wide
        if torch.rand((), generator=generator) < boxes:
            inside = torch.maximum(along.abs(), across.abs()) < 1
        else:
            inside = along.square() + across.square() < 1
        colour = palette[int(torch.randint(5, (), generator=generator))] * uniform(0.5, 1.5)
        shade = 1 + uniform(-0.5, 0.5) * along + uniform(-0.5, 0.5) * across
        grain = 1 + uniform(0, 0.25) * torch.randn(inside.shape, generator=generator)
        patch = image[:, low_y:high_y, low_x:high_x]
        filled = colour[:, None, None] * (shade * grain).clamp_min(0)
        image[:, low_y:high_y, low_x:high_x] = torch.where(inside, filled, patch)
    return image


def _material(generator: torch.Generator, colour: Tensor) -> Tensor:
    """A wall [3, S, S] of a colour with a slow gradient and blotches."""
    uniform = Uniform(generator)
    cells = int(torch.randint(2, 12, (), generator=generator))
    blotches = torch.randn(1, 1, cells, cells, generator=generator) * uniform(0, 0.5)
    wide = F.interpolate(blotches, (BACKGROUND_PX, BACKGROUND_PX), mode="bilinear", align_corners=False)[0]
    return colour * wide.exp()


BRIGHTEST = 6.0  # largest stored radiance, over the mean radiance of the person
_LIGHTS = 48
_LOOKS, _LOOK_PX = 3, 256  # skins and clothes of a person, and texture side of those besides the person's own
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
    fill(folder, partial(_photographed, face_models, seed, settings), people, jobs)


def _photographed(face_models: list[str], seed: int, settings: PortraitBankSettings, index: int) -> Files:
    return {f"{index:05d}": photos_of(face_models[index % len(face_models)], index, seed, settings)}


@torch.no_grad()
def photos_of(face_model: str, index: int, seed: int, settings: PortraitBankSettings) -> dict[str, Tensor]:
    """Photograph one person: V views, P photos of each, of side S, and their truth.

    pictures [V, P, 3, S, S] uint8: the square root of radiance over `BRIGHTEST` times the person's mean;
    alpha [V, S, S] uint8, of 255; label [V, S, S] uint8: class of most of what is covered; landmarks_px
    [V, 68 + M, 2], NaN for those that a person does not have; rotation [V, 3, 3], head_to_camera.
    """
    random, generator = generators(seed, index, 3)
    subject = draw_subject(cached_face_model(face_model), index, seed, settings.side_px)
    cameras = [_draw_camera(settings.side_px, random) for _ in range(settings.views)]
    views = seen_by(cameras, subject, _LIGHTS, _BAKE, index, random)
    looks = draw_looks(subject, _LOOKS, generator)
    pictures = [
        _picture(view, looks[photo % len(looks)], draw_photo_light(view.directions, generator, _LAMP))
        for view in views
        for photo in range(settings.photos)
    ]
    classes = torch.stack([view.classes for view in views])
    return {
        "pictures": torch.stack(pictures).view(len(views), -1, *pictures[0].shape),
        "alpha": 255 - classes[..., 0],
        "label": 1 + classes[..., 1:].argmax(-1).byte(),
        "landmarks_px": torch.stack([view.landmarks_px for view in views]),
        "rotation": torch.stack([view.rotation for view in views]),
    }


def seen_by(
    cameras: list[StageCamera], subject: Subject, lights: int, bake: BakeSettings, index: int, random: Random
) -> list[BakedPortrait]:
    """Bake what cameras see of person number `index`, under a rig that is turned at random."""
    turn = pose_to_rotation(*random.uniform(-180, 180, 3).tolist()).double()
    directions = (rig_directions(lights).double() @ turn).numpy()
    transport = bake_subject(subject, cameras, directions, bake, index)
    return [view_of(subject, transport, camera) for camera in cameras]


def draw_looks(subject: Subject, count: int, generator: torch.Generator) -> list[Appearance]:
    """The person's own skin and clothes, and others."""
    return [subject.appearance, *(draw_appearance(_LOOK_PX, generator) for _ in range(count - 1))]


def draw_turn(random: Random, std_deg: Sequence[float], most_deg: Sequence[float]) -> Tensor:
    """Draw the rotation of a camera from standard deviations and largest values of yaw, pitch and roll."""
    limit = np.array(most_deg)
    return pose_to_rotation(*random.normal(0, std_deg).clip(-limit, limit).tolist())


def _draw_camera(side_px: int, random: Random) -> StageCamera:
    """Draw a camera: pose, distance, and how much of the person it shows."""
    rotation = draw_turn(random, _POSE_STD_DEG, _POSE_MAX_DEG)
    distance_m, height_m = (math.exp(random.uniform(*np.log(ends))) for ends in (_DISTANCE_M, _HEIGHT_M))
    right, up = random.normal(0, _SHIFT, 2).clip(-2 * _SHIFT, 2 * _SHIFT) * height_m
    lens = Camera(side_px * distance_m / height_m, side_px, side_px, side_px / 2, side_px / 2)
    return StageCamera(lens, rotation, torch.tensor([right, up - _MIDDLE_M, -distance_m]).float())


class Lamp(NamedTuple):
    """One small lamp in near darkness: share of photos, and how dim the rest is (weight, exponent).

    `behind`: z by which the lamp may stand behind the person; `power`: its weight.
    """

    share: float
    dim: float
    exponent: int
    behind: float
    power: float


_LAMP = Lamp(0.25, 0.1, 3, 0.6, 4.0)


def draw_photo_light(directions: Tensor, generator: torch.Generator, lamp: Lamp) -> Tensor:
    """Draw weights [L, 3] of a photo's lights: as in training of the field, or one lamp in near darkness."""
    if torch.rand((), generator=generator) >= lamp.share:
        return draw_light(directions, generator)
    dim = lamp.dim * float(torch.rand((), generator=generator)) ** lamp.exponent
    weights = torch.full((len(directions), 3), dim)
    at = torch.multinomial((directions[:, 2] + lamp.behind).clamp_min(0), 1, generator=generator)
    weights[at] += lamp.power
    return weights


def _picture(view: BakedPortrait, look: Appearance, weights: Tensor) -> Tensor:
    """A photo [3, S, S] in bytes, as `photos_of` describes."""
    (image,) = images_under(view, materials_of(view, look), weights[None])
    total = image.permute(1, 2, 0).contiguous().sum()  # in this order, since sums depend on it
    mean = total / 3 / ((255.0 - view.classes[..., 0].float()).sum() / 255).clamp_min(1)
    return (255 * (image / (BRIGHTEST * mean.clamp_min(1e-6))).clamp(0, 1).sqrt()).round().byte()
