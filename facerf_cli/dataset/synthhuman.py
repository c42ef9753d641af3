"""SynthHuman (Microsoft, *DAViD*, ICCV 2025; CDLA-Permissive-2.0): rendered people, their alpha and normals.

    rgb_0000000.png alpha_0000000.png normal_0000000.exr    and depth and cameras, which are not read

Nothing says where its heads are, and its people have no classes: they teach what is person and what is
background. Those whose face is found teach normals, as the Portrait Network sees their photo; their light is
not known.
"""

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.batch.made_from import is_made_from
from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.inputs import Batch
from facerf_cli.network.portrait import PortraitInputs, mirrored_x
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.parse import LANDMARKS
from facerf_cli.portrait.person import SIDE_PX, unit_normals, with_normals
from facerf_cli.relighting.models import Networks
from facerf_cli.relighting.white import even_shade_of
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.bank.parsing import PortraitCrops
from facerf_cli.synth.bank.transport import person_in
from facerf_cli.synth.random_fields import Uniform

LICENCE = "SynthHuman: CDLA-Permissive-2.0"
_SMALLEST = 0.5  # crop, in shorter sides of the image
_AROUND = 48  # lights all around whose shadows are summarised, as of photos


def with_licence(provenance: dict[str, Any]) -> dict[str, Any]:
    """The provenance of a training that these images join."""
    return provenance | {"licence": f"{provenance['licence']}; {LICENCE}"}


class SynthHuman:
    """The images of a folder, and of folders in it, read when they are drawn."""

    def __init__(self, folder: Path) -> None:
        self.paths = sorted(folder.rglob("rgb_*.png"))
        if not self.paths:
            raise InputError(f"{folder}: has no rgb_*.png; give a folder of SynthHuman, unpacked")

    def draw(self, side: int, generator: torch.Generator) -> PortraitCrops:
        """Draw one crop [1, ...] of a random image, mirrored or not."""
        path = self.paths[int(torch.randint(len(self.paths), (), generator=generator))]
        image, alpha = linear_to_srgb(read_image(path).pixels), _layer(path, "alpha", ".png")[..., :1]
        if alpha.shape[:2] != image.shape[:2]:
            raise InputError(f"{path}: its alpha has another size; unpack the set again")
        layers = torch.cat([torch.from_numpy(part).float() for part in (image, alpha)], 2).permute(2, 0, 1)
        height, width = layers.shape[1:]
        side_px = round(min(height, width) * float(Uniform(generator)(_SMALLEST, 1)))
        room = height - side_px + 1, width - side_px + 1
        top, left = (int(torch.randint(most, (), generator=generator)) for most in room)
        crop = layers[:, top : top + side_px, left : left + side_px]
        crop = F.interpolate(crop[None], (side, side), mode="bilinear", antialias=True)[0].clamp(0, 1)
        if torch.rand((), generator=generator) < 0.5:
            crop = crop.flip(-1)
        return PortraitCrops(
            crops=crop[None, :3],
            alpha=crop[None, 3],
            label=torch.full((1, side, side), -1),
            weight=torch.ones(1, side, side),
            landmarks=torch.full((1, LANDMARKS, 2), 0.5),
            known=torch.zeros(1, LANDMARKS, dtype=torch.bool),
            present=torch.ones(1),
        )


@dataclass(frozen=True)
class SeenNormals(Batch):
    """B people as the Portrait Network sees their photo, true normals [B, 3, S, S], and alpha [B, 1, S, S].

    Alpha is 0 where no normal is known.
    """

    inputs: PortraitInputs
    normals: Tensor
    alpha: Tensor


class SynthHumanNormals:
    """People of SynthHuman whose face is found, a file each, read when they are drawn."""

    def __init__(self, images: SynthHuman, cache: Path, networks: Networks, jobs: int) -> None:
        """Look at images that are not in the folder `cache` yet; InputError where none shows a face."""
        files = {path: cache / f"{path.stem}.safetensors" for path in images.paths}
        of = networks.sha256("parsing")
        missing = [one for one in files.items() if not is_made_from(one[1], of)]
        if missing:
            in_shards(partial(_look_at_all, networks, of), missing, jobs)
        self.files = [file for file in files.values() if _shows_a_face(file)]
        if not self.files:
            raise InputError(f"{images.paths[0].parent}: no image shows a face that its normals agree with")

    def draw(self, generator: torch.Generator) -> SeenNormals:
        """Draw a random person, B = 1, mirrored or not."""
        file = self.files[int(torch.randint(len(self.files), (), generator=generator))]
        seen = {name: values.float() for name, values in load_file(file).items()}
        normals, alpha = seen.pop("true_normals"), seen.pop("alpha")
        inputs = PortraitInputs(**seen)
        inputs = replace(inputs, image=inputs.image * even_shade_of(inputs.image[0], inputs.classes[0]))
        if torch.rand((), generator=generator) < 0.5:
            inputs, normals, alpha = inputs.mirrored(), mirrored_x(normals.flip(-1)), alpha.flip(-1)
        return SeenNormals(inputs, normals, alpha)


def _look_at_all(networks: Networks, of: str, files: list[tuple[Path, Path]]) -> None:
    """Write what is seen of images; an empty file where no face is found that the normals agree with."""
    with one_thread():
        for path, file in files:
            tensors: dict[str, Tensor] = {}
            normals, alpha = _layer(path, "normal", ".exr"), _layer(path, "alpha", ".png")[..., :1]
            with suppress(InputError):
                tensors = _look(networks.people, read_image(path).pixels, normals, alpha)
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file) as temporary:
                save_file(tensors, temporary, {"of": of})


@torch.no_grad()
def _look(
    people: PeopleNetworks, photo: np.ndarray, normals: np.ndarray, alpha: np.ndarray
) -> dict[str, Tensor]:
    """Look at the person of an image, float16: the network's inputs, true normals and alpha."""
    rig = rig_directions(_AROUND)
    person = person_in(people, photo)
    person = person.within(replace(person.square, size_px=SIDE_PX), photo)
    normals = unit_normals(normals, (photo.shape[0], photo.shape[1]))
    try:
        person = with_normals(person, normals)
    except InputError:  # as OpenCV writes x, y, z: to blue, green, red
        person = with_normals(person, normals[..., ::-1])
    assert person.normals is not None
    layers = torch.from_numpy(person.square.apply(np.dstack([person.normals, alpha])))
    layers = layers.permute(2, 0, 1)[None] * torch.from_numpy(person.square.valid(*photo.shape[:2]))
    true = layers[:, :3]
    inputs = person.inputs(rig)
    tensors = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
    known = true.norm(dim=1, keepdim=True) > 0.5
    tensors |= {"true_normals": F.normalize(true, dim=1), "alpha": layers[:, 3:].clamp(0, 1) * known}
    return {name: values.half().contiguous() for name, values in tensors.items()}


def _shows_a_face(file: Path) -> bool:
    with safe_open(file, framework="pt") as opened:
        return bool(opened.keys())


def _layer(path: Path, name: str, suffix: str) -> np.ndarray:
    """Another layer [H, W, 3] of the image `rgb_NUMBER.png`, its values as they are."""
    other = path.with_name(path.name.replace("rgb", name, 1)).with_suffix(suffix)
    return read_image(other, "linear", with_alpha=False).pixels
