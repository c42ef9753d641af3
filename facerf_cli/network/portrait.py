"""Portrait Network: from a photo of a person to its light transport, as maps that are shared by all lights.

    OLAT_l = A (V'_l (n . l)+ + (V'_l sum_k b_k(l) P_k + sum_k b_k(l) U_k)+) + V'_l G_l sum_j g_j lobe_j

A is the photo without its light, gain times photo plus bias, so that detail survives. The gain starts from
the proxy's shading under the light that explains the photo best (`portrait/proxy.py`). b_k are
spherical harmonics of the light's direction; P and U hold light with and without the shadows of the proxy
V_l; the lobes of l are highlights about normals n and, in hair (`HAIRY`), about strands t. G_l is 1 in hair;
elsewhere it ends highlights where a surface turns from the light. V'_l corrects the shadows V_l:
logit V'_l = a (2 V_l - 1) + sum_k b_k(l) W_k. All maps come from one forward pass; a light then costs a few
products a pixel. The sum over lights is linear in their intensities.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.light.sh import mirror_signs, sh_basis
from facerf_cli.network.base import Blocks, Classes, Side, WidthsOfFour
from facerf_cli.network.batch import Batch
from facerf_cli.network.inputs import MEAN_RADIANCE, resize
from facerf_cli.network.parsing import Residual, UNet
from facerf_cli.raster.texture import Pixels, smoothstep

SKIN = 1  # index of the class whose mean exposes the image
HAIRY = (2, 6, 7)  # brows, hair and beard
_REACH = 3  # order of the spherical harmonics that summarise the proxy's visibility
LIT_ORDER, SHADOW_ORDER = 3, 4  # of P and U; of W
_SHARPNESS = (8.0, 45.0)  # exponents of the highlights about normals
_STRAND_SHARPNESS = 30.0
_TURNED = 0.15  # highlights fade between this and the negative n . l
_VIEW = (0.0, 0.0, 1.0)  # toward the distant camera
_DIM = 0.15  # added to the proxy's shading before the photo is divided by it
_FINE = {"gain": 3, "bias": 3, "normals": 3, "strands": 3, "gloss": len(_SHARPNESS) + 1, "trust": 1}
_COARSE = {  # maps at half the side
    "lit": (LIT_ORDER + 1) ** 2,
    "around": (LIT_ORDER + 1) ** 2,
    "shadow": (SHADOW_ORDER + 1) ** 2,
}
_OUTPUTS = 4 * sum(_FINE.values()) + sum(_COARSE.values())


@dataclass(frozen=True)
class PortraitSettings:
    """Channels and residual blocks at 1/2, 1/4, ... of the square's side; classes of the input."""

    widths: WidthsOfFour = (40, 72, 120, 176, 208)
    blocks: Blocks = (1, 1, 2, 2, 2)
    classes: Classes = 14
    side: Side = 192


@dataclass(frozen=True)
class PortraitInputs(Batch):
    """Inputs of the network for B people in squares of side S; camera space.

    image [B, 3, S, S] scene-linear, exposed so that the mean of the skin is `MEAN_RADIANCE`; classes
    [B, C, S, S]; normals [B, 3, S, S], depth [B, 1, S, S] (0.1 m) and covered [B, 1, S, S] of the proxy;
    reached [B, K, S, S]: spherical harmonics of the proxy's visibility; own [B, 1, S, S]: its shading under
    the photo's light, 1 on average over the skin.
    """

    image: Tensor
    classes: Tensor
    normals: Tensor
    depth: Tensor
    covered: Tensor
    reached: Tensor
    own: Tensor

    def mirrored(self) -> "PortraitInputs":
        """Return the mirror images of the people."""
        flipped = self.each(lambda layer: layer.flip(-1))
        normals, reached = mirrored_x(flipped.normals), mirrored_harmonics(flipped.reached)
        return replace(flipped, normals=normals, reached=reached)

    def stacked(self) -> Tensor:
        """Return the input [B, C, S, S] of the first layer."""
        root = (self.image.clamp(0, 4) + 0.005).sqrt() - 0.5
        own = (self.own.clamp(0, 4) + 0.02).sqrt() - 1
        layers = (root, self.classes, self.normals, self.depth, self.covered, self.reached, own)
        return torch.cat(layers, 1)


