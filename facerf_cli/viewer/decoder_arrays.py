"""The decoder of the Reflectance Network as arrays: a page runs it for a face's texture under a single light.

What does not depend on the light is computed here: features of the face that enter each level. Weights keep
8 bits a number, in steps of each output channel: it costs 0.01 of 255.
"""

from typing import Any

import torch
from torch import Tensor, nn

from facerf_cli.errors import UsageError
from facerf_cli.field import Field
from facerf_cli.network.inputs import head_rotation, resize, without_cast
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, LitUp
from facerf_cli.viewer.arrays import ArrayPack


@torch.no_grad()
def add_decoder(pack: ArrayPack, field: Field) -> dict[str, Any]:
    """Add the decoder for a face, and the quotient; return its plain numbers."""
    network, face = field.models.network, field.face
    if not isinstance(network, DefaultReflectanceNetwork):
        raise UsageError(
            "facerf view: needs a Reflectance Network of form default; give no other --checkpoint"
        )
    visible = face.visible[None, None]
    texture = without_cast(face.texture[None], visible, field.models.source_colours)
    encoded = network.encode(texture, face.normals[None], visible)
    x = network.bottleneck(encoded.features[-1])
    levels = list(zip(reversed(network.up), reversed(encoded.features), strict=True))
    for index, (up, skip) in enumerate(levels):
        assert isinstance(up, LitUp)
        fixed = up.skip(skip) + (0 if index else up.enter(x))
        pack.add(f"fixed{index}", fixed[0], "short")
        if index:
            _add_layer(pack, f"enter{index}", up.enter)
        for name in ("light", "inner", "outer"):
            _add_layer(pack, f"{name}{index}", getattr(up, name))
        _add_layer(pack, f"modulation{index}", up.modulation)
    _add_layer(pack, "head", network.head)
    assert isinstance(network.light_code, nn.Sequential)
    _add_layer(pack, "code0", network.light_code[0])
    _add_layer(pack, "code1", network.light_code[2])
    side = network.settings.side
    pack.add("decoderNormals", resize(face.normals[None], side)[0], "short")
    pack.add("meanShadow", network.mean_visibility[None] / 255, "byte")
    pack.add("decoderRig", network.rig.T.contiguous(), "half")
    quotient = field.quotient
    assert quotient is not None
    pack.add("quotientRatio", quotient.ratio.log(), "half")
    pack.add("quotientExplained", quotient.explained[None], "half")
    cast = (face.texture / texture[0]).flatten(1).nanmedian(1).values
    return {
        "levels": len(levels),
        "side": side,
        "sourceScale": (1 / (cast * encoded.exposure.item())).tolist(),
        "sourceExposure": encoded.exposure.item(),
        "headToCamera": head_rotation(network.mean_normals, face.normals[None])[0].flatten().tolist(),
    }


def _add_layer(pack: ArrayPack, name: str, layer: nn.Module) -> None:
    """Add weights [out, in, ...] and biases [1, out]."""
    weight, bias = layer.weight, layer.bias
    assert isinstance(weight, Tensor) and isinstance(bias, Tensor)
    pack.add(name, weight.detach(), "byte")
    pack.add(name + "Bias", bias.detach()[None], "half")
