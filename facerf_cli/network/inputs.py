"""Parts that networks share: settings in checkpoints, precision, steps between a texture and their layers.

These are exposure, colour cast, roots, resizing and head pose.
"""

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Self, TypeVar

import torch
import torch.nn.functional as F
from pydantic import Field, TypeAdapter
from torch import Tensor, nn

from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
MEAN_RADIANCE = 0.25  # of the visible face once its exposure is divided out
_ROOT_OFFSET = 0.02  # keeps the slope of the root finite at black

_DECODER_CHANNELS = 220  # that a decoder holds at once for each light, at its working side
_TEXTURE_CHANNELS = 16  # that its output holds at once for each light, at the side of the texture
_ORDINARY_CAST = 2.0  # standard deviations within which a colour cast is left to the network
_BF16_CAPABILITY = 8  # of an NVIDIA GPU that computes in bfloat16
_NAMES = {"cpu": "processor", "cuda": "GPU"}
_GREY = 1e-4  # difference of the channels of a grey image, of its mean, left by resampling
_LEAST_DEVIATION = 0.02  # of a log ratio of colours: that of grey data would be 0


@dataclass(frozen=True)
class SourceColours:
    """Colours of the sources that a network was trained on.

    Mean and covariance of log(red / green) and log(blue / green) of the visible face's mean colour.
    """

    mean: tuple[float, float]
    covariance: tuple[tuple[float, float], tuple[float, float]]

    @staticmethod
    def of(colours: Tensor) -> "SourceColours":
        """Measure the mean colours [N, 3] of sources, scene-linear and positive, N > 1."""
        chroma = _chroma(colours.double())
        covariance = torch.cov(chroma.T) + _LEAST_DEVIATION**2 * torch.eye(2, dtype=chroma.dtype)
        (a, b), (_, c) = covariance.tolist()
        red, blue = chroma.mean(0).tolist()
        return SourceColours((red, blue), ((a, b), (b, c)))

    def as_metadata(self) -> dict[str, Any]:
        """Numbers for a checkpoint."""
        return asdict(self)

    @staticmethod
    def from_metadata(metadata: Any) -> "SourceColours":
        """Read `as_metadata`; raises KeyError, TypeError or ValueError for anything else."""
        red, blue = (float(value) for value in metadata["mean"])
        (a, b), (c, d) = ((float(x), float(y)) for x, y in metadata["covariance"])
        if not (a > 0 and d > 0 and b == c and a * d > b * b and all(map(math.isfinite, (red, blue, a, d)))):
            raise ValueError(f"no colours of sources: {metadata}")
        return SourceColours((red, blue), ((a, b), (c, d)))


def exposure_of(texture: Tensor, visible: Tensor) -> Tensor:
    """Exposure of linear textures [B, 3, T, T]: divided by it, their visible mean is `MEAN_RADIANCE`.

    visible [B, 1, T, T] in 0..1; the result is [B, 1, 1, 1] and positive.
    """
    radiance = (texture.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    exposure = radiance / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) / MEAN_RADIANCE
    return exposure.clamp_min(1e-6)


def colour_cast(texture: Tensor, visible: Tensor, trained: SourceColours) -> Tensor:
    """Colour cast of the light on linear textures [B, 3, T, T], as far as it exceeds that of `trained`.

    visible [B, 1, T, T] in 0..1; the result is [B, 3, 1, 1] and positive. Divide textures by it: their mean
    radiance does not change. It is exactly 1 for ordinary photos. A colour further from the mean colour of
    training than `_ORDINARY_CAST` is moved within that distance, and the further it is the closer to the
    mean: the less usual the colour, the more certainly it is the light's.
    """
    mean = mean_colours(texture, visible)
    red, blue = (part - middle for part, middle in zip(_chroma(mean).unbind(1), trained.mean, strict=True))
    (a, b), (_, c) = trained.covariance
    # Mahalanobis distance, by the Cholesky factor of the covariance
    distance = torch.hypot(red / a**0.5, (blue - red * (b / a)) / (c - b * b / a) ** 0.5)
    chroma = torch.stack([red, blue], 1)
    inside = (_ORDINARY_CAST / distance.clamp_min(1e-6)) ** 2
    excess = chroma * (1 - inside).clamp_min(0)[:, None]
    cast = torch.stack([excess[:, 0], torch.zeros_like(excess[:, 0]), excess[:, 1]], 1).exp()
    cast = cast * (mean / cast).mean(1, keepdim=True) / mean.mean(1, keepdim=True)
    return cast.to(texture)[..., None, None]


