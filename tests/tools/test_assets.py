"""The assets in the package are what their recipes build."""

import numpy as np
import pytest
import torch

from facerf_cli.baselines.synthesis import ASSET, SIDE, light_prior, skin_prior
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, LANDMARKS_M, OUTLINES_PATH, REGIONS, region_mask
from tools import builtin_face, face_regions
from tools.baseline_priors import LIGHT_ORDER, learn_light, learn_skin

MIRROR = torch.tensor([-1.0, 1, 1])


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return load_face_model()


def mirrored(field: torch.Tensor) -> torch.Tensor:
    return (field.reshape(GRID, GRID, 3).flip(1) * MIRROR).reshape(-1, 3)


@pytest.mark.slow
def test_the_built_in_model_is_what_its_recipe_builds(model):
    built = builtin_face.build()
    assert model.expression_names == built.expression_names
    assert torch.equal(model.mean, built.mean) or (model.mean - built.mean).abs().max() < 1e-6
    assert (model.expression - built.expression).abs().max() < 3e-5  # kept in half precision
    spread, rebuilt = (m.identity.square().sum(0).sqrt() for m in (model, built))  # modes may turn
    assert (spread - rebuilt).abs().max() < 3e-5


def test_the_mean_is_read_once_symmetric_and_its_left_is_the_subjects(model):
    assert load_face_model() is load_face_model("builtin")
    assert torch.equal(model.mean, mirrored(model.mean))
    found = model.landmarks(model.mean[None])[0].numpy()
    assert np.linalg.norm(found - LANDMARKS_M, axis=-1).max() < 0.5e-3
    smile = model.expression[model.expression_names.index("smile_left")]
    assert smile[model.mean[:, 0] > 0.01].norm() > 5 * smile[model.mean[:, 0] < -0.01].norm()


def test_priors_drawn_again_are_faces_with_more_light_from_above() -> None:
    diffuse, gloss = learn_skin(50)
    for found, kept, near in ((diffuse, skin_prior().diffuse, 0.3), (gloss, skin_prior().gloss, 0.1)):
        assert float((found.mean - kept.mean).abs().mean()) < near
    light = learn_light(40)
    assert torch.allclose(light.mean[0], light_prior(LIGHT_ORDER).mean[0], rtol=0.15)
    mean = skin_prior().diffuse.at(torch.zeros(len(skin_prior().diffuse.modes)), 128).exp()
    assert mean.shape == (3, 128, 128) and float(mean.min()) > 0.005 and float(mean.max()) < 0.9

    def at(name: str) -> torch.Tensor:
        mask = region_mask(name, 128)
        return (mean * mask).sum((1, 2)) / mask.sum()

    assert (at("brows") < 0.8 * at("skin")).all()
    assert at("lips")[0] / at("lips")[1] > at("skin")[0] / at("skin")[1]
    assert torch.equal(skin_prior().diffuse.at(torch.zeros(50), SIDE), skin_prior().diffuse.mean)
    constant, upward = light_prior(1).mean[:2, 1]
    assert 0.2 < float(upward / constant) < 1.5
    assert ASSET.stat().st_size < 2 << 20


def test_outlines_are_those_that_their_recipe_draws() -> None:
    outlines = face_regions.build()
    with np.load(OUTLINES_PATH, allow_pickle=False) as stored:
        assert set(stored) == set(outlines) == set(REGIONS) - {"skin"}
        for name, outline in outlines.items():
            np.testing.assert_allclose(stored[name], outline, atol=1e-9)
