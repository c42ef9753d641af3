"""The way of a photo through the code: frames from verb to network, files and modules, caches, lines.

    python benchmarks/way.py [--photo FILE]

One photo is relit by one light in this process, with a profile of every call. Frames are the functions of the
package that are open, from the verb's own to that where networks read the person; files are those whose
functions run. Calls are the functions of the package from `relight_item` to the deepest one that reads the
maps of the light at the pixels of a strip (`grid_sample`). Caches and lines are counted in the source.
"""

import argparse
import ast
import os
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # all in one thread, whose frames are counted

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "facerf_cli"
VERB = PACKAGE / "cli" / "relight.py"
STRIPS = PACKAGE / "image" / "strips.py"
_CACHES = ("cache", "lru_cache", "cached_property")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photo", type=Path, default=ROOT / "examples" / "astronaut.jpg")
    photo = parser.parse_args().photo
    files: set[str] = set()
    stacks: list[list[str]] = []
    deepest: list[str] = []

    def profile(frame: FrameType, event: str, called: Any) -> None:
        if event == "c_call" and getattr(called, "__name__", "") == "grid_sampler":
            calls = _calls_to_pixel(frame)
            if len(calls) > len(deepest):
                deepest[:] = calls
        if event != "call" or not frame.f_code.co_filename.startswith(str(PACKAGE)):
            return
        name = frame.f_code.co_name
        if name != "<module>":
            files.add(frame.f_code.co_filename)
        if not stacks and name == "reflectance_of":
            stacks.append(_open_frames(frame))

    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(profile)
        try:
            from facerf_cli.main import main as facerf

            facerf(["relight", str(photo), "--light", "60,30", "-o", folder])
        finally:
            sys.setprofile(None)
    modules = [name for name in sys.modules if name.partition(".")[0] == "facerf_cli"]
    sources = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
    tests = [path.read_text() for path in (ROOT / "tests").rglob("*.py")]
    counts = {
        "calls from relight_item to a pixel's sum": len(deepest),
        "frames from verb to network": len(stacks[0]),
        "modules that relight imports": len(modules),
        "files that one photo enters": len(files),
        "caches": sum(map(caches, sources.values())),
        "nested functions of rows": sum(map(closures_of_rows, sources.values())),
        "files of the package": len(sources),
        "lines of the package": sum(text.count("\n") for text in sources.values()),
        "lines of tests": sum(text.count("\n") for text in tests),
    }
    for name, count in counts.items():
        print(f"{count:7,}  {name}")
    for frames in (stacks[0], deepest):
        print("\n" + "\n".join(frames))


def _open_frames(frame: FrameType | None) -> list[str]:
    """Functions of the package that are open, from the verb's on."""
    found = []
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE):
            found.append(f"{path.relative_to(PACKAGE)} {frame.f_code.co_qualname}")
        if path == VERB and frame.f_code.co_name == "relight":
            break
        frame = frame.f_back
    return found[::-1]


def _calls_to_pixel(frame: FrameType | None) -> list[str]:
    """Functions of the package that are open from `relight_item` on, while a strip is rendered."""
    found, in_strip = [], False
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        in_strip |= path == STRIPS
        if path.is_relative_to(PACKAGE) and not frame.f_code.co_name.startswith("<"):
            found.append(f"{path.relative_to(PACKAGE)} {frame.f_code.co_qualname}")
        if frame.f_code.co_name == "relight_item":
            return found[::-1] if in_strip else []
        frame = frame.f_back
    return []


def caches(text: str) -> int:
    """Functions and attributes of a source that are kept by functools."""
    nodes = list(ast.walk(ast.parse(text)))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module == "functools"]
    names = {alias.name for node in imports for alias in node.names} & set(_CACHES)
    return sum(isinstance(node, ast.Name) and node.id in names for node in nodes)


def closures_of_rows(text: str) -> int:
    """Functions within functions that take `rows`."""
    tree = ast.parse(text)
    outer = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    inner = {
        node
        for one in outer
        for node in ast.walk(one)
        if node is not one and isinstance(node, ast.FunctionDef | ast.Lambda)
    }
    return sum("rows" in [argument.arg for argument in node.args.args] for node in inner)


if __name__ == "__main__":
    main()
