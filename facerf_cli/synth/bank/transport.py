"""Bank of portraits that the Portrait Network is trained on: what cameras see of synthetic people.

A portrait is kept without light: the facets of the image, how much of each light reaches them, and what they
are made of in several looks. A person's light is baked once, at the vertices of the mesh; each camera takes a
photo of it, in which the person is found, and squares, as the Portrait Network sees them of
photos (`portrait.proxy`). `portrait_samples.py` draws samples of it.
"""

import math
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.batch.recipe import is_made_from
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import fit_landmarks
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.portrait import SKIN
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.person import SIDES, SeenPerson, look_at_person, surface_of
from facerf_cli.raster.camera import Camera, project
from facerf_cli.relighting.models import Networks
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.bank import Files, file_of, fill
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.portraits import (
    draw_looks,
    draw_turn,
    seen_by,
)
from facerf_cli.synth.bank.texture_samples import draw_light
from facerf_cli.synth.camera import background
from facerf_cli.synth.portraits import BakedPortrait, images_under, materials_of, portrait_tensors
from facerf_cli.synth.random_fields import Random, generators
from facerf_cli.synth.shading import Material
from facerf_cli.synth.subjects import Subject, draw_subject
from facerf_cli.synth.views import StageCamera

# Bounced light is smoothed over more than an edge of cloth, where few rays would leave spots.
_BAKE = BakeSettings(light_samples=2, light_radius_deg=1.5, bounce_samples=10, bounce_blur_m=0.012)
# Standard deviations of the camera's yaw, pitch and roll, and their largest values, in degrees.
_POSE_STD_DEG, _POSE_MAX_DEG = (24.0, 9.0, 5.0), (65.0, 28.0, 18.0)
_NEAREST, _FARTHEST_M = 0.17, 3.0  # of the camera: metres for each face that its squares show, and metres
SIDE_PX, PHOTO_PX = 256, 448  # most of a square, and of the photo in which the person is found
_FACE_PX = (58.0, 80.0)  # pixels along a face, as far as the square's side allows
_LEAST_PX, _STEP_PX = 96, 32  # of a square's side
_SIDES_STD = 0.06  # of the sides of squares, which show as much as those of photos
_CUT, _CUT_FACES = 1 / 3, (0.7, 1.6)  # share of photos that end below the face's middle, and where
_PHOTO_SIDES = (1.0, 1.25)  # of the photo, in sides of what its squares take; it is no smaller than `SIDES`
_PHOTO = "photo_"  # before the names of photos
_TRIES, _CROP_PX = 3, 256  # lights in which a face is looked for; side of the crop that it is fitted in
_SHIFT_STD = 0.03  # of the square's place, in its sides
_ABOVE, _BELOW = 1.3, 4.4  # faces: least of a low square that is above the face, and most that is below it


@dataclass(frozen=True)
class TransportBankSettings:
    """Numbers of cameras, squares of each of them, looks and lights of a person; sides in pixels."""

    cameras: int = 2
    squares: int = 3
    looks: int = 3
    lights: int = 48
    side_px: int = SIDE_PX
    photo_px: int = PHOTO_PX


TINY_BANK = TransportBankSettings(cameras=1, squares=1, looks=1, lights=12, side_px=128)


def add_transport(
    folder: Path,
    face_models: list[str],
    people: range,
    jobs: int,
    seed: int,
    settings: TransportBankSettings = TransportBankSettings(),
) -> None:
    """Bake synthetic people into `folder`; keep finished ones. The face models take turns."""
    baked = partial(_baked, face_models, seed, settings)
    fill(folder, baked, people, jobs, last=f"_{settings.cameras * settings.squares - 1}")


def _baked(face_models: list[str], seed: int, settings: TransportBankSettings, index: int) -> Files:
    return transport_of(face_models[index % len(face_models)], index, seed, settings)


