"""Textures of a prepared dataset: OLAT stacks and relit sources, unwrapped once, that training reads.

    textures-SIDE/SUBJECT/CAMERA.safetensors   OLAT textures of a stack and their visibility, half floats
    textures-SIDE/SUBJECT/relit-KEY.npy        sources [rows, 3, T, T] float16, if they were written

`build_textures` makes what is missing or older than its stack; the folder may be deleted. KEY is a digest of
the subject's pairs and stacks.
"""

import logging
from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path
from facerf_cli.dataset.weights import load_pairs
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit, fit_from_arrays
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import digest
from facerf_cli.files.images import HALF_MAX, read_image
from facerf_cli.files.olat_stack import StackHeader, read_olat_header, read_olats
from facerf_cli.logs import LOGGER_NAME, json_line
from facerf_cli.raster.texture import normal_map, unwrap
from facerf_cli.workers import in_shards, one_thread

# Images unwrapped together: so many, but no more samples in memory than _VALUES_AT_ONCE.
_IMAGES_AT_ONCE = 16
_VALUES_AT_ONCE = 1 << 25
_LEAST_INSIDE = 0.9  # share of a texel's pixels that must lie on the face and inside the photo
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
    missing = [subject for subject in subjects if not _is_finished(dataset, side, subject)]
    if not missing:
        return
    log.info("%s: unwrapping %d subjects (done once)", dataset.folder / f"textures-{side}", len(missing))
    work = partial(_build_shard, dataset, face_model, side)
    if jobs > 1 and len(missing) > 1:
        in_shards(work, missing, jobs)
    else:
        work(missing)


def _build_shard(dataset: Dataset, face_model: str, side: int, subjects: list[str]) -> None:
    model = load_face_model(face_model)
    with one_thread():
        for subject in subjects:
            for camera in dataset.cameras[subject]:
                if not _is_unwrapped(dataset, side, subject, camera):
                    _unwrap_stack(dataset, model, side, subject, camera)
            if _has_sources(dataset, subject) and not sources_path(dataset, side, subject).exists():
                _unwrap_sources(dataset, model, side, subject)


def _folder(dataset: Dataset, side: int, subject: str) -> Path:
    return dataset.folder / f"textures-{side}" / subject


def _pairs(dataset: Dataset, subject: str) -> list[Pair]:
    found = load_pairs(dataset).get(subject)
    return found[0] if found else []


def stamp(dataset: Dataset, subject: str, camera: str) -> str:
    """Text that changes when a stack is written again."""
    facts = dataset.stack_path(subject, camera).stat()
    return f"{LAYOUT_VERSION}-{facts.st_size}-{facts.st_mtime_ns}"


def _is_finished(dataset: Dataset, side: int, subject: str) -> bool:
    stacks = all(_is_unwrapped(dataset, side, subject, camera) for camera in dataset.cameras[subject])
    return stacks and (not _has_sources(dataset, subject) or sources_path(dataset, side, subject).exists())


def _is_unwrapped(dataset: Dataset, side: int, subject: str, camera: str) -> bool:
    return is_made_from(dataset, subject, camera, texture_path(dataset, side, subject, camera))


def is_made_from(dataset: Dataset, subject: str, camera: str, path: Path) -> bool:
    """Tell whether a safetensors file was made from a stack as it is, by its metadata `of`; see `stamp`."""
    if not path.is_file():
        return False
    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("of") == stamp(dataset, subject, camera)
    except (SafetensorError, OSError):
        return False


def _has_sources(dataset: Dataset, subject: str) -> bool:
    """Tell whether all sources of a subject were written; otherwise they are summed as they are drawn."""
    pairs = _pairs(dataset, subject)
    return bool(pairs) and all(image_path(dataset, *pair.key).is_file() for pair in pairs)


def _unwrap_stack(dataset: Dataset, model: MorphableModel, side: int, subject: str, camera: str) -> None:
    """Write a stack's textures: olats [L, 3, T, T], and the fields of `samples.UnwrappedView`."""
    path = dataset.stack_path(subject, camera)
    header = read_olat_header(path)
    fit, vertices = _read_fit(path, header, model)
    planes = torch.from_numpy(np.dstack([header.source, header.seen])).permute(2, 0, 1)
    texture, visible = unwrap(planes, vertices, grid_triangles(), fit.camera, side)
    visible = visible * (texture[3] > _LEAST_INSIDE)
    if visible.max() < 0.5:
        raise InputError(f"{path}: the fit lies outside the visible face; run prepare-dataset again")
    at_once = _at_once(side)
    olats = torch.empty(len(header.directions), 3, side, side, dtype=torch.float16)
    for first in range(0, len(olats), at_once):
        part = slice(first, first + at_once)
        olats[part] = _unwrapped(read_olats(path, part), vertices, fit, side)
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


def _read_fit(path: Path, header: StackHeader, model: MorphableModel) -> tuple[FaceFit, Tensor]:
    """Read a stack's fit, and its mesh in the crop's camera space [V, 3]."""
    try:
        if header.layout_version != LAYOUT_VERSION or header.kind != "image":
            raise ValueError("another UV layout, or not a stack of images")
        fit = fit_from_arrays(header.fit)
        if header.seen.shape != (fit.crop.size_px, fit.crop.size_px):
            raise ValueError("the images have another size")
        return fit, fit.vertices_camera(model)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: invalid fit ({error}); run prepare-dataset again") from None


def _at_once(side: int) -> int:
    """Number of images that are unwrapped together; a texel has 4 x 4 samples."""
    return max(1, min(_IMAGES_AT_ONCE, _VALUES_AT_ONCE // (3 * (4 * side) ** 2)))


def _unwrapped(images: Tensor, vertices: Tensor, fit: FaceFit, side: int) -> Tensor:
    """Textures [N, 3, T, T] float16 of images [N, 3, H, W]."""
    planes = images.float().flatten(0, 1)
    texture, _ = unwrap(planes, vertices, grid_triangles(), fit.camera, side)
    return texture.clamp(-HALF_MAX, HALF_MAX).half().view(-1, 3, side, side)


def _unwrap_sources(dataset: Dataset, model: MorphableModel, side: int, subject: str) -> None:
    """Write a subject's unwrapped sources, in the order of its pairs."""
    pairs, path = _pairs(dataset, subject), sources_path(dataset, side, subject)
    at_once = _at_once(side)
    with atomic_path(path) as temporary:
        shape = (len(pairs), 3, side, side)
        textures = np.lib.format.open_memmap(temporary, "w+", np.float16, shape)
        for camera in dataset.cameras[subject]:
            stack = dataset.stack_path(subject, camera)
            fit, vertices = _read_fit(stack, read_olat_header(stack), model)
            rows = [row for row, pair in enumerate(pairs) if pair.source_camera == camera]
            for first in range(0, len(rows), at_once):
                part = rows[first : first + at_once]
                images = torch.stack([_read_source(dataset, pairs[row], fit) for row in part])
                textures[part] = _unwrapped(images, vertices, fit, side).numpy()
        textures.flush()
        del textures
    for old in path.parent.glob("relit-*.npy"):
        if old != path:
            old.unlink()


def _read_source(dataset: Dataset, pair: Pair, fit: FaceFit) -> Tensor:
    path = image_path(dataset, *pair.key)
    pixels = read_image(path).pixels
    if pixels.shape[:2] != (fit.crop.size_px, fit.crop.size_px):
        raise InputError(f"{path}: another size than its stack; run relight-dataset with --overwrite always")
    return torch.from_numpy(pixels).permute(2, 0, 1)
