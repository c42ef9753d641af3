"""Training crops for the Geometry Network: photos of a bank's people, with the fit to find in each.

For every sample a photo is mirrored or not, and rotated, shifted and scaled in the crop. A background and
sometimes an occluder are added, and a camera degrades the result. The pose follows every move.
"""

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, MIRROR_68
from facerf_cli.network.batch import Batch
from facerf_cli.synth.bank import split_people
from facerf_cli.synth.bank.people import photos_in, read_photo
from facerf_cli.synth.camera import Similarity, SimulatedCamera, background, occluder, recoloured, resample
from facerf_cli.synth.random_fields import Uniform

_LEAST_FACING = math.cos(math.radians(55))  # of a head to the camera; in other photos landmarks are guesses
_OCCLUDED, _TURNED = 0.3, 0.5  # fractions of samples
_NEAREST_OCCLUDER = 0.3  # distance from the crop's middle, in sides
_CAMERA = SimulatedCamera(0.2, curve=0.3)
_TURN_DEG = 15.0  # largest turn
# Standard deviations of the shift to the right and down (sides) and of log scale: a crop is cut around a
# detector's box, see `dataset/crops.py`.
_SHIFT, _SCALE = (0.1, 0.03), 0.07


@dataclass(frozen=True)
class GeometryCrops(Batch):
    """Crops of B faces as a camera shows them, and the fit that the network should find in them."""

    crops: Tensor  # [B, 3, S, S]
    landmarks_px: Tensor  # [B, 68, 2] true positions, also of hidden ones
    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] of the built-in model
    beta: Tensor  # [B, Ke]


@dataclass(frozen=True, eq=False)
class _Face:
    """Where a photo shows a face, and its fit; see `people.bake_person`."""

    path: Path
    points_px: Tensor
    centre_px: Tensor
    side_px: float
    fit: dict[str, Tensor]

    @staticmethod
    def read(path: Path) -> "_Face":
        with safe_open(path, framework="pt") as file:
            left, top, side_px = file.get_tensor("crop").tolist()
            names = ("rotation", "translation_m", "alpha", "beta")
            fit = {name: file.get_tensor(f"fit_{name}") for name in names}
            points_px = file.get_tensor("points_px")
        return _Face(path, points_px, torch.tensor([left, top]) + side_px / 2, side_px, fit)

    def mirrored(self, photo_px: int) -> "_Face":
        flip, width = torch.tensor([-1.0, 1.0, 1.0]), torch.tensor([float(photo_px), 0.0])
        to_alpha, to_beta = _mirrored_coefficients()
        fit = {
            "rotation": flip[:, None] * self.fit["rotation"] * flip,
            "translation_m": flip * self.fit["translation_m"],
            "alpha": self.fit["alpha"] @ to_alpha,
            "beta": self.fit["beta"] @ to_beta,
        }
        points_px = self.points_px[torch.from_numpy(MIRROR_68)] * flip[:2] + width
        return _Face(self.path, points_px, self.centre_px * flip[:2] + width, self.side_px, fit)


class GeometryPhotos:
    """Draws crops of the faces in a bank's photos."""

    def __init__(self, folder: Path, backgrounds: Tensor, provenance: dict[str, Any]) -> None:
        faces = [[_Face.read(path) for path in photos] for photos in photos_in(folder)]
        facing = [[one for one in person if one.fit["rotation"][2, 2] > _LEAST_FACING] for person in faces]
        self.faces = [person or everyone for person, everyone in zip(facing, faces, strict=True)]
        self.backgrounds, self.provenance = backgrounds, provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        return split_people(len(self.faces), held_out)

    def mean_translation_m(self) -> tuple[float, float, float]:
        """Return the mean translation of all faces, the starting point of the network."""
        shifts_m = [face.fit["translation_m"] for person in self.faces for face in person]
        x, y, z = torch.stack(shifts_m).mean(0).tolist()
        return x, y, z

    def draw(self, person: int, side: int, generator: torch.Generator) -> GeometryCrops:
        """Draw one crop of a person, [1, 3, side, side], with its fit."""
        faces = self.faces[person]
        face = faces[int(torch.randint(len(faces), (), generator=generator))]
        photo = read_photo(face.path, generator)
        if torch.rand((), generator=generator) < 0.5:
            photo, face = photo.mirrored(), face.mirrored(photo.side_px)
        crop, fit = _draw_crop(face.centre_px, face.side_px, generator), face.fit
        pixels = torch.cat([photo.radiance, photo.alpha[None]])
        cut = resample(pixels, crop.positions_px(side))
        image = recoloured(self._composed(cut, generator), _CAMERA.colours(generator))
        rotation, translation_m = crop.pose(
            face.centre_px, face.side_px, fit["rotation"], fit["translation_m"]
        )
        return GeometryCrops(
            _CAMERA.take(image, image.mean(), generator)[None],
            side * crop.in_crop(face.points_px)[None],
            rotation[None],
            translation_m[None],
            fit["alpha"][None],
            fit["beta"][None],
        )

    def _composed(self, person: Tensor, generator: torch.Generator) -> Tensor:
        """Composite a crop [4, S, S] over a background, and sometimes under an occluder: [3, S, S]."""
        side = person.shape[-1]
        image = person[:3] + (1 - person[3:]) * background(self.backgrounds, side, generator)
        if torch.rand((), generator=generator) < _OCCLUDED:
            other = background(self.backgrounds, side, generator)
            image = image + occluder(side, generator, _NEAREST_OCCLUDER) * (other - image)
        return image


def _draw_crop(centre_px: Tensor, side_px: float, generator: torch.Generator) -> Similarity:
    """Draw a crop around the position of another, as detectors cut it."""
    turns = torch.rand((), generator=generator) < _TURNED
    turn_deg = float(Uniform(generator)(-_TURN_DEG, _TURN_DEG)) * bool(turns)
    scale = math.exp(_SCALE * float(torch.randn((), generator=generator).clamp(-2, 2)))
    shift = torch.tensor(_SHIFT) * torch.randn(2, generator=generator).clamp(-2, 2)
    return Similarity.around(centre_px, side_px / scale, turn_deg, shift)


@cache  # two pseudoinverses
def _mirrored_coefficients() -> tuple[Tensor, Tensor]:
    """Return matrices [Ki, Ki] and [Ke, Ke] from the built-in model's coefficients to the mirrored face's."""
    model = load_face_model()
    maps = []
    for basis in (model.identity, model.expression):
        mirrored = basis.view(-1, GRID, GRID, 3).flip(2) * torch.tensor([-1.0, 1.0, 1.0])
        flat, image = basis.flatten(1).double(), mirrored.flatten(1).double()
        maps.append((image @ flat.T @ torch.linalg.pinv(flat @ flat.T)).float())
    return maps[0], maps[1]
