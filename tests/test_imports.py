"""Imports of files point down, from the command line to errors, and never in a circle (docs/design.md)."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "facerf_cli"
LEVELS = (
    ("__main__", "main", "cli"),
    ("work", "api", "evaluation"),
    ("training", "viewer", "capture", "dataset", "synth"),
    ("person", "relighting", "portrait", "baselines", "network", "face"),
    ("batch", "light", "raster", "image", "files", "run", "errors", "option", "_version"),
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
STRANGERS = ({"network", "face"}, {"raster", "light"})  # what one needs of the other is handed in
Graph = dict[Path, set[Path]]


def imported(path: Path) -> Iterator[Path]:
    """Files of the package that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports are not used here"
            names = [f"{node.module}.{alias.name}" for alias in node.names] + [str(node.module)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        places = [ROOT.joinpath(*name.split(".")) for name in names if name.startswith("facerf_cli")]
        yield from (file for place in places if (file := place.with_suffix(".py")).is_file() and file != path)


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def complaints(graph: Graph) -> list[str]:
    """Imports that point up, or between rooms that do not know each other."""
    arrows = [(a, b) for a, others in graph.items() for b in others if room(a) != room(b)]
    return [
        f"{a} imports {b}"
        for a, b in sorted(arrows)
        if LEVEL[room(a)] > LEVEL[room(b)] or {room(a), room(b)} in STRANGERS
    ]


@pytest.fixture(scope="module")
def graph() -> Graph:
    files = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
    return {path: set(imported(path)) for path in files}


def test_rooms_have_levels_whose_imports_point_down_without_circles(graph: Graph) -> None:
    assert {room(path) for path in graph} == set(LEVEL)
    assert not complaints(graph)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(str(path.relative_to(PACKAGE)) for path in error.args[1]))
