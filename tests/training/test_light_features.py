from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.dataset.crops import stack_info
from facerf_cli.dataset.faces import open_faces
from facerf_cli.face.topology import grid_triangles
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.network.features import LightNetwork, LightSettings
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.raster.texture import unwrap
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.synth.bank.texture_samples import TEXTURE_CAMERA, Sample
from facerf_cli.training.light_features import LightFeaturesObjective
from facerf_cli.training.objective import seeded
from facerf_cli.training.texture import PeopleSettings
from tests.dataset.dataset_fixture import write_small_dataset
from tests.toy_faces import ToyFaces
from tests.training.alone import assert_samples_are_alone

SETTINGS = PeopleSettings(lights=4, held_out_people=2, held_out_draws=3)


def objective(bank: Bank) -> LightFeaturesObjective:
    return LightFeaturesObjective(bank, LightNetwork(LightSettings(1 / 8, 4, 32)), SETTINGS)


def test_training_lowers_the_loss_and_finds_lights_of_held_out_heads(bank: Bank) -> None:
    stage = objective(bank)
    before = stage.validate().metrics["angle_deg"]
    optimizer = torch.optim.AdamW(stage.networks.parameters(), lr=2e-3)
    losses = []
    for step in range(60):
        loss = sum(stage(stage.draw(2, lambda i, step=step: seeded(0, step, i), step)).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    after = stage.validate()
    assert after.metrics["angle_deg"] < 50 < before  # one constant guess is off by 65
    assert after.metrics == stage.validate().metrics
    assert stage.chooses_by in after.metrics and set(stage.networks) == {"light_features"}
    assert after.sheet is not None and after.sheet.shape == (2 * 3 * 3 * 32, 4 * 32, 3)


def test_a_sample_does_not_depend_on_its_neighbours(bank: Bank) -> None:
    assert_samples_are_alone(objective(bank))


def test_lights_are_unit_vectors_in_the_frame_of_the_head(bank: Bank) -> None:
    lights = objective(bank).draw(4, lambda i: seeded(3, i), 0).lights_head
    assert torch.allclose(lights.norm(dim=-1), torch.ones(4, 4), atol=1e-5)
    batch = objective(bank).draw(8, lambda i: seeded(2, i), 0)
    assert (batch.textures.amax((1, 2)) == 0).any()
    brightness = batch.textures.mean(2)
    right_less_left = brightness[..., 16:].sum((2, 3)) - brightness[..., :16].sum((2, 3))
    sideways = batch.lights_head[..., 0]
    clear = sideways.abs() > 0.5
    assert clear.sum() > 4
    assert (right_less_left[clear].sign() == sideways[clear].sign()).float().mean() > 0.9


def test_the_crops_of_a_stack_give_its_textures(tmp_path: Path) -> None:
    """Unwrapped in the step: the stack's textures but for the camera's colours, and its lights."""
    dataset = write_small_dataset(tmp_path, lights=20, crop_px=48)
    faces, subject = open_faces(dataset.folder, "builtin", 32), dataset.subjects[0]
    batch = faces.draw_lights(torch.tensor([0]), 5, torch.Generator().manual_seed(2))
    found = faces.light_textures(batch)
    errors, colours = [], batch.colours[0].diagonal()  # of a camera that sees colours
    for camera in dataset.cameras[subject]:
        path = dataset.stack_path(subject, camera)
        info, olats = stack_info(path), read_olats(path).float()
        light = (found.lights_head[0] @ (info.directions @ info.rotation).T).argmax(1)
        vertices = info.fit.vertices_camera(faces.model)
        images = olats[light].flatten(0, 1)
        wanted, _ = unwrap(images, vertices, grid_triangles(), info.fit.camera, 32)
        difference = found.textures[0] - wanted.view(5, 3, 32, 32) * colours[:, None, None]
        errors.append(float(difference[found.textures[0] > 0].abs().mean() / found.textures.mean()))
    assert min(errors) < 0.03 < 0.3 < max(errors)  # another camera's view of the face
    stage = LightFeaturesObjective(faces, LightNetwork(LightSettings(1 / 16, 4, 8, 32)), SETTINGS)
    drawn = stage.draw(2, lambda i: seeded(5, i), 0)
    assert stage(drawn)["light"].item() > 0 and "angle_deg" in stage.validate().metrics


def test_cameras_cast_colours() -> None:
    matrices = torch.stack([TEXTURE_CAMERA.colours(seeded(draw)) for draw in range(400)])
    grey = matrices[:, 0, 1] > 0
    cast, mixed = matrices[~grey], matrices[grey]
    assert 0.2 < grey.float().mean() < 0.3
    assert torch.equal(cast, cast.diagonal(dim1=1, dim2=2).diag_embed())
    assert torch.equal(mixed, mixed[:, :1].expand_as(mixed)), "a row for all channels"
    balance = matrices.sum(1).log()
    assert balance.abs().max() < 0.121 and balance.std() > 0.05


def test_directions_are_learnt_in_the_frame_of_the_head() -> None:
    """R^T of the light in camera space: a texture does not show how its head is turned."""
    turn = pose_to_rotation(35.0, -10.0, 5.0)

    class TurnedFaces(ToyFaces):
        def draw(self, people: Tensor, lights: int, generator: torch.Generator) -> Sample:
            sample = super().draw(people, lights, generator)
            return replace(sample, normals_target=torch.einsum("dc,bcij->bdij", turn, sample.normals_source))

    stage = LightFeaturesObjective(TurnedFaces(), LightNetwork(LightSettings(1 / 16, 4, 8)), SETTINGS)
    batch = stage.draw(2, lambda i: seeded(5, i), 0)
    drawn = torch.cat([TurnedFaces().draw(*_drawn(stage, seeded(5, i))).lights for i in range(2)])
    torch.testing.assert_close(batch.lights_head, drawn @ turn, rtol=0, atol=1e-4)


def _drawn(stage: LightFeaturesObjective, generator: torch.Generator) -> tuple[Tensor, int, torch.Generator]:
    """The arguments with which the stage draws a sample."""
    return torch.tensor([stage.any_person(generator)]), SETTINGS.lights, generator
