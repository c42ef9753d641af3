"""The truth of an image: matte, classes, surface and material of known shapes; places of irises and ears."""

from dataclasses import fields, replace

import numpy as np
import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.appearance.materials import Appearance
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.views import more_landmarks, stage_cameras, truth_of
from tests.synth.shapes import appearance, ball, camera, material

SIDE_PX, RADIUS_M, FAR_M = 64, 0.05, 10.0


def halves() -> HeadMesh:
    """A ball whose right half is hair to the classes."""
    mesh = ball(RADIUS_M, 5)
    return replace(mesh, label=np.where(mesh.vertices[:, 0] > 0, class_index("hair"), class_index("skin")))


def painted() -> Appearance:
    return appearance(material((0.6, 0.4, 0.2), 0.03))


def test_layers_of_all_classes_are_those_of_geometry_in_camera_space() -> None:
    truth = truth_of(halves(), painted(), camera())
    assert abs(truth.alpha.sum() - np.pi * (RADIUS_M / 0.12 * SIDE_PX) ** 2) < 0.01 * truth.alpha.sum()
    assert ((truth.alpha > 0) & (truth.alpha < 1)).sum() > 60
    np.testing.assert_allclose(truth.classes.sum(-1), 1, atol=1e-6)
    middle = SIDE_PX // 2
    inside = np.hypot(*(np.mgrid[-middle:middle, -middle:middle] + 0.5)) < 20
    left, right = inside.copy(), inside.copy()
    left[:, middle - 1 :], right[:, : middle + 1] = False, False
    assert (truth.classes[left][:, class_index("skin")] > 0.99).all()
    assert (truth.classes[right][:, class_index("hair")] > 0.99).all()
    np.testing.assert_allclose(
        truth.albedo[inside], np.broadcast_to([0.6, 0.4, 0.2], (inside.sum(), 3)), atol=1e-5
    )
    np.testing.assert_allclose(truth.specular[inside], 0.03, atol=1e-6)
    centre = truth.positions_m - [0, 0, -FAR_M]
    np.testing.assert_allclose(np.linalg.norm(centre, axis=-1)[inside], RADIUS_M, atol=3e-4)
    cosines = (truth.normals * centre).sum(-1)[inside] / RADIUS_M
    assert cosines.min() > 0.99
    depth = -truth.positions_m[..., 2][inside]
    assert abs(depth.min() - (FAR_M - RADIUS_M)) < 3e-4
    turned = truth_of(halves(), painted(), camera(yaw_deg=90.0))
    # The head's left half in the image, skin, turns to the camera when the head turns to the right.
    assert turned.classes[middle, middle, class_index("skin")] > 0.99
    np.testing.assert_allclose(turned.normals[middle, middle], [0, 0, 1], atol=0.03)
    assert turned.positions_m[middle, middle, 2] > -FAR_M + 0.9 * RADIUS_M
    truth = truth_of(halves(), painted(), camera())
    assert all(np.isfinite(getattr(truth, field.name)).all() for field in fields(truth))
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