def without_cast(texture: Tensor, visible: Tensor, trained: SourceColours | None) -> Tensor:
    """Divide textures by their `colour_cast`, as in training; unchanged where the colours are unknown."""
    return texture if trained is None else texture / colour_cast(texture.detach(), visible, trained)


def is_grey(image: Tensor) -> bool:
    """True for an image [3, ...] without colours; its person is predicted without colours, too."""
    return bool((image - image[:1]).abs().max() <= _GREY * image.mean())


def mean_colours(texture: Tensor, visible: Tensor) -> Tensor:
    """Mean colours [B, 3], positive, float64, of the visible texels; visible [B, 1, T, T] in 0..1."""
    seen = visible.sum((2, 3)).clamp_min(1e-6)
    return ((texture * visible).sum((2, 3)) / seen).clamp_min(1e-6).double()


def _chroma(colours: Tensor) -> Tensor:
    return (colours[:, ::2] / colours[:, 1:2]).log()


def to_root(radiance: Tensor) -> Tensor:
    """Compress radiance for a network or a loss: nearly its square root, 0 at 0, with a finite slope."""
    return (radiance + _ROOT_OFFSET**2).sqrt() - _ROOT_OFFSET


def from_root(root: Tensor) -> Tensor:
    """Invert `to_root`; 0 for negative roots."""
    return root.clamp_min(0) * (root + 2 * _ROOT_OFFSET)


def resize(x: Tensor, side: int) -> Tensor:
    """Resample [B, C, H, W] to a side: averaged if that is smaller, bilinear if it is larger."""
    if x.shape[-1] == side:
        return x
    if x.shape[-1] > side:
        blocks = x.shape[-1] // side
        if x.shape[-2:] == (side * blocks, side * blocks):  # the same, in half the time
            return F.avg_pool2d(x, blocks)
        return F.interpolate(x, (side, side), mode="area")
    return F.interpolate(x, (side, side), mode="bilinear", align_corners=False)


def head_rotation(mean_normals: Tensor, normals: Tensor) -> Tensor:
    """Estimate head_to_camera [B, 3, 3], which best rotates the mean face's normals to those of a face.

    mean_normals [3, S, S] in the head frame, normals [B, 3, T, T] in camera space. The solution is that of
    the orthogonal Procrustes problem.
    """
    small = resize(normals, mean_normals.shape[-1])
    if small.device.type == "mps":  # Apple's GPUs have no doubles
        small = small.cpu()
    moment = torch.einsum("bcij,dij->bcd", small.double(), mean_normals.to(small.device).double())
    u, _, vt = torch.linalg.svd(moment)
    signs = moment.new_ones(len(moment), 3)
    signs[:, 2] = torch.det(u @ vt)
    return (u @ torch.diag_embed(signs) @ vt).to(normals)


def decoder_bytes(side: int, texels: int) -> int:
    """Memory of a reflectance decoder for one light of one face, for a texture of so many texels (T x T).

    It is that of the form default, by count of channels enough for the form paper, too.
    """
    return 4 * (_DECODER_CHANNELS * side**2 + _TEXTURE_CHANNELS * texels)


