"""Textures of a prepared dataset, unwrapped once, and the training samples of the texture stages from them.

    textures-SIDE/SUBJECT/CAMERA.safetensors   OLAT textures of a stack and their visibility, half floats
    textures-SIDE/SUBJECT/relit-KEY.npy        sources [rows, 3, T, T] float16, if they were written

`build_textures` makes what is missing or older than its stack; the folder may be deleted. KEY is a digest of
the subject's pairs and stacks.

Samples take the place of the synthetic ones of `synth/bank/texture_samples.py`, with photographed instead of
rendered lights. A source is an unwrapped image of `relight-dataset`; for lazy pairs it is the weighted sum of
the stack's textures, which is the same, for unwrapping is linear. Without pairs a random light is drawn, as
for synthetic heads.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.batch.made_from import is_made_from, text_of_state
from facerf_cli.dataset.dataset import PREPARE_AGAIN, Dataset, provenance_of, read_dataset, read_stack
from facerf_cli.dataset.pairs import DRAW_AGAIN, Pair, image_path, load_pairs
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import digest
from facerf_cli.files.images import HALF_MAX, read_image
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.texture import inpaint, normal_map, unwrap
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.bank.heads import HeadBakeSettings, bake_head
from facerf_cli.synth.bank.texture_samples import Sample, draw_light, draw_target_lights, simulate_camera

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
    missing = [part for subject in subjects for part in _missing(dataset, side, subject)]
    if not missing:
        return
    folder, count = dataset.folder / f"textures-{side}", len({subject for subject, _ in missing})
    log.info("%s: unwrapping %d subjects (done once)", folder, count)
    work = partial(_build_shard, dataset, face_model, side)
    if jobs > 1 and len(missing) > 1:
        in_shards(work, missing, jobs)
    else:
        work(missing)


def _missing(dataset: Dataset, side: int, subject: str) -> Iterator[tuple[str, str]]:
    """Subject and camera of each stack to unwrap; "" in a camera's place means the subject's sources."""
    for camera in dataset.cameras[subject]:
        if not is_made_from(texture_path(dataset, side, subject, camera), stamp(dataset, subject, camera)):
            yield subject, camera
    if _has_sources(dataset, subject) and not sources_path(dataset, side, subject).exists():
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


def _has_sources(dataset: Dataset, subject: str) -> bool:
    """Tell whether all sources of a subject were written; otherwise they are summed as they are drawn."""
    pairs = _pairs(dataset, subject)
    return bool(pairs) and all(image_path(dataset, *pair.key).is_file() for pair in pairs)


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
            _, fit = read_stack(dataset.stack_path(subject, camera))
            vertices = fit.vertices_camera(model)
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
        raise InputError(f"{path}: another size than its stack; {DRAW_AGAIN}")
    return torch.from_numpy(pixels).permute(2, 0, 1)


def heads_of(dataset: Dataset, held_out: int) -> tuple[Tensor, Tensor]:
    """Places in `subjects` of the split train, and of at most `held_out` of the split validation."""
    places = {subject: place for place, subject in enumerate(dataset.subjects)}
    for split in ("train", "validation"):
        if not dataset.splits[split]:
            advice = "run prepare-dataset with another --split"
            raise InputError(f"{dataset.folder}: no subject in the split {split}; {advice}")
    train, validation = (
        torch.tensor([places[subject] for subject in dataset.splits[split]])
        for split in ("train", "validation")
    )
    return train, validation[:held_out]


_SAME_POSE_SHARE = 0.5  # of samples without pairs
_MEAN_SIDE = 64  # texels along a side of the mean face's shadows, as in the network


@dataclass(frozen=True, eq=False)
class DatasetTextures:
    """A prepared dataset and its textures, a `SampleSource`; its heads are indices of `dataset.subjects`."""

    dataset: Dataset
    model: MorphableModel
    side: int
    provenance: dict[str, Any]
    sources: dict[str, Path]  # unwrapped sources, of subjects that have them
    rig_lights: int = RIG_LIGHTS  # of the mean face's shadows

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Heads of the split train, and at most `held_out` of the split validation."""
        return heads_of(self.dataset, held_out)

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals [3, T, T], visibility [L, T, T] and its directions [L, 3] of the face model's mean."""
        settings = HeadBakeSettings(_MEAN_SIDE, self.rig_lights, bake=BakeSettings(bounce_samples=0))
        mean = bake_head(self.model, 0, 0, settings)
        normals = normal_map(mean["vertices"], grid_triangles(), _MEAN_SIDE)
        return normals, mean["visibility"].float() / 255, mean["directions"]

    def draw(self, heads: Tensor, lights: int, generator: torch.Generator) -> Sample:
        """Draw one sample of every subject in `heads` [B], with `lights` target lights.

        The albedo of real skin is unknown. The exposure is that of the face under a constant map of radiance
        1 instead, which equals the albedo but for light that other parts of the face occlude.
        """
        subjects = [self.dataset.subjects[int(head)] for head in heads]
        lights = min(lights, *(len(self.dataset.lights_of(subject)) for subject in subjects))
        faces = [self._draw_face(subject, lights, generator) for subject in subjects]
        names = _FaceTextures.__dataclass_fields__
        of = {name: torch.stack([getattr(face, name) for face in faces]) for name in names}
        lit = of.pop("lit")
        source, of["target"] = simulate_camera(of.pop("texture"), of["target"], lit, of["visible"], generator)
        filled = [inpaint(*pair) for pair in zip(source, of["visible"][:, 0], strict=True)]
        return Sample(source=torch.stack(filled), **of)

    def _draw_face(self, subject: str, lights: int, generator: torch.Generator) -> "_FaceTextures":
        pairs, weights = load_pairs(self.dataset).get(subject, ([], None))
        if weights is None:
            return self._draw_without_pairs(subject, lights, generator)
        row = int(torch.randint(len(pairs), (), generator=generator))
        pair = pairs[row]
        with self._open(subject, pair.source_camera) as file:
            source, texture = UnwrappedView.read(file), self._written_source(subject, row)
            if texture is None:
                texture = _weighted_sum(file, torch.from_numpy(np.array(weights[row])))
        return self._face(subject, pair.target_camera, source, texture, pair.target_light, lights, generator)

    def _draw_without_pairs(self, subject: str, lights: int, generator: torch.Generator) -> "_FaceTextures":
        """Draw cameras, light and targets of a subject without pairs."""
        cameras = self.dataset.cameras[subject]
        camera, other = (cameras[int(i)] for i in torch.randint(len(cameras), (2,), generator=generator))
        same = torch.rand((), generator=generator) < _SAME_POSE_SHARE
        with self._open(subject, camera) as file:
            source = UnwrappedView.read(file)
            texture = _weighted_sum(file, draw_light(source.directions, generator))
        return self._face(subject, camera if same else other, source, texture, None, lights, generator)

    def _face(
        self,
        subject: str,
        target_camera: str,
        source: "UnwrappedView",
        texture: Tensor,
        first_light: int | None,
        lights: int,
        generator: torch.Generator,
    ) -> "_FaceTextures":
        """Add random target lights, `first_light` first where it is given, to a source."""
        with self._open(subject, target_camera) as file:
            target = UnwrappedView.read(file)
            lights = min(lights, len(target.directions))
            chosen = draw_target_lights(target.directions, lights, generator)
            if first_light is not None:
                rest = chosen[chosen != first_light]
                chosen = torch.cat([torch.tensor([first_light]), rest])[:lights]
            olats = file.get_slice("olats")
            images = torch.stack([olats[int(light)] for light in chosen]).float()
        source_to_target = target.rotation @ source.rotation.T
        return _FaceTextures(
            texture=texture,
            lit=source.lit,
            visible=source.visible,
            normals_source=source.normals,
            target=images,
            lights=target.directions[chosen],
            # The source's normals turned, as in `pipeline.predict_olat`.
            normals_target=torch.einsum("dc,cij->dij", source_to_target, source.normals),
            weight=target.visible * (0.3 + 0.7 * source.visible),
        )

    def _open(self, subject: str, camera: str) -> Any:
        return safe_open(texture_path(self.dataset, self.side, subject, camera), framework="pt")

    def _written_source(self, subject: str, row: int) -> Tensor | None:
        """The unwrapped source [3, T, T] of a subject's pair; None for lazy pairs."""
        if subject not in self.sources:
            return None
        return torch.from_numpy(np.load(self.sources[subject], mmap_mode="r")[row].astype(np.float32))


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


