"""Known answers for the paper's loss, a term at a time: which image, head, light and frame each term uses.

The networks are stand-ins that write down what they are given and return what the test expects. The expected
terms are computed here from the paper's formulas, with the heads of source and target kept apart.
"""

from dataclasses import dataclass
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.dataset.crops import CropPairs, spread_pairs
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.photos import PhotoCrops
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, INNER_MOUTH_CORNERS, grid_triangles
from facerf_cli.network.geometry import GeometryEstimate
from facerf_cli.network.inputs import SourceColours, colour_cast
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.raster.texture import normal_map
from facerf_cli.training.joint import (
    JointObjective,
    JointSettings,
    PosedHeads,
    render_textures,
    unwrap_images,
)
from tests.training.joint_dataset import CROP_PX, SIDE, write_joint_dataset

MODEL = load_face_model()
CAMERA = crop_camera(CROP_PX)
SOURCE, TARGET = 0, 1
INNER = [i for i in range(len(CONTOUR), 68) if i not in INNER_MOUTH_CORNERS]


def _estimate() -> GeometryEstimate:
    """Two heads that differ in pose and shape: of the source and of the target."""
    generator = torch.Generator().manual_seed(3)
    rotation = torch.stack([pose_to_rotation(-20.0, 5.0, 0.0), pose_to_rotation(25.0, -5.0, 4.0)])
    translation_m = torch.tensor([[0.0, 0.0, -1.0], [0.01, 0.0, -1.05]])
    alpha, beta = (0.5 * torch.randn(2, count, generator=generator) for count in (6, 4))
    return GeometryEstimate(rotation.float(), translation_m, alpha, beta)


class KnownGeometry(nn.Module):
    """Returns the first of the known heads for a photo, both for a pair, sources first."""

    def __init__(self) -> None:
        super().__init__()
        self.alpha = nn.Parameter(_estimate().alpha)

    def forward(self, crops: Tensor) -> GeometryEstimate:
        known = _estimate()._replace(alpha=self.alpha)
        return GeometryEstimate(*(part[: len(crops)] for part in known))


class WritesDown(nn.Module):
    """A Reflectance Network that returns one random texture, and keeps its arguments."""

    rig_lights, has_mean_face = 0, False

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(4)
        self.texture = nn.Parameter(torch.rand(1, 3, SIDE, SIDE, generator=generator))
        self.encoded: tuple[Tensor, ...] = ()
        self.decoded: tuple[Any, ...] = ()

    def encode(self, *given: Tensor) -> str:
        self.encoded = given
        return "code"

    def decode(self, *given: Any) -> Tensor:
        self.decoded = given
        return self.texture[:, None]


class Raw(nn.Module):
    """A feature network whose layers are the image itself and its half."""

    def layers(self, linear: Tensor) -> list[Tensor]:
        return [linear, F.avg_pool2d(linear, 2)]


@dataclass(frozen=True)
class Asked:
    """The objective, a pair, its terms, and the heads by index."""

    objective: JointObjective
    network: WritesDown
    batch: CropPairs
    terms: dict[str, Tensor]
    heads: PosedHeads

    def head(self, which: int) -> PosedHeads:
        parts = (self.heads.vertices, self.heads.rotation, self.heads.fixed_landmarks)
        return PosedHeads(*(part[which : which + 1] for part in parts))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_joint_dataset(tmp_path_factory.mktemp("known"))


def _asked(dataset: Dataset, batch: CropPairs | None = None) -> Asked:
    network = WritesDown()
    settings = JointSettings(crop_px=CROP_PX, texture_side=SIDE, validation_pairs=1)
    objective = JointObjective(dataset, MODEL, network, KnownGeometry(), Raw(), Raw(), settings=settings)
    objective.measure()
    if batch is None:
        generator = torch.Generator().manual_seed(5)
        crops = torch.rand(2, 3, CROP_PX, CROP_PX, generator=generator)
        landmarks_px = CROP_PX * (0.3 + 0.4 * torch.rand(2, 68, 2, generator=generator))
        light = F.normalize(torch.tensor([[0.6, 0.2, 0.5]]), dim=1)
        batch = CropPairs(
            crops[:1], crops[1:], landmarks_px[:1], landmarks_px[1:], light, torch.zeros(1).long()
        )
    return Asked(objective, network, batch, objective(batch), _heads())


def _heads() -> PosedHeads:
    """v^c = R (mean + M_id alpha + M_exp beta) + t of both heads, by the paper's formula."""
    known = _estimate()
    shape = MODEL.mean + torch.einsum("bk,kvc->bvc", known.alpha, MODEL.identity[:6])
    shape = shape + torch.einsum("bk,kvc->bvc", known.beta, MODEL.expression[:4])
    vertices = torch.einsum("bij,bvj->bvi", known.rotation, shape) + known.translation_m[:, None]
    return PosedHeads(vertices, known.rotation, MODEL.landmarks(vertices)[:, INNER])


@pytest.fixture(scope="module")
def asked(dataset: Dataset) -> Asked:
    return _asked(dataset)


def _close(found: Tensor, wanted: Tensor) -> None:
    """Compare in single precision, in which a mesh and its normals are summed in another order."""
    torch.testing.assert_close(found.detach(), wanted.detach(), rtol=1e-3, atol=1e-4)


