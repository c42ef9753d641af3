"""Lens distortion: frames become those of a pinhole camera with the same K."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.capture.distortion import distorted
from facerf_cli.capture.stage_json import read_capture
from facerf_cli.errors import InputError
from tests.capture.test_stage_json import GOOD, K, capture_at

LENS = (-0.25, 0.1, 0.004, -0.003, 0.02)
WIDE = [[60.0, 0, 33], [0, 60.0, 29], [0, 0, 1]]  # the frame's corners lie at a radius of 0.7


def scene(plane: np.ndarray) -> np.ndarray:
    """A smooth picture of the plane at depth 1 [..., 2]."""
    x, y = plane[..., 0], plane[..., 1]
    return np.stack([2 + np.sin(3 * x + y), 2 + np.cos(4 * y - x), 2 + x * y], -1).astype(np.float32)


def plane_of_pixels() -> np.ndarray:
    rows, columns = np.mgrid[:60, :64] + 0.5
    return np.stack([(columns - 33) / 60, (rows - 29) / 60], -1)


def test_the_model_is_opencvs() -> None:
    """Worked by hand from its documentation at x, y = 0.5, 0.25: r2 = 0.3125, radial = 0.9322509765625."""
    moved = distorted(torch.tensor([0.5, 0.25]).double(), LENS)
    radial = 1 - 0.25 * 0.3125 + 0.1 * 0.3125**2 + 0.02 * 0.3125**3
    x = 0.5 * radial + 2 * 0.004 * 0.5 * 0.25 - 0.003 * (0.3125 + 2 * 0.25)
    y = 0.25 * radial + 0.004 * (0.3125 + 2 * 0.0625) + 2 * -0.003 * 0.5 * 0.25
    np.testing.assert_allclose(moved.numpy(), [x, y], rtol=1e-12)


def test_a_distorted_frame_is_read_as_a_pinhole_sees_it(tmp_path: Path) -> None:
    seen = wanted = torch.from_numpy(plane_of_pixels())
    for _ in range(60):  # the lens's inverse, by iteration
        seen = seen + wanted - distorted(seen, LENS)
    image = scene(seen.numpy())
    camera = GOOD["cameras"][0] | {"K": WIDE, "distortion": LENS}
    lights = [light | {"intensity": [1, 1, 1]} for light in GOOD["lights"]]
    folder = capture_at(tmp_path, image, cameras=[camera], lights=lights, black_level=0.0)
    found = read_capture(folder).frame("0000", "C0", 0)
    truth, off = scene(plane_of_pixels()), (slice(4, -4), slice(4, -4))
    assert np.abs(image - truth)[off].max() > 0.1  # the lens matters
    assert np.abs(found - truth)[off].max() < 0.01
    none = capture_at(tmp_path, image, cameras=[camera | {"distortion": [0, 0, 0, 0]}], lights=lights)
    assert not read_capture(none).distortion


@pytest.mark.parametrize(
    ("lens", "says"),
    [
        ([0.1], "k1, k2, p1, p2, k3 of OpenCV are needed"),
        ([0.1, 0, 0, "x"], "k1, k2, p1, p2, k3 of OpenCV are needed"),
        ([0.1] * 8, "undistort images of other lenses first"),
        ([-3.0, 0, 0, 0], "distortion folds the image"),
    ],
)
def test_a_lens_that_cannot_be_undone_is_one_line(tmp_path: Path, lens: list[float], says: str) -> None:
    camera = GOOD["cameras"][0] | {"K": WIDE, "distortion": lens}
    with pytest.raises(InputError, match=says):
        read_capture(capture_at(tmp_path, cameras=[camera]))


def test_a_single_camera_is_the_world_and_of_several_each_has_a_pose(tmp_path: Path) -> None:
    lone = {key: value for key, value in GOOD["cameras"][0].items() if key != "world_to_camera"}
    camera = read_capture(capture_at(tmp_path, cameras=[lone])).cameras["C0"]
    assert torch.equal(camera.rotation, torch.eye(3).double()) and not camera.translation_m.any()
    two = [GOOD["cameras"][0], lone | {"id": "C1", "K": K}]
    with pytest.raises(InputError, match="camera C1 has no 'world_to_camera'"):
        read_capture(capture_at(tmp_path, cameras=two))
