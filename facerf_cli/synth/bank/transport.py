"""Bank of portraits that the Portrait Network is trained on: what cameras see of synthetic people; samples.

A portrait is kept without light: the facets of the image, how much of each light reaches them, and what they
are made of in several looks. A person's light is baked once, at the vertices of the mesh; each camera takes a
photo of it, in which the person is found, and squares of several scales, as the Portrait Network sees them of
photos (`portrait.proxy`). A sample is a square in a random light, and the same under single lights.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from facerf_cli.batch.made_from import is_made_from
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import fit_landmarks
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.files.atomic import atomic_path
from facerf_cli.light.sphere import direction_to_azel
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.inputs import MEAN_RADIANCE, Batch
from facerf_cli.network.portrait import SKIN, PortraitInputs, mirrored_x, reached_by
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.person import SIDES, SeenPerson, look_at_person, surface_of
from facerf_cli.portrait.proxy import own_shading
from facerf_cli.raster.camera import Camera, project
from facerf_cli.relighting.models import Networks
from facerf_cli.run.workers import in_shards, one_thread
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.bank import Files, file_of, files_in, fill, split_people
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
from facerf_cli.synth.bank.texture_samples import draw_light, in_front
from facerf_cli.synth.portraits import BakedPortrait, albedo_of, images_under, materials_of, portrait_tensors
from facerf_cli.synth.random_fields import Random, Uniform, generators
from facerf_cli.synth.shading import Material
from facerf_cli.synth.subjects import Subject, draw_subject, subject_model
from facerf_cli.synth.views import StageCamera

# Bounced light is smoothed over more than an edge of cloth, where few rays would leave spots.
_BAKE = BakeSettings(light_samples=2, light_radius_deg=1.5, bounce_samples=10, bounce_blur_m=0.012)
# Standard deviations of the camera's yaw, pitch and roll, and their largest values, in degrees.
_POSE_STD_DEG, _POSE_MAX_DEG = (24.0, 9.0, 5.0), (65.0, 28.0, 18.0)
_NEAREST, _FARTHEST_M = 0.17, 3.0  # of the camera: metres for each face that its squares show, and metres
SIDE_PX, PHOTO_PX = 256, 448  # of the squares, and of the photo in which the person is found
SCALES = (1.5, 7.0)  # sides of the squares in faces, the extents of the landmarks
_PHOTO_SIDES = (1.0, 1.25)  # of the photo, in sides of what its squares take; it is no smaller than `SIDES`
_PHOTO = "photo_"  # before the names of photos
_TRIES, _CROP_PX = 3, 256  # lights in which a face is looked for; side of the crop that it is fitted in
_SHIFT_STD = 0.03  # of the square's place, in its sides
_ABOVE, _BELOW = 1.3, 4.4  # faces: least of a low square that is above the face, and most that is below it
# Lights from behind: elevation and least azimuth, and how much likelier a target they are than one in front.
_BACK_EL_DEG, _BACK_AZ_DEG, _BACK = (0.0, 40.0), 120.0, 2.0


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
    255; squares [Q, 4], the fields of a `Crop` of the photo; directions [L, 3] of the lights.
    """
    random, generator = generators(seed, index, 5)
    subject = draw_subject(subject_model(face_model), index, seed, settings.side_px, arms=True)
    drawn = _draw_cameras(subject, random, settings)
    cameras = [camera for one in drawn for camera in (one.photo, *one.squares)]
    views = iter(seen_by(cameras, subject, settings.lights, _BAKE, index, random))
    looks = draw_looks(subject, settings.looks, generator)
    files: Files = {}
    for number, one in enumerate(drawn):
        first = number * settings.squares
        files[f"{_PHOTO}{index:05d}_{first}"] = _photo(next(views), looks[0], one.crops, generator)
        for k in range(first, first + settings.squares):
            view = next(views)
            materials = _materials([materials_of(view, look) for look in looks])
            files[f"{index:05d}_{k}"] = {**portrait_tensors(view), **materials}
    return files


