"""The outlines in the package are those that their recipe draws."""

import numpy as np

from facerf_cli.face.topology import OUTLINES_PATH, REGIONS
from tools.face_regions import build


def test_the_asset_is_what_the_recipe_draws() -> None:
    outlines = build()
    with np.load(OUTLINES_PATH, allow_pickle=False) as stored:
        assert set(stored) == set(outlines) == set(REGIONS) - {"skin"}
        for name, outline in outlines.items():
            np.testing.assert_allclose(stored[name], outline, atol=1e-9)