class Down(nn.Module):
    """Halve the side (except in the first), then apply a residual convolution."""

    def __init__(self, channels_in: int, channels_out: int, first: bool = False, groups: int = 4) -> None:
        super().__init__()
        self.enter = nn.Conv2d(channels_in, channels_out, 3, stride=1 if first else 2, padding=1)
        self.norm = nn.GroupNorm(groups, channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Features [B, C, H, W] to [B, C', H / 2, W / 2], or to the same side."""
        x = F.silu(self.norm(self.enter(x)))
        result: Tensor = x + F.silu(self.inner(x))
        return result


Count = Annotated[int, Field(ge=1, le=4096)]
Side = Annotated[int, Field(ge=8, le=4096)]  # pixels or texels
Grid = Annotated[int, Field(ge=1, le=64)]
VggWidth = Annotated[float, Field(gt=0, le=4)]  # a share of the channels of VGG-16
Landmarks = Annotated[int, Field(ge=68, le=256)]
Classes = Annotated[int, Field(ge=2, le=256)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1, max_length=12)]
WidthsOfFour = Annotated[  # for group normalisation
    tuple[Annotated[int, Field(ge=4, le=512, multiple_of=4)], ...], Field(min_length=3, max_length=6)
]
Blocks = Annotated[tuple[Annotated[int, Field(ge=0, le=8)], ...], Field(min_length=3, max_length=6)]


@dataclass(frozen=True)
class Batch:
    """Base of dataclasses whose fields are tensors [B, ...], or such dataclasses again."""

    def each(self, function: Callable[[Tensor], Tensor]) -> Self:
        """Apply a function to every tensor."""
        values = (getattr(self, field.name) for field in fields(self))
        return type(self)(*(x.each(function) if isinstance(x, Batch) else function(x) for x in values))

    def to(self, device: torch.device) -> Self:
        """Copy all tensors to `device`; a GPU goes on with its work meanwhile if they are pinned."""
        return self.each(lambda values: values.to(device, non_blocking=device.type == "cuda"))

    def pin_memory(self) -> Self:
        """The tensors in memory that a GPU reads by itself; the data loader calls this."""
        return self.each(torch.Tensor.pin_memory)

    def parts(self, count: int) -> list[Self]:
        """The samples in `count` batches of the same size."""
        return [self.each(lambda values: values.chunk(count)[part]) for part in range(count)]  # noqa: B023


Samples = TypeVar("Samples", bound=Batch)


def concatenate(samples: Sequence[Samples]) -> Samples:
    """Join samples into a batch."""
    parts = [[getattr(sample, field.name) for sample in samples] for field in fields(samples[0])]
    return type(samples[0])(*(concatenate(x) if isinstance(x[0], Batch) else torch.cat(x) for x in parts))


class SavedNetwork(nn.Module):
    """A network that a checkpoint describes by its form and its settings."""

    form: ClassVar[str] = "default"
    kind_of_settings: ClassVar[type[Any]]  # a dataclass

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    def as_metadata(self) -> dict[str, Any]:
        """Form and settings, for a checkpoint."""
        return {"form": self.form, **asdict(self.settings)}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> Self:
        """Make an untrained network; raises TypeError or ValueError if the settings make none."""
        kind = cls.kind_of_settings
        known = {field.name for field in fields(kind)}
        given = {name: value for name, value in metadata.items() if name != "form" or name in known}
        if unknown := sorted(given.keys() - known):
            raise TypeError(f"a network of this form has no {', '.join(unknown)}")
        return cls(TypeAdapter(kind).validate_json(json.dumps(given), strict=True))  # JSON's lists are tuples


def mixed_precision(device: torch.device, wanted: bool) -> torch.autocast:
    """Context in which a network computes in bfloat16, if that is `wanted`.

    A processor without instructions for bfloat16 emulates them and is a hundred times slower, and old GPUs
    lack them, too: there the network stays in float32, and a line says so once.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and _has_bf16(device))


@cache  # said once
def _has_bf16(device: torch.device) -> bool:
    has: bool = device.type not in ("cpu", "cuda")
    if device.type == "cpu":
        has = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if device.type == "cuda":
        has = torch.cuda.get_device_capability(device)[0] >= _BF16_CAPABILITY
    if not has:
        log.info("this %s has no instructions for bfloat16; networks stay in float32", _NAMES[device.type])
    return has
