"""The Geometry Network's own stage: crops that show what their truth says, and a loss that falls."""

from pathlib import Path

import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.geometry import GeometryEstimate, GeometryNetwork, GeometryNetworkSettings
from facerf_cli.raster.camera import crop_camera
from facerf_cli.synth.bank.geometry_crops import GeometryPhotos
from facerf_cli.synth.bank.people import read_photo
from facerf_cli.training.geometry import GeometryObjective, GeometryObjectiveSettings
from facerf_cli.training.objective import seeded
from tests.kinds import Folders
from tests.refusals import refused
from tests.synth.conftest import backgrounds
from tests.training.alone import assert_samples_are_alone

FEW = GeometryObjectiveSettings(held_out_people=1, held_out_draws=4)


@pytest.fixture(scope="module")
def folder(people_folder: Path, tmp_path_factory: Folders) -> Path:
    """Three people, who are one."""
    folder = tmp_path_factory.mktemp("people")
    for person in range(3):
        path = folder / f"photo_{person:05}_0.safetensors"
        path.symlink_to(people_folder / "photo_00001_0.safetensors")
    return folder


@pytest.fixture(scope="module")
def faces(folder: Path) -> GeometryPhotos:
    return GeometryPhotos(folder, backgrounds(), {"licence": "MIT"})


@pytest.fixture
def objective(faces: GeometryPhotos) -> GeometryObjective:
    torch.manual_seed(0)
    return GeometryObjective(faces, settings=FEW)


def draw(objective, count=4, seed=7):
    return objective.draw(count, lambda index: seeded(seed, index), 0)


def test_images_show_a_face_and_the_paper_form_learns_from_them(faces):
    face = faces.faces[1][0]
    photo = read_photo(face.path, torch.Generator())
    nose = face.points_px[27:36].long()
    assert photo.alpha[nose[:, 1], nose[:, 0]].min() == 1
    assert photo.radiance.mean(0)[photo.alpha > 0].mean() > 0.05
    assert (face.points_px - face.centre_px).abs().max() < face.side_px / 2
    network = GeometryNetwork(GeometryNetworkSettings("paper", 80, 29))
    objective = GeometryObjective(faces, network, FEW)
    sum(objective(draw(objective, 1)).values()).backward()
    assert network.trunk[0].weight.grad.abs().max() > 0


def test_samples_depend_on_no_neighbours_and_the_truth_is_close(objective):
    assert_samples_are_alone(objective)
    terms = objective(draw(objective, 1))
    assert set(terms) == {"landmarks", "rotation", "depth", "coefficients"}
    batch = draw(objective, 8)
    truth = GeometryEstimate(batch.rotation, batch.translation_m, batch.alpha[:, :40], batch.beta)
    percent = 100 * objective.distances_iod(truth, batch)
    assert percent[:, 17:].mean() < 4  # the built-in model's fit to other heads
    mirrored = truth._replace(rotation=truth.rotation.flip(0))
    assert objective.distances_iod(mirrored, batch).mean() > 2 * percent.mean() / 100


def test_the_pose_follows_every_move_of_the_crop(objective):
    """The fit to the moved landmarks is the stored fit, moved: mirror, turn, scale and shift are right."""
    batch = draw(objective, 12)
    fit = fit_batch(load_face_model(), batch.landmarks_px, crop_camera(64))
    assert (fit.rotation.float() - batch.rotation).flatten(1).norm(dim=1).max() < 0.06  # 2.5 degrees
    assert (fit.translation_m.float() - batch.translation_m).abs().max() < 0.012
    assert (fit.beta.float() - batch.beta).abs().max() < 0.3 < fit.beta.abs().max()


def test_validation_is_the_same_every_time_and_shows_it(objective):
    first, second = objective.validate(), objective.validate()
    assert first.metrics == second.metrics and objective.chooses_by in first.metrics
    assert 5 < first.metrics["landmarks_percent"] < 150  # untrained: the mean head
    side = first.sheet.shape[0]
    assert first.sheet.shape == (side, FEW.held_out_draws * side, 3)
    for colour in ((0, 1, 0), (1, 0, 0)):  # true landmarks, and where the network has them
        assert (first.sheet == colour).all(-1).any()


def test_no_images_is_said(tmp_path):
    refused(InputError, "no photos", GeometryPhotos, tmp_path, backgrounds(), {})
