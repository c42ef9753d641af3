"""The simulated camera's errors, and crops that are moved with their landmarks and pose."""

from dataclasses import replace

import pytest
import torch

from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.synth.camera import Similarity, SimulatedCamera, occluder, resample

PLAIN = SimulatedCamera(0, 0, (2.0, 2.0), 0, curve=0, noise=0)


def test_a_camera_without_errors_exposes_and_clips() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.linspace(0, 3, 81).view(9, 9).expand(3, 9, 9)
    taken = PLAIN.take(image, torch.tensor(1.0), generator)
    assert torch.allclose(taken, (image / 2).clamp(0, 1), atol=1e-5)
    assert torch.equal(PLAIN.colours(generator), torch.eye(3))
    compressed = replace(PLAIN, jpeg=1.0).take(image, torch.tensor(1.0), generator)
    assert 0 < (compressed - taken).abs().mean() < 0.1


def test_phones_sharpen_and_cameras_raise_contrast() -> None:
    step = torch.where(torch.arange(32) < 16, 0.6, 1.4).expand(3, 32, 32)

    def of_step(phone: float, contrast: float) -> tuple[float, float]:
        """Return the largest overshoot at the edge, and the mean contrast of the two sides."""
        camera = replace(PLAIN, phone=phone, contrast=(contrast, contrast))
        photos = [camera.take(step, step.mean(), torch.Generator().manual_seed(seed)) for seed in range(40)]
        lines = torch.stack(photos).sqrt().mean((1, 2))
        high, low = lines[:, 24:28].mean(1), lines[:, 4:8].mean(1)
        overshoot = (lines[:, 16:20].amax(1) / high - 1).max()
        return float(overshoot), float(((high - low) / (high + low)).mean())

    (plain, flat), (sharp, _), (_, steep) = of_step(0, 0), of_step(1, 0), of_step(0, 0.4)
    assert plain < 0.02 < 0.04 < sharp and steep > 1.02 * flat


@pytest.mark.parametrize("turn_deg", [0.0, 12.0, -30.0])
def test_points_pixels_and_pose_move_together(turn_deg: float) -> None:
    """A head's face lies at its depth, where shift and scale of a pose are exact."""
    centre_px, shift = torch.tensor([40.0, 30.0]), torch.tensor([0.1, -0.05])
    crop = Similarity.around(centre_px, 32.0, turn_deg, shift)
    torch.testing.assert_close(crop.in_crop(centre_px[None])[0], 0.5 + shift)
    assert crop.side_px == pytest.approx(32)
    image = torch.zeros(1, 64, 64)
    image[0, 22, 50] = 1  # its centre lies at (50.5, 22.5)
    seen = resample(image, crop.positions_px(320))[0]
    peak = torch.tensor(divmod(int(seen.argmax()), 320)[::-1]) / 320
    assert (peak - crop.in_crop(torch.tensor([[50.5, 22.5]]))[0]).abs().max() < 0.01
    rotation, translation_m = pose_to_rotation(10, 5, 0), torch.tensor([0.0, 0.0, -1.0])
    face = torch.tensor([[0.0, 0, 0.11], [0.05, 0, 0.11], [0, 0.05, 0.11]]) @ rotation  # of a plane facing it
    upright = Similarity.around(centre_px, 40.0, 0, torch.zeros(2))
    moved_rotation, moved_m = crop.pose(centre_px, 40.0, rotation, translation_m)
    before, after = (
        project(face @ turn.T + move, crop_camera(1))
        for turn, move in ((rotation, translation_m), (moved_rotation, moved_m))
    )
    in_photo = (before - 0.5) @ upright.matrix.T + centre_px
    torch.testing.assert_close(crop.in_crop(in_photo), after, rtol=0, atol=0.01)


def test_occluders_stay_off_the_middle() -> None:
    generator = torch.Generator().manual_seed(0)
    covers = torch.stack([occluder(64, generator, 0.3) for _ in range(60)])
    assert covers.min() == 0 and covers.max() == 1 and (covers.mean((1, 2)) > 0).float().mean() > 0.5
    assert covers[:, 32, 32].mean() < 0.15 < covers.amax(0).mean()
