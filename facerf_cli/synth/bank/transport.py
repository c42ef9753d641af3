"""Bank of portraits that the Portrait Network is trained on: what cameras see of synthetic people; samples.

A portrait is kept without light: the facets of the image, how much of each light reaches them, and what they
are made of in several looks. The squares lie around the head as those that the Portrait Network sees of
photos (`portrait.proxy`). A sample is a photo in a random light, and the same person under single lights.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.batch.made_from import is_made_from
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import fit_landmarks
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.inputs import MEAN_RADIANCE, Batch
from facerf_cli.network.portrait import SKIN, PortraitInputs, mirrored_x, reached_by
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.person import SIDE_PX, SIDES, SeenPerson, look_at_person, surface_of
from facerf_cli.portrait.proxy import own_shading
from facerf_cli.raster.camera import Camera, project
from facerf_cli.relighting.models import Networks
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.bank import Files, files_in, fill, split_people
from facerf_cli.synth.bank.face_crops import gaussian_blurred
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.bank.portraits import (
    Lamp,
    background_of,
    draw_looks,
    draw_photo_light,
    draw_turn,
    seen_by,
)
from facerf_cli.synth.bank.texture_samples import draw_light, draw_target_lights
from facerf_cli.synth.portraits import BakedPortrait, albedo_of, images_under, materials_of, portrait_tensors
from facerf_cli.synth.random_fields import Random, Uniform, generators
from facerf_cli.synth.shading import Material
from facerf_cli.synth.subjects import Subject, draw_subject, subject_model
from facerf_cli.synth.views import StageCamera

_BAKE = BakeSettings(light_samples=2, light_radius_deg=1.5, bounce_samples=6)
# Standard deviations of the camera's yaw, pitch and roll, and their largest values, in degrees.
_POSE_STD_DEG, _POSE_MAX_DEG = (24.0, 9.0, 5.0), (65.0, 28.0, 18.0)
_DISTANCE_M = (0.5, 3.0)
_TRIES, _CROP_PX = 3, 256  # lights in which a face is looked for; side of the crop that it is fitted in
_SIZE_STD, _SHIFT_STD = 0.06, 0.03  # of the square: logarithm of its side, and its place in sides


@dataclass(frozen=True)
class TransportBankSettings:
    """Numbers of views, looks and lights of a person."""

    views: int = 4
    looks: int = 3
    lights: int = 48


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
    fill(folder, baked, people, jobs, last=f"_{settings.views - 1}")


def _baked(face_models: list[str], seed: int, settings: TransportBankSettings, index: int) -> Files:
    views = transport_of(face_models[index % len(face_models)], index, seed, settings)
    return {f"{index:05d}_{view}": tensors for view, tensors in enumerate(views)}


@torch.no_grad()
def transport_of(
    face_model: str, index: int, seed: int, settings: TransportBankSettings
) -> list[dict[str, Tensor]]:
    """Bake one person: for each view the fields of `BakedPortrait`, and its facets' materials in K looks.

    look_albedo [K, N, 3], look_specular and look_roughness [K, N]: float16, see `Material`.
    """
    random, generator = generators(seed, index, 5)
    subject = draw_subject(subject_model(face_model), index, seed, SIDE_PX)
    cameras = [_draw_camera(subject, random) for _ in range(settings.views)]
    views = seen_by(cameras, subject, settings.lights, _BAKE, index, random)
    looks = draw_looks(subject, settings.looks, generator)
    return [
        {**portrait_tensors(view), **_materials([materials_of(view, look) for look in looks])}
        for view in views
    ]


def _materials(looks: list[Material]) -> dict[str, Tensor]:
    return {
        f"look_{name}": torch.stack([getattr(look, name) for look in looks]).half()
        for name in ("albedo", "specular", "roughness")
    }


def _draw_camera(subject: Subject, random: Random) -> StageCamera:
    """Draw a camera whose image is the square around the head, a little off."""
    rotation = draw_turn(random, _POSE_STD_DEG, _POSE_MAX_DEG)
    distance_m = math.exp(random.uniform(*np.log(_DISTANCE_M)))
    towards = torch.tensor([*random.normal(0, 0.05, 2), -distance_m]).float()  # off the axis of the lens
    landmarks = torch.from_numpy(subject.landmarks_world).float() @ rotation.T.float() + towards
    seen = project(landmarks, Camera(1.0, 1, 1, 0.0, 0.0))
    low, high = seen.amin(0), seen.amax(0)
    side = SIDES * float((high - low).max()) * math.exp(random.normal(0, _SIZE_STD))
    x, y = (-SIDE_PX * ((low + high) / 2 / side + torch.from_numpy(random.normal(0, _SHIFT_STD, 2)))).tolist()
    lens = Camera(SIDE_PX / side, SIDE_PX, SIDE_PX, SIDE_PX / 2 + x, SIDE_PX / 2 + y)
    return StageCamera(lens, rotation, towards)


def add_proxies(folder: Path, backgrounds: Tensor, networks: Networks, jobs: int, seed: int) -> None:
    """Add to each portrait of a bank what the networks see of it (`seen_in`); keep finished ones."""
    sha256 = networks.sha256("parsing")
    missing = [path for path in files_in(folder) if not is_made_from(seen_path(path), sha256)]
    in_shards(partial(look_at_views, backgrounds, networks, seed), missing, jobs)


def seen_path(path: Path) -> Path:
    """The file beside a portrait's that holds what is seen of it."""
    return path.with_name(f"seen_{path.name}")