@torch.no_grad()
def transport_of(face_model: str, index: int, seed: int, settings: TransportBankSettings) -> Files:
    """Bake one person, by the names of files.

    A square has the fields of `BakedPortrait`, and its facets' materials in K looks: look_albedo [K, N, 3],
    look_specular and look_roughness [K, N], float16, see `Material`. The squares of a camera lie in its photo
    of side P: lit [T, 3, P, P] float16 over black, in the first look and T lights; alpha [P, P] uint8, of
    255; squares [Q, 4], the fields of a `Crop` of the photo; rows [], of the photo from its top that are its
    user's; directions [L, 3] of the lights.
    """
    random, generator = generators(seed, index, 5)
    subject = draw_subject(cached_face_model(face_model), index, seed, settings.side_px, arms=True)
    drawn = _draw_cameras(subject, random, settings)
    cameras = [camera for one in drawn for camera in (one.photo, *one.squares)]
    views = iter(seen_by(cameras, subject, settings.lights, _BAKE, index, random))
    looks = draw_looks(subject, settings.looks, generator)
    files: Files = {}
    for number, one in enumerate(drawn):
        first = number * settings.squares
        photo = _photo(next(views), looks[0], generator)
        files[f"{_PHOTO}{index:05d}_{first}"] = photo | {"squares": one.crops, "rows": torch.tensor(one.rows)}
        for k in range(first, first + settings.squares):
            view = next(views)
            materials = _materials([materials_of(view, look) for look in looks])
            files[f"{index:05d}_{k}"] = {**portrait_tensors(view), **materials}
    return files


def _photo(view: BakedPortrait, look: Appearance, generator: torch.Generator) -> dict[str, Tensor]:
    """The person in a photo, in several lights; see `transport_of`."""
    weights = torch.stack([draw_light(view.directions, generator) for _ in range(_TRIES)])
    images = images_under(view, materials_of(view, look), weights)
    images = images / images.mean((1, 2, 3), keepdim=True).clamp_min(1e-6)
    alpha = 255 - view.classes[..., 0]
    return {"lit": images.half(), "alpha": alpha, "directions": view.directions}


def _materials(looks: list[Material]) -> dict[str, Tensor]:
    return {
        f"look_{name}": torch.stack([getattr(look, name) for look in looks]).half()
        for name in ("albedo", "specular", "roughness")
    }


class _Views(NamedTuple):
    """A camera's photo and its squares, also [Q, 4] as the fields of a `Crop` of the photo, and its rows."""

    photo: StageCamera
    squares: list[StageCamera]
    crops: Tensor
    rows: int


def _draw_cameras(subject: Subject, random: Random, settings: TransportBankSettings) -> list[_Views]:
    """Draw cameras, whose squares show what those of photos show."""
    shape = settings.cameras, settings.squares
    scales = SIDES * np.exp(random.normal(0, _SIDES_STD, shape))
    return [_draw_views(subject, sides, random, settings) for sides in scales]


def _draw_views(
    subject: Subject, scales: np.ndarray, random: Random, settings: TransportBankSettings
) -> _Views:
    """Draw a camera that takes squares of these sides [K] in faces, a little off."""
    rotation = draw_turn(random, _POSE_STD_DEG, _POSE_MAX_DEG)
    distance_m = math.exp(random.uniform(*np.log((_NEAREST * scales.max(), _FARTHEST_M))))
    towards = torch.tensor([*random.normal(0, 0.05, 2), -distance_m]).float()  # off the axis of the lens
    landmarks = torch.from_numpy(subject.landmarks_world).float() @ rotation.T.float() + towards
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


def add_proxies(folder: Path, backgrounds: Tensor, networks: Networks, jobs: int, seed: int) -> None:
    """Add to each portrait of a bank what the networks see of it (`seen_in`); keep finished ones."""
    sha256 = networks.sha256("parsing")
    photos = sorted(folder.glob(f"{_PHOTO}[0-9]*.safetensors"))
    missing = [path for path in photos if not all(is_made_from(seen, sha256) for seen in _seen_paths(path))]
    in_shards(partial(look_at_photos, backgrounds, networks, seed), missing, jobs)


