from pathlib import Path

import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.landmarks import find_faces
from facerf_cli.face.topology import region_mask
from facerf_cli.files.images import read_image
from facerf_cli.light.estimate import estimate_light
from facerf_cli.light.sphere import rig_directions
from facerf_cli.pipeline import (
    FaceTexture,
    Models,
    crop_face,
    evidence_of_photo,
    explain_photo,
    fit_face,
    load_models,
    predict_olat,
    unwrap_face,
    weigh,
)

PHOTO = Path(__file__).parents[1] / "examples/astronaut.jpg"


@pytest.fixture(scope="module")
def models() -> Models:
    return load_models(None, "builtin", torch.device("cpu"))


@pytest.fixture(scope="module")
def face(models: Models) -> FaceTexture:
    photo = read_image(PHOTO).pixels
    landmarks_px = find_faces(photo, "astronaut")[0].landmarks_px
    crop, cropped = crop_face(photo, landmarks_px, 256)
    fit = fit_face(models.face, crop, landmarks_px, photo.shape)
    return unwrap_face(models.face, fit, cropped, 128, photo.shape)


def test_relit_by_its_own_light_the_photo_comes_back(models: Models, face: FaceTexture) -> None:
    rig = rig_directions(60)
    own = torch.cat(list(predict_olat(models, face, rig)))
    held = torch.cat(list(predict_olat(models, face, rig, quotient=explain_photo(models, face))))
    seen = face.visible > 0.9
    photo = face.texture[:, seen]

    def error(olats: torch.Tensor) -> float:
        remade = weigh(olats, estimate_light(olats[..., seen], photo)[None])[0][:, seen]
        return float((remade - photo).norm() / photo.norm())

    assert error(own) < 0.25
    assert error(held) < 0.7 * error(own)


def test_light_is_read_inside_the_face_and_off_the_eyes(face: FaceTexture) -> None:
    """The paper's M_t; with its eyes where they are asked for."""
    mask = evidence_of_photo(face).mask
    kept = evidence_of_photo(face, keep_eyes=True).mask
    eyes, inside = region_mask("eyes", len(mask)) > 0.5, region_mask("face", len(mask)) > 0.5
    assert not (mask & eyes).any() and (kept & eyes).sum() > 0.9 * eyes.sum()
    assert torch.equal(mask & ~eyes, kept & ~eyes)
    assert not (mask & ~inside).any() and mask.sum() > 0.5 * inside.sum()


def test_a_face_that_is_hardly_seen_has_no_light_to_read(face: FaceTexture) -> None:
    sliver = torch.zeros_like(face.visible)
    sliver[:, 60] = 1
    with pytest.raises(InputError, match="too little of the face"):
        evidence_of_photo(FaceTexture(face.texture, face.visible * sliver, face.normals))
    with pytest.raises(InputError, match="black"):
        evidence_of_photo(FaceTexture(face.texture * 0, face.visible, face.normals))
