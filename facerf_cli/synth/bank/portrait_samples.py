"""Samples that the Portrait Network is trained on: a photo in a random light, and under single lights.

The people come from a bank (`people.py`) or a dataset (`dataset/squares.py`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.sphere import direction_to_azel
from facerf_cli.network.batch import Batch
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.portrait import SKIN, PortraitInputs, mirrored_x, reached_by
from facerf_cli.portrait.person import SIDES
from facerf_cli.portrait.proxy import own_shading
from facerf_cli.relighting.white import even_shade_of
from facerf_cli.synth.bank import files_in, split_people
from facerf_cli.synth.bank.people import KeyLight, draw_photo_light
from facerf_cli.synth.bank.proxies import seen_path
from facerf_cli.synth.bank.texture_samples import in_front
from facerf_cli.synth.camera import SimulatedCamera, background, recoloured, turned
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.renderer import BakedView, albedo_of, images_under
from facerf_cli.synth.shading import Material

_KEY_LIGHT = KeyLight(0.3, 0.01, 2, 0.3, 1.0)
_CAMERA = SimulatedCamera(grey=0.2, blur_px=1.2, phone=0.2, contrast=(0.0, 0.3))
SMALL = 4  # pixels along each side that are averaged where the photo's original light is summed
_SHADOWED = 0.25  # share of photos in the shadow of something that they do not show
_EMPTY_BYTES = 1000  # a file without tensors is smaller
_BRIGHTEST = 8.0  # of targets; brighter highlights are clipped
# Lights from behind: elevation and least azimuth, and the share of targets that they get beside their own.
_BACK_EL_DEG, _BACK_AZ_DEG, _BACK = (0.0, 40.0), 120.0, 0.08


@dataclass(frozen=True, eq=False)
class StoredView:
    """View from a bank, and the materials of its facets in several looks."""

    baked: BakedView
    looks: list[Material]


def load_view(path: Path) -> StoredView:
    tensors = load_file(path)
    albedo, specular, roughness = (
        tensors.pop(f"look_{name}").float() for name in ("albedo", "specular", "roughness")
    )
    relief = torch.zeros(albedo.shape[1], 2)
    looks = [Material(*look, relief) for look in zip(albedo, specular, roughness, strict=True)]
    return StoredView(BakedView.unpacked(tensors), looks)


@dataclass(frozen=True)
class PortraitSample(Batch):
    """Photos of B people, what the networks see in them, and T target images of each."""

    inputs: PortraitInputs
    lights: Tensor  # [B, T, 3] of the targets
    visible: Tensor  # [B, T, s, s]
    targets: Tensor  # [B, T, 3, S, S]
    rig: Tensor  # [B, L, 3] of the photo's original light
    rig_visible: Tensor  # [B, L, s, s]
    weights: Tensor  # [B, L, 3]
    original: Tensor  # [B, 3, S, S] the photo without noise
    albedo: Tensor  # [B, 3, S, S], known where `labelled` is 1
    true_normals: Tensor  # [B, 3, S, S], likewise
    shares: Tensor  # [B, C, S, S] of the true classes
    labelled: Tensor  # [B]


class PortraitSource(Protocol):
    """People to draw samples of: synthetic, or from a dataset (`dataset/squares.py`)."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin and licence of the people."""

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """Indices of the people to train on, and of at most `held_out` others."""

    def sides_px(self, people: Sequence[int]) -> list[int]:
        """Sides of the squares of some people, of each square."""

    def draw(
        self, people: Sequence[int], targets: int, generator: torch.Generator, side_px: int | None = None
    ) -> PortraitSample:
        """Draw one sample [1, ...] of some people, with `targets` lights, of a side if one is given."""


class PortraitSquares:
    """Squares of a bank, read when they are drawn."""

    def __init__(self, folder: Path, backgrounds: Tensor, provenance: dict[str, Any]) -> None:
        people: dict[str, dict[Path, int]] = {}
        for path in files_in(folder):
            if seen_path(path).exists() and seen_path(path).stat().st_size > _EMPTY_BYTES:
                people.setdefault(path.stem.split("_")[0], {})[path] = _side_px(path)
        if not people:
            raise InputError(f"{folder}: no squares; bake people with `facerf train --stage portrait`")
        self.views = list(people.values())
        self.backgrounds = backgrounds
        self.provenance = provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        return split_people(len(self.views), held_out)

    def sides_px(self, people: Sequence[int]) -> list[int]:
        return [side for one in people for side in self.views[one].values()]

    def draw(
        self, people: Sequence[int], targets: int, generator: torch.Generator, side_px: int | None = None
    ) -> PortraitSample:
        of_side = (
            [path for path, side in self.views[one].items() if side_px in (None, side)] for one in people
        )
        of_people = [paths for paths in of_side if paths]
        views = of_people[_below(len(of_people), generator)]
        path = views[_below(len(views), generator)]
        view = load_view(path)
        surface = view.looks[_below(len(view.looks), generator)]
        rig = view.baked.directions
        weights = source_light(rig, generator)
        chosen = draw_targets(rig, targets, generator)
        single = torch.eye(len(rig))[chosen, :, None].expand(-1, -1, 3)
        albedo, normals = albedo_of(view.baked, surface)
        lit = LitPerson(
            images=images_under(view.baked, surface, torch.cat([weights[None], single])),
            albedo=albedo,
            normals=normals,
            shares=view.baked.classes.permute(2, 0, 1),
            behind=1 - view.baked.alpha,
            rig=rig,
            weights=weights,
            chosen=chosen,
        )
        return sample_of(lit, load_file(seen_path(path)), self.backgrounds, generator)


