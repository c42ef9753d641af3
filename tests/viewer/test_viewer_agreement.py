"""The factored basis of a real photo agrees with the composition that `facerf relight` writes."""

from pathlib import Path

import numpy as np
import torch

from facerf_cli.colour import linear_to_srgb
from facerf_cli.files.images import read_image
from facerf_cli.models import load_models
from facerf_cli.pipeline import composition_of, find_for, head_of, reflectance_of, relit_by
from facerf_cli.resize import shrunk_photo
from facerf_cli.viewer.basis import BasisSettings, light_basis
from facerf_cli.viewer.packing import packed
from tests.oracles.viewer_page import Page

ASTRONAUT = Path(__file__).parents[2] / "examples" / "astronaut.jpg"


def test_page_agrees_with_relight_at_lights_of_its_rig() -> None:
    models = load_models(None, "builtin", torch.device("cpu"))
    photo = read_image(ASTRONAUT).pixels
    face = find_for(models.default_geometry, photo, "astronaut")[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face), 384)
    basis = light_basis(models, photo, head, BasisSettings(lights=24, rank=24, maps_px=192))
    twin, seen = Page(packed(basis, [])), basis.matte > 0.5
    field = reflectance_of(models, head, "portrait", photo=photo)
    whole = composition_of(models, photo, head, field)
    assert seen.mean() > 0.2
    for light in np.argsort(-basis.directions[:, 2])[:4]:  # from in front: not shown at many stops
        toward = torch.from_numpy(basis.directions[light])[None]
        relit = next(relit_by(whole, head, field, toward, torch.ones(1, 1, 3)))
        ev = whole.exposure_ev(relit, "auto")
        truth = 255 * linear_to_srgb((whole.image(relit, ev).pixels * 2.0**ev).clip(0, 1))
        sums = twin.sums([(basis.directions[light].astype(float), np.ones(3))])
        assert abs(twin.exposure_ev(sums) - ev) < 0.05
        error = np.abs(truth - twin.shown(sums, ev))
        # No light is truncated; what is left, 2.3 and 14 at most, is 8 bits, JPEG and the size of the maps.
        assert error[seen].mean() < 2.6 and np.percentile(error[seen], 99) < 18
        assert error[basis.matte == 0].mean() < 1.3
