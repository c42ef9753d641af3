"""Bank of synthetic people for the stages geometry, parsing and portrait.

    photo_PERSON_K.safetensors   a photo by one camera: images of the person in several lights, with the truth
    PERSON_K.safetensors         a square of a photo, the input of the Portrait Network, without light

A person's light is baked once, at the vertices of the mesh. The background of a photo stays black; every
training sample adds its own. The stages geometry and parsing need only the photos.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.parse import MIRROR
from facerf_cli.portrait.person import SIDES
from facerf_cli.raster.camera import Camera, crop_camera, pose_to_rotation, project
from facerf_cli.synth.appearance.materials import draw_appearance
from facerf_cli.synth.bank import Files, fill
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.texture_samples import draw_light
from facerf_cli.synth.person import SyntheticPerson, draw_person
from facerf_cli.synth.random_fields import Random, generators
from facerf_cli.synth.renderer import BakedView, bake_light, images_under, materials_of, view_of
from facerf_cli.synth.shading import Material
from facerf_cli.synth.views import StageCamera

# Bounced light is smoothed over more than an edge of cloth, where few rays would leave spots.
_BAKE = BakeSettings(light_samples=2, light_radius_deg=1.5, bounce_samples=10, bounce_blur_m=0.012)
# Standard deviations of the camera's yaw, pitch and roll, and their largest values, in degrees.
_POSE_STD_DEG, _POSE_MAX_DEG = (28.0, 10.0, 6.0), (70.0, 30.0, 20.0)
_NEAREST, _FARTHEST_M = 0.17, 3.0  # of the camera: metres for each face that its squares show, and metres
SIDE_PX, PHOTO_PX = 256, 448  # largest side of a square, and side of a photo
_FACE_PX = (58.0, 80.0)  # pixels along a face, as far as the square's side allows
_LEAST_PX, _STEP_PX = 96, 32  # of a square's side
_SIDES_STD = 0.06  # of the log of a square's side over that in users' photos
_CUT, _CUT_FACES = 1 / 3, (0.7, 1.6)  # share of photos that end below the face's middle, and where
_PHOTO_SIDES = (1.0, 1.25)  # of the photo, over the extent of its squares; it is no smaller than `SIDES`
PHOTO = "photo_"  # before the names of photos
_SHIFT_STD = 0.03  # of the square's place, in its sides
_ABOVE, _BELOW = 1.3, 4.4  # faces: least of a low square that is above the face, and most that is below it


BRIGHTEST = 6.0  # largest stored radiance, over the mean radiance of the person
_LOOK_PX = 256  # texture side of looks other than the person's own
GEOMETRY_PX = 128  # side of the crop that the pose is fitted in


@dataclass(frozen=True)
class PeopleBankSettings:
    """Numbers of cameras, of squares and images of each, of looks and of lights; sides in pixels."""

    cameras: int = 3
    squares: int = 2
    images: int = 6
    looks: int = 3
    lights: int = 48
    side_px: int = SIDE_PX
    photo_px: int = PHOTO_PX
    with_squares: bool = True


# Photos show faces of about 100 pixels, for which coarse meshes and few lights suffice.
PHOTO_BANK = PeopleBankSettings(lights=24, side_px=96, with_squares=False)
TINY_BANK = PeopleBankSettings(cameras=1, squares=1, images=1, looks=1, lights=12, side_px=96, photo_px=128)


def add_people(
    folder: Path, face_models: list[str], people: range, jobs: int, seed: int, settings: PeopleBankSettings
) -> None:
    """Bake synthetic people into `folder`; keep finished ones. The face models take turns."""
    last = f"{PHOTO}{{:05d}}_{settings.cameras - 1}"
    if settings.with_squares:
        last = f"{{:05d}}_{settings.cameras * settings.squares - 1}"
    fill(folder, partial(bake_person, face_models, seed, settings), people, jobs, last=last)


@torch.no_grad()
def bake_person(face_models: list[str], seed: int, settings: PeopleBankSettings, index: int) -> Files:
    """Bake person number `index`, of one of the face models by turns; return tensors by file name.

    A photo of side P has images [T, 3, P, P] uint8 over black in T lights and in looks by turns: the square
    root of radiance over `BRIGHTEST` times the person's mean; alpha [P, P] uint8, times 255; label [P, P]
    uint8: class of most of the covered part; landmarks_px [68 + M, 2], NaN for those that a person lacks;
    points_px [68, 2]: landmarks of the mesh, also hidden ones; directions [L, 3] of the lights. crop [3]:
    left, top and side of the face in the photo. fit_rotation [3, 3], fit_translation_m [3], fit_alpha [Ki]
    and fit_beta [Ke]: fit of the built-in model to points_px through the crop's camera. squares [Q, 4]: the
    fields of a `Crop` of the photo. rows []: number of rows, from the top, of a user's photo.

    A square has the fields of `BakedView.packed`, and its materials in K looks: look_albedo [K, N, 3],
    look_specular and look_roughness [K, N], float16, see `Material`.
    """
    random, generator = generators(seed, index, 5)
    model = cached_face_model(face_models[index % len(face_models)])
    person = draw_person(model, index, seed, settings.side_px, arms=True)
    drawn = _draw_cameras(person, random, settings)
    turn = pose_to_rotation(*random.uniform(-180, 180, 3).tolist()).double()
    directions = (rig_directions(settings.lights).double() @ turn).numpy()
    cameras = [camera for one in drawn for camera in (one.photo, *one.squares)]
    light = bake_light(person, cameras, directions, _BAKE, index)
    others = [draw_appearance(_LOOK_PX, generator) for _ in range(settings.looks - 1)]
    files: Files = {}
    for number, one in enumerate(drawn):
        view, own = view_of(person, light, one.photo)
        looks = [own, *(materials_of(view, look) for look in others)]
        files[f"{PHOTO}{index:05d}_{number}"] = {
            **_photo(view, looks, settings.images, generator),
            **_fit(person, one.photo),
            "squares": one.crops,
            "rows": torch.tensor(one.rows),
        }
        for k, square in enumerate(one.squares if settings.with_squares else []):
            view, own = view_of(person, light, square)
            looks = [own, *(materials_of(view, look) for look in others)]
            files[f"{index:05d}_{number * settings.squares + k}"] = view.packed() | {
                f"look_{name}": torch.stack([getattr(look, name) for look in looks]).half()
                for name in ("albedo", "specular", "roughness")
            }
    return files


def _photo(
    view: BakedView, looks: list[Material], images: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """Render the images of a photo, and its truth; see `bake_person`."""
    weights = [draw_photo_light(view.directions, generator, _KEY_LIGHT) for _ in range(images)]
    radiance = torch.empty(images, 3, *view.alpha.shape)
    for first, look in enumerate(looks[:images]):
        every = slice(first, None, len(looks))
        radiance[every] = images_under(view, look, torch.stack(weights[every]))
    mean = radiance.sum((1, 2, 3), keepdim=True) / 3 / view.alpha.sum().clamp_min(1)
    relative = (radiance / (BRIGHTEST * mean.clamp_min(1e-6))).clamp(0, 1)
    return {
        "images": (255 * relative.sqrt()).round().byte(),
        "alpha": (255 * view.alpha).round().byte(),
        "label": 1 + view.classes[..., 1:].argmax(-1).byte(),
        "landmarks_px": view.landmarks_px,
        "directions": view.directions,
    }


def _fit(person: SyntheticPerson, camera: StageCamera) -> dict[str, Tensor]:
    """Fit the built-in model to the true landmarks of a photo; see `bake_person`."""
    landmarks_m = torch.from_numpy(person.landmarks_world).float()
    points_px = project(camera.to_camera(landmarks_m), camera.camera)
    crop = from_landmarks(points_px.numpy(), GEOMETRY_PX)
    in_crop = torch.from_numpy(crop.to_crop(points_px.numpy())).float()
    fit = fit_batch(cached_face_model(BUILTIN), in_crop[None], crop_camera(GEOMETRY_PX))
    names = ("rotation", "translation_m", "alpha", "beta")
    return {
        "points_px": points_px,
        "crop": torch.tensor([crop.x0_px, crop.y0_px, crop.side_px]),
        **{f"fit_{name}": getattr(fit, name)[0].float().contiguous() for name in names},
    }


class _Views(NamedTuple):
    """Cameras of a photo and of its squares, the squares as `crops` [Q, 4] of the photo, and its rows."""

    photo: StageCamera
    squares: list[StageCamera]
    crops: Tensor
    rows: int


def _draw_cameras(person: SyntheticPerson, random: Random, settings: PeopleBankSettings) -> list[_Views]:
    """Draw cameras with squares like in users' photos."""
    shape = settings.cameras, settings.squares
    scales = SIDES * np.exp(random.normal(0, _SIDES_STD, shape))
    return [_draw_views(person, sides, random, settings) for sides in scales]