def seen_path(path: Path) -> Path:
    """The file beside a portrait's that holds what is seen of it."""
    return path.with_name(f"seen_{path.name}")


def _seen_paths(photo: Path) -> list[Path]:
    """The files for what is seen of the squares of a photo."""
    person, first = photo.stem.removeprefix(_PHOTO).split("_")
    with safe_open(photo, framework="pt") as file:
        count = len(file.get_tensor("squares"))
    return [seen_path(file_of(photo.parent, f"{person}_{k}")) for k in range(int(first), int(first) + count)]


def look_at_photos(backgrounds: Tensor, networks: Networks, seed: int, photos: list[Path]) -> None:
    """Write what is seen of the squares of photos, on one thread."""
    made_from = {"of": networks.sha256("parsing")}
    with one_thread():
        for path in photos:
            number = int(path.stem.removeprefix(_PHOTO).replace("_", ""))
            paths = _seen_paths(path)
            found = seen_in(load_file(path), backgrounds, networks.people, seed + number)
            for seen, layers in zip(paths, found or [{}] * len(paths), strict=True):
                with atomic_path(seen) as temporary:
                    save_file(layers, temporary, made_from)


@torch.no_grad()
def seen_in(
    photo: dict[str, Tensor], backgrounds: Tensor, people: PeopleNetworks, seed: int
) -> list[dict[str, Tensor]]:
    """Fit and segment a photo as those of users are, and look at its squares, each as `layers_of`.

    Nothing where no face is found in it.
    """
    generator = torch.Generator().manual_seed(seed)
    behind = 1 - photo["alpha"].float() / 255
    squares = [Crop(x, y, side, int(size)) for x, y, side, size in photo["squares"].tolist()]
    rows = int(photo.get("rows", torch.tensor(len(behind))))
    for image in photo["lit"].float():
        scene = (image * 0.1 + behind * background(backgrounds, len(behind), generator))[:, :rows]
        exposed = (scene / scene.mean().clamp_min(1e-6) * 0.2).permute(1, 2, 0).numpy()
        with suppress(InputError):
            person = person_in(people, exposed)
            found = [person.within(square, exposed) for square in squares]
            if all(float(one.classes[SKIN].sum()) > 1 for one in found):
                return [layers_of(one, photo["directions"]) | _rows_in(one.square, rows) for one in found]
    return []


def _rows_in(square: Crop, rows: int) -> dict[str, Tensor]:
    """Rows [] of a square that a photo of so many rows shows."""
    shown = round((rows - square.y0_px) * square.size_px / square.side_px)
    return {"rows": torch.tensor(min(max(shown, 1), square.size_px))}


def person_in(people: PeopleNetworks, photo: np.ndarray) -> SeenPerson:
    """Find the largest face of a scene-linear photo [H, W, 3], fit it, and look at the person.

    Raises InputError without a face.
    """
    face = find_faces(people, photo, "portrait")[0]
    crop = from_landmarks(face.landmarks_px, _CROP_PX)
    fit = fit_landmarks(cached_face_model(BUILTIN), crop.to_crop(face.landmarks_px), crop)
    return look_at_person(people, cached_face_model(BUILTIN), photo, fit)


def layers_of(person: SeenPerson, directions: Tensor) -> dict[str, Tensor]:
    """Return the layers that are kept of a person, and the shadows of lights [L, 3].

    classes [C, S, S], covered [1, S, S] and visible [L, s, s] of the lights: uint8, of 255; normals
    [3, S, S], depth [1, S, S]: float16; sides []: of the square, in faces.
    """
    normals, depth, covered = surface_of(person.maps)
    return {
        "classes": (255 * person.classes).round().byte(),
        "covered": (255 * covered[0]).byte(),
        "normals": normals[0].half().contiguous(),
        "depth": depth[0].half(),
        "visible": (255 * person.shadows.along(directions)).round().byte(),
        "sides": torch.tensor(person.sides),
    }
