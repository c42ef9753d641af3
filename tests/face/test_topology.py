"""Regions lie at their landmarks and cover UV space once; the interior and the outline face the camera."""

import pytest
import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import (
    CONTOUR,
    GRID,
    LANDMARK_UV,
    REGIONS,
    contour_rays,
    grid_triangles,
    grid_uv,
    interior_mask,
    interior_texture,
    region_mask,
    silhouette_ids,
)
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from tests.refusals import refused

SIDE = 96
YAWS_DEG = (0.0, 35.0, -35.0)


def at(mask: torch.Tensor, uv) -> float:
    column, row = (int(c * mask.shape[0]) for c in uv)
    return float(mask[row, column])


@pytest.mark.parametrize("name", REGIONS)
def test_masks_are_symmetric_and_bounded(name):
    mask = region_mask(name, SIDE)
    assert mask.shape == (SIDE, SIDE) and mask.dtype == torch.float32
    assert torch.equal(mask, mask.flip(1))
    assert mask.min() >= 0 and 0.5 < mask.max() <= 1


def test_parts_cover_uv_space_once_and_an_unknown_region_is_named():
    total = sum(region_mask(part, 256) for part in ("skin", "eyes", "brows", "lips", "nostrils", "neck"))
    assert torch.allclose(total, torch.ones(256, 256), atol=1e-6)
    refused(ValueError, "ears", region_mask, "ears", 8)


@pytest.mark.parametrize(
    "name, inside, outside",
    [
        ("eyes", LANDMARK_UV[36:42].mean(0), LANDMARK_UV[19]),
        ("eyes", LANDMARK_UV[42:48].mean(0), LANDMARK_UV[27]),
        ("brows", LANDMARK_UV[24] + [0, 0.01], LANDMARK_UV[27]),
        ("lips", LANDMARK_UV[[51, 62]].mean(0), LANDMARK_UV[33]),
        ("mouth", LANDMARK_UV[[62, 66]].mean(0), LANDMARK_UV[[57, 66]].mean(0)),
        ("nostrils", LANDMARK_UV[31] + [0.0145, -0.022], LANDMARK_UV[30]),
        ("neck", LANDMARK_UV[4] + [0, 0.1], LANDMARK_UV[8] - [0, 0.08]),
        ("face", LANDMARK_UV[30], LANDMARK_UV[4] + [-0.08, 0.08]),
        ("skin", (LANDMARK_UV[30] + LANDMARK_UV[2]) / 2, LANDMARK_UV[57] - [0, 0.01]),
    ],
)
def test_masks_lie_where_the_landmarks_say(name, inside, outside):
    mask = region_mask(name, 256)
    assert at(mask, inside) > 0.6 and at(mask, outside) < 0.05


def _mask(yaw_deg: float, side_px: int = 128) -> tuple[torch.Tensor, torch.Tensor]:
    """The mask [S, S] of the mean face, and its landmarks' pixels [68, 2]."""
    model, camera = load_face_model(), crop_camera(side_px)
    turned = model.mean @ pose_to_rotation(yaw_deg, 0, 0).T + torch.tensor([0.0, 0.0, -1.0])
    fragments = rasterize(turned, grid_triangles(), camera)
    uv = interpolate(grid_uv(), grid_triangles(), fragments)
    mask = interior_mask(turned, fragments, uv, 128)
    assert mask.shape == (1, side_px, side_px) and mask.min() >= 0 and mask.max() <= 1
    return mask[0], project(model.landmarks(turned[None])[0], camera)


def test_the_interior_holds_the_features_and_what_turns_away_leaves_it() -> None:
    mask, landmarks_px = _mask(0)
    column, row = landmarks_px.long().T
    assert (mask[row[17:], column[17:]] > 0.99).all()  # brows, nose, eyes and mouth, none cut out
    assert (mask[row[5:12], column[5:12]] < 0.3).all()  # the jaw; at the ears a pixel is many texels
    assert (mask[0] == 0).all() and (mask[:, 0] == 0).all()
    texture = interior_texture(64)[0]
    column, row = (torch.from_numpy(LANDMARK_UV) * 64).long().T
    assert (texture[row[27:], column[27:]] == 1).all()
    assert (texture[row[:17], column[:17]] < 0.3).all() and (texture[-1] == 0).all()
    frontal, turned = _mask(0)[0], _mask(60)[0]
    assert turned.sum() < 0.9 * frontal.sum()
    assert _mask(180)[0].sum() == 0


def _turned_face(yaw_deg: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels [V, 2] of the mean face in a crop, and its rotation."""
    rotation = pose_to_rotation(yaw_deg, 0, 0)
    vertices = load_face_model().mean @ rotation.T + torch.tensor([0.0, 0.0, -1.0])
    return project(vertices, crop_camera(256)), rotation


def test_outlines_are_the_furthest_of_each_ray_also_of_turned_faces() -> None:
    rays = contour_rays()
    ends = torch.stack([rays[::8, -1] % GRID, rays[::8, -1] // GRID], -1) / (GRID - 1)
    assert (ends - torch.from_numpy(LANDMARK_UV[list(CONTOUR)])).abs().max() < 0.6 / (GRID - 1)
    seen = [_turned_face(yaw_deg) for yaw_deg in YAWS_DEG]
    px, rotations = (torch.stack(parts) for parts in zip(*seen, strict=True))
    ids = silhouette_ids(px, rotations)
    for face in range(len(YAWS_DEG)):
        for ray, found in zip(rays, ids[face], strict=True):
            assert found in ray
        # the ray to the chin reaches furthest down, whatever the yaw
        chin = rays[len(rays) // 2]
        assert ids[face, len(rays) // 2] == chin[px[face, chin, 1].argmax()]
    at_jaw = (ids == rays[:, -1]).float()
    half = len(rays) // 2
    assert at_jaw[0].mean() > 0.8  # seen from before, the outline is the jaw line
    # turned to the picture's right, that side's outline moves in over the cheek, and the other's does not
    assert at_jaw[1, -half:].mean() < 0.5 < at_jaw[1, :half].mean()
    assert at_jaw[2, :half].mean() < 0.5 < at_jaw[2, -half:].mean()
    px, rotation = _turned_face(35.0)
    outline = px[silhouette_ids(px[None], rotation[None])[0]]
    cheek = contour_rays()[-40:-24].flatten()  # of the far side
    assert px[cheek, 0].max() <= outline[-40:-24, 0].max() + 0.5
