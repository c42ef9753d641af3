"""The priors in the package."""

import torch

from facerf_cli.baselines.synthesis import ASSET, SIDE, light_prior, skin_prior
from facerf_cli.face.topology import region_mask
from tools.baseline_priors import LIGHT_ORDER, learn_light, learn_skin


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
