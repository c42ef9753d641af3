"""Reflectance Network of this project: form `default`.

It predicts a texture under any single light from one texture (paper, 'Network Architecture'). It differs from
the paper's network in three ways that make it learn faster: the light also enters the decoder, as maps in UV
space (cosine, half vector, the mean face's shadow) and as feature-wise modulation; the output is
`source x gain + bias` in square-root space; and the network works at a fixed side, while gain and bias are
applied at the texture's side.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.base import Count, Down, Side, Widths
from facerf_cli.network.inputs import exposure_of, from_root, head_rotation, resize
from facerf_cli.network.reflectance import ReflectanceNetwork

_MAP_SIDE = 64  # of the stored normals and shadows of the mean face
_DARKEST = 1e-8  # least radiance, to keep the slope of the square root finite
_STEEP = 1e-3  # radiance below which gradients no longer grow
_LIGHT_MAPS = 4  # cosine, gloss, shadow and base gain
_LIGHT_FEATURES = 12  # numbers per light: camera and head direction, products of the latter
_CODE_CHANNELS = 96  # of the light code that modulates the decoder
_KERNEL_SHARPNESS = 70.0  # of the interpolation between the shadow maps of neighbouring lights


@dataclass(frozen=True)
class DefaultReflectanceSettings:
    """Channels of encoder and decoder at each halving of the working side, and other sizes.

    `rig_lights` is the number of lights whose shadows on the mean face are stored. If `normals` is False,
    zeros replace the normal maps (paper, 'Ablative Study').
    """

    side: Side = 128
    encoder_widths: Widths = (32, 64, 128, 192, 224, 256)
    decoder_widths: Widths = (20, 36, 64, 96, 128, 160)
    template_channels: Count = 8
    rig_lights: Count = 150
    normals: bool = True


@dataclass(frozen=True)
class DefaultEncoded:
    """B encoded faces: inputs of the decoder for any light, and the source for its output."""

    bottom: Tensor  # coarsest features
    skips: list[Tensor]  # from fine to coarse
    source_root: Tensor  # [B, 3, T, T] square root of the source over its exposure
    exposure: Tensor  # [B, 1, 1, 1] divisor of the source


class DefaultReflectanceNetwork(ReflectanceNetwork):
    """Predict OLAT textures, scene-linear and non-negative, from T_s, N_s, N_t and light directions."""

    kind_of_settings = DefaultReflectanceSettings
    mean_normals: Tensor
    mean_visibility: Tensor
    rig: Tensor

    def __init__(self, settings: DefaultReflectanceSettings = DefaultReflectanceSettings()) -> None:
        super().__init__(settings)
        enc, dec = settings.encoder_widths, settings.decoder_widths
        self.rig_lights = rig_lights = settings.rig_lights
        self.template = nn.Parameter(torch.empty(settings.template_channels, 32, 32))
        nn.init.normal_(self.template, std=0.1)
        widths = (7 + settings.template_channels, *enc)
        self.down = nn.ModuleList(
            Down(a, b, first=i == 0) for i, (a, b) in enumerate(zip(widths, enc, strict=False))
        )
        self.bottleneck = nn.Conv2d(enc[-1], dec[-1], 3, padding=1)
        self.light_code = nn.Sequential(
            nn.Linear(_LIGHT_FEATURES, _CODE_CHANNELS),
            nn.SiLU(),
            nn.Linear(_CODE_CHANNELS, _CODE_CHANNELS),
            nn.SiLU(),
        )
        coarser = (*dec[1:], dec[-1])
        self.up = nn.ModuleList(
            LitUp(coarser[i], dec[i], enc[i], coarsest=i == len(dec) - 1) for i in range(len(dec))
        )
        self.head = nn.Conv2d(dec[0], 6, 3, padding=1)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]
        self.register_buffer("mean_normals", torch.zeros(3, _MAP_SIDE, _MAP_SIDE))
        self.register_buffer(
            "mean_visibility", torch.zeros(rig_lights, _MAP_SIDE, _MAP_SIDE, dtype=torch.uint8)
        )
        self.register_buffer("rig", torch.zeros(rig_lights, 3))

    @property
    def has_mean_face(self) -> bool:
        """Whether `set_mean_face` has stored the mean face."""
        return bool(self.mean_normals.any())

    def set_mean_face(self, normals: Tensor, visibility: Tensor, directions: Tensor) -> None:
        """Store the mean face; see `ReflectanceNetwork`."""
        if len(directions) != len(self.rig):
            raise ValueError(
                f"the network stores the shadows of {len(self.rig)} lights, not of {len(directions)}"
            )
        size = (_MAP_SIDE, _MAP_SIDE)
        self.mean_normals.copy_(F.normalize(F.interpolate(normals[None], size, mode="area")[0], dim=0))
        self.mean_visibility.copy_((F.interpolate(visibility[None], size, mode="area")[0] * 255).round())
        self.rig.copy_(directions)

    def encode(self, texture: Tensor, normals_source: Tensor, visible: Tensor) -> DefaultEncoded:
        """Encode linear textures and camera-space normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1."""
        exposure = exposure_of(texture, visible)
        radiance = texture / exposure
        source_root = radiance.clamp_min(_DARKEST).sqrt()
        if radiance.requires_grad:  # else black texels, where the root is steep, dominate the gradient
            bounded = source_root.detach() / (radiance.detach() + _STEEP).sqrt()
            radiance.register_hook(bounded.mul)  # type: ignore[no-untyped-call]
        side = self.settings.side
        small = [resize(x, side) for x in (source_root, visible, self._normals_used(normals_source))]
        template = F.interpolate(self.template[None], (side, side), mode="bilinear", align_corners=False)
        x = torch.cat([*small, template.expand(len(texture), -1, -1, -1)], 1)
        features = []
        for down in self.down:
            x = down(x)
            features.append(x)
        skips = [up.get_submodule("skip")(x) for up, x in zip(self.up, features, strict=True)]
        return DefaultEncoded(self.bottleneck(features[-1]), skips, source_root, exposure)

    def decode(self, encoded: DefaultEncoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode OLAT textures [B, L, 3, T, T] for camera-space lights [B, L, 3], normals [B, 3, T, T]."""
        root = self.decode_root(encoded, normals_target, lights)
        return from_root(root) * encoded.exposure[:, None]

    def decode_root(self, encoded: DefaultEncoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode `to_root` of the textures over the source's exposure [B, L, 3, T, T]; may be negative."""
        faces, count, _ = lights.shape
        maps, base, code = self._light_inputs(self._normals_used(normals_target), lights)
        x, coarser = encoded.bottom.repeat_interleave(count, 0), [maps]
        for skip in encoded.skips[1:]:
            coarser.append(resize(coarser[-1], skip.shape[-1]))
        layers = zip(reversed(self.up), reversed(encoded.skips), reversed(coarser), strict=True)
        for up, skip, light_maps in layers:
            x = up(x, skip, light_maps, code, count)
        both = self.head(x).float().contiguous()  # not channels-last: textures are multiplied by maps
        both[:, :3] += base
        gain, bias = resize(both, encoded.source_root.shape[-1]).chunk(2, 1)
        root = torch.addcmul(bias, encoded.source_root.repeat_interleave(count, 0), gain)
        return root.view(faces, count, *root.shape[1:])

    def _normals_used(self, normals: Tensor) -> Tensor:
        return normals if self.settings.normals else torch.zeros_like(normals)

    def _light_inputs(self, normals_target: Tensor, lights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return light maps [B*L, 4, T', T'], Lambert's base gain [B*L, 1, T', T'], light codes [B*L, 96]."""
        normals = resize(normals_target, self.settings.side)
        head_to_camera = head_rotation(self.mean_normals, normals_target)
        lights_head = lights @ head_to_camera  # row vectors: R^T w
        half = F.normalize(lights + lights.new_tensor([0.0, 0.0, 1.0]), dim=-1)
        cosine = torch.einsum("blc,bcij->blij", lights, normals)
        gloss = torch.einsum("blc,bcij->blij", half, normals).clamp_min(0)
        gloss = gloss.square().square().square()  # the 8th power
        shadow = resize(self._mean_shadow(lights_head), self.settings.side)
        base = (cosine.clamp_min(0) * shadow + 1e-4).sqrt()
        maps = torch.stack([cosine, gloss, shadow, base], 2).flatten(0, 1)
        products = (lights_head[..., :, None] * lights_head[..., None, :]).flatten(-2)[
            ..., [0, 1, 2, 4, 5, 8]
        ]
        features = torch.cat([lights, lights_head, products], -1).flatten(0, 1)
        return maps, base.flatten(0, 1)[:, None], self.light_code(features)

    def _mean_shadow(self, lights_head: Tensor) -> Tensor:
        """Interpolate the mean face's visibility [B, L, T'', T''] between the stored directions."""
        weights = (_KERNEL_SHARPNESS * (lights_head @ self.rig.T)).softmax(-1)
        flat = weights @ self.mean_visibility.to(weights).flatten(1) / 255
        return flat.view(*flat.shape[:2], _MAP_SIDE, _MAP_SIDE)


class LitUp(nn.Module):
    """Double the side (except at the coarsest level), add skip and light maps, modulate by the light code."""

    def __init__(self, channels_in: int, channels_out: int, skip_channels: int, coarsest: bool) -> None:
        super().__init__()
        self.scale = 1 if coarsest else 2
        kernel, padding = (3, 1) if coarsest else (1, 0)
        self.enter = nn.Conv2d(channels_in, channels_out, kernel, padding=padding)
        self.skip = nn.Conv2d(skip_channels, channels_out, 1)
        self.light = nn.Conv2d(_LIGHT_MAPS, channels_out, 3, padding=1)
        self.modulation = nn.Linear(_CODE_CHANNELS, 2 * channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.outer = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor, skip: Tensor, maps: Tensor, code: Tensor, lights: int) -> Tensor:
        """Return features [B * lights, C, H, W].

        Args:
            x: Coarser features [B * lights, C, h, w].
            skip: Output [B, C, H, W] of the layer `skip` for the face's features.
            maps: Light maps [B * lights, C, H, W].
            code: Light codes [B * lights, C].
            lights: Number of lights per face.
        """
        x = self.enter(x)
        if self.scale == 2:
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = self.light(maps).add_(x)
        x.view(-1, lights, *x.shape[1:]).add_(skip[:, None])
        scale, shift = self.modulation(code)[..., None, None].chunk(2, 1)
        x = F.silu(x.mul_(1 + scale).add_(shift), inplace=True)
        x = F.silu(self.inner(x), inplace=True).add_(x)
        return F.silu(self.outer(x), inplace=True).add_(x)
