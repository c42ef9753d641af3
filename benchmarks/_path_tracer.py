"""Images of a synthetic head by path tracing in Mitsuba 3 (scalar_rgb): the reference for the bake renderer.

The scene has geometry, normals, textures, relief, directional lights, diffuse bounces and the two specular
lobes. It has no subsurface scattering, hair is shaded like any other surface, and all shadows are hard.
Requires mitsuba: pip install 'facerf[dev]'.
"""

import math
import types
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.random_fields import CANVAS_SPAN
from facerf_cli.synth.shading import LOBES, Material
from facerf_cli.synth.views import StageCamera

_LIGHT = "light.to_world"  # parameter that turns the light


@dataclass(frozen=True)
class PathSettings:
    """Paths per pixel for diffuse light and for highlights, and diffuse bounces after the first hit."""

    samples: int = 64
    gloss_samples: int = 32
    bounces: int = 2
    gloss: bool = True
    relief: bool = True


def photograph(
    head: HeadMesh,
    appearance: Appearance,
    directions: np.ndarray,
    camera: StageCamera,
    settings: PathSettings = PathSettings(),
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Render linear images [L, 3, H, W] under lights of rgb 1 at `directions` [L, 3], and coverage [H, W]."""
    mi = load_mitsuba()
    diffuse = _Scene(mi, _scene(mi, head, appearance, camera, settings, glossy=False))
    glossy = (
        _Scene(mi, _scene(mi, head, appearance, camera, settings, glossy=True)) if settings.gloss else None
    )
    images = []
    for light, direction in enumerate(directions):
        image = diffuse.render(direction, settings.samples, seed + light)
        if glossy is not None:
            image[..., :3] += glossy.render(direction, settings.gloss_samples, seed + light)[..., :3]
        images.append(torch.from_numpy(image))
    stack = torch.stack(images)
    return stack[..., :3].permute(0, 3, 1, 2).contiguous(), stack[0, ..., 3].contiguous()


def load_mitsuba() -> types.ModuleType:
    """Import mitsuba and set its variant."""
    import mitsuba

    if mitsuba.variant() != "scalar_rgb":
        mitsuba.set_variant("scalar_rgb")
    return mitsuba


class _Scene:
    """A loaded scene with one movable light."""

    def __init__(self, mi: types.ModuleType, description: dict[str, Any]) -> None:
        self._mi = mi
        self._scene = mi.load_dict(description)
        self._parameters = mi.traverse(self._scene)

    def render(self, direction: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Render an image with coverage [H, W, 4] under a light at the unit direction [3]."""
        self._parameters[_LIGHT] = self._mi.ScalarTransform4f(_looking_along(-direction))
        self._parameters.update()
        return np.array(self._mi.render(self._scene, seed=seed, spp=samples), np.float32)


def _looking_along(direction: np.ndarray) -> np.ndarray:
    """Rotation [4, 4] whose z axis is the unit direction [3]."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    motion = np.eye(4)
    motion[:3, :3] = np.stack([x, np.cross(direction, x), direction], 1)
    return motion


def _scene(
    mi: types.ModuleType,
    head: HeadMesh,
    appearance: Appearance,
    camera: StageCamera,
    settings: PathSettings,
    glossy: bool,
) -> dict[str, Any]:
    """Describe the scene with only diffuse or only specular surfaces."""
    meshes = {}
    for index in np.unique(head.part):
        name = PARTS[index]
        material = appearance.materials[name]
        surface = _gloss(mi, material) if glossy else _diffuse(mi, material)
        if settings.relief:
            surface = _bumped(mi, material, surface)
        meshes[name] = _mesh(mi, head, int(index), mi.load_dict(surface))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2 if glossy else 2 + settings.bounces, "rr_depth": 99},
        "sensor": _sensor(mi, camera),
        "light": {
            "type": "directional",
            "direction": [0, 0, -1],
            "irradiance": {"type": "rgb", "value": math.pi},
        },
        **meshes,
    }


def _mesh(mi: types.ModuleType, head: HeadMesh, part: int, surface: Any) -> Any:
    """Triangles of one part, with normals and texture coordinates."""
    triangles = head.triangles[head.part[head.triangles[:, 0]] == part]
    used, corners = np.unique(triangles, return_inverse=True)
    properties = mi.Properties()
    properties["bsdf"] = surface
    mesh = mi.Mesh(
        PARTS[part],
        len(used),
        len(triangles),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    uv = head.uv[used]
    if PARTS[part] == "skin":
        uv = (uv - CANVAS_SPAN[0]) / (CANVAS_SPAN[1] - CANVAS_SPAN[0])
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = head.vertices[used].astype(np.float32).ravel()
    parameters["vertex_normals"] = head.normals[used].astype(np.float32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters["faces"] = corners.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _sensor(mi: types.ModuleType, stage_camera: StageCamera) -> dict[str, Any]:
    """Describe the camera. Mitsuba's looks along +z with x to the left; a box filter covers one pixel."""
    camera = stage_camera.camera
    head_to_camera = np.eye(4)
    head_to_camera[:3, :3] = stage_camera.head_to_camera.double().numpy()
    head_to_camera[:3, 3] = stage_camera.translation_m.double().numpy()
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width_px / (2 * camera.focal_px))),
        "principal_point_offset_x": 0.5 - camera.cx_px / camera.width_px,
        "principal_point_offset_y": 0.5 - camera.cy_px / camera.height_px,
        "near_clip": 0.01,
        "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f(np.linalg.inv(head_to_camera) @ np.diag([-1.0, 1, -1, 1])),
        "film": {
            "type": "hdrfilm",
            "width": camera.width_px,
            "height": camera.height_px,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def _diffuse(mi: types.ModuleType, material: Material) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": _texture(mi, material.albedo)}


def _gloss(mi: types.ModuleType, material: Material) -> dict[str, Any]:
    """Describe the two lobes of `shading.LOBES`; a metallic `principled` has no diffuse part."""
    lobes = [
        {
            "type": "principled",
            "metallic": 1.0,
            "base_color": _texture(mi, material.specular.expand(3, -1, -1)),
            "roughness": _texture(mi, material.roughness * factor),
        }
        for factor, _ in LOBES
    ]
    return {"type": "blendbsdf", "weight": LOBES[1][1], "first": lobes[0], "second": lobes[1]}


def _bumped(mi: types.ModuleType, material: Material, surface: dict[str, Any]) -> dict[str, Any]:
    """Tilt the normals of a surface by its relief; Mitsuba's second tangent points against v."""
    along_u, along_v = material.relief
    normals = torch.stack([-along_u, along_v, torch.ones_like(along_u)])
    normals = normals / normals.norm(dim=0, keepdim=True)
    return {"type": "normalmap", "normalmap": _texture(mi, (normals + 1) / 2), "surface": surface}


def _texture(mi: types.ModuleType, texture: Tensor) -> dict[str, Any]:
    """Describe a texture [C, H, W] of raw values, bilinear, clamped at the borders."""
    pixels = np.ascontiguousarray(texture.permute(1, 2, 0).float().numpy())
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": "mirror"}
