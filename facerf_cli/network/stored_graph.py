"""Networks stored with their operators: MediaPipe's (`tools/mediapipe_weights.py`).

A step of the stored graph is `[operator, inputs, output, settings]`: inputs are numbers of earlier outputs (0
is the image) or names of weights. Values of four dimensions are [B, C, H, W].
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch import Tensor, nn

from facerf_cli.network.parsing import ParsingNetwork

LICENCE = "Apache-2.0, (c) The MediaPipe Authors (Google); trained on photos of real people"
ASSET = Path(__file__).parents[1] / "assets" / "mediapipe.safetensors"


class StoredGraph(nn.Module):
    """Network of the asset, selected by name; its operators run in sequence.

    `forward` takes images [B, 3, H, W] float32 with the size and range of the network's training, on any
    device, and returns the outputs by name, on the CPU.
    """

    def __init__(self, name: str, path: Path = ASSET) -> None:
        super().__init__()
        with safe_open(path, framework="pt") as file:
            self.graph = json.loads(file.metadata()[name])
            self.constants = {
                key: file.get_tensor(key).float() for step in self.graph["steps"] for key in _names(step[1])
            }

    @property
    def device(self) -> torch.device:
        return next(iter(self.constants.values())).device

    def _apply(self, function: Callable[[Tensor], Tensor], recurse: bool = True) -> "StoredGraph":
        self.constants = {key: function(tensor) for key, tensor in self.constants.items()}
        return self

    @torch.inference_mode()
    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """See the class."""
        # processors convolve faster in this format
        values: dict[int | str, Any] = {0: images.to(self.device, memory_format=torch.channels_last)}
        values.update(self.constants)
        for operator, inputs, output, settings in self.graph["steps"]:
            values[output] = OPERATORS[operator](*(values[key] for key in inputs), **settings)
            for used in self.graph["last_use"].get(str(output), ()):
                del values[used]
        return {name: values[number].cpu() for name, number in self.graph["outputs"].items()}


@dataclass(frozen=True)
class PeopleNetworks:
    """Networks that find people in a photo and segment them.

    MediaPipe's detect near and far faces, fit the mesh of a face, segment people, and detect bodies; facerf's
    classifies a person's pixels.
    """

    parsing: ParsingNetwork
    near_faces: StoredGraph
    far_faces: StoredGraph
    face_mesh: StoredGraph
    person: StoredGraph
    body: StoredGraph


@cache  # loaded once per device
def mediapipe_networks(device: torch.device) -> tuple[StoredGraph, ...]:
    """Load MediaPipe's networks on a device, in the order of `PeopleNetworks`."""
    names = [field.name for field in fields(PeopleNetworks)][1:]
    return tuple(StoredGraph(name).to(device) for name in names)


def _names(inputs: list[int | str]) -> list[str]:
    return [key for key in inputs if isinstance(key, str)]


def _convolve(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    stride: list[int],
    pad: list[int],
    dilation: list[int],
    groups: int,
) -> Tensor:
    return F.conv2d(F.pad(x, pad) if any(pad) else x, weight, bias, stride, 0, dilation, groups)


def _convolve_transposed(
    x: Tensor, weight: Tensor, bias: Tensor, *, stride: list[int], crop: list[int], size: list[int]
) -> Tensor:
    """Return the result cropped to `size`, starting at row and column `crop`."""
    (top, left), (height, width) = crop, size
    return F.conv_transpose2d(x, weight, bias, stride)[:, :, top : top + height, left : left + width]


def _largest(x: Tensor, *, kernel: list[int], stride: list[int], pad: list[int]) -> Tensor:
    return F.max_pool2d(F.pad(x, pad, value=-torch.inf) if any(pad) else x, kernel, stride)


def _mean(x: Tensor, *, kernel: list[int], stride: list[int]) -> Tensor:
    return F.avg_pool2d(x, kernel, stride)


