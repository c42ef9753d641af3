"""A person of the stage who moves: the face by expressions, the head by the camera, and no light with it."""

import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from _talking_head import Actor, seen_from, turned

from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.camera import rotation_to_pose
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.person import draw_person
from facerf_cli.synth.views import stage_cameras


def test_the_jaw_opens_and_the_hair_stays() -> None:
    model = cached_face_model("builtin")
    subject = draw_person(model, 5, 101, 64)
    moved = Actor(subject, model).with_expression({"jaw_open": 1.0})
    offset = moved.mesh.vertices - subject.mesh.vertices
    chin = np.linalg.norm(subject.mesh.vertices - subject.landmarks_world[8], axis=1).argmin()
    jaw = model.expression[model.expression_names.index("jaw_open")]
    wanted = model.landmarks(jaw[None])[0, 8].numpy() @ subject.head_to_world.numpy().T
    assert wanted[1] < -0.005  # m
    np.testing.assert_allclose(offset[chin], wanted, atol=0.003)
    top = subject.mesh.vertices[:, 1] > np.quantile(subject.mesh.vertices[:, 1], 0.97)
    assert np.abs(offset[top]).max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(moved.mesh.normals, axis=1), 1, atol=1e-3)
    still = Actor(subject, model).with_expression({})
    np.testing.assert_allclose(still.mesh.vertices, subject.mesh.vertices, atol=1e-6)


def test_the_head_turns_and_the_lights_do_not() -> None:
    camera = stage_cameras(64, "bust")[0]
    seen = turned(camera, 20.0, -5.0)
    pose = rotation_to_pose(seen.head_to_camera @ camera.head_to_camera.T)
    assert np.allclose(pose, (20, -5, 0), atol=1e-3)
    lights = rig_directions(12)
    in_camera = torch.from_numpy(seen_from(lights, seen)) @ seen.head_to_camera.double().T
    torch.testing.assert_close(in_camera, lights.double(), atol=1e-6, rtol=0)
