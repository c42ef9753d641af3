"""One head through a shot: the same identity in each frame, and the pose of the frame."""

import numpy as np
import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.raster.camera import Camera, pose_to_rotation, project, rotation_to_pose
from facerf_cli.relighting.sequence import OnePerson, identity_of, spread_over

SIZE = (180, 240)
YAWS = (-12.0, -4.0, 3.0, 11.0)


def drawn_identity(strength: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return strength * torch.randn(len(load_face_model("builtin").identity), generator=generator)


def frames_of_a_head(strength: float = 0.4) -> list[np.ndarray]:
    """Landmarks [68, 2] of one head that turns and opens its mouth."""
    model, alpha = load_face_model("builtin"), drawn_identity(strength)[None]
    camera = Camera(640.0, SIZE[1], SIZE[0], SIZE[1] / 2, SIZE[0] / 2)
    found = []
    for yaw, jaw in zip(YAWS, (0.0, 0.5, 1.0, 0.5), strict=True):
        beta = torch.zeros(1, len(model.expression))
        beta[0, model.expression_names.index("jaw_open")] = jaw
        vertices = model.vertices(alpha, beta)[0] @ pose_to_rotation(yaw, 2.0, 0.0).T
        points = model.landmarks(vertices[None])[0] + torch.tensor([0.0, 0.0, -1.0])
        found.append(project(points, camera).numpy().astype(np.float64))
    return found


def test_one_identity_and_the_pose_of_each_frame() -> None:
    model, frames = load_face_model("builtin"), frames_of_a_head()
    alpha = identity_of(model, frames, SIZE, 128)
    person = OnePerson(model, alpha, SIZE, 128)
    fits = [person.fit(frame) for frame in frames]
    for fit, yaw in zip(fits, YAWS, strict=True):
        torch.testing.assert_close(fit.alpha, alpha, rtol=0, atol=0)
        assert abs(rotation_to_pose(fit.rotation)[0] - yaw) < 2.5  # the crop's camera sees it a little aside
        assert fit.error_iod < 0.03 and fit.quality == "good"
        assert fit.vertices_camera(model).isfinite().all()
    jaw = model.expression_names.index("jaw_open")
    assert fits[2].beta[jaw] > fits[0].beta[jaw] + 0.2


def test_a_known_identity_explains_the_landmarks_and_key_frames_are_spread() -> None:
    model, frames = load_face_model("builtin"), frames_of_a_head(2.0)
    person = OnePerson(model, drawn_identity(2.0), SIZE, 128)
    for frame in frames:
        fit = person.fit(frame)
        found = project(model.landmarks(fit.vertices_camera(model)[None])[0], fit.camera)[17:]
        apart_px = (found - fit.landmarks_px[17:]).norm(dim=1).mean()
        assert apart_px < 0.35  # of 128; the crop's perspective is not quite the camera's
    assert spread_over([3, 4, 8, 9, 20], 3) == [3, 8, 20]
    assert spread_over(range(2), 5) == [0, 1]
