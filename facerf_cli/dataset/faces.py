"""Faces of a prepared dataset for the stages that train on textures, unwrapped in the training step.

Workers read crops from the OLAT stacks (`dataset/crops.py`); the device unwraps them, and no textures are
written. Samples replace the synthetic ones of `synth/bank/texture_samples.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from facerf_cli.capture.stage_json import MOST_CAMERAS
from facerf_cli.dataset.crops import (
    PairReader,
    StackInfo,
    crop_weights,
    pairs_of_split,
    stack_info,
    unwrap_crops,
)
from facerf_cli.dataset.dataset import Dataset, people_of, provenance_of, read_dataset
from facerf_cli.dataset.pairs import Pair, load_pairs
from facerf_cli.errors import InputError
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles, on_device
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.sphere import RIG_LIGHTS
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.batch import Batch
from facerf_cli.network.inputs import MEAN_RADIANCE, resize
from facerf_cli.raster.texture import inpaint, normal_map
from facerf_cli.synth.bank.heads import HeadBakeSettings, bake_head
from facerf_cli.synth.bank.texture_samples import TEXTURE_CAMERA, Sample, draw_target_lights, exposed
from facerf_cli.synth.camera import recoloured

_LEAST_INSIDE = 0.9  # fraction of a texel's pixels that must lie on the face and inside the photo
_AROUND_PX = 16  # rows read beyond the face, for texels that cross its border
_CROP_PER_TEXTURE = 2  # largest side of a crop that is unwrapped, in sides of the texture
_MEAN_SIDE = 64  # texels along a side of the mean face's shadows
_WEIGHTS_BYTES = 256 << 20  # of the visibility that is kept, a quarter MB per stack at 128 texels


@dataclass(frozen=True)
class FaceCrops(Batch):
    """N images of each of B faces, in crops of side S.

    Attributes:
        images: [B, N, 3, S, S], linear.
        seen: [B, 1, S, S] in 0..1, where the crop shows the face.
        vertices: [B, V, 3], fitted meshes in camera space.
        stacks: [B], a number for each stack of the dataset.
    """

    images: Tensor
    seen: Tensor
    vertices: Tensor
    stacks: Tensor


@dataclass(frozen=True)
class LightTextures(Batch):
    """B faces under L single lights: textures [B, L, 3, T, T] linear, zero where unseen; lights [B, L, 3].

    The lights are unit vectors in the head's frame; `people` [B] are their indices.
    """

    textures: Tensor
    lights_head: Tensor
    people: Tensor


@dataclass(frozen=True)
class LitCrops(Batch):
    """B faces under L single lights; `colours` [B, 3, 3] map true colours to an exposed camera's."""

    crops: FaceCrops
    colours: Tensor
    lights_head: Tensor
    people: Tensor


@dataclass(frozen=True)
class SampleCrops(Batch):
    """Crops of a `Sample`: B sources, and their targets under L lights each.

    Attributes:
        source: One photo of each face, by a simulated camera.
        target: L images of each face, by the target's camera.
        turn: [B, 3, 3], from the source's camera space to the target's.
        lights: [B, L, 3], unit vectors in the target's camera space.
        colours: [B, 3, 3], from true colours to an exposed camera's.
    """

    source: FaceCrops
    target: FaceCrops
    turn: Tensor
    lights: Tensor
    colours: Tensor