def _landmarks(asked: Asked, which: int) -> Tensor:
    """L_l of one head: 49 fixed landmarks, and contour ones at the outline's closest vertices."""
    head = asked.head(which)
    detected = (asked.batch.source_landmarks_px, asked.batch.target_landmarks_px)[which]
    found = head.landmarks_px(detected, CAMERA)
    fixed = project(MODEL.landmarks(head.vertices)[:, INNER], CAMERA)
    _close(found[:, len(CONTOUR) :], fixed)
    wanted = torch.cat([detected[:, : len(CONTOUR)], detected[:, INNER]], 1)
    return ((found - wanted) * 2 / CROP_PX).square().sum(-1).mean()


def test_the_source_is_unwrapped_by_its_own_head_and_the_target_gives_normals_and_light(asked: Asked) -> None:
    texture, normals, visible = asked.network.encoded
    face = unwrap_images(asked.batch.source, asked.head(SOURCE), SIDE)
    colours = asked.objective.source_colours
    assert colours is not None
    _close(texture, face.texture / colour_cast(face.texture, face.visible, colours))
    _close(visible, face.visible)
    _close(normals[0], normal_map(asked.head(SOURCE).vertices[0], grid_triangles(), SIDE))
    # N_t are those of the target's head; the light is the pair's, in camera space.
    code, normals, light = asked.network.decoded
    assert code == "code"
    _close(normals[0], normal_map(asked.head(TARGET).vertices[0], grid_triangles(), SIDE))
    assert torch.equal(light, asked.batch.light[:, None])


def test_photometric_and_feature_terms_compare_the_target(asked: Asked) -> None:
    """L_p = 5 |M_t (I^_t - I_t)|_1, rendered with the target's head."""
    image, mask = render_textures(asked.network.texture, asked.head(TARGET), CAMERA)
    error = ((image - asked.batch.target).abs() * mask).sum() / 3 / mask.sum()
    _close(asked.terms["photometric"], 5 * error)
    # L_I is of I^_t and T^_t, L_L of T^_t alone; both against the target's own.
    truth = unwrap_images(asked.batch.target, asked.head(TARGET), SIDE)
    seen = (truth.visible > 0).float()
    of_image = _raw_distance(asked, "appearance", image * mask, asked.batch.target * mask)
    of_texture = _raw_distance(asked, "light", asked.network.texture * seen, truth.texture * seen)
    _close(asked.terms["appearance_features"], of_image + of_texture)
    _close(asked.terms["light_features"], of_texture)


def _raw_distance(asked: Asked, name: str, a: Tensor, b: Tensor) -> Tensor:
    """Mean squared differences of the layers, over their mean squares on training targets."""
    pairs = spread_pairs(asked.objective._train, 8, lambda pair: True)
    targets = torch.cat([asked.objective._train.read_target(pair) for pair in pairs])
    powers = [layer.square().mean() for layer in Raw().layers(targets)]
    _close(asked.objective.features[name].powers, torch.stack(powers))
    layers = zip(Raw().layers(a), Raw().layers(b), powers, strict=True)
    return sum((x - y).square().mean() / power for x, y, power in layers)


def test_geometry_terms_add_source_target_and_photos(asked: Asked) -> None:
    """L_l = 25 (source + target); L_r = .4 |alpha|^2 + .002 |beta|^2 of both."""
    _close(asked.terms["landmarks"], 25 * (_landmarks(asked, SOURCE) + _landmarks(asked, TARGET)))
    estimate = _estimate()
    prior = 0.4 * estimate.alpha.square().mean(1).sum() + 0.002 * estimate.beta.square().mean(1).sum()
    _close(asked.terms["regularisation"], prior)
    batch = asked.batch
    terms = asked.objective(PhotoCrops(batch.source, batch.source_landmarks_px))
    assert set(terms) == {"landmarks", "regularisation"}
    _close(terms["landmarks"], 25 * _landmarks(asked, SOURCE))


def test_gradients_reach_the_target_s_texture_by_its_prediction_alone(asked: Asked) -> None:
    """T_t(I_t) sends none back through the target's mesh: only where the texture is rendered does it."""
    asked.objective.zero_grad()
    asked.terms["light_features"].backward(retain_graph=True)
    assert asked.network.texture.grad is not None and asked.network.texture.grad.abs().sum() > 0
    geometry: Any = asked.objective.networks["geometry"]
    assert geometry.alpha.grad is None or geometry.alpha.grad.abs().sum() == 0


def test_a_strange_colour_of_light_is_removed_from_the_source_alone(dataset: Dataset, asked: Asked) -> None:
    blue = torch.tensor([0.05, 0.3, 3.0]).view(1, 3, 1, 1)
    batch = asked.batch
    cast = CropPairs(
        batch.source * blue,
        batch.target,
        batch.source_landmarks_px,
        batch.target_landmarks_px,
        batch.light,
        batch.people,
    )
    found = _asked(dataset, cast)
    texture, _, visible = found.network.encoded
    face = unwrap_images(cast.source, found.head(SOURCE), SIDE)
    mean, before = (((image * visible).sum((2, 3)) / visible.sum())[0] for image in (texture, face.texture))
    assert mean[2] / mean[1] < 0.5 * before[2] / before[1]
    assert isinstance(found.objective.source_colours, SourceColours)
    _close(found.terms["photometric"], asked.terms["photometric"])
