from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from facerf_cli.errors import InputError
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.topology import region_mask
from facerf_cli.light.estimate import estimate_signed_weights
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions
from facerf_cli.network.inputs import MEAN_RADIANCE, colour_cast
from facerf_cli.person import Person, Target
from facerf_cli.portrait.person import look_at_person
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.face_alone import FaceAlone
from facerf_cli.relighting.field import Field, photo_evidence, weighted_sum
from facerf_cli.relighting.fitting import fit_photo, reflectance_of
from facerf_cli.relighting.memory import require_face
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.photo_light import Estimator, estimate_light
from facerf_cli.run import memory
from tests import astronaut
from tests.refusals import refused


@pytest.fixture(scope="module")
def models() -> Models:
    return astronaut.models()


@pytest.fixture(scope="module")
def head() -> Head:
    return astronaut.head()


def olats_of(
    models: Models, head: Head, lights: Tensor, turn: Tensor | None = None, network_alone: bool = False
) -> Tensor:
    """OLAT textures [L, 3, T, T] of the face."""
    field = reflectance_of(models, head, "field", network_alone)
    assert isinstance(field, Field)
    return torch.cat(list(field.olats(lights, turn)))


def test_relit_by_its_own_light_the_photo_comes_back(models: Models, head: Head) -> None:
    rig = rig_directions(40)
    own = olats_of(models, head, rig, network_alone=True)
    corrected = olats_of(models, head, rig)
    seen = head.face.visible > 0.9
    texture = head.face.texture[:, seen]

    def error(olats: torch.Tensor) -> float:
        weights = estimate_signed_weights(olats[..., seen], texture)
        rendered = weighted_sum([olats], weights[None])[0][:, seen]
        return float((rendered - texture).norm() / texture.norm())

    assert error(own) < 0.25
    assert error(corrected) < 0.7 * error(own)


def test_light_is_read_inside_a_face_that_is_seen_and_off_the_eyes(head: Head) -> None:
    """The paper's M_t; with the eyes on demand."""
    mask = photo_evidence(head.face).mask
    kept = photo_evidence(head.face, keep_eyes=True).mask
    eyes, inside = region_mask("eyes", len(mask)) > 0.5, region_mask("face", len(mask)) > 0.5
    assert not (mask & eyes).any() and (kept & eyes).sum() > 0.9 * eyes.sum()
    assert torch.equal(mask & ~eyes, kept & ~eyes)
    assert not (mask & ~inside).any() and mask.sum() > 0.5 * inside.sum()
    face, sliver = head.face, torch.zeros_like(head.face.visible)
    sliver[:, 60] = 1
    with pytest.raises(InputError, match="too little of the face"):
        photo_evidence(FaceTexture(face.texture, face.visible * sliver, face.normals))
    refused(InputError, "black", photo_evidence, FaceTexture(face.texture * 0, face.visible, face.normals))


def test_a_turned_head_is_shown_alone_in_its_pose(models: Models, head: Head) -> None:
    light = RigLight(azel_to_direction(0.0, 0.0)[None], torch.ones(1, 3))
    turned = replace(head.fit, rotation=pose_to_rotation(30, 0, 0))
    straight = replace(head.fit, rotation=pose_to_rotation(0, 0, 0))
    targets = [Target(fit) for fit in (straight, turned)]
    person = Person(models, None, head, reflectance_of(models, head))
    images = [person.image(light, target) for target in targets]
    for image, target in zip(images, targets, strict=True):
        assert image.shape == (256, 256, 3)
        assert (image[person.prepare(target).matte == 0] == 0).mean() > 0.5
    # the point nearest to the camera
    noses = [
        FaceAlone(models.face, head, fit=target.fit).view.surface(slice(0, 256))[..., 5] for target in targets
    ]
    columns = [int(torch.where(z == 0, -torch.inf, z).amax(0).argmax()) for z in noses]
    assert columns[1] > columns[0] + 10  # yaw > 0 turns the nose to the image's right


