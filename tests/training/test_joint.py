"""The joint stage on a dataset of four people under twenty lights, with both forms of both networks."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from facerf_cli.dataset.crops import CropPairs
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.photos import PhotoCrops
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.features import LightNetwork, LightSettings, VggFeatures
from facerf_cli.network.geometry import GeometryEstimate, GeometryNetwork, GeometryNetworkSettings
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork, PaperReflectanceSettings
from facerf_cli.training.joint import (
    JointObjective,
    JointSettings,
    pose_heads,
    render_textures,
    unwrap_images,
)
from facerf_cli.training.losses import PaperWeights
from facerf_cli.training.objective import seeded
from tests import fake_device
from tests.kinds import Folders, Patch
from tests.training.joint_dataset import CROP_PX, SIDE, write_joint_dataset

SETTINGS = JointSettings(crop_px=CROP_PX, texture_side=SIDE, validation_pairs=2)
PAPER = PaperReflectanceSettings(side=SIDE, widths=(8, 8, 16, 16), features=8)


class SmallGeometry(nn.Module):
    """Stands in for the Geometry Network where a test is not about its trunk: the same head for all crops."""

    def __init__(self) -> None:
        super().__init__()
        real = GeometryNetwork(GeometryNetworkSettings("default", 6, 4, (0.0, 0.0, -1.0)))
        self.settings, self.regress = real.settings, real.regress
        self.real = real
        self.trunk = nn.Linear(3, self.regress.in_features)
        real.trunk = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), self.trunk)

    def forward(self, crops: Tensor) -> tuple[Tensor, ...]:
        return self.real(crops)


class FakePhotos:
    """As `dataset.photos.Photos`."""

    paths = ("one",)

    def draw(self, generator: torch.Generator) -> PhotoCrops:
        landmarks_px = CROP_PX * (0.3 + 0.4 * torch.rand(1, 68, 2, generator=generator))
        return PhotoCrops(torch.rand(1, 3, CROP_PX, CROP_PX, generator=generator), landmarks_px)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: Folders) -> Dataset:
    return write_joint_dataset(tmp_path_factory.mktemp("dataset"))


def objective_of(
    dataset: Dataset, reflectance: nn.Module | None = None, **settings: object
) -> JointObjective:
    torch.manual_seed(1)
    objective = JointObjective(
        dataset,
        load_face_model(),
        reflectance or PaperReflectanceNetwork(PAPER),
        SmallGeometry(),
        VggFeatures(0.1),
        LightNetwork(LightSettings(0.1, 2, 8)),
        FakePhotos(),  # type: ignore[arg-type]
        replace(SETTINGS, **settings),  # type: ignore[arg-type]
    )
    objective.measure()
    return objective


def batch_of(
    objective: JointObjective, photos: bool, count: int = 1, first: int = 0
) -> CropPairs | PhotoCrops:
    """A batch of the kind; `first` is its first sample's number."""
    step = next(s for s in range(99) if isinstance(objective.draw(1, seeded, s), PhotoCrops) == photos)
    return objective.draw(count, lambda i, step=step: seeded(0, step, first + i), step)


def gradients(objective: JointObjective, term: Tensor) -> dict[str, float]:
    """Sum of absolute gradients of each network."""
    objective.zero_grad()
    term.backward(retain_graph=True)
    return {
        name: sum(float(p.grad.abs().sum()) for p in network.parameters() if p.grad is not None)
        for name, network in objective.networks.items()
    }


@pytest.mark.parametrize("photos", [False, True])
def test_a_step_mixes_no_devices(dataset: Dataset, photos: bool) -> None:
    objective = objective_of(dataset)
    batch = batch_of(objective, photos).each(fake_device.OnDevice)
    fake_device.moved(objective)
    objective.features = {
        name: replace(features, powers=fake_device.OnDevice(features.powers))
        for name, features in objective.features.items()
    }
    with fake_device.in_use() as calls:
        torch.stack(list(objective(batch).values())).sum().backward()
    assert calls.count > 100


