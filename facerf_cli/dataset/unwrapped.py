"""Textures of a prepared dataset, unwrapped once.

    textures-SIDE/SUBJECT/CAMERA.safetensors   OLAT textures of a stack and their visibility, half floats
    textures-SIDE/SUBJECT/relit-KEY.npy        sources [rows, 3, T, T] float16, if they were written

`build_textures` makes what is missing or older than its stack; the folder may be deleted. KEY is a digest of
the subject's pairs and stacks.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.batch.recipe import is_made_from, text_of_state
from facerf_cli.dataset.dataset import PREPARE_AGAIN, Dataset, read_stack
from facerf_cli.dataset.pairs import DRAW_AGAIN, Pair, image_path, load_pairs
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import digest
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.files.read import read_image
from facerf_cli.files.write import HALF_MAX
from facerf_cli.raster.texture import normal_map, unwrap
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.run.workers import in_shards, one_thread

# Images unwrapped together: so many, but no more samples in memory than _VALUES_AT_ONCE.
_IMAGES_AT_ONCE = 16
_VALUES_AT_ONCE = 1 << 25
LEAST_INSIDE = 0.9  # share of a texel's pixels that must lie on the face and inside the photo
log = logging.getLogger(LOGGER_NAME)


def texture_path(dataset: Dataset, side: int, subject: str, camera: str) -> Path:
    """Path of a stack's textures."""
    return _folder(dataset, side, subject) / f"{camera}.safetensors"


def sources_path(dataset: Dataset, side: int, subject: str) -> Path:
    """Path of a subject's unwrapped sources."""
    rows = "".join(json_line(asdict(pair)) for pair in _pairs(dataset, subject))
    stamps = "".join(stamp(dataset, subject, camera) for camera in dataset.cameras[subject])
    return _folder(dataset, side, subject) / f"relit-{digest((rows + stamps).encode())}.npy"


def build_textures(dataset: Dataset, face_model: str, side: int, subjects: Iterable[str], jobs: int) -> None:
    """Unwrap stacks and written sources of subjects fitted with `face_model`; skip finished ones."""
    missing = [part for subject in subjects for part in missing_parts(dataset, side, subject)]
    if not missing:
        return
    folder, count = dataset.folder / f"textures-{side}", len({subject for subject, _ in missing})
    log.info("%s: unwrapping %d subjects (done once)", folder, count)
    work = partial(_build_shard, dataset, face_model, side)
    if jobs > 1 and len(missing) > 1:
        in_shards(work, missing, jobs)
    else:
        work(missing)


def missing_parts(dataset: Dataset, side: int, subject: str) -> Iterator[tuple[str, str]]:
    """Subject and camera of each stack to unwrap; "" in a camera's place means the subject's sources."""
    for camera in dataset.cameras[subject]:
        if not is_made_from(texture_path(dataset, side, subject, camera), stamp(dataset, subject, camera)):
            yield subject, camera
    pairs = _pairs(dataset, subject)
    written = bool(pairs) and all(image_path(dataset, *pair.key).is_file() for pair in pairs)
    if written and not sources_path(dataset, side, subject).exists():  # others are summed as they are drawn
        yield subject, ""


def _build_shard(dataset: Dataset, face_model: str, side: int, parts: list[tuple[str, str]]) -> None:
    model = load_face_model(face_model)
    with one_thread():
        for subject, camera in parts:
            if camera:
                _unwrap_stack(dataset, model, side, subject, camera)
            else:
                _unwrap_sources(dataset, model, side, subject)


def _folder(dataset: Dataset, side: int, subject: str) -> Path:
    return dataset.folder / f"textures-{side}" / subject


def _pairs(dataset: Dataset, subject: str) -> list[Pair]:
    found = load_pairs(dataset).get(subject)
    return found[0] if found else []


def stamp(dataset: Dataset, subject: str, camera: str) -> str:
    """Text that changes when a stack is written again, or the UV layout changes."""
    return f"{LAYOUT_VERSION}-{text_of_state(dataset.stack_path(subject, camera))}"


