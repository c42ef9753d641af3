"""What every form of the Reflectance Network does with the fields that it is given.

From one texture to the texture under any single light (paper, 'Network Architecture').

This `default` form departs from the paper's in three ways that learn faster: the light also enters the
decoder, as maps in the chart (cosine, half-vector, the mean face's shadow) and as feature-wise modulation;
the output is `source x gain + bias` in square-root space; and the network works at a fixed side while gain
and bias are applied at the texture's own. The encoder runs once a face, the decoder once a light.
"""

from dataclasses import asdict, dataclass
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

MEAN_RADIANCE = 0.25  # of the visible face after exposure is taken out
_LIT = 0.02  # keeps the root's slope finite in the dark

# Of log(red / green) and log(blue / green) of training's sources, each face's mean: 192 draws of a bank.
_CAST_MEAN, _CAST_COVARIANCE = (0.318, -0.214), ((0.094, -0.038), (-0.038, 0.081))
_ORDINARY_CAST = 2.0  # standard deviations, within which a cast is left to the network


def to_root(radiance: Tensor) -> Tensor:
    """What the default form predicts and its loss compares: nearly the square root, 0 at 0."""
    return (radiance + _LIT**2).sqrt() - _LIT


def from_root(root: Tensor) -> Tensor:
    """The radiance of a root; none below 0."""
    return root.clamp_min(0) * (root + 2 * _LIT)


def exposure_of(texture: Tensor, visible: Tensor) -> Tensor:
    """What to divide linear textures [B, 3, T, T] by, so that their visible mean is `MEAN_RADIANCE`.

    visible [B, 1, T, T] in 0..1; the result is [B, 1, 1, 1] and positive.
    """
    radiance = (texture.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    exposure = radiance / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) / MEAN_RADIANCE
    return exposure.clamp_min(1e-6)


def colour_cast(texture: Tensor, visible: Tensor) -> Tensor:
    """What to divide linear textures [B, 3, T, T] by, where light has coloured them beyond training's photos.

    [B, 3, 1, 1], positive; the mean radiance stays. Exactly 1 for ordinary photos and grey ones. A face
    further from training's mean colour than `_ORDINARY_CAST` is brought inside, by the inverse of its
    distance: the stranger the colour, the surer it is the light's. visible [B, 1, T, T] in 0..1.
    """
    mean = ((texture * visible).sum((2, 3)) / visible.sum((2, 3)).clamp_min(1e-6)).clamp_min(1e-6).double()
    chroma = (mean[:, [0, 2]] / mean[:, 1:2]).log() - mean.new_tensor(_CAST_MEAN)
    spread = torch.linalg.cholesky(mean.new_tensor(_CAST_COVARIANCE))
    distance = torch.linalg.solve_triangular(spread, chroma.T, upper=False).norm(dim=0)
    inside = (_ORDINARY_CAST / distance.clamp_min(1e-6)) ** 2
    excess = chroma * (1 - inside).clamp_min(0)[:, None]
    cast = torch.stack([excess[:, 0], torch.zeros_like(excess[:, 0]), excess[:, 1]], 1).exp()
    cast = cast * (mean / cast).mean(1, keepdim=True) / mean.mean(1, keepdim=True)
    return cast.to(texture)[..., None, None]


def resize(x: Tensor, side: int) -> Tensor:
    """Resample [B, C, H, W] to a side: averaged when smaller, bilinear when larger."""
    if x.shape[-1] == side:
        return x
    if x.shape[-1] > side:
        return F.interpolate(x, (side, side), mode="area")
    return F.interpolate(x, (side, side), mode="bilinear", align_corners=False)


def head_rotation(mean_normals: Tensor, normals: Tensor) -> Tensor:
    """head_to_camera [B, 3, 3] that best turn the mean face's normals [3, S, S] to normals [B, 3, T, T]."""
    small = resize(normals, mean_normals.shape[-1]).cpu().double()  # Apple's GPUs have no doubles
    moment = torch.einsum("bcij,dij->bcd", small, mean_normals.cpu().double())
    u, _, vt = torch.linalg.svd(moment)
    signs = torch.ones(len(moment), 3, dtype=moment.dtype)
    signs[:, 2] = torch.det(u @ vt)
    return (u @ torch.diag_embed(signs) @ vt).to(normals)


_MAP_SIDE = 64  # of the mean face's normals and shadows
_DARKEST = 1e-8  # radiance at which the square root's slope is still finite
_LIGHT_MAPS = 4
_LIGHT_FEATURES = 12
_KERNEL_SHARPNESS = 70.0  # of the interpolation between the shadow maps of neighbouring lights