def _draw_views(
    person: SyntheticPerson, scales: np.ndarray, random: Random, settings: PeopleBankSettings
) -> _Views:
    """Draw a camera that takes squares of these sides [K] in faces, a little off."""
    limit_deg = np.array(_POSE_MAX_DEG)
    pose_deg = random.normal(0, _POSE_STD_DEG).clip(-limit_deg, limit_deg)
    rotation = pose_to_rotation(*pose_deg.tolist())
    distance_m = math.exp(random.uniform(*np.log((_NEAREST * scales.max(), _FARTHEST_M))))
    towards = torch.tensor([*random.normal(0, 0.05, 2), -distance_m]).float()  # off the axis of the lens
    landmarks = torch.from_numpy(person.landmarks_world).float() @ rotation.T.float() + towards
    seen = project(landmarks, Camera(1.0, 1, 1, 0.0, 0.0)).double()
    low, high = seen.amin(0), seen.amax(0)
    middle, face = ((low + high) / 2).numpy(), float((high - low).max())

    def window(sides: float) -> np.ndarray:
        """Left, top and side of a square, at distance 1."""
        down = random.uniform(0, max(0.0, min(sides / 2 - _ABOVE, _BELOW - sides / 2)))
        off = random.normal(0, _SHIFT_STD, 2) * sides + [0, down]
        return np.array([*(middle + (off - sides / 2) * face), sides * face])

    def side_px(sides: float) -> int:
        wanted = _STEP_PX * round(sides * random.uniform(*_FACE_PX) / _STEP_PX)
        return int(min(max(wanted, _LEAST_PX), settings.side_px))

    def camera(square: np.ndarray, size_px: int) -> StageCamera:
        x, y = (size_px / square[2] * square[:2]).tolist()
        return StageCamera(Camera(size_px / square[2], size_px, size_px, -x, -y), rotation, towards)

    squares, sizes = [window(sides) for sides in scales], [side_px(sides) for sides in scales]
    corners = np.array([square[:2] for square in squares])
    ends = corners + np.array([square[2:] for square in squares])
    side = max(float((ends.max(0) - corners.min(0)).max()) * random.uniform(*_PHOTO_SIDES), SIDES * face)
    whole = np.array([*((ends.max(0) + corners.min(0)) / 2 - side / 2), side])
    px = settings.photo_px / side
    crops = [[*((x[:2] - whole[:2]) * px), x[2] * px, size] for x, size in zip(squares, sizes, strict=True)]
    cut = random.uniform(*_CUT_FACES) if random.uniform() < _CUT else math.inf
    return _Views(
        camera(whole, settings.photo_px),
        [camera(*one) for one in zip(squares, sizes, strict=True)],
        torch.tensor(np.array(crops)),
        round(min((middle[1] + cut * face - whole[1]) * px, settings.photo_px)),
    )


