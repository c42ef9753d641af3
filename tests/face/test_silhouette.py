import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, GRID, LANDMARK_UV, contour_rays, silhouette_ids
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project

YAWS_DEG = (0.0, 35.0, -35.0)


def _seen(yaw_deg: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels [V, 2] of the mean face in a crop, and its rotation."""
    rotation = pose_to_rotation(yaw_deg, 0, 0)
    vertices = load_face_model().mean @ rotation.T + torch.tensor([0.0, 0.0, -1.0])
    return project(vertices, crop_camera(256)), rotation


def test_rays_end_at_the_contour_landmarks() -> None:
    rays = contour_rays()
    ends = torch.stack([rays[::8, -1] % GRID, rays[::8, -1] // GRID], -1) / (GRID - 1)
    assert (ends - torch.from_numpy(LANDMARK_UV[list(CONTOUR)])).abs().max() < 0.6 / (GRID - 1)


def test_outline_is_the_furthest_of_each_ray() -> None:
    seen = [_seen(yaw_deg) for yaw_deg in YAWS_DEG]
    px, rotations = (torch.stack(parts) for parts in zip(*seen, strict=True))
    ids = silhouette_ids(px, rotations)
    rays = contour_rays()
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


def test_outline_of_a_turned_face_bounds_it() -> None:
    px, rotation = _seen(35.0)
    outline = px[silhouette_ids(px[None], rotation[None])[0]]
    cheek = contour_rays()[-40:-24].flatten()  # of the far side
    assert px[cheek, 0].max() <= outline[-40:-24, 0].max() + 0.5