def _unwrap_stack(dataset: Dataset, model: MorphableModel, side: int, subject: str, camera: str) -> None:
    """Write a stack's textures: olats [L, 3, T, T], and the fields of `UnwrappedView`."""
    path = dataset.stack_path(subject, camera)
    header, fit = read_stack(path)
    vertices = fit.vertices_camera(model)
    planes = torch.from_numpy(np.dstack([header.source, header.seen])).permute(2, 0, 1)
    texture, visible = unwrap(planes, vertices, grid_triangles(), fit.camera, side)
    visible = visible * (texture[3] > LEAST_INSIDE)
    if visible.max() < 0.5:
        raise InputError(f"{path}: the fit lies outside the visible face; {PREPARE_AGAIN}")
    at_once = images_at_once(side)
    olats = torch.empty(len(header.directions), 3, side, side, dtype=torch.float16)
    for first in range(0, len(olats), at_once):
        part = slice(first, first + at_once)
        olats[part] = unwrapped_images(read_olats(path, part), vertices, fit, side)
    tensors = {
        "olats": olats,
        "lit": texture[:3].half(),
        "visible": visible[None].half(),
        "normals": normal_map(vertices, grid_triangles(), side).half(),
        "rotation": torch.from_numpy(header.rotation).float(),
        "directions": torch.from_numpy(header.directions).float(),
    }
    with atomic_path(texture_path(dataset, side, subject, camera)) as temporary:
        contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
        save_file(contiguous, temporary, {"of": stamp(dataset, subject, camera)})


def images_at_once(side: int) -> int:
    """Number of images that are unwrapped together; a texel has 4 x 4 samples."""
    return max(1, min(_IMAGES_AT_ONCE, _VALUES_AT_ONCE // (3 * (4 * side) ** 2)))


def unwrapped_images(images: Tensor, vertices: Tensor, fit: FaceFit, side: int) -> Tensor:
    """Textures [N, 3, T, T] float16 of images [N, 3, H, W]."""
    planes = images.float().flatten(0, 1)
    texture, _ = unwrap(planes, vertices, grid_triangles(), fit.camera, side)
    return texture.clamp(-HALF_MAX, HALF_MAX).half().view(-1, 3, side, side)


def _unwrap_sources(dataset: Dataset, model: MorphableModel, side: int, subject: str) -> None:
    """Write a subject's unwrapped sources, in the order of its pairs."""
    pairs, path = _pairs(dataset, subject), sources_path(dataset, side, subject)
    at_once = images_at_once(side)
    with atomic_path(path) as temporary:
        shape = (len(pairs), 3, side, side)
        textures = np.lib.format.open_memmap(temporary, "w+", np.float16, shape)
        for camera in dataset.cameras[subject]:
            _, fit = read_stack(dataset.stack_path(subject, camera))
            vertices = fit.vertices_camera(model)
            rows = [row for row, pair in enumerate(pairs) if pair.source_camera == camera]
            for first in range(0, len(rows), at_once):
                part = rows[first : first + at_once]
                images = torch.stack([_read_source(dataset, pairs[row], fit) for row in part])
                textures[part] = unwrapped_images(images, vertices, fit, side).numpy()
        textures.flush()
        del textures
    for old in path.parent.glob("relit-*.npy"):
        if old != path:
            old.unlink()


def _read_source(dataset: Dataset, pair: Pair, fit: FaceFit) -> Tensor:
    path = image_path(dataset, *pair.key)
    pixels = read_image(path).pixels
    if pixels.shape[:2] != (fit.crop.size_px, fit.crop.size_px):
        raise InputError(f"{path}: another size than its stack; {DRAW_AGAIN}")
    return torch.from_numpy(pixels).permute(2, 0, 1)


@dataclass(frozen=True)
class UnwrappedView:
    """A subject in one camera's crop, unwrapped: textures of the fitted mesh, camera space.

    The fields' names are those of the tensors in a texture file.
    """

    rotation: Tensor  # [3, 3] head_to_camera
    directions: Tensor  # [L, 3]
    normals: Tensor  # [3, T, T]
    visible: Tensor  # [1, T, T]
    lit: Tensor  # [3, T, T] under a constant map of radiance 1

    @staticmethod
    def read(file: Any) -> "UnwrappedView":
        """Read all tensors of a texture file but its OLATs."""
        names = UnwrappedView.__dataclass_fields__
        return UnwrappedView(*(file.get_tensor(name).float() for name in names))
