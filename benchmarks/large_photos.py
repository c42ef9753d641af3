"""Peak memory and time of `facerf relight` on large photos, at several ceilings of `--memory`.

    python benchmarks/large_photos.py [--megapixels 12 24 40 62] [--memory 0.5 1 2]

The photos are skimage's astronaut, cut to 4:3 and enlarged, as JPEG, under one light. Peaks are the largest
resident sets of the processes, as `/usr/bin/time -v` has them, less that for the same photo of 512 x 512
pixels: what the process holds at rest. The twin is a ceiling that allows all. Times are those of the
processors, user and system.
"""

import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from _common import arguments, print_header, print_row
from PIL import Image
from skimage.data import astronaut

_ALL_GB = 64.0


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[12, 24, 40, 62])
    parser.add_argument("--memory", type=float, nargs="+", default=[0.5, 1, 2], help="GB")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        rest_kb, _, _ = relight(enlarged(Path(folder), 0.262), _ALL_GB)
        print(f"at rest {rest_kb / 2**20:.2f} GB")
        print_header("megapixels", *(f"{limit:g} GB" for limit in given.memory), "all")
        for megapixels in given.megapixels:
            photo = enlarged(Path(folder), megapixels)
            cells = [cell(*relight(photo, limit), rest_kb) for limit in (*given.memory, _ALL_GB)]
            print_row(f"{megapixels:g}", *cells)


def enlarged(folder: Path, megapixels: float) -> Path:
    """The astronaut's photo at so many megapixels."""
    width = round((megapixels * 1e6 * 4 / 3) ** 0.5)
    path = folder / f"{width}.jpg"
    Image.fromarray(astronaut()[:384]).resize((width, width * 3 // 4), Image.Resampling.BICUBIC).save(path)
    return path


def relight(photo: Path, limit_gb: float) -> tuple[int, float, str]:
    """Peak KB and seconds of the processors of one run, and why it was refused."""
    line = [sys.executable, "-m", "facerf_cli", "relight", str(photo), "-o", str(photo.parent / "lit")]
    line += ["--light", "75,20", "--overwrite", "always", "-q", "--memory", str(limit_gb)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return usage.ru_maxrss, seconds, said if process.returncode else ""


def cell(peak_kb: int, seconds: float, refused: str, rest_kb: int) -> str:
    """The peak over rest, and the time; or what is needed."""
    if refused:
        return "needs " + refused.partition("needs ")[2].partition(" of memory")[0]
    return f"{(peak_kb - rest_kb) / 2**20:.2f} GB, {seconds:.1f} s"


if __name__ == "__main__":
    main()
