"""Agreement of a page of `facerf view`, as Chromium draws it, with `facerf relight`, in steps of 255; bytes.

    python benchmarks/page_agreement.py [PHOTO ...]

Ten single lights and three procedural maps, at the automatic exposure of each side and the default view, over
the pixels of which the person has more than half. Needs Chromium; WebGL2 is drawn by software.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from _common import ASTRONAUT, ROOT, arguments

from facerf_cli.cli.items.view_photos import page_maps, portrait_field_of
from facerf_cli.colour import SOFT_VIEW, encode_display
from facerf_cli.files.images import read_image
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.models import load_models
from facerf_cli.pipeline import composition_of, find_for, head_of, relit_by
from facerf_cli.resize import shrunk_photo
from facerf_cli.viewer.packing import packed
from facerf_cli.viewer.page import page

sys.path.insert(0, str(ROOT))
from tests.viewer.browser import drawn

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
    """Addresses, directions [L, 3] and weights [L, 3] of all lights."""
    one = torch.ones(1, 3)
    found = [(f"light={az},{el}", azel_to_direction(az, el)[None].float(), one) for az, el in LIGHTS]
    rig = rig_directions()
    for sky in page_maps():
        if sky.name in MAPS:
            pixels = torch.from_numpy(sky.pixels.astype(np.float16).astype(np.float32))
            found.append((f"env={sky.name}", rig, envmap_weights(pixels, rig)))
    return found


def measure(path: Path, folder: Path) -> None:
    """Print the table of one photo."""
    models = load_models(None, "builtin", torch.device("cpu"))
    photo = read_image(path).pixels
    face = find_for(models.default_geometry, photo, str(path))[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face), PHOTO_PX)
    field = portrait_field_of(models, head, photo)
    whole = composition_of(models, photo, head, field)
    text = page(path.stem, path.name, packed(photo, head.fit.crop, field, whole, page_maps()), "")
    print(f"{path.name}: {photo.shape[1]} x {photo.shape[0]}, {len(text) / 2**20:.1f} MiB")
    begun = time.perf_counter()
    shown = drawn(text, [name for name, *_ in setups()], folder)
    print(f"{time.perf_counter() - begun:.0f} s for {len(shown)} states in software")
    print("light              EV relight   page    mean   99 %    most")
    seen = whole.matte > 0.5
    for (name, directions, weights), one in zip(setups(), shown, strict=True):
        relit = next(relit_by(whole, head, field, directions, weights[None]))
        ev = whole.exposure_ev(relit, "auto")
        exposed = whole.image(relit, ev).pixels * np.float32(2.0**ev)
        truth = np.round(255 * encode_display(exposed, SOFT_VIEW, whole.matte))
        error = np.abs(truth - one.pixels[..., :3])[seen]
        errors = f"{error.mean():8.2f}{np.percentile(error, 99):7.1f}{error.max():8.0f}"
        print(f"{name:18}{ev:11.2f}{one.ev:7.2f}{errors}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path, default=[ASTRONAUT])
    options = parser.parse_args()
    for path in options.photos:
        with tempfile.TemporaryDirectory() as folder:
            measure(path, Path(folder))


if __name__ == "__main__":
    main()
