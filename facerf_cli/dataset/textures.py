"""A prepared dataset unwrapped into the chart, once: what training reads in the place of pictures.

    textures-SIDE/SUBJECT/CAMERA.safetensors   a stack's lights, and how its texels are seen, in half floats
    textures-SIDE/SUBJECT/relit-KEY.npy        the sources that were written [rows, 3, T, T] float16

Made by `build_textures` where missing or older than the stack; all of it can be removed. KEY is the digest of
the subject's pairs and stacks.

Training samples from a prepared dataset: photographed lights in the place of the bank's shading.

Textures come from `textures.py`. A source is what `relight-dataset` wrote, unwrapped; with --lazy it is
the lights' weights times the stack's textures, which is the same, for unwrapping is linear. Without any pairs
its light is drawn as the bank's is.
"""

import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.dataset.dataset import Dataset, read_dataset
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
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.transport import BakeSettings
from facerf_cli.logs import LOGGER_NAME, json_line
from facerf_cli.raster.texture import inpaint, normal_map, unwrap
from facerf_cli.synth.heads_bank import GeometrySettings, bake_head, one_thread
from facerf_cli.synth.texture_samples import Sample, draw_light, draw_target_lights, photograph
from facerf_cli.workers import in_shards

_AT_ONCE = 16  # pictures that are unwrapped together, and fewer where
_VALUES_AT_ONCE = 1 << 25  # so many samples would be held
_INSIDE = 0.9  # of the pixels that a texel shows, the share that must be face and inside the photo
log = logging.getLogger(LOGGER_NAME)


def texture_path(dataset: Dataset, side: int, subject: str, camera: str) -> Path:
    """Where a stack's textures are kept."""
    return _folder(dataset, side, subject) / f"{camera}.safetensors"


def sources_path(dataset: Dataset, side: int, subject: str) -> Path:
    """Where a subject's unwrapped sources are, or would be."""
    rows = "".join(json_line(asdict(pair)) for pair in _pairs(dataset, subject))
    stamps = "".join(_stamp(dataset, subject, camera) for camera in dataset.cameras[subject])
    return _folder(dataset, side, subject) / f"relit-{digest((rows + stamps).encode())}.npy"


def _folder(dataset: Dataset, side: int, subject: str) -> Path:
    return dataset.folder / f"textures-{side}" / subject


def _pairs(dataset: Dataset, subject: str) -> list[Pair]:
    found = load_pairs(dataset).get(subject)
    return found[0] if found else []


def _stamp(dataset: Dataset, subject: str, camera: str) -> str:
    """What tells a stack from one that was written later."""
    facts = dataset.stack_path(subject, camera).stat()
    return f"{LAYOUT_VERSION}-{facts.st_size}-{facts.st_mtime_ns}"


def build_textures(dataset: Dataset, face_model: str, side: int, subjects: Iterable[str], jobs: int) -> None:
    """Unwrap stacks and written sources of subjects, fitted with `face_model`; finished ones are kept."""
    missing = [subject for subject in subjects if not _is_finished(dataset, side, subject)]
    if not missing:
        return
    log.info("%s: unwrapping %d subjects, once", dataset.folder / f"textures-{side}", len(missing))
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


def _is_finished(dataset: Dataset, side: int, subject: str) -> bool:
    stacks = all(_is_unwrapped(dataset, side, subject, camera) for camera in dataset.cameras[subject])
    return stacks and (not _has_sources(dataset, subject) or sources_path(dataset, side, subject).exists())


def _is_unwrapped(dataset: Dataset, side: int, subject: str, camera: str) -> bool:
    path = texture_path(dataset, side, subject, camera)
    if not path.is_file():
        return False
    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("of") == _stamp(dataset, subject, camera)
    except (SafetensorError, OSError):
        return False


def _has_sources(dataset: Dataset, subject: str) -> bool:
    """Whether all of a subject's sources were written; else they are weighed as they are drawn."""
    pairs = _pairs(dataset, subject)
    return bool(pairs) and all(image_path(dataset, *pair.key).is_file() for pair in pairs)


def _unwrap_stack(dataset: Dataset, model: MorphableModel, side: int, subject: str, camera: str) -> None:
    """Write a stack's textures: olats [L, 3, T, T], and the fields of `captured.View`."""
    path = dataset.stack_path(subject, camera)
    header = read_olat_header(path)
    fit, vertices = _fit_of(path, header, model)
    planes = torch.from_numpy(np.dstack([header.source, header.seen])).permute(2, 0, 1)
    texture, visible = unwrap(planes, vertices, grid_triangles(), fit.camera, side)
    visible = visible * (texture[3] > _INSIDE)
    if visible.max() < 0.5:
        raise InputError(f"{path}: nothing of the face is seen by its fit; run prepare-dataset again")
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
        save_file(contiguous, temporary, {"of": _stamp(dataset, subject, camera)})