def test_the_light_of_the_photo_explains_it_and_a_mask_that_hides_nothing_changes_nothing(
    models: Models, head: Head
) -> None:
    estimate = estimate_light(models, head, rig=rig_directions(60))
    assert estimate.light.weights.shape == (60, 3) and (estimate.light.weights >= 0).all()
    assert estimate.evidence.residual(estimate.explained) < 0.25
    whole = np.ones(head.cropped.shape[:2], np.float32)
    assert torch.equal(head.without(models.face, whole).face.texture, head.face.texture)
    whole[: len(whole) // 2] = 0
    assert head.without(models.face, whole).face.visible.sum() < 0.8 * head.face.visible.sum()
    network = WritesDown()
    blue = replace(head.face, texture=head.face.texture * torch.tensor([0.05, 0.3, 3.0]).view(3, 1, 1))
    unknown = replace(models.with_networks(reflectance=network), source_colours=None)
    olats_of(unknown, replace(head, face=blue), rig_directions(4), network_alone=True)
    assert torch.equal(network.encoded[0], blue.texture[None])
    size, unit = (512, 512), 1 << 20
    memory.set_limit(64 * unit)
    require_face(models.face, head.fit, size)
    memory.set_limit(34 * unit)
    with pytest.raises(InputError, match=r"a face of \d+ x \d+ pixels: needs .* of memory.*smaller photo"):
        require_face(models.face, head.fit, size)


def test_a_face_is_encoded_once_and_sees_lights_as_in_one_batch(
    models: Models, head: Head, monkeypatch: pytest.MonkeyPatch
) -> None:
    field, network, faces = Field(models, head.face), models.networks.reflectance, []
    encode = network.encode
    monkeypatch.setattr(network, "encode", lambda *source: faces.append(source) or encode(*source))
    rig = rig_directions(5)
    apart = torch.cat([next(field.olats(light[None])) for light in rig])
    assert len(faces) == 1
    torch.testing.assert_close(apart, torch.cat(list(Field(models, head.face).olats(rig))))


class WritesDown(nn.Module):
    """A Reflectance Network that keeps what it is given; its OLATs are grey."""

    rig_lights, has_mean_face = 0, False

    def encode(self, *given: Tensor) -> None:
        self.encoded = given

    def decode(self, encoded: None, *given: Tensor) -> Tensor:
        self.normals, self.lights = given
        side = self.encoded[0].shape[-1]
        return torch.full((1, self.lights.shape[1], 3, side, side), 0.2)

    def bytes_per_light(self, texels: int) -> int:
        return 1


def test_the_network_gets_what_the_paper_says(models: Models, head: Head) -> None:
    """T_s without a strange cast, N_s, N_t = the turned N_s, and the lights as they were asked for."""
    network, face = WritesDown(), head.face
    blue = torch.tensor([0.05, 0.3, 3.0]).view(3, 1, 1)
    lit = replace(head, face=replace(face, texture=face.texture * blue))
    lights = torch.stack([azel_to_direction(60.0, 30.0), azel_to_direction(-70.0, 0.0)])
    rotation = pose_to_rotation(40.0, 0.0, 0.0)
    olats_of(models.with_networks(reflectance=network), lit, lights, head.fit.turn_to(rotation), True)
    texture, normals, visible = network.encoded
    assert models.source_colours is not None
    cast = colour_cast(lit.face.texture[None], face.visible[None, None], models.source_colours)
    assert cast[0, 2] > 3 * cast[0, 0]
    torch.testing.assert_close(texture, lit.face.texture[None] / cast)
    assert torch.equal(normals, face.normals[None]) and torch.equal(visible, face.visible[None, None])
    assert torch.equal(network.lights, lights[None])
    turned = torch.einsum("dc,cij->dij", rotation @ head.fit.rotation.T, face.normals)
    torch.testing.assert_close(network.normals[0], turned)


def test_a_field_that_is_corrected_sees_no_coloured_shade(models: Models, head: Head) -> None:
    face, seen = head.face, []
    half = face.texture.shape[-1] // 2
    texture = face.texture.clone()
    texture[..., :half] *= torch.tensor([0.2, 0.1, 0.4]).view(3, 1, 1)
    shaded = replace(head, face=replace(face, texture=texture))
    for alone in (True, False):
        network = WritesDown()
        own = models.with_networks(reflectance=network)
        olats_of(own, shaded, azel_to_direction(0.0, 0.0)[None], network_alone=alone)
        well = face.visible[:, :half] > 0.9
        colour = network.encoded[0][0, :, :, :half][:, well].mean(1)
        seen.append(float(colour[2] / colour[1]))
    assert seen[1] < 0.6 * seen[0]


def test_features_see_the_exposure_of_their_training(models: Models, head: Head) -> None:
    """Whatever the photo's brightness, S_f and V_f see a face whose mean is `MEAN_RADIANCE`."""
    seen: list[Tensor] = []

    class Features:
        def layers(self, linear: Tensor) -> list[Tensor]:
            seen.append(linear.detach())
            return [linear]

    dark = replace(head, face=replace(head.face, texture=head.face.texture / 16))
    mask = photo_evidence(dark.face).mask
    estimate_light(models, dark, rig=rig_directions(20), estimator=Estimator(features=Features()))
    photo = seen[0][0]  # what the explanations are compared with
    assert abs(float(photo[:, mask].mean()) - MEAN_RADIANCE) < 1e-4
    assert not photo[:, ~mask].any()


def test_sums_of_lights_do_not_depend_on_how_they_are_batched() -> None:
    generator = torch.Generator().manual_seed(0)
    olats, weights = torch.rand(7, 3, 4, 5, generator=generator), torch.rand(2, 7, 3, generator=generator)
    whole = torch.einsum("mlc,lcij->mcij", weights, olats)
    torch.testing.assert_close(weighted_sum(torch.split(olats, 3), weights), whole)


def test_a_broken_pixel_in_the_face_changes_little_of_its_light(models: Models) -> None:
    photo, landmarks_px = astronaut.photo().copy(), astronaut.face().landmarks_px
    x, y = landmarks_px[30].round().astype(int)  # the tip of the nose
    photo[y, x] = 1e6
    whole, broken = (fit_photo(models, image, landmarks_px) for image in (astronaut.photo(), photo))
    means = [float((head.face.texture * head.face.visible).mean()) for head in (whole, broken)]
    assert means[1] < 1.02 * means[0]
    seen = look_at_person(models.networks.people, models.face, photo, broken.fit)
    assert float(seen.image.max()) < 10