def _resize(x: Tensor, *, size: list[int], align_corners: bool, half_pixel: bool) -> Tensor:
    """Resize bilinearly; torch lacks the case without a flag: samples at their index times the scale."""
    if align_corners or half_pixel:
        return F.interpolate(x, tuple(size), mode="bilinear", align_corners=align_corners)
    for axis, count in ((2, size[0]), (3, size[1])):
        last = x.shape[axis] - 1
        at = (torch.arange(count, device=x.device) * (x.shape[axis] / count)).clamp(0, last)
        low = at.floor().long()
        share = (at - low).reshape([-1 if other == axis else 1 for other in range(4)])
        x = torch.lerp(x.index_select(axis, low), x.index_select(axis, (low + 1).clamp(max=last)), share)
    return x


def _depth_to_space(x: Tensor, *, block: int) -> Tensor:
    """Spread channels over blocks of pixels; the block's places are the outer part of the channels."""
    batch, channels, height, width = x.shape
    inner = channels // block**2
    spread = x.reshape(batch, block, block, inner, height, width).permute(0, 3, 4, 1, 5, 2)
    return spread.reshape(batch, inner, height * block, width * block)


def _flatten(x: Tensor, *, shape: list[int]) -> Tensor:
    """Return values in the order rows, columns, channels, as [B, *shape]."""
    last = x.permute(0, 2, 3, 1) if x.dim() == 4 else x
    return last.reshape(len(x), *shape)


def _to_image(x: Tensor, *, shape: list[int]) -> Tensor:
    """Return values [B, ...] in the order rows, columns, channels as an image [B, C, H, W]."""
    return x.reshape(len(x), *shape).permute(0, 3, 1, 2)


def _turned_crop(points: Tensor, *, scale: list[float], size: list[int], **places: Any) -> Tensor:
    """Return the matrix [B, 2, 3] from pixels of an upright crop to pixels of the points [B, N, 3].

    `places`: indices of the points `inside` the crop and of the points `left` and `right` on its horizontal
    axis, and an additional rotation in radians, `turn_rad`.
    """
    across_x, across_y = (points[:, places["right"], :2] - points[:, places["left"], :2]).unbind(-1)
    angle = torch.atan2(across_y, across_x) - places["turn_rad"]
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], 1)  # from crop to image
    upright = points[:, places["inside"], :2] @ turn
    low, high = upright.amin(1), upright.amax(1)
    side = points.new_tensor(size)
    linear = turn * (points.new_tensor(scale) * (high - low) / side)[:, None]
    offset = turn @ ((low + high) / 2)[..., None] - linear @ (side / 2)[:, None]
    return torch.cat([linear, offset], -1)


def _crop(x: Tensor, matrix: Tensor, *, size: list[int]) -> Tensor:
    """Crop a map of features to [B, C, *size]; values outside the map are 0."""
    extent = x.new_tensor([x.shape[3], x.shape[2]])
    v, u = (torch.arange(count, device=x.device) + 0.5 for count in size)
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    at = grid @ matrix[:, None, :, :2].transpose(2, 3) + matrix[:, None, None, :, 2]
    inside = ((at >= 0.5) & (at <= extent - 0.5)).all(-1)[:, None]
    return F.grid_sample(x, at / extent * 2 - 1, align_corners=False) * inside


def _uncrop(points: Tensor, matrix: Tensor) -> Tensor:
    """Map points [B, N, 2 or 3] of a crop to the original image; a third coordinate stays unchanged."""
    place = points[..., :2] @ matrix[..., :2].transpose(1, 2) + matrix[:, None, :, 2]
    return torch.cat([place, points[..., 2:]], -1)


OPERATORS: dict[str, Callable[..., Tensor]] = {
    "convolve": _convolve,
    "convolve_transposed": _convolve_transposed,
    "max_pool": _largest,
    "mean_pool": _mean,
    "add": torch.add,
    "multiply": torch.mul,
    "prelu": lambda x, slope: torch.where(x >= 0, x, x * slope),
    "relu": F.relu,
    "relu6": F.relu6,
    "sigmoid": torch.sigmoid,
    "hard_swish": F.hardswish,
    "resize": _resize,
    "pad": lambda x, pad: F.pad(x, pad),
    "depth_to_space": _depth_to_space,
    "flatten": _flatten,
    "to_image": _to_image,
    "join": lambda *parts, axis: torch.cat(parts, axis),
    "first": lambda x, count, axis: x.narrow(axis, 0, count),
    "turned_crop": _turned_crop,
    "crop": _crop,
    "uncrop": _uncrop,
}