@pytest.fixture(scope="module")
def objective(dataset: Dataset) -> JointObjective:
    objective = objective_of(dataset)
    with torch.no_grad():  # coefficients and pose of an untrained one hardly depend on the crop
        objective.networks["geometry"].regress.weight.mul_(30)
        objective.networks["reflectance"].light_convolutions[-1].weight.mul_(10)
    return objective


def test_each_term_reaches_what_it_should_and_photos_the_geometry_alone(objective: JointObjective) -> None:
    terms = objective(batch_of(objective, photos=False))
    reached = {name: gradients(objective, term) for name, term in terms.items()}
    assert set(reached) == {
        "landmarks",
        "regularisation",
        "photometric",
        "appearance_features",
        "light_features",
    }
    for name, sums in reached.items():
        assert sums["geometry"] > 0, name  # through the mesh, the texture, the normals or the picture
        assert (sums["reflectance"] > 0) == (name not in ("landmarks", "regularisation")), name
    assert all(parameter.grad is None for parameter in objective.feature_networks.parameters())
    terms = objective(batch_of(objective, photos=True))
    assert set(terms) == {"landmarks", "regularisation"}
    sums = gradients(objective, torch.stack(list(terms.values())).sum())
    assert sums["geometry"] > 0 and sums["reflectance"] == 0


def test_a_fifth_of_the_batches_are_photos(objective: JointObjective) -> None:
    kinds = []
    reader, drawn = objective._train, objective.draw(1, seeded, 0)
    objective._train = type("Quick", (), {"draw": lambda self, *wanted: drawn})()  # type: ignore[assignment]
    try:
        kinds = [isinstance(objective.draw(1, seeded, step), PhotoCrops) for step in range(2000)]
    finally:
        objective._train = reader
    assert abs(sum(kinds) / len(kinds) - 0.2) < 0.03
    assert not isinstance(batch_of(objective, photos=False), PhotoCrops)


def test_samples_do_not_know_their_neighbours_and_checkpoints_their_losses(objective: JointObjective) -> None:
    with torch.no_grad():
        for photos in (False, True):
            joint = objective(batch_of(objective, photos, count=2))
            apart = [objective(batch_of(objective, photos, first=number)) for number in range(2)]
            for name, term in joint.items():
                mean = (apart[0][name] + apart[1][name]) / 2
                assert torch.allclose(term, mean, rtol=1e-3, atol=1e-6), name
    vgg, light = objective.provenance["feature_losses"]
    assert "ImageNet" in vgg and light == "S_f" and objective.provenance["photos"] == 1


def test_networks_trained_here_see_channels_apart(objective: JointObjective) -> None:
    assert [objective.features[name].apart for name in ("appearance", "light")] == [False, True]


@torch.no_grad()
def test_terms_have_the_weights(dataset: Dataset, objective: JointObjective) -> None:
    batch = batch_of(objective, photos=False)
    plain = objective(batch)
    before = objective.settings
    objective.settings = replace(before, weights=PaperWeights(50.0, 3.0, 20.0, 7.0))
    heavy = objective(batch)
    objective.settings = before
    factors = {"landmarks": 2, "regularisation": 3, "photometric": 4}
    for name, term in plain.items():
        assert heavy[name].item() == pytest.approx(factors.get(name, 7) * term.item(), rel=1e-4), name


@torch.no_grad()
def test_terms_of_a_known_head_are_small(dataset: Dataset) -> None:
    """With the heads that made the pictures landmarks agree, and what was unwrapped is rendered back."""
    objective = objective_of(dataset)
    batch = batch_of(objective, photos=False)
    assert isinstance(batch, CropPairs)
    wrong = objective(batch)["landmarks"]
    detected_px = torch.cat([batch.source_landmarks_px, batch.target_landmarks_px])
    fit = fit_batch(load_face_model(), detected_px, objective.camera)
    estimate = GeometryEstimate(
        fit.rotation.float(), fit.translation_m.float(), fit.alpha.float(), fit.beta.float()
    )
    heads = pose_heads(load_face_model(), estimate)
    right = objective._geometry_terms(estimate, heads, detected_px)["landmarks"].sum()
    assert right < 0.02 < wrong
    images = torch.cat([batch.source, batch.target])
    unwrapped = unwrap_images(images, heads, 96)
    rendered, mask = render_textures(unwrapped.texture, heads, objective.camera)
    difference = ((rendered - images).abs() * mask).sum() / mask.sum() / 3
    assert difference < 0.1 * (images * mask).sum() / mask.sum() / 3