def mirrored_x(vectors: Tensor) -> Tensor:
    """Negate x of vectors [B, 3, S, S]."""
    return torch.cat([-vectors[:, :1], vectors[:, 1:]], 1)


def mirrored_harmonics(coefficients: Tensor) -> Tensor:
    """Return coefficients [B, K, S, S] of the same function of (-x, y, z)."""
    signs = mirror_signs(coefficients.shape[1]).to(coefficients)
    return coefficients * signs.view(-1, 1, 1)


def reached_by(directions: Tensor, visible: Tensor, side: int) -> Tensor:
    """Return spherical harmonics [K, side, side] of the visibility [L, s, s] of lights [L, 3] on a sphere."""
    basis = sh_basis(directions, _REACH) / len(directions)
    summary = torch.einsum("lk,lij->kij", basis, visible)
    return F.interpolate(summary[None] * 3, size=(side, side), mode="bilinear", align_corners=False)[0]


def skin_exposure(image: Tensor, classes: Tensor) -> Tensor:
    """Return the divisor [B, 1, 1, 1] that gives images [B, 3, S, S] a mean of `MEAN_RADIANCE` on skin."""
    skin = classes[:, SKIN : SKIN + 1]
    mean = (image.mean(1, keepdim=True) * skin).sum((2, 3), keepdim=True)
    return (mean / skin.sum((2, 3), keepdim=True).clamp_min(1e-3) / MEAN_RADIANCE).clamp_min(1e-6)


