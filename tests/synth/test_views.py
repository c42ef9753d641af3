"""Classes and depth of images of known shapes; positions of irises and ears."""

from dataclasses import replace

import numpy as np
import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.views import StageCamera, layers_of, more_landmarks, stage_cameras, surface_samples
from tests.synth.shapes import ball, camera

SIDE_PX, RADIUS_M, FAR_M = 64, 0.05, 10.0


def halves() -> HeadMesh:
    """A ball whose right half is hair to the classes."""
    mesh = ball(RADIUS_M, 5)
    return replace(mesh, label=np.where(mesh.vertices[:, 0] > 0, class_index("hair"), class_index("skin")))


def layers(camera: StageCamera) -> tuple[np.ndarray, np.ndarray]:
    return layers_of(halves(), surface_samples(halves(), camera), camera)


def test_classes_and_depth_are_the_geometrys() -> None:
    classes, depth_m = layers(camera())
    alpha = 1 - classes[..., class_index("background")]
    assert abs(alpha.sum() - np.pi * (RADIUS_M / 0.12 * SIDE_PX) ** 2) < 0.01 * alpha.sum()
    assert ((alpha > 0) & (alpha < 1)).sum() > 60
    np.testing.assert_allclose(classes.sum(-1), 1, atol=1e-6)
    middle = SIDE_PX // 2
    inside = np.hypot(*(np.mgrid[-middle:middle, -middle:middle] + 0.5)) < 20
    left, right = inside.copy(), inside.copy()
    left[:, middle - 1 :], right[:, : middle + 1] = False, False
    assert (classes[left][:, class_index("skin")] > 0.99).all()
    assert (classes[right][:, class_index("hair")] > 0.99).all()
    assert abs(depth_m[inside].min() - (FAR_M - RADIUS_M)) < 3e-4 and depth_m[0, 0] == 0
    # The head's left half in the image, skin, turns to the camera when the head turns to the right.
    turned, _ = layers(camera(yaw_deg=90.0))
    assert turned[middle, middle, class_index("skin")] > 0.99
    cameras = stage_cameras(64)
    places = torch.stack([-c.head_to_camera.T.float() @ c.translation_m.float() for c in cameras])
    assert len(cameras) == 8 and (places[:, 2] > 0).all()
    assert torch.allclose(places.norm(dim=1), torch.tensor(1.2), atol=1e-5)
    assert places[1, 0] < 0 < places[2, 0] and places[7, 1] > 0


def test_irises_follow_the_gaze_and_ears_have_ends() -> None:
    model = load_face_model()
    ahead, aside = (
        more_landmarks(shell_head(model.mean, gaze, subdivisions=0)) for gaze in ((0.0, 0.0), (20.0, 0.0))
    )
    for side, sign in (("left", -1), ("right", 1)):
        iris = ahead[f"{side} iris"]
        ring = np.stack([ahead[f"{side} iris {k}"] for k in range(8)])
        assert iris[0] * sign > 0.02 and iris[2] > ring[:, 2].max()
        spread = np.linalg.norm((ring - ring.mean(0))[:, :2], axis=-1)
        np.testing.assert_allclose(spread, 0.012 * np.sin(np.radians(29)), atol=0.0012)
        assert ring[0, 0] > iris[0] + 0.004 and ring[2, 1] > iris[1] + 0.004
        assert 0.003 < aside[f"{side} iris"][0] - iris[0] < 0.006  # 13 mm sin 20 degrees is 4.4 mm
        top, lobe, back = (ahead[f"{side} ear {name}"] for name in ("top", "lobe", "back"))
        assert top[1] > lobe[1] + 0.04 and back[2] < lobe[2]
