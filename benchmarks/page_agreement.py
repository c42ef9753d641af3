"""Agreement of a page of `facerf view` with `facerf relight`, in 8-bit steps; bytes; texture fetches.

    python benchmarks/page_agreement.py [PHOTO ...] [--rank 192] [--lights 800]

Ten single lights and three procedural maps, at the automatic exposure of each side. The page is drawn by its
numpy twin (`tests/oracles/viewer_page.py`), which `tests/viewer/test_viewer_browser.py` holds to a browser.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from _common import ASTRONAUT, ROOT, arguments

from facerf_cli.cli.items.view_photos import page_maps
from facerf_cli.colour import linear_to_srgb
from facerf_cli.files.images import read_image
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.models import load_models
from facerf_cli.pipeline import composition_of, find_for, head_of, reflectance_of, relit_by
from facerf_cli.resize import shrunk_photo
from facerf_cli.viewer.basis import BasisSettings, light_basis
from facerf_cli.viewer.packing import packed
from facerf_cli.viewer.page import page

sys.path.insert(0, str(ROOT))
from tests.oracles.viewer_page import Page, direction

LIGHTS = (
    (20, 5),
    (40, 25),
    (-70, 10),
    (0, 80),
    (0, -40),
    (75, -20),
    (-30, 50),
    (110, 20),
    (-140, 20),
    (180, 30),
)
MAPS = ("sun", "windows", "studio")
PHOTO_PX = 1024


def setups() -> list[tuple[str, torch.Tensor, torch.Tensor]]:
    """Names, directions [L, 3] and weights [L, 3] of all lights."""
    one = torch.ones(1, 3)
    found = [(f"{az},{el}", torch.from_numpy(direction(az, el)).float()[None], one) for az, el in LIGHTS]
    rig = rig_directions()
    for sky in page_maps():
        if sky.name in MAPS:
            found.append((sky.name, rig, envmap_weights(torch.from_numpy(sky.pixels), rig)))
    return found


def measure(path: Path, settings: BasisSettings) -> None:
    """Print the table of one photo."""
    models = load_models(None, "builtin", torch.device("cpu"))
    photo = read_image(path).pixels
    face = find_for(models.default_geometry, photo, str(path))[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face), PHOTO_PX)
    field = reflectance_of(models, head, "portrait", photo=photo)
    whole = composition_of(models, photo, head, field)
    basis = light_basis(models, photo, head, settings)
    document = packed(basis, page_maps())
    twin, seen = Page(document), basis.matte > 0.5
    text = page(path.stem, path.name, document, "")
    fetches = twin.rank * basis.maps[0, ..., 0].size / basis.matte.size + 4
    print(
        f"{path.name}: {basis.matte.shape[1]} x {basis.matte.shape[0]}, {len(text) / 2**20:.1f} MiB,", end=" "
    )
    print(f"{fetches:.1f} texture fetches a pixel")
    print("light        EV relight   page    mean   99 %")
    for name, directions, weights in setups():
        relit = next(relit_by(whole, head, field, directions, weights[None]))
        ev = whole.exposure_ev(relit, "auto")
        truth = 255 * linear_to_srgb((whole.image(relit, ev).pixels * 2.0**ev).clip(0, 1))
        lights = list(zip(directions.double().numpy(), weights.numpy(), strict=True))
        sums = twin.sums([(toward / np.linalg.norm(toward), rgb) for toward, rgb in lights])
        error = np.abs(truth - twin.shown(sums, twin.exposure_ev(sums)))[seen]
        errors = f"{error.mean():8.2f}{np.percentile(error, 99):7.1f}"
        print(f"{name:12}{ev:11.2f}{twin.exposure_ev(sums):7.2f}{errors}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path, default=[ASTRONAUT])
    parser.add_argument("--rank", type=int, default=BasisSettings.rank)
    parser.add_argument("--lights", type=int, default=BasisSettings.lights)
    options = parser.parse_args()
    for path in options.photos:
        measure(path, BasisSettings(options.lights, options.rank))


if __name__ == "__main__":
    main()