def look_at_views(backgrounds: Tensor, networks: Networks, seed: int, paths: list[Path]) -> None:
    """Write what is seen of views, on one thread."""
    made_from = {"of": networks.sha256("parsing")}
    with one_thread():
        for path in paths:
            number = int(path.stem.replace("_", ""))
            seen = seen_in(load_view(path), backgrounds, networks.people, seed + number)
            with atomic_path(seen_path(path)) as temporary:
                save_file(seen, temporary, made_from)


@torch.no_grad()
def seen_in(view: "StoredView", backgrounds: Tensor, people: PeopleNetworks, seed: int) -> dict[str, Tensor]:
    """Fit and segment a photo of a view as those of users are; empty where no face is found in it.

    All is seen in the view's own frame, so that it lies on the view's images; see `layers_of`.
    """
    generator = torch.Generator().manual_seed(seed)
    portrait, frame = view.portrait, Crop(0.0, 0.0, float(SIDE_PX), SIDE_PX)
    chosen = backgrounds[int(torch.randint(len(backgrounds), (), generator=generator))]
    for _ in range(_TRIES):
        weights = draw_light(portrait.directions, generator)
        background = background_of(chosen, SIDE_PX, generator)
        image = images_under(portrait, view.looks[0], weights[None])[0]
        image = image / image.mean().clamp_min(1e-6) * 0.1 + (1 - view.alpha) * background
        exposed = (image / image.mean().clamp_min(1e-6) * 0.2).permute(1, 2, 0).numpy()
        with suppress(InputError):
            return layers_of(person_in(people, exposed, frame), portrait.directions)
    return {}


def person_in(people: PeopleNetworks, photo: np.ndarray, square: Crop | None = None) -> SeenPerson:
    """Find the largest face of a scene-linear photo [H, W, 3], fit it, and look at the person.

    All is seen in the square around the landmarks, or in a given one. Raises InputError without a face.
    """
    face = find_faces(people, photo, "portrait")[0]
    crop = from_landmarks(face.landmarks_px, _CROP_PX)
    fit = fit_landmarks(cached_face_model(BUILTIN), crop.to_crop(face.landmarks_px), crop)
    return look_at_person(people, cached_face_model(BUILTIN), photo, fit, square)


def layers_of(person: SeenPerson, directions: Tensor) -> dict[str, Tensor]:
    """Return the layers that are kept of a person, and the shadows of lights [L, 3].

    classes [C, S, S], covered [1, S, S] and visible [L, s, s] of the lights: uint8, of 255; normals
    [3, S, S], depth [1, S, S]: float16.
    """
    normals, depth, covered = surface_of(person.maps)
    return {
        "classes": (255 * person.classes).round().byte(),
        "covered": (255 * covered[0]).byte(),
        "normals": normals[0].half().contiguous(),
        "depth": depth[0].half(),
        "visible": (255 * person.visibility(directions)).round().byte(),
    }


@dataclass(frozen=True, eq=False)
class StoredView:
    """One view of the bank, and the materials of its facets in several looks."""

    portrait: BakedPortrait
    looks: list[Material]

    @property
    def alpha(self) -> Tensor:
        """Cover [S, S] of the person."""
        return 1 - self.portrait.classes[..., 0].float() / 255


