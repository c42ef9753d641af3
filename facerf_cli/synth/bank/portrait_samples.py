"""Training samples of whole portraits: a photo in a random light, and the same person under single lights."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.portrait import (
    SKIN,
    PortraitInputs,
    mirrored_harmonics,
    mirrored_x,
    reached_by,
)
from facerf_cli.portrait.proxy import own_shading
from facerf_cli.synth.bank.face_crops import gaussian_blurred
from facerf_cli.synth.bank.portraits import background_of
from facerf_cli.synth.bank.texture_samples import draw_light, draw_target_lights
from facerf_cli.synth.bank.transport import load_view, seen_path
from facerf_cli.synth.portraits import albedo_of, images_under
from facerf_cli.synth.random_fields import Uniform

_LAMP_SHARE = 0.3  # of photos, lit by one lamp in near darkness
_GREY = 0.2  # share of grey photos
SMALL = 4  # pixels along each side that are averaged where the photo's own light is summed
_EMPTY_BYTES = 1000  # a file without tensors is smaller
_BRIGHTEST = 8.0  # of targets; brighter highlights are clipped


@dataclass(frozen=True)
class PortraitSample:
    """Photos of B people, what is seen in them (`PortraitInputs`), and T target images of each.

    `lights` [B, T, 3] and `visible` [B, T, s, s] are of the targets [B, T, 3, S, S]; `rig` [B, L, 3],
    `rig_visible` [B, L, s, s] and `weights` [B, L, 3] of the photo's own light, `own` [B, 3, S, S] the photo
    without noise; albedo, true_normals [B, 3, S, S], known where `labelled` [B] is 1; shares [B, C, S, S] of
    the true classes.
    """

    image: Tensor
    classes: Tensor
    normals: Tensor
    depth: Tensor
    covered: Tensor
    reached: Tensor
    own_shading: Tensor
    lights: Tensor
    visible: Tensor
    targets: Tensor
    rig: Tensor
    rig_visible: Tensor
    weights: Tensor
    own: Tensor
    albedo: Tensor
    true_normals: Tensor
    shares: Tensor
    labelled: Tensor

    @property
    def inputs(self) -> PortraitInputs:
        """Inputs of the network."""
        names = ("image", "classes", "normals", "depth", "covered", "reached", "own_shading")
        return PortraitInputs(*(getattr(self, name) for name in names))

    def to(self, device: torch.device) -> "PortraitSample":
        """Move the sample to `device`."""
        return PortraitSample(*(getattr(self, field.name).to(device) for field in fields(self)))


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
        for path in sorted(folder.glob("[0-9]*.safetensors")):
            if seen_path(path).exists() and seen_path(path).stat().st_size > _EMPTY_BYTES:
                people.setdefault(path.stem.split("_")[0], []).append(path)
        if not people:
            raise InputError(f"{folder}: no portraits; make them with `facerf train --stage portrait`")
        self.views = list(people.values())
        self.backgrounds = backgrounds
        self.provenance = provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """Indices of the people to train on, and of the first `held_out` ones."""
        return list(range(held_out, len(self.views))), list(range(held_out))

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
    """A person under the light of a photo, and under T lights of a rig.

    images [1 + T, 3, S, S]; weights [L, 3] of the rig [L, 3] light the first, each of the lights `chosen`
    [T] one of the others. albedo [3, S, S], or what stands for it; normals [3, S, S], None where nobody
    knows them; shares [C, S, S] of the classes; behind [S, S], the share of what lies behind the person.
    """

    images: Tensor
    albedo: Tensor
    normals: Tensor | None
    shares: Tensor
    behind: Tensor
    rig: Tensor
    weights: Tensor
    chosen: Tensor


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
    sample = PortraitSample(
        image=photo / _mean_over(photo, skin) * MEAN_RADIANCE,
        classes=classes,
        normals=normals,
        depth=seen["depth"].float(),
        covered=seen["covered"].float() / 255,
        reached=reached_by(directions, around, side),
        own_shading=own_shading(photo, classes, normals, directions, around),
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
    batched = PortraitSample(*(getattr(sample, field.name)[None] for field in fields(sample)))
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
    if torch.rand((), generator=generator) >= _LAMP_SHARE:
        return draw_light(rig, generator)
    weights = torch.full((len(rig), 3), 0.01 * float(torch.rand((), generator=generator)) ** 2)
    weights[torch.multinomial((rig[:, 2] + 0.3).clamp_min(0), 1, generator=generator)] += 1.0
    return weights


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
    values = {}
    for field in fields(sample):
        value = getattr(sample, field.name)
        values[field.name] = value.flip(-1) if value.dim() > 3 else value
    for name in ("normals", "true_normals"):
        values[name] = mirrored_x(values[name])
    for name in ("lights", "rig"):
        values[name] = values[name] * torch.tensor([-1.0, 1, 1])
    values["reached"] = mirrored_harmonics(values["reached"])
    return PortraitSample(**values)
