"""The portrait field of a photo as arrays: all from which a page computes the person under any light.

Names and formulas are those of `network/portrait.py`, `portrait/correction.py`, `portrait_field.py` and
`whole_person.py`; the page's scripts repeat them.
"""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.composite import PhotoDetail
from facerf_cli.face.landmarks import to_display
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.correction import SHARPNESS
from facerf_cli.portrait_field import PortraitField
from facerf_cli.viewer.arrays import ArrayPack, Kind
from facerf_cli.whole_person import WholePerson

_BLOCK = 4  # pixels of the maps along one in which the change of light beyond the square is known
_MAPS: dict[str, Kind] = {
    "albedo": "half",
    "normals": "short",
    "strands": "short",
    "gloss": "half",
    "trust": "half",
    "lit": "short",
    "around": "short",
    "shadow": "short",
}


def add_person(pack: ArrayPack, field: PortraitField, whole: WholePerson) -> dict[str, Any]:
    """Add what the portrait field needs; return its plain numbers."""
    for name, kind in _MAPS.items():
        pack.add(name, getattr(field.maps, name)[0], kind)
    classes = field.person.classes
    correction = field.correction
    assert correction is not None
    pack.add("excess", correction.excess, "half")
    pack.add("likeness", correction.mean_likeness[None], "half")
    pack.add("explained", correction.explained[None], "half")
    pack.add("share", 1 - classes[:1], "byte")
    pack.add("own", whole.own[None], "byte")
    pack.add("skin", (classes[[class_index("skin")]] > 0.5).float(), "byte")
    pack.add("albedoLines", whole.albedo_maps, "half")
    pack.add("hair", whole.hair_maps, "half")
    pack.add("atBorder", whole.at_border[None], "byte")
    pack.add("beyond", _beyond_square(whole.own_change), "half")
    return {
        "side": classes.shape[-1],
        "exposure": field.exposure,
        "personExposure": field.person.exposure,
        "floor": correction.floor,
        "likenessPower": SHARPNESS,
        "mean": correction.mean,
        "gainRange": list(whole.gain_range),
        "square": _square(field),
    }


def add_shadow_rays(pack: ArrayPack, field: PortraitField) -> None:
    """Add the proxy's mesh and the rays that find what reaches each pixel."""
    rays = field.person.shadows
    pack.add("vertices", field.person.proxy.vertices.T.contiguous(), "short")
    pack.add("triangles", field.person.proxy.triangles.flatten().numpy(), "index")
    pack.add("covered", rays.covered[None].float(), "byte")
    pack.add("origins", np.ascontiguousarray(rays.origins.T), "short")
    pack.add("disc", rays.numbers[..., 0].reshape(-1, len(rays.origins)), "short")


def add_detail(pack: ArrayPack, detail: PhotoDetail, field: PortraitField) -> dict[str, Any]:
    """Add what puts a relit texture into the photo; return its plain numbers."""
    texture = field.field.face.texture
    person = field.person
    albedo = texture[None] / person.exposure * _sampled(field, "gain") + _sampled(field, "bias")
    pack.add("faceTexture", texture, "half")
    pack.add("faceAlbedo", albedo[0], "half")
    pack.add("trusted", detail.trusted[None], "byte")
    pack.add("ownDetail", detail.own_texture[None], "byte")
    pack.add("texels", field.texels.permute(2, 0, 1).contiguous(), "short")
    return {"meanSource": detail.mean_source.tolist(), "detailFloor": detail.floor}


def _sampled(field: PortraitField, name: str) -> torch.Tensor:
    maps = getattr(field.maps, name)
    return F.grid_sample(maps, field.texels[None], padding_mode="border", align_corners=False)


def _beyond_square(own_change: Tensor) -> Tensor:
    """The photo's part [3, b, b] of the change of light, in blocks of pixels and one more on each side."""
    wide = F.pad(own_change[None], (_BLOCK,) * 4, mode="replicate")
    return F.avg_pool2d(wide, _BLOCK)[0]


def _square(field: PortraitField) -> list[float]:
    square = field.person.square
    return [square.x0_px, square.y0_px, square.side_px]


def displayed(own: np.ndarray) -> np.ndarray:
    """The person's colours as a guide of the gain, 0..1."""
    return to_display(own) / np.float32(255)