@dataclass(frozen=True)
class _FaceTextures:
    """One face of a sample, before the simulated camera."""

    texture: Tensor  # [3, T, T] of the source
    lit: Tensor  # [3, T, T] of the source under a constant map of radiance 1
    visible: Tensor  # [1, T, T] of the source
    normals_source: Tensor  # [3, T, T]
    target: Tensor  # [L, 3, T, T]
    lights: Tensor  # [L, 3] in the target's camera space
    normals_target: Tensor  # [3, T, T]
    weight: Tensor  # [1, T, T]


def _weighted_sum(file: Any, weights: Tensor) -> Tensor:
    """Sum a file's OLAT textures with weights [L, 3]: [3, T, T]."""
    olats = file.get_tensor("olats")  # [L, 3, T, T]
    channels = [weights[:, c] @ olats[:, c].flatten(1).float() for c in range(3)]
    return torch.stack(channels).view(olats.shape[1:])


def model_of(dataset: Dataset, face_model: str) -> MorphableModel:
    """Load the face model that a dataset was fitted with; raise InputError where another is given."""
    model = load_face_model(face_model)
    if model.name != dataset.face_model:
        fitted = f"fitted with the face model {dataset.face_model}, not {model.name}"
        raise InputError(f"{dataset.folder}: {fitted}; give --fit-with")
    return model


def open_dataset_textures(
    folder: Path, face_model: str, side: int, jobs: int, rig_lights: int = RIG_LIGHTS
) -> DatasetTextures:
    """Open the dataset in a folder and make missing textures of its splits train and validation."""
    dataset = read_dataset(folder)
    model = model_of(dataset, face_model)
    subjects = [*dataset.splits["train"], *dataset.splits["validation"]]
    textures = DatasetTextures(dataset, model, side, provenance_of(dataset, model), {}, rig_lights)
    textures.heads(1)  # raises for a split without subjects before anything is unwrapped
    build_textures(dataset, face_model, side, subjects, jobs)
    written = {subject: sources_path(dataset, side, subject) for subject in subjects}
    return replace(textures, sources={name: path for name, path in written.items() if path.exists()})
