"""Agreement of a page of `facerf view`, as Chromium draws it, with `facerf relight`, in steps of 255; bytes.

    python benchmarks/page_agreement.py [PHOTO ...] [--lights N] [--size PX]

N lights of the rig and N between its lights, each in the room that it stands in by default, three procedural
maps, and these together with a light, at the automatic exposure of each side and the default view, over the
pixels of which the person has more than half. Needs Chromium; WebGL2 is drawn by software.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from _common import ASTRONAUT, ROOT, arguments

from facerf_cli.face.head import shrunk_photo
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import SOFT_VIEW, encode_display, most_exposure_ev
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import direction_to_azel, golden_spiral, rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.person import Person
from facerf_cli.pipeline import find_for, head_of, reflectance_of
from facerf_cli.relighting.models import load_models
from facerf_cli.viewer.page import packed, page
from facerf_cli.work.light_setups import LightSources, collect_setups, in_room
from facerf_cli.work.lights import lights_over_rig, with_room
from facerf_cli.work.view_photos import head_place, of_photo, page_maps

sys.path.insert(0, str(ROOT))
from tests.viewer.browser import drawn

MAPS = ("sun", "windows", "studio")
KEY = "70,30"
Setup = tuple[str, str, Lights]


def setups(count: int) -> list[Setup]:
    """Kind, address and lights of every state."""
    rig, found = rig_directions(), []
    between = torch.from_numpy(golden_spiral(count)).float()
    for kind, some in (("on the rig", rig[:: len(rig) // count][:count]), ("between", between)):
        for toward in some:
            azimuth, elevation = (round(float(x), 3) for x in direction_to_azel(toward))
            found.append((kind, f"light={azimuth},{elevation}", in_default_room(f"{azimuth},{elevation}")))
    key = in_default_room(KEY)
    for sky in page_maps():
        if sky.name in MAPS:
            pixels = torch.from_numpy(sky.pixels.astype(np.float32))
            of_map = envmap_weights(pixels, rig)[None]
            both = torch.cat([rig, key.directions]), torch.cat([of_map, key.weights], 1)
            found.append(("map", f"env={sky.name}", Lights(rig, of_map)))
            found.append(("map and light", f"env={sky.name}&light={KEY}", Lights(*both)))
    return found


def in_default_room(light: str) -> Lights:
    """A light as `facerf relight --light` has it."""
    (setup,) = collect_setups(LightSources(light=[light]), Path("out"))
    return lights_over_rig((with_room(in_room(setup, None, False)),), "150", "cell")


def measure(path: Path, folder: Path, count: int, size_px: int) -> None:
    """Print the table of one photo."""
    models = load_models()
    photo = read_image(path).pixels
    face = find_for(models.networks.people, models.default_geometry, photo, str(path))[0]
    photo, head = shrunk_photo(photo, head_of(models, photo, face), size_px)
    basis, plate = of_photo(models, photo, head)
    document = packed(basis, plate, head_place(head.fit.crop, plate.matte), page_maps())
    text = page(path.name, [path.name], document, "")
    print(f"{path.name}: {photo.shape[1]} x {photo.shape[0]}, {len(text) / 2**20:.1f} MiB")
    begun = time.perf_counter()
    given = setups(count)
    shown = drawn(text, [address for _, address, _ in given], folder)
    print(f"{time.perf_counter() - begun:.0f} s for {len(shown)} states in software")
    field = reflectance_of(models, head, "portrait", photo=photo)
    whole = Person(models, photo, head, field).composed()
    seen = whole.matte > 0.5
    print("light                    EV relight   page    mean   95 %   99 %    most")
    errors: dict[str, list[np.ndarray]] = {}
    for (kind, name, lights), one in zip(given, shown, strict=True):
        relit = next(whole.relit(lights))
        (strength,) = lights.strengths()
        ev = min(whole.exposure_ev(relit, "auto"), most_exposure_ev("auto", strength))
        exposed = whole.image(relit, ev).pixels * np.float32(2.0**ev)
        truth = np.round(255 * encode_display(exposed, SOFT_VIEW, whole.matte))
        error = np.abs(truth - one.pixels[..., :3])[seen]
        errors.setdefault(kind, []).append(error)
        print(f"{name:24}{ev:11.2f}{one.ev:7.2f}{figures(error)}", flush=True)
    for kind, some in errors.items():
        print(f"{kind + ', all values':42}{figures(np.concatenate(some))}")


def figures(error: np.ndarray) -> str:
    """Mean, percentiles and maximum of errors, as columns."""
    of_95, of_99 = np.percentile(error, (95, 99))
    return f"{error.mean():8.2f}{of_95:7.1f}{of_99:7.1f}{error.max():8.0f}"


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path, default=[ASTRONAUT])
    parser.add_argument("--lights", type=int, default=20)
    parser.add_argument("--size", type=int, default=512)
    options = parser.parse_args()
    for path in options.photos:
        with tempfile.TemporaryDirectory() as folder:
            measure(path, Path(folder), options.lights, options.size)


if __name__ == "__main__":
    main()
