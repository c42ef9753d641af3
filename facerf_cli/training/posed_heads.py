"""Heads estimated by the Geometry Network: meshes in the fixed camera, landmarks, textures and images.

This is the differentiable path of the joint stage from coefficients and pose to pixels (paper, 'Network
Architecture'). Gradients flow through the mesh, the unwrapped texture, the normals and the rendered image.
Constant are the vertices of contour landmarks, which texels are seen, and which triangle a pixel sees.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.silhouette import silhouette_ids
from facerf_cli.face.topology import CONTOUR, INNER_MOUTH_CORNERS, grid_triangles, grid_uv, interior_mask
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.raster.camera import Camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import UnwrapSettings, inpaint, normal_map, sample_texture, unwrap
from facerf_cli.training.losses import slid_contour

FIXED_LANDMARKS = tuple(i for i in range(len(CONTOUR), 68) if i not in INNER_MOUTH_CORNERS)
LANDMARKS = (*CONTOUR, *FIXED_LANDMARKS)  # the paper's 66 (Saragih et al., 2011), the contour's first

# Side of the depth map of unwrapping: so many times the crop's, but at most _DEPTH_PX.
_DEPTH_PX, _DEPTH_PER_PX = 512, 3


@dataclass(frozen=True)
class PosedHeads:
    """B meshes in camera space [B, V, 3], rotations head_to_camera [B, 3, 3] and fixed landmarks."""

    vertices: Tensor
    rotation: Tensor
    fixed_landmarks: Tensor  # [B, 49, 3] camera space

    def landmarks_px(self, detected_px: Tensor, camera: Camera) -> Tensor:
        """L(v): the 66 `LANDMARKS` [B, 66, 2]; contour ones slide to the detected landmarks [B, 68, 2]."""
        px = project(self.vertices, camera)
        outline = silhouette_ids(px, self.rotation)
        outline_px = px.gather(1, outline[..., None].expand(-1, -1, 2))
        contour_px = slid_contour(outline_px, detected_px[:, list(CONTOUR)])
        return torch.cat([contour_px, project(self.fixed_landmarks, camera)], 1)


def pose_heads(model: MorphableModel, estimate: GeometryEstimate) -> PosedHeads:
    """v^c = R v(alpha, beta) + t, with as many leading shapes of the model as there are coefficients."""
    head = leading(model, estimate.alpha.shape[1], estimate.beta.shape[1])
    turned = head.vertices(estimate.alpha, estimate.beta) @ estimate.rotation.mT
    vertices = turned + estimate.translation_m[:, None]
    return PosedHeads(vertices, estimate.rotation, head.landmarks(vertices)[:, list(FIXED_LANDMARKS)])


def leading(model: MorphableModel, identities: int, expressions: int) -> MorphableModel:
    """Keep the leading shapes of a model, as many as a Geometry Network has coefficients."""
    return MorphableModel(
        model.name,
        model.licence,
        model.mean,
        model.identity[:identities],
        model.expression[:expressions],
        model.expression_names[:expressions],
    )


@dataclass(frozen=True)
class UnwrappedHeads:
    """Textures [B, 3, T, T] with unseen texels filled, visibility [B, 1, T, T] and normals [B, 3, T, T]."""

    texture: Tensor
    visible: Tensor
    normals: Tensor


def unwrap_images(images: Tensor, heads: PosedHeads, camera: Camera, side: int) -> UnwrappedHeads:
    """Unwrap images [B, 3, S, S] of the heads: T_s and N_s."""
    triangles = grid_triangles().to(images.device)
    settings = UnwrapSettings(depth_side_px=min(_DEPTH_PX, _DEPTH_PER_PX * camera.width_px))
    faces = []
    for image, vertices in zip(images, heads.vertices, strict=True):
        texture, visible = unwrap(image, vertices, triangles, camera, side, settings)
        faces.append((inpaint(texture, visible), visible[None], normal_map(vertices, triangles, side)))
    textures, seen, normals = (torch.stack(parts) for parts in zip(*faces, strict=True))
    return UnwrappedHeads(textures, seen, normals)


def head_normals(heads: PosedHeads, side: int) -> Tensor:
    """Camera-space normal maps [B, 3, T, T] of the heads: N_t."""
    triangles = grid_triangles().to(heads.vertices.device)
    return torch.stack([normal_map(vertices, triangles, side) for vertices in heads.vertices])


def render_textures(textures: Tensor, heads: PosedHeads, camera: Camera) -> tuple[Tensor, Tensor]:
    """Render textures [B, C, T, T] on the heads: images [B, C, S, S] and masks M_t [B, 1, S, S] in 0..1."""
    device = textures.device
    triangles, uv = grid_triangles().to(device), grid_uv().to(device)
    images, masks = [], []
    for texture, vertices in zip(textures, heads.vertices, strict=True):
        fragments = rasterize(vertices, triangles, camera)
        seen_uv = interpolate(uv, triangles, fragments)
        covered = fragments.covered[..., None].to(texture.dtype)
        images.append((sample_texture(texture, seen_uv) * covered).permute(2, 0, 1))
        masks.append(interior_mask(vertices, fragments, seen_uv, texture.shape[-1]))
    return torch.stack(images), torch.stack(masks)
