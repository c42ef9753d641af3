"""What the networks see of the people of a bank: classes, fitted proxy and its shadows."""

from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import fit_landmarks
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import is_made_from
from facerf_cli.network.portrait import SKIN
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.person import SeenPerson, look_at_person, surface_of
from facerf_cli.relighting.models import Networks
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.bank import file_of
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.people import PHOTO
from facerf_cli.synth.camera import background

_CROP_PX = 256  # side of the crop that a face is fitted in
_EXPOSURE = 1.5  # of the person in front of backgrounds


def add_proxies(folder: Path, backgrounds: Tensor, networks: Networks, jobs: int, seed: int) -> None:
    """Write what the networks see of each square of a bank (`seen_in`); keep finished ones."""
    sha256 = networks.sha256("parsing")
    photos = sorted(folder.glob(f"{PHOTO}[0-9]*.safetensors"))
    missing = [path for path in photos if not all(is_made_from(seen, sha256) for seen in _seen_paths(path))]
    in_shards(partial(look_at_photos, backgrounds, networks, seed), missing, jobs)


def seen_path(path: Path) -> Path:
    """Return the file, beside a square's, of what the networks see of it."""
    return path.with_name(f"seen_{path.name}")


def _seen_paths(photo: Path) -> list[Path]:
    person, number = photo.stem.removeprefix(PHOTO).split("_")
    with safe_open(photo, framework="pt") as file:
        count = len(file.get_tensor("squares"))
    first = int(number) * count
    return [seen_path(file_of(photo.parent, f"{person}_{k}")) for k in range(first, first + count)]


def look_at_photos(backgrounds: Tensor, networks: Networks, seed: int, photos: list[Path]) -> None:
    """Write what the networks see of the squares of photos, on one thread."""
    made_from = {"of": networks.sha256("parsing")}
    with one_thread():
        for path in photos:
            number = int(path.stem.removeprefix(PHOTO).replace("_", ""))
            paths = _seen_paths(path)
            squares = seen_in(load_file(path), backgrounds, networks.people, seed + number)
            for seen, layers in zip(paths, squares or [{}] * len(paths), strict=True):
                with atomic_path(seen) as temporary:
                    save_file(layers, temporary, made_from)


@torch.no_grad()
def seen_in(
    photo: dict[str, Tensor], backgrounds: Tensor, people: PeopleNetworks, seed: int
) -> list[dict[str, Tensor]]:
    """Fit and segment a photo like a user's, and return `layers_of` each of its squares.

    The list is empty if no face is found.
    """
    generator = torch.Generator().manual_seed(seed)
    behind = 1 - photo["alpha"].float() / 255
    squares = [Crop(x, y, side, int(size)) for x, y, side, size in photo["squares"].tolist()]
    rows = int(photo["rows"])
    for image in photo["images"]:
        person = _EXPOSURE * (image.float() / 255).square()
        scene = (person + behind * background(backgrounds, len(behind), generator))[:, :rows]
        exposed = (scene / scene.mean().clamp_min(1e-6) * 0.2).permute(1, 2, 0).numpy()
        with suppress(InputError):
            whole = person_in(people, exposed)
            views = [whole.within(square, exposed) for square in squares]
            if all(float(view.classes[SKIN].sum()) > 1 for view in views):
                seen = [layers_of(view, photo["directions"]) for view in views]
                for layers, square in zip(seen, squares, strict=True):
                    shown = round((rows - square.y0_px) * square.size_px / square.side_px)
                    layers["rows"] = torch.tensor(min(max(shown, 1), square.size_px))
                return seen
    return []


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
