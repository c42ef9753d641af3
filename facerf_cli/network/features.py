"""Networks whose features compare images and textures: V_f, S_f and LPIPS, all with the trunk of VGG-16.

V_f (paper, 'Loss Functions') is the trunk of VGG-16 (Simonyan and Zisserman, *Very deep convolutional
networks for large-scale image recognition*, 2015, configuration D) with ImageNet's weights; it is never
trained here. S_f is the same trunk, possibly narrower, with a head that regresses the direction of the light
on a texture; it is trained (`training/light_features.py`), then frozen like V_f. LPIPS version 0.1 is the
form 'lin' on VGG (Zhang et al., *The Unreasonable Effectiveness of Deep
Features as a Perceptual Metric*, CVPR 2018).

All of them read scene-linear Rec.709 at the caller's exposure, with white at 1; values above 1 are kept. They
encode it to sRGB, as ImageNet's images are, and normalise it by ImageNet's mean and deviation. The published
code of LPIPS takes encoded images in -1..1, shifted by -.030 -.088 -.188 and scaled by .458 .448 .450, which
is the same normalisation.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.base import Count, Grid, SavedNetwork, Side, VggWidth
from facerf_cli.network.inputs import resize

# Index of each convolution in torchvision's `features`, and its channels.
CONVOLUTIONS = (
    *((0, 64), (2, 64), (5, 128), (7, 128), (10, 256), (12, 256), (14, 256)),
    *((17, 512), (19, 512), (21, 512), (24, 512), (26, 512), (28, 512)),
)
_POOLS = (4, 9, 16, 23)  # indices of the pooling layers
FEATURE_LAYERS = {"conv1_2": 3, "conv2_2": 8, "conv3_3": 15}  # index of the ReLU of each layer of V_f and S_f
LPIPS_LAYERS = FEATURE_LAYERS | {"conv4_3": 22, "conv5_3": 29}  # and of LPIPS
IMAGENET_MEAN = (0.485, 0.456, 0.406)  # of encoded RGB in 0..1, used to train torchvision's weights
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
SMALLEST_PX = 16  # least side of images for LPIPS, so that the last layers have pixels
_EPSILON = 1e-10  # added to lengths of features, like in the published code of LPIPS


class FeatureNetwork(Protocol):
    """V_f or S_f."""

    def layers(self, linear: Tensor) -> list[Tensor]:
        """Return features of linear images [B, 3, H, W] after the ReLU of each of `FEATURE_LAYERS`."""


def feature_distance(
    net: FeatureNetwork, prediction: Tensor, target: Tensor, powers: Tensor | None = None
) -> Tensor:
    """Return the squared distance [B] of features, summed over the layers; images [B, 3, H, W] are linear.

    It is one term of the paper's L_I (with V_f) or L_L (with S_f). The paper does not specify whether a
    layer's squared norm is a sum or a mean. Here it is the mean over the layer's elements, so that weights do
    not depend on the size, divided by `powers` [layers] (see `layer_powers`) unless they are None. No
    gradient flows to `target`. Mask both images first, with the same mask.
    """
    with torch.no_grad():
        wanted = net.layers(target)
    differences = [a.float() - b.float() for a, b in zip(net.layers(prediction), wanted, strict=True)]
    squared = torch.stack([d.square().mean((1, 2, 3)) for d in differences], -1)
    return (squared if powers is None else squared / powers).sum(-1)


@torch.no_grad()
def layer_powers(net: FeatureNetwork, images: Tensor) -> Tensor:
    """Return mean squares [layers] of a network's features on linear images [B, 3, H, W].

    Distances relative to them give every layer and every network the same weight.
    """
    return torch.stack([layer.float().square().mean() for layer in net.layers(images)])


class VggFeatures(nn.Module):
    """VGG-16 up to conv3_3, or deeper; tensors have torchvision's names, `features.N.weight` and `.bias`."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, width: float = 1.0, wanted: Mapping[str, int] = FEATURE_LAYERS) -> None:
        """Make the trunk up to the last `wanted` layer; `width`, up to 4, scales all channels."""
        super().__init__()
        if not 0 < width <= 4:
            raise ValueError(f"a width of {width}")
        channels = {index: max(1, round(count * width)) for index, count in CONVOLUTIONS}
        modules: list[nn.Module] = []
        entering = 3
        for index in range(max(wanted.values()) + 1):
            if index in channels:
                modules.append(_convolution(entering, channels[index]))
                entering = channels[index]
            else:
                modules.append(nn.MaxPool2d(2) if index in _POOLS else nn.ReLU(inplace=True))
        self.features = nn.Sequential(*modules)
        self.out_channels = entering
        self.layer_channels = {index: channels[index - 1] for index in sorted(wanted.values())}
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGENET_DEVIATION).view(3, 1, 1), persistent=False)

    def layers(self, linear: Tensor) -> list[Tensor]:
        """Return features [B, C, H / s, W / s], s = 1, 2, 4 .., of the wanted layers, of [B, 3, H, W]."""
        x = (encode_display(linear.float()) - self.mean) / self.deviation
        features = []
        for index, module in enumerate(self.features):
            x = module(x)
            if index in self.layer_channels:
                features.append(x)
        return features

    def load_published(self, tensors: Mapping[str, Tensor]) -> None:
        """Load the trunk from a VGG-16's weights with torchvision's names, ignoring other layers.

        Raises ValueError that names a missing or unsuitable layer.
        """
        own = self.state_dict().items()
        self.load_state_dict({name: _fitting(tensors, name, tensor) for name, tensor in own})


