"""Seconds for some single lights on one photo: from Python, and by the command line, each in a new process.

    python benchmarks/python_lights.py [--lights 24] [--photo PHOTO] [--size PIXELS] [--rounds 3]

Both start Python, load the networks, fit the person and relight it. `with files` writes what the command line
writes, an EXR with the matte and a PNG for each light. The least of some rounds counts. Seconds of the
processor are those of all threads together.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from _common import ROOT, arguments, print_header, print_row

import facerf_cli as facerf
from facerf_cli.image.strips import resized

_PYTHON = """
import sys, time
started = time.perf_counter()
import numpy as np
import facerf_cli as facerf
person = facerf.fit(facerf.load_models(), facerf.read_image(sys.argv[1]))
lights = [facerf.Light.single(float(azimuth), 20) for azimuth in sys.argv[3:]]
images = person.relight(lights[:1])
first = time.perf_counter()
images += person.relight(lights[1:])
print((time.perf_counter() - first) / (len(lights) - 1))
if sys.argv[2]:
    for number, image in enumerate(images):
        facerf.write_image(f"{sys.argv[2]}/{number}.exr", np.dstack([image, person.matte]))
        facerf.write_image(f"{sys.argv[2]}/{number}.png", image)
"""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--lights", type=int, default=24)
    parser.add_argument("--photo", type=Path, default=ROOT / "examples/astronaut.jpg")
    parser.add_argument("--size", type=int, help="side in pixels to which a square photo is resized")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report(given, Path(folder))


def report(given: argparse.Namespace, folder: Path) -> None:
    """Print a row for each way."""
    photo = given.photo
    if given.size:
        pixels = facerf.read_image(photo)
        photo = folder / "photo.png"
        facerf.write_image(photo, resized(pixels, given.size, given.size))
    azimuths = [str(round(-180 + 360 * number / given.lights)) for number in range(given.lights)]
    lights = [f"--light={azimuth},20" for azimuth in azimuths]
    line = ["-m", "facerf_cli", "relight", str(photo), *lights, "--room", "none", "--exposure", "0"]
    ways = {
        "command line": [*line, "-o", str(folder / "out"), "--overwrite", "always"],
        "Python, with files": ["-c", _PYTHON, str(photo), str(folder), *azimuths],
        "Python": ["-c", _PYTHON, str(photo), "", *azimuths],
    }
    took: dict[str, list[tuple[float, float, float]]] = {name: [] for name in ways}
    for name, command in [*ways.items()] * given.rounds:
        started, before = time.perf_counter(), os.times()
        done = subprocess.run(
            [sys.executable, *command], capture_output=True, text=True, check=True, env=os.environ, cwd=ROOT
        )
        each = float(done.stdout) if name.startswith("Python") else 0.0
        after = os.times()
        busy = sum(after[2:4]) - sum(before[2:4])  # of the processes that ended
        took[name].append((time.perf_counter() - started, busy, each))
    print_header("way", "seconds in all", "seconds of the processor", "seconds of a further light")
    for name, rounds in took.items():
        total, busy, each = np.min(rounds, 0)
        print_row(name, f"{total:.1f}", f"{busy:.1f}", f"{each:.2f}" if each else "-")


if __name__ == "__main__":
    main()
