"""Features in which pictures and textures are compared (paper, 'Loss Functions').

V_f is the trunk of VGG-16 (Simonyan and Zisserman, *Very deep convolutional networks for large-scale image
recognition*, 2015, configuration D) with ImageNet's weights, and is never trained here. S_f is the same
trunk, narrower where the settings say so, under a head that says where the light of a texture stands; it is
trained (`training/light_features_objective.py`), then frozen like V_f.

Both read scene-linear Rec.709, encode it to sRGB as ImageNet's pictures are, and normalise by ImageNet's mean
and deviation. The exposure is the caller's: white at 1; what is brighter goes on above the encoded 1.

LPIPS: how different two pictures look, by the features of VGG-16 (version 0.1).

Zhang et al., *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, CVPR 2018, the form
'lin' on VGG. The published code takes encoded pictures in -1..1 and scales them by shift -.030 -.088 -.188
and scale .458 .448 .450; in 0..1 that is ImageNet's mean and deviation, so V_f's own first step serves.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Each convolution's place in torchvision's `features`, and its channels.
CONVOLUTIONS = (
    *((0, 64), (2, 64), (5, 128), (7, 128), (10, 256), (12, 256), (14, 256)),
    *((17, 512), (19, 512), (21, 512), (24, 512), (26, 512), (28, 512)),
)
_POOLS = (4, 9, 16, 23)
FEATURE_LAYERS = {"conv1_2": 3, "conv2_2": 8, "conv3_3": 15}  # where the ReLU of each stands; V_f's and S_f's
LPIPS_LAYERS = FEATURE_LAYERS | {"conv4_3": 22, "conv5_3": 29}  # what LPIPS sees

IMAGENET_MEAN = (0.485, 0.456, 0.406)  # of encoded RGB in 0..1, as torchvision's weights were trained
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


class Layered(Protocol):
    """V_f or S_f."""

    def layers(self, linear: Tensor) -> list[Tensor]:
        """Features of linear pictures [B, 3, H, W] after the ReLU of each of `FEATURE_LAYERS`."""


def feature_distance(net: Layered, prediction: Tensor, target: Tensor) -> Tensor:
    """Squared distance of features, summed over the layers [B]; prediction and target [B, 3, H, W] linear.

    One term of the paper's L_I (with V_f) or L_L (with S_f). The paper leaves open whether a layer's squared
    norm is a sum or a mean: here it is the mean over the layer's elements, so that a weight means the same at
    every size. No gradient goes to `target`. Mask both before, with the same mask.
    """
    with torch.no_grad():
        wanted = net.layers(target)
    differences = [a.float() - b.float() for a, b in zip(net.layers(prediction), wanted, strict=True)]
    return torch.stack([d.square().mean((1, 2, 3)) for d in differences]).sum(0)


class VggFeatures(nn.Module):
    """VGG-16 up to conv3_3, or deeper; its tensors have torchvision's names, `features.N.weight` `.bias`."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, width: float = 1.0, wanted: Mapping[str, int] = FEATURE_LAYERS) -> None:
        """`width` scales the channels of every layer, up to 4 times; 1 is VGG-16. `wanted`: what is given."""
        super().__init__()
        if not 0 < width <= 4:
            raise ValueError(f"a width of {width}")
        channels = {place: max(1, round(count * width)) for place, count in CONVOLUTIONS}
        modules: list[nn.Module] = []
        entering = 3
        for place in range(max(wanted.values()) + 1):
            if place in channels:
                modules.append(_convolution(entering, channels[place]))
                entering = channels[place]
            else:
                modules.append(nn.MaxPool2d(2) if place in _POOLS else nn.ReLU(inplace=True))
        self.features = nn.Sequential(*modules)
        self.out_channels = entering
        self._wanted = {place: channels[place - 1] for place in sorted(wanted.values())}
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGENET_DEVIATION).view(3, 1, 1), persistent=False)

    def layer_channels(self) -> list[int]:
        """The channels of each layer that is given."""
        return list(self._wanted.values())

    def layers(self, linear: Tensor) -> list[Tensor]:
        """Features [B, C, H / s, W / s], s = 1, 2, 4 .., of linear pictures [B, 3, H, W]: those wanted."""
        x = (encode_display(linear.float()) - self.mean) / self.deviation
        found = []
        for place, module in enumerate(self.features):
            x = module(x)
            if place in self._wanted:
                found.append(x)
        return found

    def load_published(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the trunk out of a VGG-16's weights by torchvision's names; other layers are passed over.

        Raises ValueError in words where a layer is missing or is no VGG-16's.
        """
        own = self.state_dict()
        for name, tensor in own.items():
            given = tensors.get(name)
            if not isinstance(given, Tensor):
                raise ValueError(f"it has no {name}")
            if given.shape != tensor.shape or not given.is_floating_point():
                raise ValueError(f"its {name} is {_words(given)}, not {_words(tensor)}")
            if not given.isfinite().all():
                raise ValueError(f"its {name} holds values that are not finite")
        self.load_state_dict({name: tensors[name] for name in own})


@dataclass(frozen=True)
class LightSettings:
    """S_f: the default's is cheap on a CPU at 128 px; `LightSettings(width=1.0)` is VGG-16's own trunk."""

    width: float = 0.25
    grid: int = 8  # the side to which conv3_3 is pooled before the head: where things are lit tells the light
    hidden: int = 128


class LightNetwork(nn.Module):
    """S_f: a texture lit by one light -> the light's direction, in the head's own frame.

    A texture does not show how the head is turned, so the direction is in the head frame (DESIGN, 'Axes').
    """

    def __init__(self, settings: LightSettings = LightSettings()) -> None:
        super().__init__()
        self.settings = settings
        self.trunk = VggFeatures(settings.width)
        self.pool = nn.AdaptiveAvgPool2d(settings.grid)
        self.head = nn.Sequential(
            nn.Linear(self.trunk.out_channels * settings.grid**2, settings.hidden),
            nn.ReLU(),
            nn.Linear(settings.hidden, 3),
        )

    def forward(self, textures: Tensor) -> Tensor:
        """Unit directions [B, 3] toward the light of linear textures [B, 3, T, T], zero where unseen."""
        deepest = self.trunk.layers(textures)[-1]
        return F.normalize(self.head(self.pool(deepest).flatten(1)).float(), dim=-1)

    def layers(self, linear: Tensor) -> list[Tensor]:
        """The trunk's; see `VggFeatures.layers`."""
        return self.trunk.layers(linear)

    def as_metadata(self) -> dict[str, Any]:
        """Form and settings, for a checkpoint."""
        return {"form": "vgg", **asdict(self.settings)}

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> Self:
        """An untrained network of these; raises KeyError, TypeError or ValueError where they make none."""
        return cls(LightSettings(**{name: value for name, value in metadata.items() if name != "form"}))


def encode_display(linear: Tensor) -> Tensor:
    """IEC 61966-2-1 of any shape, with a gradient everywhere; `colour.linear_to_srgb` for 0 and above.

    Below zero, where a prediction may stray and no picture is, its straight part goes on.
    """
    curved = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def _convolution(channels_in: int, channels_out: int) -> nn.Conv2d:
    convolution = nn.Conv2d(channels_in, channels_out, 3, padding=1)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
    nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
    return convolution


def _words(tensor: Tensor) -> str:
    return f"{' x '.join(map(str, tensor.shape))} {str(tensor.dtype).removeprefix('torch.')}"


SMALLEST_PX = 16  # below it the last layers have nothing to see
_EPSILON = 1e-10  # the published code's, beside the length


class Lpips(nn.Module):
    """The distance of pictures; VGG-16's tensors are `trunk.features.N`, the heads `heads.N` [C]."""

    def __init__(self, width: float = 1.0) -> None:
        """`width` scales the channels, for tests; 1 is what is published."""
        super().__init__()
        self.trunk = VggFeatures(width, LPIPS_LAYERS)
        self.heads = nn.ParameterList([torch.ones(count) / count for count in self.trunk.layer_channels()])

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """LPIPS [B] of scene-linear pictures [B, 3, H, W], at least 16 px a side; they are encoded."""
        if min(first.shape[-2:]) < SMALLEST_PX or first.shape != second.shape:
            raise ValueError(f"pictures {tuple(first.shape)} and {tuple(second.shape)}")
        total = first.new_zeros(len(first))
        layers = zip(self.trunk.layers(first), self.trunk.layers(second), self.heads, strict=True)
        for a, b, head in layers:
            squared = (_unit(a) - _unit(b)).square()
            total = total + torch.einsum("bchw,c->bhw", squared, head).mean((1, 2))
        return total

    def load_heads(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the heads by the published names, `linN.model.1.weight` [1, C, 1, 1].

        Raises ValueError in words where one is missing or is none.
        """
        found = []
        for place, head in enumerate(self.heads):
            name = f"lin{place}.model.1.weight"
            given = tensors.get(name)
            if not isinstance(given, Tensor):
                raise ValueError(f"it has no {name}")
            if given.shape != (1, len(head), 1, 1) or not given.is_floating_point():
                raise ValueError(f"its {name} is {' x '.join(map(str, given.shape))} of {given.dtype}")
            if not (given.isfinite() & (given >= 0)).all():
                raise ValueError(f"its {name} holds values below 0 or not finite")
            found.append(given.flatten())
        with torch.no_grad():
            for head, values in zip(self.heads, found, strict=True):
                head.copy_(values)


def _unit(features: Tensor) -> Tensor:
    """Features [B, C, H, W] of length 1 at each place; 0 where there are none."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + _EPSILON)