def _fit_of(path: Path, header: StackHeader, model: MorphableModel) -> tuple[FaceFit, Tensor]:
    """A stack's fit, and the fitted mesh in its crop's camera space [V, 3]."""
    try:
        if header.layout_version != LAYOUT_VERSION or header.kind != "image":
            raise ValueError("it has another UV layout, or is no stack of pictures")
        fit = fit_from_arrays(header.fit)
        if header.seen.shape != (fit.crop.size_px, fit.crop.size_px):
            raise ValueError("the pictures have another size")
        return fit, fit.vertices_camera(model)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: the fit in it is of no use: {error}") from None


def _at_once(side: int) -> int:
    """Pictures that are unwrapped together; a texel is 4 x 4 samples."""
    return max(1, min(_AT_ONCE, _VALUES_AT_ONCE // (3 * (4 * side) ** 2)))


def _unwrapped(images: Tensor, vertices: Tensor, fit: FaceFit, side: int) -> Tensor:
    """Textures [N, 3, T, T] float16 of pictures [N, 3, H, W]."""
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
            fit, vertices = _fit_of(stack, read_olat_header(stack), model)
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
        raise InputError(f"{path}: not of its stack's size; run relight-dataset with --overwrite")
    return torch.from_numpy(pixels).permute(2, 0, 1)


_SAME_POSE_SHARE = 0.5
_MEAN_SIDE = 64  # of the mean face's shadows, as the network holds them


@dataclass(frozen=True, eq=False)
class Captured:
    """A prepared dataset and its textures, as training takes it; heads are places in `dataset.subjects`."""

    dataset: Dataset
    model: MorphableModel
    side: int
    provenance: dict[str, Any]
    sources: dict[str, Path]  # of each subject whose sources were written and unwrapped
    rig_lights: int = RIG_LIGHTS  # of the mean face's shadows

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """The heads of the split train, and at most `held_out` of the split validation."""
        places = {subject: place for place, subject in enumerate(self.dataset.subjects)}
        train, validation = (
            [places[subject] for subject in self.dataset.splits[split] if self.dataset.cameras[subject]]
            for split in ("train", "validation")
        )
        for split, found in (("train", train), ("validation", validation)):
            if not found:
                raise InputError(
                    f"{self.dataset.folder}: no subject in the split {split}; "
                    "run prepare-dataset with another --split"
                )
        return torch.tensor(train), torch.tensor(validation[:held_out])

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of the face model's mean."""
        settings = GeometrySettings(_MEAN_SIDE, self.rig_lights, bake=BakeSettings(bounce_samples=0))
        mean = bake_head(self.model, 0, 0, settings)
        normals = normal_map(mean["vertices"], grid_triangles(), _MEAN_SIDE)
        return normals, mean["visibility"].float() / 255, mean["directions"]

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """One sample of every subject in `heads` [B], with `lights` target lights.

        The albedo of real skin is not known: the exposure is taken from the face under a constant map of
        radiance 1 in its place, which is the albedo less what other parts of the face hide of the map.
        """
        subjects = [self.dataset.subjects[int(head)] for head in heads]
        lights = min(lights, *(len(self.dataset.lights_of(subject)) for subject in subjects))
        faces = [self._draw_face(subject, lights, generator) for subject in subjects]
        visible = torch.stack([face.source.visible for face in faces])
        source, target = photograph(
            torch.stack([face.texture for face in faces]),
            torch.stack([face.target for face in faces]),
            torch.stack([face.source.lit for face in faces]),
            visible,
            generator,
        )
        return Sample(
            source=torch.stack([inpaint(s, v[0]) for s, v in zip(source, visible, strict=True)]),
            visible=visible,
            normals_source=torch.stack([face.source.normals for face in faces]),
            normals_target=torch.stack([face.normals_target for face in faces]),
            lights=torch.stack([face.lights for face in faces]),
            target=target,
            weight=torch.stack([face.weight for face in faces]),
        )

    def _draw_face(self, subject: str, lights: int, generator: torch.Generator) -> "_Face":
        pairs, weights = load_pairs(self.dataset).get(subject, ([], None))
        if weights is None:
            return self._draw_freely(subject, lights, generator)
        row = int(torch.randint(len(pairs), (), generator=generator))
        pair = pairs[row]
        with self._opened(subject, pair.source_camera) as file:
            source, texture = View.of(file), self._written(subject, row)
            if texture is None:
                texture = _lit(file, torch.from_numpy(np.array(weights[row])))
        return self._face(subject, pair.target_camera, source, texture, pair.target_light, lights, generator)

    def _draw_freely(self, subject: str, lights: int, generator: torch.Generator) -> "_Face":
        """A sample of a subject without pairs: camera, light and target drawn here."""
        cameras = self.dataset.cameras[subject]
        camera, other = (cameras[int(i)] for i in torch.randint(len(cameras), (2,), generator=generator))
        same = torch.rand((), generator=generator) < _SAME_POSE_SHARE
        with self._opened(subject, camera) as file:
            source = View.of(file)
            texture = _lit(file, draw_light(source.directions, generator))
        return self._face(subject, camera if same else other, source, texture, None, lights, generator)

    def _face(
        self,
        subject: str,
        target_camera: str,
        source: "View",
        texture: Tensor,
        first_light: int | None,
        lights: int,
        generator: torch.Generator,
    ) -> "_Face":
        with self._opened(subject, target_camera) as file:
            target = View.of(file)
            lights = min(lights, len(target.directions))
            chosen = draw_target_lights(target.directions, lights, generator)
            if first_light is not None:  # the pair's own, and others beside it
                rest = chosen[chosen != first_light]
                chosen = torch.cat([torch.tensor([first_light]), rest])[:lights]
            olats = file.get_slice("olats")
            images = torch.stack([olats[int(light)] for light in chosen]).float()
        turn = target.rotation @ source.rotation.T
        return _Face(
            source=source,
            texture=texture,
            target=images,
            lights=target.directions[chosen],
            normals_target=torch.einsum("dc,cij->dij", turn, source.normals),  # as `pipeline.predict_olat`
            weight=target.visible * (0.3 + 0.7 * source.visible),
        )

    def _opened(self, subject: str, camera: str) -> Any:
        return safe_open(texture_path(self.dataset, self.side, subject, camera), framework="pt")

    def _written(self, subject: str, row: int) -> Tensor | None:
        """The unwrapped source [3, T, T] of a subject's pair, where sources were written."""
        if subject not in self.sources:
            return None
        return torch.from_numpy(np.load(self.sources[subject], mmap_mode="r")[row].astype(np.float32))


@dataclass(frozen=True)
class View:
    """A subject in one camera's crop, unwrapped: fields [.., T, T] of the fitted chart, camera space."""

    rotation: Tensor  # [3, 3] head_to_camera
    directions: Tensor  # [L, 3]
    normals: Tensor  # [3, T, T]
    visible: Tensor  # [1, T, T]
    lit: Tensor  # [3, T, T] under a constant map of radiance 1

    @staticmethod
    def of(file: Any) -> "View":
        """What a texture file holds beside the lights."""
        return View(*(file.get_tensor(name).float() for name in View.__dataclass_fields__))


@dataclass(frozen=True)
class _Face:
    source: View
    texture: Tensor  # [3, T, T] of the source
    target: Tensor  # [L, 3, T, T]
    lights: Tensor  # [L, 3] in the target's camera space
    normals_target: Tensor
    weight: Tensor  # [1, T, T]


def _lit(file: Any, weights: Tensor) -> Tensor:
    """The texture [3, T, T] of a file's lights under weights [L, 3]."""
    olats = file.get_tensor("olats")  # [L, 3, T, T]
    channels = [weights[:, c] @ olats[:, c].flatten(1).float() for c in range(3)]
    return torch.stack(channels).view(olats.shape[1:])


def open_captured(
    folder: Path, face_model: str, side: int, jobs: int, rig_lights: int = RIG_LIGHTS
) -> Captured:
    """The dataset in a folder, its textures made where they are missing; the split test is left alone."""
    dataset, model = read_dataset(folder), load_face_model(face_model)
    if model.name != dataset.face_model:
        raise InputError(
            f"{folder}: fitted with the face model {dataset.face_model}, not {model.name}; give --fit-with"
        )
    subjects = [*dataset.splits["train"], *dataset.splits["validation"]]
    captured = Captured(dataset, model, side, provenance_of(dataset, model), {}, rig_lights)
    captured.heads(1)  # a split without subjects is named before anything is unwrapped
    build_textures(dataset, face_model, side, subjects, jobs)
    written = {subject: sources_path(dataset, side, subject) for subject in subjects}
    return replace(captured, sources={name: path for name, path in written.items() if path.exists()})


def provenance_of(dataset: Dataset, model: MorphableModel) -> dict[str, Any]:
    """What a checkpoint says of a dataset that it was trained on."""
    name = dataset.folder.resolve().name
    return {
        "trained_on": f"{name}, {len(dataset.splits['train'])} subjects",
        "dataset": dataset.provenance,
        "fitted_with": model.credit,
        "licence": _licence(dataset.provenance, name),
    }


def _licence(provenance: dict[str, Any], name: str) -> str:
    """The words that the dataset or its capture has for its licence, if any."""
    found = provenance.get("capture")
    capture = found if isinstance(found, dict) else {}
    if words := provenance.get("licence") or capture.get("licence"):
        return str(words)
    if capture.get("synthetic") is True and "face_model_licence" in capture:  # by `facerf synth-stage`
        return f"MIT; the heads' shapes: {capture['face_model_licence']}"
    return f"that of the dataset {name}"
