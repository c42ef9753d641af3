"""Imports point down only: from the command line by the pipeline to errors (docs/design.md)."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "facerf_cli"
LEVELS = (
    ("__main__", "manpages", "completions"),
    ("main",),
    ("cli",),
    ("evaluation", "training", "api"),
    ("dataset",),
    ("synth", "capture", "viewer", "film"),
    ("pipeline",),
    (
        "field",
        "own_light",
        "baselines",
        "composite",
        "group_photo",
        "near_textures",
        "portrait_field",
        "resize",
        "whole_person",
    ),
    ("models", "portrait"),
    ("network", "face"),
    ("raster", "light", "files", "metrics"),
    ("workers", "ray_workers", "colour", "memory", "ocio", "logs", "stopping", "strips", "errors", "option"),
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
STRANGERS = (("network", "face"), ("raster", "light"))  # what one needs of the other is handed in


def room_of(module: str) -> str:
    return module.split(".")[1]


def imports(path: Path) -> list[str]:
    """Modules of facerf that a file imports, wherever in the file."""
    package = "facerf_cli"
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports are not used here"
            module = node.module or ""
            found += [f"{module}.{alias.name}" for alias in node.names] if module == package else [module]
    return [name for name in found if name.startswith(f"{package}.") and name != f"{package}.__version__"]


def complaint(importer: str, imported: str) -> str | None:
    """What is wrong with a room's import of another, if anything; rooms of one level may know each other."""
    if importer == imported:
        return None
    if LEVEL[importer] > LEVEL[imported]:
        return f"{importer} imports {imported}, which stands above it"
    if any({importer, imported} == set(pair) for pair in STRANGERS):
        return f"{importer} and {imported} do not import each other"
    return None


FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_point_down(path: Path) -> None:
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    assert room in LEVEL, f"{room} has no place in LEVELS"
    wrong = [text for module in imports(path) if (text := complaint(room, room_of(module)))]
    assert not wrong


def test_the_rule_catches_what_it_should(tmp_path: Path) -> None:
    assert complaint("files", "face") and complaint("network", "face") and complaint("light", "raster")
    assert (
        complaint("colour", "files") and not complaint("face", "raster") and not complaint("files", "light")
    )
    source = tmp_path / "a.py"
    source.write_text(
        "import torch\ndef f():\n    from facerf_cli.main import app\n    from facerf_cli import errors\n"
    )
    assert imports(source) == ["facerf_cli.main", "facerf_cli.errors"]