def load_view(path: Path) -> StoredView:
    """Read a view."""
    tensors = load_file(path)
    albedo, specular, roughness = (
        tensors.pop(f"look_{name}").float() for name in ("albedo", "specular", "roughness")
    )
    relief = torch.zeros(albedo.shape[1], 2)
    looks = [Material(*look, relief) for look in zip(albedo, specular, roughness, strict=True)]
    return StoredView(BakedPortrait(**tensors), looks)


_LAMP = Lamp(0.3, 0.01, 2, 0.3, 1.0)
_GREY = 0.2  # share of grey photos
SMALL = 4  # pixels along each side that are averaged where the photo's own light is summed
_EMPTY_BYTES = 1000  # a file without tensors is smaller
_BRIGHTEST = 8.0  # of targets; brighter highlights are clipped


@dataclass(frozen=True)
class PortraitSample(Batch):
    """Photos of B people, what is seen in them, and T target images of each."""

    inputs: PortraitInputs
    lights: Tensor  # [B, T, 3] of the targets
    visible: Tensor  # [B, T, s, s]
    targets: Tensor  # [B, T, 3, S, S]
    rig: Tensor  # [B, L, 3] of the photo's own light
    rig_visible: Tensor  # [B, L, s, s]
    weights: Tensor  # [B, L, 3]
    own: Tensor  # [B, 3, S, S] the photo without noise
    albedo: Tensor  # [B, 3, S, S], known where `labelled` is 1
    true_normals: Tensor  # [B, 3, S, S], likewise
    shares: Tensor  # [B, C, S, S] of the true classes
    labelled: Tensor  # [B]


class PortraitSource(Protocol):
    """People to draw samples of: synthetic ones, or those of a dataset (`dataset/portraits.py`)."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin and licence of the people."""
        ...

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """Indices of the people to train on, and of at most `held_out` others."""
        ...

    def draw(self, people: Sequence[int], targets: int, generator: torch.Generator) -> PortraitSample:
        """Draw one sample [1, ...] of one of some people, with `targets` lights."""
        ...


class StoredTransport:
    """The bank's portraits, read when they are drawn."""

    def __init__(self, folder: Path, backgrounds: Tensor, provenance: dict[str, Any]) -> None:
        people: dict[str, list[Path]] = {}
        for path in files_in(folder):
            if seen_path(path).exists() and seen_path(path).stat().st_size > _EMPTY_BYTES:
                people.setdefault(path.stem.split("_")[0], []).append(path)
        if not people:
            raise InputError(f"{folder}: no portraits; make them with `facerf train --stage portrait`")
        self.views = list(people.values())
        self.backgrounds = backgrounds
        self.provenance = provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """See `split_people`."""
        return split_people(len(self.views), held_out)

    def draw(self, people: Sequence[int], targets: int, generator: torch.Generator) -> PortraitSample:
        """Draw one sample [1, ...] of one of some people, with `targets` lights."""
        views = self.views[people[_below(len(people), generator)]]
        path = views[_below(len(views), generator)]
        view = load_view(path)
        surface = view.looks[_below(len(view.looks), generator)]
        rig = view.portrait.directions
        weights = source_light(rig, generator)
        chosen = draw_target_lights(rig, targets, generator)
        single = torch.eye(len(rig))[chosen, :, None].expand(-1, -1, 3)
        albedo, normals = albedo_of(view.portrait, surface)
        lit = LitPerson(
            images=images_under(view.portrait, surface, torch.cat([weights[None], single])),
            albedo=albedo,
            normals=normals,
            shares=view.portrait.classes.permute(2, 0, 1).float() / 255,
            behind=1 - view.alpha,
            rig=rig,
            weights=weights,
            chosen=chosen,
        )
        return sample_of(lit, load_file(seen_path(path)), self.backgrounds, generator)


@dataclass(frozen=True, eq=False)
class LitPerson:
    """A person under the light of a photo, and under T lights of a rig."""

    images: Tensor  # [1 + T, 3, S, S]
    albedo: Tensor  # [3, S, S], or what stands for it
    normals: Tensor | None  # [3, S, S]; None where nobody knows them
    shares: Tensor  # [C, S, S] of the classes
    behind: Tensor  # [S, S], the share of what lies behind the person
    rig: Tensor  # [L, 3]
    weights: Tensor  # [L, 3] of the rig's lights in the first image
    chosen: Tensor  # [T] lights of the others


