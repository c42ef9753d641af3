"""The light of a photo, by faces that the field itself has lit."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from facerf_cli.face.head import FaceTexture
from facerf_cli.image.colour import to_display
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.portrait.parse import Square, look
from facerf_cli.relighting.field import Field, shrunk
from facerf_cli.relighting.fitting import fit_photo
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.photo_light import estimate_light, light_of_frames, over_rig, source_light
from tests import astronaut

AROUND = RigLight(rig_directions(48), torch.full((48, 3), 4 / 48))
OFF_DEG = 7.0  # the last ring of the search has 6; the nearest light of the rig is 16 to 18 away
RIG_DEG = 10.0
COLOUR = 0.25  # relative error of the lamp's colour: the photo shows it only times that of the skin


@pytest.fixture(scope="module")
def models() -> Models:
    return astronaut.models()


@pytest.fixture(scope="module")
def face() -> FaceTexture:
    """The face as the Parsing Network's landmarks fit it; there the field explains its own images best."""
    photo, around = to_display(astronaut.photo()), Square.around(astronaut.face().landmarks_px, 1.7)
    view = look(astronaut.models().networks.parsing, photo, [around])[0]
    head = fit_photo(astronaut.models(), astronaut.photo(), view.landmarks_px[:68])
    small = shrunk(head.face)
    return replace(small, visible=torch.ones_like(small.visible))


def lit(models: Models, face: FaceTexture, light: RigLight) -> FaceTexture:
    """The face as the field shows it under a light."""
    return replace(face, texture=Field(models, face).relit(light.directions, light.weights[None])[0])


def degrees_between(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(torch.rad2deg(torch.acos((one @ other).clamp(-1, 1))))


OF_FRAMES = (-38.0, 12.0)


@pytest.mark.parametrize("azel_deg", [(7.0, -6.0), OF_FRAMES, (55.0, 30.0)])
def test_a_lamp_is_found_where_it_is(
    models: Models, face: FaceTexture, azel_deg: tuple[float, float]
) -> None:
    lamp = azel_to_direction(*azel_deg)
    assert min(degrees_between(one, lamp) for one in rig_directions(32)) > RIG_DEG
    colour = torch.tensor([[1.0, 0.8, 0.6]])
    shown = lit(models, face, RigLight(lamp[None], colour))
    light = source_light(models, shown).light
    assert degrees_between(light.directions[0], lamp) < OFF_DEG
    assert light.weights[0].sum() > 0.6 * light.weights.sum()
    torch.testing.assert_close(light.weights[0] / light.weights[0, 0], colour[0], rtol=COLOUR, atol=0)
    if azel_deg == OF_FRAMES:  # the same frame twice has the same light
        of_two = light_of_frames(models, [shown, shown])
        torch.testing.assert_close(of_two.directions, light.directions, rtol=0, atol=1e-3)
        torch.testing.assert_close(of_two.weights, light.weights, rtol=0.01, atol=1e-3)


def test_light_from_all_around_has_no_lamp_and_the_quotient_is_of_the_light_that_is_held(
    models: Models, face: FaceTexture
) -> None:
    found = source_light(models, lit(models, face, AROUND)).light.weights
    assert found[0].sum() < 0.1 * found.sum()
    assert found[1:].std() < 0.3 * found[1:].mean()
    # A frame of a shot is explained by the shot's light.
    lamp, other = (RigLight(azel_to_direction(x, 0.0)[None], torch.ones(1, 3)) for x in (30.0, -30.0))
    shown = lit(models, face, lamp)
    held = light_of_frames(models, [lit(models, face, other)])
    own, wrong = source_light(models, shown), source_light(models, shown, held)
    assert wrong.light is held
    assert (wrong.quotient.ratio.log().abs().mean()) > 2 * own.quotient.ratio.log().abs().mean()


def test_over_a_rig_the_light_keeps_its_sum_and_the_lamp_its_place() -> None:
    lamp, rig = azel_to_direction(-38.0, 12.0), rig_directions(150)
    around = torch.rand(32, 3, generator=torch.Generator().manual_seed(1)) / 32
    light = RigLight(torch.cat([lamp[None], rig_directions(32)]), torch.cat([torch.ones(1, 3), around]))
    weights = over_rig(light, rig)
    torch.testing.assert_close(weights.sum(0), light.weights.sum(0))
    alone = over_rig(RigLight(light.directions, light.weights * torch.eye(33)[:, :1]), rig)
    assert (alone[:, 0] > 0).sum() == 3
    assert degrees_between(F.normalize(alone[:, 0] @ rig, dim=0), lamp) < 2  # the triangle's sides have 18
    assert (weights >= alone).all()


@pytest.mark.slow
@pytest.mark.parametrize(("fill", "one_lamp"), [(0.02, True), (0.6, False)])
def test_one_lamp_that_explains_the_photo_is_its_light(
    models: Models, face: FaceTexture, fill: float, one_lamp: bool
) -> None:
    """With much light from elsewhere the rig's lights are the estimate. No light explains the noise."""
    lamps = azel_to_direction(torch.tensor([-38.0, 70.0]), torch.tensor([12.0, 40.0]))
    shown = lit(models, face, RigLight(lamps, torch.tensor([[1.0], [fill]]).expand(2, 3)))
    noise = 1 + 0.12 * torch.randn(shown.texture.shape, generator=torch.Generator().manual_seed(0))
    head = replace(astronaut.head(), face=replace(shown, texture=shown.texture * noise))
    found = estimate_light(models, head)
    rig_alone = found.evidence.least_squares()
    assert found.key_share is not None and (found.key_share > 0.8) == one_lamp
    assert torch.equal(found.light.weights, rig_alone) != one_lamp