def _side_px(path: Path) -> int:
    with safe_open(path, framework="pt") as file:
        return int(file.get_slice("classes").get_shape()[0])


@dataclass(frozen=True, eq=False)
class LitPerson:
    """Person under the light of a photo, and under T lights of a rig."""

    images: Tensor  # [1 + T, 3, S, S]
    albedo: Tensor  # [3, S, S], or what stands for it
    normals: Tensor | None  # [3, S, S]; None if unknown
    shares: Tensor  # [C, S, S] of the classes
    behind: Tensor  # [S, S], the share of what lies behind the person
    rig: Tensor  # [L, 3]
    weights: Tensor  # [L, 3] of the rig's lights in the first image
    chosen: Tensor  # [T] lights of the others


def sample_of(
    lit: LitPerson, seen: dict[str, Tensor], backgrounds: Tensor, generator: torch.Generator
) -> PortraitSample:
    """Photograph a person in front of a background; `seen` are the layers of `proxies.layers_of`.

    Where `seen` has the visibility of a rig all around as `around`, with directions `around_directions`, the
    person's own rig need not lie all around.
    """
    classes = seen["classes"].float() / 255
    visible = seen["visible"].float() / 255
    around = seen["around"].float() / 255 if "around" in seen else visible
    directions = seen.get("around_directions", lit.rig)
    colours = _CAMERA.colours(generator)
    images, albedo = recoloured(lit.images, colours), recoloured(lit.albedo, colours)
    skin, side = classes[SKIN], classes.shape[-1]
    scale = MEAN_RADIANCE / _mean_over(albedo, skin)
    behind = 4 * recoloured(background(backgrounds, side, generator), colours) * lit.behind
    lit_skin = images[0] / _mean_over(images[0], skin)
    scene = lit_skin * _foreign_shadow(side, generator) + behind
    photo = _CAMERA.take(scene, torch.ones(()), generator)
    rows = int(seen.get("rows", side))
    photo = photo[:, torch.arange(side).clamp(max=rows - 1)]  # as a square beyond a photo's edge shows it
    shares = lit.shares.clone()
    shares[:, rows:] = 0
    shares[0, rows:] = 1
    normals, sides = seen["normals"].float(), seen.get("sides", torch.tensor(SIDES))
    inputs = PortraitInputs(
        image=photo / _mean_over(photo, skin) * MEAN_RADIANCE * even_shade_of(photo, classes),
        classes=classes,
        normals=normals,
        depth=seen["depth"].float(),
        covered=seen["covered"].float() / 255,
        reached=reached_by(directions, around, side),
        own=own_shading(photo, classes, normals, directions, around, float(sides)),
    )
    sample = PortraitSample(
        inputs=inputs,
        lights=lit.rig[lit.chosen],
        visible=visible[lit.chosen],
        targets=(images[1:] * scale).clamp(max=_BRIGHTEST),
        rig=lit.rig,
        rig_visible=visible,
        weights=lit.weights,
        original=images[0] * scale,
        albedo=albedo * scale,
        true_normals=normals if lit.normals is None else lit.normals,
        shares=shares,
        labelled=torch.tensor(float(lit.normals is not None)),
    )
    batched = sample.each(lambda values: values[None])
    return mirrored(batched) if torch.rand((), generator=generator) < 0.5 else batched


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def draw_targets(rig: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw indices [count] of lights of a rig [L, 3]: as in photos, and some that make rims."""
    azimuth, elevation = direction_to_azel(rig)
    low, high = _BACK_EL_DEG
    behind = (azimuth.abs() > _BACK_AZ_DEG) & (elevation > low) & (elevation < high)
    usual = in_front(rig)
    more = _BACK * usual.sum() / behind.sum().clamp_min(1)
    return torch.multinomial(usual + more * behind, count, generator=generator)


def source_light(rig: Tensor, generator: torch.Generator) -> Tensor:
    """Draw weights [L, 3] of the photo's light."""
    return draw_photo_light(rig, generator, _KEY_LIGHT)


def _mean_over(image: Tensor, weight: Tensor) -> Tensor:
    """Mean of an image [3, S, S] under weights [S, S]."""
    return ((image.mean(0) * weight).sum() / weight.sum().clamp_min(1e-3)).clamp_min(1e-6)


def _foreign_shadow(side: int, generator: torch.Generator) -> Tensor:
    """Draw the share [3, S, S] of light that something outside the photo lets pass, often all of it.

    A straight or round edge of any softness; what passes has a colour.
    """
    uniform = Uniform(generator)
    if torch.rand((), generator=generator) > _SHADOWED:
        return torch.ones(3, side, side)
    at = torch.linspace(-1, 1, side)
    y, x = torch.meshgrid(at, at, indexing="ij")
    angle, near, bend = uniform(0, 2 * math.pi), uniform(-0.5, 0.5), uniform(-0.6, 0.6)
    along, across = turned(x, y, angle)
    distance = along - near + bend * across.square()
    softness = torch.exp(uniform(math.log(0.01), math.log(0.4)))
    passes = uniform(0.15, 0.8) * torch.exp(uniform(-0.15, 0.15, 3, 1, 1))
    return torch.lerp(passes, torch.ones(3, 1, 1), torch.sigmoid(distance / softness))


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