def sample_of(
    lit: LitPerson, seen: dict[str, Tensor], backgrounds: Tensor, generator: torch.Generator
) -> PortraitSample:
    """Photograph a person before a background; `seen` are the layers of `transport_bank.layers_of`.

    Where `seen` has the visibility of a rig all around as `around`, with directions `around_directions`, the
    person's own rig need not lie all around.
    """
    classes = seen["classes"].float() / 255
    visible = seen["visible"].float() / 255
    around = seen["around"].float() / 255 if "around" in seen else visible
    directions = seen.get("around_directions", lit.rig)
    images, albedo = _balanced(lit.images, lit.albedo, generator)
    skin, side = classes[SKIN], classes.shape[-1]
    scale = MEAN_RADIANCE / _mean_over(albedo, skin)
    stored = backgrounds[_below(len(backgrounds), generator)]
    background = 4 * background_of(stored, side, generator) * lit.behind
    photo = _as_taken(images[0] / _mean_over(images[0], skin) + background, generator)
    normals = seen["normals"].float()
    inputs = PortraitInputs(
        image=photo / _mean_over(photo, skin) * MEAN_RADIANCE,
        classes=classes,
        normals=normals,
        depth=seen["depth"].float(),
        covered=seen["covered"].float() / 255,
        reached=reached_by(directions, around, side),
        own=own_shading(photo, classes, normals, directions, around),
    )
    sample = PortraitSample(
        inputs=inputs,
        lights=lit.rig[lit.chosen],
        visible=visible[lit.chosen],
        targets=(images[1:] * scale).clamp(max=_BRIGHTEST),
        rig=lit.rig,
        rig_visible=visible,
        weights=lit.weights,
        own=images[0] * scale,
        albedo=albedo * scale,
        true_normals=normals if lit.normals is None else lit.normals,
        shares=lit.shares,
        labelled=torch.tensor(float(lit.normals is not None)),
    )
    batched = sample.each(lambda values: values[None])
    return mirrored(batched) if torch.rand((), generator=generator) < 0.5 else batched


def _balanced(images: Tensor, albedo: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Images [N, 3, S, S] and albedo [3, S, S] in another white balance, some of them grey."""
    balance = torch.exp(Uniform(generator)(-0.12, 0.12, 3, 1, 1))
    images, albedo = images * balance, albedo * balance
    if torch.rand((), generator=generator) < _GREY:
        images, albedo = (x.mean(-3, keepdim=True).expand_as(x) for x in (images, albedo))
    return images, albedo


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def source_light(rig: Tensor, generator: torch.Generator) -> Tensor:
    """Draw weights [L, 3] of the photo's light."""
    return draw_photo_light(rig, generator, _LAMP)


def _mean_over(image: Tensor, weight: Tensor) -> Tensor:
    """Mean of an image [3, S, S] under weights [S, S]."""
    return ((image.mean(0) * weight).sum() / weight.sum().clamp_min(1e-3)).clamp_min(1e-6)


def _as_taken(image: Tensor, generator: torch.Generator) -> Tensor:
    """Take a photo of a scene [3, S, S] with a mean of about 1: clipping, blur, tone curve and noise."""
    uniform = Uniform(generator)
    image = (image / uniform(1.6, 6.0)).clamp(0, 1)
    if torch.rand((), generator=generator) < 0.4:
        image = gaussian_blurred(image, float(uniform(0.3, 1.2)))
    image = image ** torch.exp(uniform(-0.22, 0.22))
    noise = torch.randn(image.shape, generator=generator) * uniform(0, 0.02)
    return (image + noise * (image + 0.02).sqrt()).clamp(0, 1)


def mirrored(sample: PortraitSample) -> PortraitSample:
    """Mirror a sample: images, and the x of vectors."""
    flipped = sample.each(lambda values: values.flip(-1) if values.dim() > 3 else values)
    other_side = torch.tensor([-1.0, 1, 1])
    return replace(
        flipped,
        inputs=sample.inputs.mirrored(),
        true_normals=mirrored_x(flipped.true_normals),
        lights=sample.lights * other_side,
        rig=sample.rig * other_side,
    )