def _photo(
    view: BakedPortrait, look: Appearance, crops: Tensor, generator: torch.Generator
) -> dict[str, Tensor]:
    """The person in a photo, in several lights; see `transport_of`."""
    weights = torch.stack([draw_light(view.directions, generator) for _ in range(_TRIES)])
    images = images_under(view, materials_of(view, look), weights)
    images = images / images.mean((1, 2, 3), keepdim=True).clamp_min(1e-6)
    alpha = 255 - view.classes[..., 0]
    return {"lit": images.half(), "alpha": alpha, "squares": crops, "directions": view.directions}


def _materials(looks: list[Material]) -> dict[str, Tensor]:
    return {
        f"look_{name}": torch.stack([getattr(look, name) for look in looks]).half()
        for name in ("albedo", "specular", "roughness")
    }


class _Views(NamedTuple):
    """A camera's photo and its squares, also [Q, 4] as the fields of a `Crop` of the photo."""

    photo: StageCamera
    squares: list[StageCamera]
    crops: Tensor


def _draw_cameras(subject: Subject, random: Random, settings: TransportBankSettings) -> list[_Views]:
    """Draw cameras; the scales of all their squares are spread over `SCALES`."""
    count = settings.cameras * settings.squares
    low, high = np.log(SCALES)
    scales = np.exp(low + (high - low) * (random.permutation(count) + random.uniform(size=count)) / count)
    return [_draw_views(subject, sides, random, settings) for sides in scales.reshape(settings.cameras, -1)]


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

    def camera(square: np.ndarray, size_px: int) -> StageCamera:
        x, y = (size_px / square[2] * square[:2]).tolist()
        return StageCamera(Camera(size_px / square[2], size_px, size_px, -x, -y), rotation, towards)

    squares = [window(sides) for sides in scales]
    corners = np.array([square[:2] for square in squares])
    ends = corners + np.array([square[2:] for square in squares])
    side = max(float((ends.max(0) - corners.min(0)).max()) * random.uniform(*_PHOTO_SIDES), SIDES * face)
    whole = np.array([*((ends.max(0) + corners.min(0)) / 2 - side / 2), side])
    px = settings.photo_px / side
    crops = [[*((square[:2] - whole[:2]) * px), square[2] * px, settings.side_px] for square in squares]
    return _Views(
        camera(whole, settings.photo_px),
        [camera(square, settings.side_px) for square in squares],
        torch.tensor(np.array(crops)),
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
    chosen = backgrounds[int(torch.randint(len(backgrounds), (), generator=generator))]
    behind = 1 - photo["alpha"].float() / 255
    squares = [Crop(x, y, side, int(size)) for x, y, side, size in photo["squares"].tolist()]
    for image in photo["lit"].float():
        scene = image * 0.1 + behind * background_of(chosen, len(behind), generator)
        exposed = (scene / scene.mean().clamp_min(1e-6) * 0.2).permute(1, 2, 0).numpy()
        with suppress(InputError):
            person = person_in(people, exposed)
            found = [person.within(square, exposed) for square in squares]
            if all(float(one.classes[SKIN].sum()) > 1 for one in found):
                return [layers_of(one, photo["directions"]) for one in found]
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
        "visible": (255 * person.visibility(directions)).round().byte(),
        "sides": torch.tensor(person.sides),
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
        chosen = draw_targets(rig, targets, generator)
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
    normals, sides = seen["normals"].float(), seen.get("sides", torch.tensor(SIDES))
    inputs = PortraitInputs(
        image=photo / _mean_over(photo, skin) * MEAN_RADIANCE,
        classes=classes,
        normals=normals,
        depth=seen["depth"].float(),
        covered=seen["covered"].float() / 255,
        reached=reached_by(directions, around, side),
        own=own_shading(photo, classes, normals, directions, around, float(sides)),
        sides=sides.view(1, 1, 1),
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


def draw_targets(rig: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw indices [count] of lights of a rig [L, 3]: as in photos, and many that make rims."""
    azimuth, elevation = direction_to_azel(rig)
    low, high = _BACK_EL_DEG
    behind = (azimuth.abs() > _BACK_AZ_DEG) & (elevation > low) & (elevation < high)
    return torch.multinomial(in_front(rig) + _BACK * behind, count, generator=generator)


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