class PortraitMaps(NamedTuple):
    """Maps of B people, [B, C, S, S]; the last three have half the side.

    Albedo is in the units of the exposed image; hair is the fraction covered by strands. Maps `at` some
    pixels all have one row, [B, C, 1, N].
    """

    gain: Tensor
    bias: Tensor
    albedo: Tensor
    normals: Tensor
    strands: Tensor
    gloss: Tensor
    hair: Tensor
    trust: Tensor
    lit: Tensor
    around: Tensor
    shadow: Tensor

    def mirrored(self) -> "PortraitMaps":
        """Return maps whose images are mirrored under mirrored lights."""
        maps = PortraitMaps(*(values.flip(-1) for values in self))
        return maps._replace(
            normals=mirrored_x(maps.normals),
            strands=mirrored_x(maps.strands),
            lit=mirrored_harmonics(maps.lit),
            around=mirrored_harmonics(maps.around),
            shadow=mirrored_harmonics(maps.shadow),
        )

    def averaged(self, other: "PortraitMaps") -> "PortraitMaps":
        """Return the mean of two predictions; a strand equals its opposite."""
        mean = PortraitMaps(*((a + b) / 2 for a, b in zip(self, other, strict=True)))
        alike = (self.strands * other.strands).sum(1, keepdim=True).sign()
        return mean._replace(
            normals=F.normalize(mean.normals, dim=1),
            strands=F.normalize(self.strands + alike * other.strands, dim=1),
        )

    def at(self, pixels: Pixels) -> "PortraitMaps":
        """Return the maps at some pixels."""
        return PortraitMaps(*(pixels.values(resize(maps, self.normals.shape[-1])) for maps in self))

    def without_colours(self) -> "PortraitMaps":
        """Return maps with grey gain, bias and albedo, for grey photos."""
        grey = {name: getattr(self, name).mean(1, keepdim=True) for name in ("gain", "bias", "albedo")}
        return self._replace(**{name: values.expand(-1, 3, -1, -1) for name, values in grey.items()})

    def shaded(self, lights: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return shading, highlights and corrected visibility [B, L, S, S] under lights [B, L, 3].

        `visible` [B, L, S, S] is the proxy's visibility. The image of a light is albedo times shading plus
        highlights. Near lights have a direction per pixel, [B, L, 1, N, 3], and require the maps `at` them.
        """
        product = "blijc,bcij->blij" if lights.dim() == 5 else "blc,bcij->blij"
        basis = sh_basis(lights, SHADOW_ORDER)  # [B, L, K] or [B, L, 1, N, K]
        few = basis[..., : (LIT_ORDER + 1) ** 2]

        def over(basis: Tensor, maps: Tensor) -> Tensor:
            return resize(torch.einsum(product, basis, maps), self.normals.shape[-1])

        visible = torch.sigmoid(self.trust * (2 * visible - 1) + over(basis, self.shadow))
        cosine = torch.einsum(product, lights, self.normals)
        lit, around = over(few, self.lit), over(few, self.around)
        shading = visible * cosine.clamp_min(0) + F.relu(visible * lit + around)
        half = F.normalize(lights + lights.new_tensor(_VIEW), dim=-1)
        n_dot_h = torch.einsum(product, half, self.normals).clamp(1e-3, 1).log()
        t_dot_h = torch.einsum(product, half, self.strands)
        glow = torch.exp(-0.5 * _STRAND_SHARPNESS * t_dot_h.square()) * self.gloss[:, -1:] * self.hair
        for index, sharpness in enumerate(_SHARPNESS):
            lobe = torch.exp(sharpness * n_dot_h) * (sharpness / 8)
            glow = glow + lobe * self.gloss[:, index : index + 1]
        facing = smoothstep((cosine + _TURNED) / (2 * _TURNED))
        return shading, visible * torch.maximum(facing, self.hair) * glow, visible

    def olats(self, lights: Tensor, visible: Tensor) -> Tensor:
        """Return images [B, L, 3, S, S] under single lights of rgb 1; see `shaded`."""
        shading, glow, _ = self.shaded(lights, visible)
        return self.albedo[:, None] * shading[:, :, None] + glow[:, :, None]


class PortraitNetwork(UNet):
    """Predict the maps of people from `PortraitInputs` with a small U-Net."""

    kind_of_settings = PortraitSettings

    def __init__(self, settings: PortraitSettings = PortraitSettings()) -> None:
        inputs = 3 + settings.classes + 3 + 1 + 1 + (_REACH + 1) ** 2 + 1
        super().__init__(settings, inputs)
        widths = settings.widths
        self.last = Residual(widths[0])
        self.predict = nn.Conv2d(widths[0], _OUTPUTS, 1)
        nn.init.normal_(self.predict.weight, std=0.01)

    def forward(self, inputs: PortraitInputs) -> PortraitMaps:
        """Predict maps; sides are multiples of 32."""
        predicted = self.predict(self.last(self.doubled(self.halved(inputs.stacked()))[-1]))
        fine, coarse = torch.split(predicted, [4 * sum(_FINE.values()), sum(_COARSE.values())], 1)
        shuffled = F.pixel_shuffle(fine, 2).float()
        parts = [
            *torch.split(shuffled, list(_FINE.values()), 1),
            *torch.split(coarse.float(), list(_COARSE.values()), 1),
        ]
        return _maps(dict(zip((*_FINE, *_COARSE), parts, strict=True)), inputs)


def _maps(raw: dict[str, Tensor], inputs: PortraitInputs) -> PortraitMaps:
    """Return the maps for the last layer's channels."""
    gain = torch.exp(raw["gain"].clamp(-4, 4)) * (1 + _DIM) / (inputs.own + _DIM)
    bias = 0.1 * F.softplus(raw["bias"] - 3)
    return PortraitMaps(
        gain=gain,
        bias=bias,
        albedo=inputs.image * gain + bias,
        normals=F.normalize(inputs.normals + raw["normals"], dim=1),
        strands=F.normalize(raw["strands"] + raw["strands"].new_tensor([0.0, 1.0, 0.0]).view(3, 1, 1), dim=1),
        gloss=0.1 * F.softplus(raw["gloss"] - 2),
        hair=inputs.classes[:, list(HAIRY)].sum(1, keepdim=True).clamp(0, 1),
        lit=0.3 * raw["lit"],
        around=torch.cat([0.3 * raw["around"][:, :1] + 0.05, 0.3 * raw["around"][:, 1:]], 1),
        trust=4 * F.softplus(raw["trust"] + 0.5),
        shadow=raw["shadow"] * 3,
    )