@dataclass(frozen=True)
class ReflectanceSettings:
    """Width of the encoder and decoder at each halving of the working side [T' = side, side/2, ...]."""

    side: int = 128
    encoder_widths: tuple[int, ...] = (32, 64, 128, 192, 224, 256)
    decoder_widths: tuple[int, ...] = (20, 36, 64, 96, 128, 160)
    template_channels: int = 8
    rig_lights: int = 150  # whose shadows on the mean face it holds
    normals: bool = True  # False: normal maps of zeros in their place (paper, 'Ablative Study')


@dataclass(frozen=True)
class Encoded:
    """What the encoder knows of B faces: skip features from fine to coarse, and what the output needs."""

    features: list[Tensor]
    source_root: Tensor  # [B, 3, T, T] square root of the normalised source
    exposure: Tensor  # [B, 1, 1, 1] what the source was divided by


class ReflectanceNetwork(nn.Module):
    """T_s, N_s, N_t, light directions -> OLAT textures, scene-linear and non-negative."""

    mean_normals: Tensor
    mean_visibility: Tensor
    rig: Tensor

    def __init__(self, settings: ReflectanceSettings = ReflectanceSettings()) -> None:
        super().__init__()
        self.settings = settings
        enc, dec, rig_lights = settings.encoder_widths, settings.decoder_widths, settings.rig_lights
        self.template = nn.Parameter(0.1 * torch.randn(settings.template_channels, 32, 32))
        widths = (7 + settings.template_channels, *enc)
        self.down = nn.ModuleList(
            Down(a, b, first=i == 0) for i, (a, b) in enumerate(zip(widths, enc, strict=False))
        )
        self.bottleneck = nn.Conv2d(enc[-1], dec[-1], 3, padding=1)
        self.light_code = nn.Sequential(
            nn.Linear(_LIGHT_FEATURES, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU()
        )
        coarser = (*dec[1:], dec[-1])
        self.up = nn.ModuleList(
            _Up(coarser[i], dec[i], enc[i], last=i == len(dec) - 1) for i in range(len(dec))
        )
        self.head = nn.Conv2d(dec[0], 6, 3, padding=1)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]
        self.register_buffer("mean_normals", torch.zeros(3, _MAP_SIDE, _MAP_SIDE))
        self.register_buffer(
            "mean_visibility", torch.zeros(rig_lights, _MAP_SIDE, _MAP_SIDE, dtype=torch.uint8)
        )
        self.register_buffer("rig", torch.zeros(rig_lights, 3))

    def as_metadata(self) -> dict[str, Any]:
        """Form and settings, for a checkpoint."""
        return {"form": "default", **asdict(self.settings)}

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> Self:
        """An untrained network of these; raises KeyError, TypeError or ValueError where they make none."""
        given = {k: v for k, v in metadata.items() if k != "form"}
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        return cls(ReflectanceSettings(**settings))

    def set_mean_face(self, normals: Tensor, visibility: Tensor, directions: Tensor) -> None:
        """Hold the mean face (head frame): normals [3, T, T], visibility [L, T, T], directions [L, 3]."""
        if len(directions) != len(self.rig):
            raise ValueError(
                f"the network holds the shadows of {len(self.rig)} lights, not of {len(directions)}"
            )
        size = (_MAP_SIDE, _MAP_SIDE)
        self.mean_normals.copy_(F.normalize(F.interpolate(normals[None], size, mode="area")[0], dim=0))
        self.mean_visibility.copy_((F.interpolate(visibility[None], size, mode="area")[0] * 255).round())
        self.rig.copy_(directions)

    def encode(self, texture: Tensor, normals_source: Tensor, visible: Tensor) -> Encoded:
        """Encode linear textures and camera-space normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1."""
        exposure = exposure_of(texture, visible)
        source_root = (texture / exposure).clamp_min(_DARKEST).sqrt()
        side = self.settings.side
        small = [resize(x, side) for x in (source_root, visible, self._seen(normals_source))]
        template = F.interpolate(self.template[None], (side, side), mode="bilinear", align_corners=False)
        x = torch.cat([*small, template.expand(len(texture), -1, -1, -1)], 1)
        features = []
        for down in self.down:
            x = down(x)
            features.append(x)
        return Encoded(features, source_root, exposure)

    def decode(self, encoded: Encoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """OLAT textures [B, L, 3, T, T] for camera-space lights [B, L, 3] and normals [B, 3, T, T]."""
        root = self.decode_root(encoded, normals_target, lights)
        return from_root(root) * encoded.exposure[:, None]

    def decode_root(self, encoded: Encoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Roots [B, L, 3, T, T] of the textures at the normalised exposure (`to_root`); may be negative."""
        faces, count, _ = lights.shape
        maps, base, code = self._light_inputs(self._seen(normals_target), lights)
        x = self.bottleneck(encoded.features[-1]).repeat_interleave(count, 0)
        for up, skip in zip(reversed(self.up), reversed(encoded.features), strict=True):
            x = up(x, skip, maps, code, count)
        gain, bias = (resize(y, encoded.source_root.shape[-1]) for y in self.head(x).float().chunk(2, 1))
        gain = gain + resize(base, encoded.source_root.shape[-1])
        root = encoded.source_root.repeat_interleave(count, 0) * gain + bias
        return root.view(faces, count, *root.shape[1:])

    def _seen(self, normals: Tensor) -> Tensor:
        return normals if self.settings.normals else torch.zeros_like(normals)

    def _light_inputs(self, normals_target: Tensor, lights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Light maps [B*L, 4, T', T'], Lambert's base gain [B*L, 1, T', T'], modulation code [B*L, 96]."""
        normals = resize(normals_target, self.settings.side)
        head_to_camera = head_rotation(self.mean_normals, normals_target)
        lights_head = lights @ head_to_camera  # row vectors: R^T w
        half = F.normalize(lights + lights.new_tensor([0.0, 0.0, 1.0]), dim=-1)
        cosine = torch.einsum("blc,bcij->blij", lights, normals)
        gloss = torch.einsum("blc,bcij->blij", half, normals).clamp_min(0) ** 8
        shadow = resize(self._mean_shadow(lights_head), self.settings.side)
        base = (cosine.clamp_min(0) * shadow + 1e-4).sqrt()
        maps = torch.stack([cosine, gloss, shadow, base], 2).flatten(0, 1)
        products = (lights_head[..., :, None] * lights_head[..., None, :]).flatten(-2)[
            ..., [0, 1, 2, 4, 5, 8]
        ]
        features = torch.cat([lights, lights_head, products], -1).flatten(0, 1)
        return maps, base.flatten(0, 1)[:, None], self.light_code(features)

    def _mean_shadow(self, lights_head: Tensor) -> Tensor:
        """The mean face's visibility [B, L, T'', T''], interpolated between the baked directions."""
        weights = (_KERNEL_SHARPNESS * (lights_head @ self.rig.T)).softmax(-1)
        flat = weights @ (self.mean_visibility.to(weights) / 255).flatten(1)
        return flat.view(*flat.shape[:2], _MAP_SIDE, _MAP_SIDE)


class Down(nn.Module):
    """Halve the side (but for the first), then a convolution around which the input goes on."""

    def __init__(self, channels_in: int, channels_out: int, first: bool) -> None:
        super().__init__()
        self.enter = nn.Conv2d(channels_in, channels_out, 3, stride=1 if first else 2, padding=1)
        self.norm = nn.GroupNorm(4, channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Features [B, C, H, W] to [B, C', H / 2, W / 2], or of the same side."""
        x = F.silu(self.norm(self.enter(x)))
        result: Tensor = x + F.silu(self.inner(x))
        return result


class _Up(nn.Module):
    """Double the side (but for the last, coarsest), add skip and light maps, modulate by the light's code."""

    def __init__(self, channels_in: int, channels_out: int, skip_channels: int, last: bool) -> None:
        super().__init__()
        self.scale = 1 if last else 2
        self.enter = nn.Conv2d(channels_in, channels_out, 3 if last else 1, padding=1 if last else 0)
        self.skip = nn.Conv2d(skip_channels, channels_out, 1)
        self.light = nn.Conv2d(_LIGHT_MAPS, channels_out, 3, padding=1)
        self.modulation = nn.Linear(96, 2 * channels_out)
        self.inner = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.outer = nn.Conv2d(channels_out, channels_out, 3, padding=1)

    def forward(self, x: Tensor, skip: Tensor, maps: Tensor, code: Tensor, lights: int) -> Tensor:
        side = skip.shape[-1]
        x = self.enter(x)
        if self.scale == 2:
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = x + self.skip(skip).repeat_interleave(lights, 0) + self.light(resize(maps, side))
        scale, shift = self.modulation(code)[..., None, None].chunk(2, 1)
        x = F.silu(x * (1 + scale) + shift)
        x = x + F.silu(self.inner(x))
        result: Tensor = x + F.silu(self.outer(x))
        return result
