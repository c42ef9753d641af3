"""Costs of one photo's first image, each beside the way that it was done before, in the same run.

    python benchmarks/start_up.py [--megapixels 12]

- Loading the networks. Naive twin: each is built with drawn weights first, which the file's then replace.
- Reading a JPEG. Naive twin: values as floats, and the curve of sRGB computed for each.
- Visibility of 150 lights. Naive twin: a scene and a view of the person for every 16 of them.

Loading is the processors' time of a new process, for what it imports is most of it; the others are the best
of a few rounds, in which the ways take turns.
"""

import resource
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import OpenImageIO as oiio
import torch
from _common import ASTRONAUT, arguments, best_s, print_header, print_row
from large_photos import enlarged

from facerf_cli.files.read import read_image
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.light.sphere import rig_directions
from facerf_cli.pipeline import find_for, head_of
from facerf_cli.portrait.person import SeenPerson, look_at_person
from facerf_cli.relighting.models import SHIPPED_NETWORKS, load_models

_ROUNDS = 3
_AT_ONCE = 16  # lights
_LOAD = """
import torch
from facerf_cli.network import checkpoint
if {naive}:
    checkpoint._Unfilled.__torch_function__ = lambda self, f, _, args=(), kw=None: f(*args, **(kw or {{}}))
from facerf_cli.relighting.models import SHIPPED_NETWORKS, load_models
load_models()
"""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--megapixels", type=float, default=12)
    given = parser.parse_args()
    print_header("", "now", "before", "ratio")
    now, before = (min(load_s(naive) for _ in range(_ROUNDS)) for naive in (False, True))
    print_row("load the networks", f"{now:.2f} s", f"{before:.2f} s", f"{now / before:.2f}")
    with TemporaryDirectory() as folder:
        path = enlarged(Path(folder), given.megapixels)
        report(f"read {given.megapixels:g} megapixels", partial(read_image, path), partial(as_floats, path))
    person, rig = astronaut_person(), rig_directions(150)
    report(
        "visibility of 150 lights", lambda: shadows(person, rig, 150), lambda: shadows(person, rig, _AT_ONCE)
    )


def report(name: str, now: Callable[[], object], before: Callable[[], object]) -> None:
    """Print a row of two ways."""
    times, _ = best_s({"now": now, "before": before}, _ROUNDS)
    ratio = times["now"] / times["before"]
    print_row(name, f"{times['now']:.2f} s", f"{times['before']:.2f} s", f"{ratio:.2f}")


def load_s(naive: bool) -> float:
    """Seconds of the processors of a process that loads the networks."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", _LOAD.format(naive=naive)], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def as_floats(path: Path) -> np.ndarray:
    """A JPEG as scene-linear floats, each value by the curve."""
    return srgb_to_linear(np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)))


def astronaut_person() -> SeenPerson:
    """The person of the example photo."""
    models, photo = load_models(), read_image(ASTRONAUT).pixels
    head = head_of(
        models, photo, find_for(models.networks.people, models.default_geometry, photo, "the example")[0]
    )
    return look_at_person(SHIPPED_NETWORKS.people, models.face, photo, head.fit)


def shadows(person: SeenPerson, rig: torch.Tensor, at_once: int) -> None:
    """Cast the shadows of lights, so many with one scene."""
    for some in torch.split(rig, at_once):
        vars(person).pop("shadows", None)
        person.visibility(some)


if __name__ == "__main__":
    main()