def test_mean_face_learns_the_pose_alone(dataset: Dataset) -> None:
    network = GeometryNetwork(GeometryNetworkSettings("default", 0, 0, (0.0, 0.0, -1.0)))
    objective = JointObjective(
        dataset, load_face_model(), PaperReflectanceNetwork(PAPER), network, settings=SETTINGS
    )
    batch = batch_of(objective, photos=False)
    terms = objective(batch)
    assert "regularisation" not in terms
    _, heads = objective._heads(batch.source, batch.source_landmarks_px)
    estimate = network(batch.source)
    mean = load_face_model().mean @ estimate.rotation[0].T + estimate.translation_m[0]
    assert torch.allclose(heads.vertices[0], mean, atol=1e-6)
    torch.stack(list(terms.values())).sum().backward()
    assert network.regress.bias.grad.shape == (9,) and (network.regress.bias.grad != 0).any()


def test_heads_can_be_fitted_to_landmarks_instead(dataset: Dataset) -> None:
    """Then the Reflectance Network is trained alone, on the heads that `relight` fits."""
    network = PaperReflectanceNetwork(PAPER)
    objective = JointObjective(dataset, load_face_model(), network, None, settings=SETTINGS)
    batch = batch_of(objective, photos=False)
    assert isinstance(batch, CropPairs) and set(objective(batch)) == {"photometric"}
    assert set(objective.networks) == {"reflectance"} and objective.inputs["geometry"] == "landmarks"
    estimate, _ = objective._heads(batch.source, batch.source_landmarks_px)
    fit = fit_batch(load_face_model(), batch.source_landmarks_px, objective.camera)
    torch.testing.assert_close(estimate.alpha, fit.alpha.float())
    assert objective.validate().metrics["landmarks_iod"] < 0.1


def test_terms_whose_networks_are_missing_are_left_out(dataset: Dataset) -> None:
    objective = JointObjective(
        dataset, load_face_model(), PaperReflectanceNetwork(PAPER), SmallGeometry(), settings=SETTINGS
    )
    assert set(objective(batch_of(objective, photos=False))) == {"landmarks", "regularisation", "photometric"}
    assert objective.provenance["feature_losses"] == [] and objective.provenance["photos"] == 0
    assert objective.provenance["licence"]


def test_validation_tells_poses_apart(objective: JointObjective) -> None:
    objective.eval()
    first, again = objective.validate(), objective.validate()
    assert first.metrics == again.metrics
    assert set(first.metrics) == {
        "si_mse",
        "si_mse_same_pose",
        "si_mse_same_pose_std",
        "si_mse_other_pose",
        "si_mse_other_pose_std",
        "landmarks_iod",
        "tint_red",
        "tint_blue",
        "pairs",
    }
    assert first.metrics["pairs"] == 4
    both = (first.metrics["si_mse_same_pose"] + first.metrics["si_mse_other_pose"]) / 2
    assert first.metrics["si_mse"] == pytest.approx(both) and first.metrics["si_mse"] > 0
    assert first.sheet is not None and first.sheet.shape == (4 * CROP_PX, 4 * CROP_PX, 3)
    assert objective.chooses_by in first.metrics


def test_validation_sees_a_tint(objective: JointObjective, monkeypatch: Patch) -> None:
    network: Any = objective.networks["reflectance"]
    decode, tint = network.decode, torch.tensor([1.5, 1.0, 0.5])[:, None, None]
    before = objective.validate().metrics
    monkeypatch.setattr(network, "decode", lambda *given: tint * decode(*given))
    after = objective.validate().metrics
    ratios = [after[name] / before[name] for name in ("tint_red", "tint_blue")]
    assert ratios == pytest.approx([1.5, 0.5])
    assert after["si_mse"] != before["si_mse"]
