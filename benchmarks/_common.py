"""What the benchmarks share: their options, the line of one that lacks its data, and times taken in turns."""

import argparse
import importlib.util
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn, TypeVar

from PIL import Image
from safetensors.torch import load_file
from skimage.data import astronaut

from facerf_cli.evaluation.metrics import Interval
from facerf_cli.synth.bank.heads import Bank
from facerf_cli.synth.bank.texture_samples import head_fields

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("FACERF_SHARED", ROOT.parent / "shared"))  # test data, not in the repository
ASTRONAUT = ROOT / "examples" / "astronaut.jpg"
PHOTOS, YALE_B, MAPS = (SHARED / "data" / name for name in ("photos", "extended_yale_b", "hdri"))
WHOLE_YALE_B = SHARED / "data" / "yale_b_full"  # uncropped frames of some people
BENCHMARK_DATA = ROOT / "benchmarks" / "data"  # outlines and shifts, measured for facerf
_SUFFIXES = (".jpg", ".jpeg", ".png")

T = TypeVar("T")


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Make a parser whose help is the script's docstring."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def skip(needs: str, give: str) -> NoReturn:
    """End the script with success and one line that names the data it lacks."""
    print(f"{Path(sys.argv[0]).stem}: skipped: needs {needs}; give {give}")
    raise SystemExit(0)


def required(given: Path | None, needs: str, option: str, default: Path | None = None) -> Path:
    """Return a path that was given, or its default; skip the script where there is neither."""
    if given is not None and not given.exists():
        raise SystemExit(f"{given}: no such file or folder; correct {option}")
    path = given or default
    if path is None or not path.exists():
        skip(needs, option)
    return path


def required_package(name: str, extra: str) -> None:
    """Skip the script where an optional package is not installed."""
    if importlib.util.find_spec(name) is None:
        skip(f"the package {name}", f"pip install 'facerf[{extra}]'")


def photos(given: list[Path]) -> list[Path]:
    """List the photos among files and folders; without any, the example and those of the test data."""
    entries = given or [ASTRONAUT, *([PHOTOS] if PHOTOS.is_dir() else [])]
    found = []
    for entry in entries:
        inside = sorted(entry.iterdir()) if entry.is_dir() else [entry]
        found += [path for path in inside if path.suffix.lower() in _SUFFIXES]
    return found


def enlarged(folder: Path, megapixels: float) -> Path:
    """Write the astronaut's photo at a size in megapixels into a folder; return its path."""
    width = round((megapixels * 1e6 * 4 / 3) ** 0.5)
    path = folder / f"{width}.jpg"
    Image.fromarray(astronaut()[:384]).resize((width, width * 3 // 4), Image.Resampling.BICUBIC).save(path)
    return path


def first_heads(bank: Path, heads: int) -> Bank:
    """Load the mean face and the next `heads` heads of a bank; `facerf train` holds out the first 12."""
    views = bank / "views-builtin"
    paths = [path for path in sorted((bank / "heads").glob("*.safetensors")) if (views / path.name).exists()]
    if len(paths) <= heads:
        raise SystemExit(f"{bank}: {len(paths)} heads with views; give a --bank of {heads + 1}")
    held = paths[: heads + 1]
    baked = [head_fields(load_file(path)) for path in held]
    return Bank(baked, [load_file(views / path.name) for path in held], {})


def best_s(ways: Mapping[str, Callable[[], T]], rounds: int) -> tuple[dict[str, float], dict[str, T]]:
    """Time several ways to do one thing: the fewest seconds of each, and what each returned last.

    The ways take turns, so that other programs slow all of them alike.
    """
    best, results = dict.fromkeys(ways, float("inf")), {}
    for _ in range(rounds):
        for name, way in ways.items():
            start_s = time.perf_counter()
            results[name] = way()
            best[name] = min(best[name], time.perf_counter() - start_s)
    return best, results


def interval_text(found: Interval | None, form: str) -> str:
    """Format a mean and its 95 % interval; a single person or head has no interval."""
    if found is None:
        return ""
    span = "" if math.isnan(found.low) else f" [{found.low:{form}}, {found.high:{form}}]"
    return f"{found.mean:{form}}{span}"


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def print_header(*cells: str) -> None:
    """Print the first two rows of a Markdown table."""
    print_row(*cells)
    print("|" + "---|" * len(cells), flush=True)