class KeyLight(NamedTuple):
    """Key light in near darkness: fraction of photos, and how dim the rest is (weight, exponent).

    `behind`: how far, along z, the light may stand behind the person; `power`: its weight.
    """

    share: float
    dim: float
    exponent: int
    behind: float
    power: float


_KEY_LIGHT = KeyLight(0.25, 0.1, 3, 0.6, 4.0)


def draw_photo_light(directions: Tensor, generator: torch.Generator, key: KeyLight) -> Tensor:
    """Draw weights [L, 3] of a photo's lights: `draw_light`'s, or a key light in near darkness."""
    if torch.rand((), generator=generator) >= key.share:
        return draw_light(directions, generator)
    dim = key.dim * float(torch.rand((), generator=generator)) ** key.exponent
    weights = torch.full((len(directions), 3), dim)
    at = torch.multinomial((directions[:, 2] + key.behind).clamp_min(0), 1, generator=generator)
    weights[at] += key.power
    return weights


@dataclass(frozen=True, eq=False)
class Photo:
    """Image with its truth: radiance [3, P, P] times alpha, alpha [P, P], label [P, P], landmarks [N, 2]."""

    radiance: Tensor
    alpha: Tensor
    label: Tensor
    landmarks_px: Tensor

    @property
    def side_px(self) -> int:
        return self.alpha.shape[-1]

    def mirrored(self) -> "Photo":
        flipped = self.landmarks_px[torch.from_numpy(MIRROR)] * torch.tensor([-1.0, 1.0])
        moved = flipped + torch.tensor([float(self.side_px), 0.0])
        return Photo(self.radiance.flip(-1), self.alpha.flip(-1), self.label.flip(-1), moved)


def photos_in(folder: Path) -> list[list[Path]]:
    """List the photos of each person in a bank; InputError if there are none."""
    people: dict[str, list[Path]] = {}
    for path in sorted(folder.glob(f"{PHOTO}[0-9]*.safetensors")):
        people.setdefault(path.stem.split("_")[1], []).append(path)
    if not people:
        raise InputError(f"{folder}: no photos of people; bake them with `facerf train --stage parsing`")
    return list(people.values())


def read_photo(path: Path, generator: torch.Generator) -> Photo:
    with safe_open(path, framework="pt") as file:
        images = file.get_slice("images")
        stored = images[int(torch.randint(images.get_shape()[0], (), generator=generator))]
        alpha, label, landmarks_px = (file.get_tensor(name) for name in ("alpha", "label", "landmarks_px"))
    return Photo((stored.float() / 255).square(), alpha.float() / 255, label, landmarks_px)
