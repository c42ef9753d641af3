import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LANDMARK_UV, grid_triangles, grid_uv, interior_mask, interior_texture
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize


def _mask(yaw_deg: float, side_px: int = 128) -> tuple[torch.Tensor, torch.Tensor]:
    """The mask [S, S] of the mean face, and its landmarks' pixels [68, 2]."""
    model, camera = load_face_model(), crop_camera(side_px)
    turned = model.mean @ pose_to_rotation(yaw_deg, 0, 0).T + torch.tensor([0.0, 0.0, -1.0])
    fragments = rasterize(turned, grid_triangles(), camera)
    uv = interpolate(grid_uv(), grid_triangles(), fragments)
    mask = interior_mask(turned, fragments, uv, 128)
    assert mask.shape == (1, side_px, side_px) and mask.min() >= 0 and mask.max() <= 1
    return mask[0], project(model.landmarks(turned[None])[0], camera)


def test_interior_holds_the_features_and_ends_inside_the_jaw() -> None:
    mask, landmarks_px = _mask(0)
    column, row = landmarks_px.long().T
    assert (mask[row[17:], column[17:]] > 0.99).all()  # brows, nose, eyes and mouth, none cut out
    assert (mask[row[5:12], column[5:12]] < 0.3).all()  # the jaw; at the ears a pixel is many texels
    assert (mask[0] == 0).all() and (mask[:, 0] == 0).all()
    texture = interior_texture(64)[0]
    column, row = (torch.from_numpy(LANDMARK_UV) * 64).long().T
    assert (texture[row[27:], column[27:]] == 1).all()
    assert (texture[row[:17], column[:17]] < 0.3).all() and (texture[-1] == 0).all()


def test_what_turns_away_leaves_the_interior() -> None:
    frontal, turned = _mask(0)[0], _mask(60)[0]
    assert turned.sum() < 0.9 * frontal.sum()


def test_a_face_seen_from_behind_has_no_interior() -> None:
    assert _mask(180)[0].sum() == 0
