"""Training samples of whole portraits: a photo in a random light, and the same person under single lights."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.sh import mirror_signs
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.portrait import SKIN, PortraitInputs, reached_by
from facerf_cli.portrait.own_shading import own_shading
from facerf_cli.synth.backgrounds import background_of
from facerf_cli.synth.face_crops import blurred
from facerf_cli.synth.portraits import albedo_of, images_under
from facerf_cli.synth.random_fields import Uniform
from facerf_cli.synth.texture_samples import draw_light, draw_target_lights
from facerf_cli.synth.transport_bank import load_view, seen_path

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
    without noise; albedo, true_normals [B, 3, S, S]; shares [B, C, S, S] of the true classes.
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

    @property
    def inputs(self) -> PortraitInputs:
        """Inputs of the network."""
        names = ("image", "classes", "normals", "depth", "covered", "reached", "own_shading")
        return PortraitInputs(*(getattr(self, name) for name in names))

    def to(self, device: torch.device) -> "PortraitSample":
        """Move the sample to `device`."""
        return PortraitSample(*(getattr(self, field.name).to(device) for field in fields(self)))


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
        view, seen = load_view(path), load_file(seen_path(path))
        surface = view.looks[_below(len(view.looks), generator)]
        rig = view.portrait.directions
        weights = _source_light(rig, generator)
        chosen = draw_target_lights(rig, targets, generator)
        single = torch.eye(len(rig))[chosen, :, None].expand(-1, -1, 3)
        images = images_under(view.portrait, surface, torch.cat([weights[None], single]))
        albedo, normals = albedo_of(view.portrait, surface)
        classes = seen["classes"].float() / 255
        visible = seen["visible"].float() / 255
        uniform = Uniform(generator)
        balance = torch.exp(uniform(-0.12, 0.12, 3, 1, 1))
        images, albedo = images * balance, albedo * balance
        if torch.rand((), generator=generator) < _GREY:
            images, albedo = (x.mean(-3, keepdim=True).expand_as(x) for x in (images, albedo))
        skin = classes[SKIN]
        scale = MEAN_RADIANCE / _mean_over(albedo, skin)
        exposed = images[0] / _mean_over(images[0], skin)
        stored = self.backgrounds[_below(len(self.backgrounds), generator)]
        background = 4 * background_of(stored, images.shape[-1], generator)
        photo = _as_taken(exposed + (1 - view.alpha) * background, generator)
        side = classes.shape[-1]
        sample = PortraitSample(
            image=photo / _mean_over(photo, skin) * MEAN_RADIANCE,
            classes=classes,
            normals=seen["normals"].float(),
            depth=seen["depth"].float(),
            covered=seen["covered"].float() / 255,
            reached=reached_by(rig, visible, side),
            own_shading=own_shading(photo, classes, seen["normals"].float(), rig, visible),
            lights=rig[chosen],
            visible=visible[chosen],
            targets=(images[1:] * scale).clamp(max=_BRIGHTEST),
            rig=rig,
            rig_visible=visible,
            weights=weights,
            own=images[0] * scale,
            albedo=albedo * scale,
            true_normals=normals,
            shares=view.portrait.classes.permute(2, 0, 1).float() / 255,
        )
        batched = PortraitSample(*(getattr(sample, field.name)[None] for field in fields(sample)))
        return mirrored(batched) if torch.rand((), generator=generator) < 0.5 else batched


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def _source_light(rig: Tensor, generator: torch.Generator) -> Tensor:
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
        image = blurred(image, float(uniform(0.3, 1.2)))
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
        values[name] = values[name] * torch.tensor([-1.0, 1, 1]).view(1, 3, 1, 1)
    for name in ("lights", "rig"):
        values[name] = values[name] * torch.tensor([-1.0, 1, 1])
    signs = mirror_signs(values["reached"].shape[1])
    values["reached"] = values["reached"] * signs.view(1, -1, 1, 1)
    return PortraitSample(**values)
