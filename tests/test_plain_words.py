"""The prose of the package: standard terms, docstrings that stand alone, and class names that are unique."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "facerf_cli"
FILES = sorted(PACKAGE.rglob("*.py"))
OPENINGS = re.compile(r"(Of|By|What|Where|How|Whether)\b")
HOUSE_WORDS = re.compile(r"\b(anew|can be had|told|be it)\b", re.I)


def docstrings(path: Path) -> list[tuple[str, str]]:
    """Names and docstrings of a file, its classes and its functions."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, documented)]
    return [(getattr(node, "name", path.name), text) for node in nodes if (text := ast.get_docstring(node))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_docstrings_stand_alone(path: Path) -> None:
    assert not [name for name, text in docstrings(path) if OPENINGS.match(text)]
    assert not [name for name, text in docstrings(path) if HOUSE_WORDS.search(text)]


def test_class_names_are_unique_in_the_package() -> None:
    names = [
        node.name
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    assert [name for name, count in Counter(names).items() if count > 1] == []