def encode_display(linear: Tensor) -> Tensor:
    """Encode linear values of any shape by IEC 61966-2-1, with a gradient everywhere.

    It agrees with `colour.linear_to_srgb` from 0 up. Below 0, which predictions may reach, the linear segment
    of the curve continues.
    """
    curved = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def _convolution(channels_in: int, channels_out: int) -> nn.Conv2d:
    convolution = nn.Conv2d(channels_in, channels_out, 3, padding=1)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
    nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
    return convolution


def _fitting(tensors: Mapping[str, Tensor], name: str, like: Tensor) -> Tensor:
    """Return a published tensor; raises ValueError unless it is finite and has the shape of another."""
    tensor = tensors.get(name)
    if not isinstance(tensor, Tensor):
        raise ValueError(f"it has no {name}")
    if tensor.shape != like.shape or not tensor.is_floating_point():
        kind, needed = (f"{' x '.join(map(str, t.shape))} {t.dtype}" for t in (tensor, like))
        raise ValueError(f"its {name} is {kind}, not {needed}")
    if not tensor.isfinite().all():
        raise ValueError(f"its {name} contains values that are not finite")
    return tensor


@dataclass(frozen=True)
class LightSettings:
    """Sizes of S_f; the default is fast on a CPU, `width` 1 is the trunk of VGG-16.

    `side` is the side of the training textures; features are correct only at this side.
    """

    width: VggWidth = 0.25
    grid: Grid = 8  # side of the pooled conv3_3 before the head: bright places reveal the light
    hidden: Count = 128
    side: Side = 128


class TrainedFeatures(SavedNetwork):
    """Trunk of VGG-16 with a head of `outputs` numbers; the features of the trunk compare images."""

    form = "vgg"

    def __init__(self, settings: Any, outputs: int) -> None:
        """Make an untrained network; `settings` has the fields of `LightSettings`."""
        super().__init__(settings)
        self.trunk = VggFeatures(settings.width)
        self.pool = nn.AdaptiveAvgPool2d(settings.grid)
        self.head = nn.Sequential(
            nn.Linear(self.trunk.out_channels * settings.grid**2, settings.hidden),
            nn.ReLU(),
            nn.Linear(settings.hidden, outputs),
        )

    def regressed(self, images: Tensor) -> Tensor:
        """Return the head's outputs [B, outputs] for linear images [B, 3, H, W]."""
        outputs: Tensor = self.head(self.pool(self.layers(images)[-1]).flatten(1)).float()
        return outputs

    def layers(self, linear: Tensor) -> list[Tensor]:
        """Return features of the trunk at its side; see `VggFeatures.layers`."""
        return self.trunk.layers(resize(linear, self.settings.side))


class LightNetwork(TrainedFeatures):
    """S_f: regress the direction of the single light on a texture.

    The direction is in the head frame, because a texture does not show the head's pose.
    """

    kind_of_settings = LightSettings

    def __init__(self, settings: LightSettings = LightSettings()) -> None:
        super().__init__(settings, 3)

    def forward(self, textures: Tensor) -> Tensor:
        """Return unit directions [B, 3] toward the light for linear textures [B, 3, T, T], 0 where hidden."""
        return F.normalize(self.regressed(textures), dim=-1)


class Lpips(nn.Module):
    """Perceptual distance of images; its tensors are `trunk.features.N` (VGG-16) and `heads.N` [C]."""

    def __init__(self, width: float = 1.0) -> None:
        """Make an untrained network; `width` scales the channels, for tests: 1 is the published one."""
        super().__init__()
        self.trunk = VggFeatures(width, LPIPS_LAYERS)
        self.heads = nn.ParameterList(
            [torch.ones(count) / count for count in self.trunk.layer_channels.values()]
        )

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Return LPIPS [B] of scene-linear images [B, 3, H, W] with sides of at least 16 px."""
        if min(first.shape[-2:]) < SMALLEST_PX or first.shape != second.shape:
            raise ValueError(f"images {tuple(first.shape)} and {tuple(second.shape)}")
        total = first.new_zeros(len(first))
        layers = zip(self.trunk.layers(first), self.trunk.layers(second), self.heads, strict=True)
        for a, b, head in layers:
            squared = (_unit(a) - _unit(b)).square()
            total = total + torch.einsum("bchw,c->bhw", squared, head).mean((1, 2))
        return total

    def load_heads(self, tensors: Mapping[str, Tensor]) -> None:
        """Load the heads by their published names, `linN.model.1.weight` [1, C, 1, 1].

        Raises ValueError that names a missing or unsuitable head.
        """
        loaded = []
        for index, head in enumerate(self.heads):
            name = f"lin{index}.model.1.weight"
            loaded.append(_fitting(tensors, name, head.view(1, -1, 1, 1)))
            if (loaded[-1] < 0).any():
                raise ValueError(f"its {name} contains values below 0")
        with torch.no_grad():
            for head, values in zip(self.heads, loaded, strict=True):
                head.copy_(values.flatten())


def _unit(features: Tensor) -> Tensor:
    """Normalise features [B, C, H, W] to length 1 at each pixel; zero features stay 0."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + _EPSILON)


@dataclass(frozen=True)
class AppearanceSettings:
    """Number of people, side of the images, and sizes; `width` 1 is the trunk of VGG-16."""

    people: Count
    side: Side = 128
    width: VggWidth = 0.25
    grid: Grid = 8  # side to which conv3_3 is pooled before the head
    hidden: Count = 256


class AppearanceNetwork(TrainedFeatures):
    """Classify the person in an image, and regress the direction of its light."""

    kind_of_settings = AppearanceSettings

    def __init__(self, settings: AppearanceSettings) -> None:
        super().__init__(settings, settings.people + 3)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return scores of the people [B, P] and unit directions toward the light [B, 3], camera space."""
        outputs = self.regressed(images)
        return outputs[:, :-3], F.normalize(outputs[:, -3:], dim=-1)