@dataclass(frozen=True, eq=False)
class DatasetFaces:
    """Faces of a dataset, for textures of `side` texels; people are indices of `dataset.subjects`."""

    dataset: Dataset
    model: MorphableModel
    side: int
    crop_px: int  # side of the crops that are unwrapped
    train: PairReader  # of the split train
    fewest_lights: int  # that a subject has
    rig_lights: int  # of the mean face's shadows
    provenance: dict[str, Any]
    point_weights: dict[int, Tensor] = field(
        default_factory=dict
    )  # `crop_weights` of stacks, by their numbers

    def people(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Return people of the split train, and at most `held_out` of the split validation."""
        train, validation = (
            torch.tensor([self.dataset.subjects.index(subject) for subject in people_of(self.dataset, split)])
            for split in ("train", "validation")
        )
        return train, validation[:held_out]

    def mean_face(self) -> tuple[Tensor, Tensor, Tensor]:
        """See `mean_face_of`."""
        return mean_face_of(self.model, self.rig_lights)

    def source_colours(self, count: int, generator: torch.Generator) -> Tensor:
        """Measure mean colours [N, 3] of about `count` training sources, as random cameras see them."""
        colours = self.train.source_colours(count)
        return torch.stack([TEXTURE_CAMERA.colours(generator) @ colour for colour in colours]).double()

    def draw_shared(
        self, lights: int, generator_of: Callable[..., torch.Generator], index: int, step: int
    ) -> tuple[Tensor, SampleCrops]:
        """Draw a training sample with `lights` target lights, and its person [1].

        See `PairReader.draw_source`.
        """
        pair, source = self.train.draw_source(generator_of, index, step)
        person = torch.tensor([self.dataset.subjects.index(pair.subject)])
        return person, self._sample(pair, source, lights, generator_of(index))

    def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> SampleCrops:
        """Draw a sample of a person [1]; the stack is opened for this sample only."""
        subject = self.dataset.subjects[int(people)]
        pairs = load_pairs(self.dataset).get(subject, ([],))[0]
        reader = PairReader(self.dataset, (subject,), pairs, self.crop_px)
        seed = int(torch.randint(1 << 31, (), generator=generator))
        pair, source = reader.draw_sources(seed)[0]
        return self._sample(pair, source.float(), lights, generator)

    def _sample(self, pair: Pair, source: Tensor, lights: int, generator: torch.Generator) -> SampleCrops:
        """Add target lights, the pair's first, and a camera to a source [3, H, W].

        The albedo of real skin is unknown. The face under a constant map of radiance 1 gives the exposure
        instead; it equals the albedo except for light that other parts of the face occlude.
        """
        path = self.dataset.stack_path(pair.subject, pair.target_camera)
        source_info, info = (
            stack_info(self.dataset.stack_path(pair.subject, pair.source_camera)),
            stack_info(path),
        )
        chosen = draw_target_lights(info.directions, min(lights, self.fewest_lights), generator)
        chosen = torch.cat([torch.tensor([pair.target_light]), chosen[chosen != pair.target_light]])
        chosen = chosen[: min(lights, self.fewest_lights)]
        colours = TEXTURE_CAMERA.colours(generator)
        exposure = MEAN_RADIANCE / (colours @ source_info.lit_colour).mean()
        crops = self._crops(pair.subject, pair.source_camera, source[None])
        image = recoloured(crops.images[0, 0].float(), colours)
        photo = TEXTURE_CAMERA.take(image, image.mean(0)[crops.seen[0, 0] > 0].mean(), generator)
        return SampleCrops(
            source=replace(crops, images=photo[None, None]),
            target=self._crops(pair.subject, pair.target_camera, _read_face(path, info, chosen.tolist())),
            turn=(info.rotation @ source_info.rotation.T)[None],
            lights=info.directions[chosen][None],
            colours=(exposure * colours)[None],
        )

    def draw_lights(self, people: Tensor, lights: int, generator: torch.Generator) -> LitCrops:
        """Draw a person [1] under random lights of one of its cameras, by a camera of random colours."""
        subject = self.dataset.subjects[int(people)]
        cameras = self.dataset.cameras[subject]
        camera = cameras[int(torch.randint(len(cameras), (), generator=generator))]
        path = self.dataset.stack_path(subject, camera)
        info = stack_info(path)
        chosen = draw_target_lights(info.directions, min(lights, self.fewest_lights), generator).tolist()
        crops = self._crops(subject, camera, _read_face(path, info, chosen))
        colours = TEXTURE_CAMERA.colours(generator) * (MEAN_RADIANCE / info.lit_mean)
        directions = info.directions[chosen] @ info.rotation  # R^T w, of row vectors
        return LitCrops(crops, colours[None], directions[None], people)

    def _crops(self, subject: str, camera: str, images: Tensor) -> FaceCrops:
        """Resample images [N, 3, H, W] of a stack to the side that is unwrapped."""
        info = stack_info(self.dataset.stack_path(subject, camera))
        if info.side_px != self.crop_px:
            images = resize(images.float(), self.crop_px)
        seen = resize(info.face[None, None].float(), self.crop_px)
        place = self.dataset.subjects.index(subject), self.dataset.cameras[subject].index(camera)
        number = torch.tensor([place[0] * MOST_CAMERAS + place[1]])
        return FaceCrops(images[None], seen, info.fit.vertices_camera(self.model)[None], number)

    def sample(self, crops: SampleCrops) -> Sample:
        """Unwrap the faces of a sample."""
        source, visible = self.unwrapped(crops.source)
        target, target_visible = self.unwrapped(crops.target)
        photo = exposed(source[:, 0], visible)
        normals = normal_map(crops.source.vertices, on_device(photo.device, grid_triangles), self.side)
        return Sample(
            source=inpaint(photo, visible[:, 0]),
            visible=visible,
            normals_source=normals,
            # the source's normals, rotated, like in `Field.olats`
            normals_target=torch.einsum("bdc,bcij->bdij", crops.turn, normals),
            lights=crops.lights,
            target=recoloured(target, crops.colours[:, None]),
            weight=target_visible * (0.3 + 0.7 * visible),
        )

    def light_textures(self, lit: LitCrops) -> LightTextures:
        """Unwrap faces under single lights."""
        textures, _ = self.unwrapped(lit.crops)
        return LightTextures(recoloured(textures, lit.colours[:, None]), lit.lights_head, lit.people)

    def unwrapped(self, crops: FaceCrops) -> tuple[Tensor, Tensor]:
        """Return textures [B, N, 3, T, T] of crops, 0 where unseen, and visibility [B, 1, T, T].

        A texel is unseen if too few of its pixels lie on the face.
        """
        planes = torch.cat([crops.images.flatten(1, 2).float(), crops.seen], 1)
        textures, visible = unwrap_crops(planes, crops.vertices, self.side, self._weights_of(crops))
        inside = textures[:, -1:] > _LEAST_INSIDE
        textures = (textures[:, :-1] * inside).view(*crops.images.shape[:3], self.side, self.side)
        return textures, visible[:, None] * inside

    def _weights_of(self, crops: FaceCrops) -> Tensor:
        """Return `crop_weights` of crops; computed once for the stacks that fit into `_WEIGHTS_BYTES`."""
        numbers = crops.stacks.tolist()
        missing = [place for place, number in enumerate(numbers) if number not in self.point_weights]
        weights = {}
        if missing:
            made = crop_weights(crops.vertices[missing], self.crop_px, self.side)
            weights = dict(zip((numbers[place] for place in missing), made, strict=True))
            if len(self.point_weights) * made[0].nbytes < _WEIGHTS_BYTES:
                self.point_weights.update(weights)
        return torch.stack([weights[n] if n in weights else self.point_weights[n] for n in numbers])


def _read_face(path: Path, info: StackInfo, lights: Sequence[int]) -> Tensor:
    """Read OLATs [N, 3, H, W] float16 of a stack, 0 above and below the face."""
    rows = info.face.any(1).nonzero()[:, 0]
    part = slice(max(int(rows[0]) - _AROUND_PX, 0), int(rows[-1]) + 1 + _AROUND_PX)
    images = torch.zeros(len(lights), 3, *info.face.shape, dtype=torch.float16)
    images[:, :, part] = read_olats(path, lights, part)
    return images


def mean_face_of(model: MorphableModel, rig_lights: int) -> tuple[Tensor, Tensor, Tensor]:
    """Bake a face model's mean: normals [3, T, T], visibility [L, T, T] and light directions [L, 3]."""
    settings = HeadBakeSettings(_MEAN_SIDE, rig_lights, bake=BakeSettings(bounce_samples=0))
    mean = bake_head(model, 0, 0, settings)
    normals = normal_map(mean["vertices"], grid_triangles(), _MEAN_SIDE)
    return normals, mean["visibility"].float() / 255, mean["directions"]


def open_faces(folder: Path, face_model: str, side: int, rig_lights: int = RIG_LIGHTS) -> DatasetFaces:
    """Open the dataset in a folder for training on textures of `side` texels.

    Raises InputError if it was fitted with another face model.
    """
    dataset, model = read_dataset(folder), load_face_model(face_model)
    if model.name != dataset.face_model:
        fitted = f"fitted with the face model {dataset.face_model}, not {model.name}"
        raise InputError(f"{dataset.folder}: {fitted}; pass {dataset.face_model} to --fit-with")
    crop_px = min(dataset.crop_px, _CROP_PER_TEXTURE * side)
    train = pairs_of_split(dataset, "train", crop_px)
    lights = min(len(dataset.lights_of(subject)) for subject in dataset.subjects)
    provenance = provenance_of(dataset, model)
    return DatasetFaces(dataset, model, side, crop_px, train, lights, rig_lights, provenance)
