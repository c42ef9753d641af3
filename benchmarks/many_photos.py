"""Resident memory and open files of one `facerf relight` over many small photos.

    python benchmarks/many_photos.py [--count 200] [PHOTO...]

Copies of the photos, 192 to 255 pixels a side, under one light. The process and its children are looked at
each second; a row has the largest values while a tenth of the photos was made.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from _common import arguments, print_header, print_row
from PIL import Image
from skimage.data import astronaut


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--count", type=int, default=200)
    given = parser.parse_args()
    images = [Image.open(path).convert("RGB") for path in given.photos] or [Image.fromarray(astronaut())]
    with TemporaryDirectory() as name:
        folder, output = Path(name) / "in", Path(name) / "out"
        folder.mkdir()
        for number in range(given.count):
            side = 192 + 7 * number % 64
            images[number % len(images)].resize((side, side)).save(folder / f"{number:04d}.jpg")
        line = [sys.executable, "-m", "facerf_cli", "relight", str(folder), "-o", str(output)]
        line += ["--light", "40,20", "--format", "png", "-q"]
        with subprocess.Popen(line, stdout=subprocess.DEVNULL) as process:
            most: dict[int, list[int]] = {}
            while process.poll() is None:
                tenth = 10 * len(list(output.glob("*.png"))) // given.count
                most[tenth] = list(map(max, most.get(tenth, [0, 0]), held(process.pid)))
                time.sleep(1)
    print_header("photos", "MiB", "open files")
    for tenth, (resident, files) in most.items():
        print_row(f"{tenth * given.count // 10}", f"{resident >> 20}", f"{files}")


def held(process: int) -> list[int]:
    """Resident bytes, and open files, of a process and those that it has started."""
    sums = [0, 0]
    for pid in [process, *children(process)]:
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            files = len(os.listdir(f"/proc/{pid}/fd"))
        except OSError:  # it has ended
            continue
        sums = [sums[0] + pages * os.sysconf("SC_PAGE_SIZE"), sums[1] + files]
    return sums


def children(process: int) -> list[str]:
    try:
        return Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []


if __name__ == "__main__":
    main()
