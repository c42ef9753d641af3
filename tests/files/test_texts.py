"""Texts, JSON and TOML: documents are read within one limit, and validated."""

import json
from pathlib import Path
from typing import Any

import pytest

from facerf_cli.errors import InputError
from facerf_cli.files import texts
from facerf_cli.files.documents import MOST_RIG_LIGHTS, Document, Name, checked, distinct, read_rig
from facerf_cli.files.texts import parse_json, read_json, read_text, read_toml
from facerf_cli.light.entries import parse_lights
from tests.refusals import refused


def test_documents_are_read() -> None:
    content = {"a": [1, 2.5, -3e8, "é", None, True], "b": {"c": [[[]]]}, "": 2**62}
    assert parse_json(json.dumps(content)) == content and parse_json(json.dumps(content).encode()) == content
    assert distinct(["a", "b"], "light") == ["a", "b"]
    refused(ValueError, "light 'b' occurs twice", distinct, ["a", "b", "b"], "light")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1" * 5000, "digits"),
        ("[NaN]", "NaN is not"),
        ("-Infinity", "not a finite"),
        ("[" * 100_000, "deep"),
        ("{}x", "Extra data"),
        (b"\xff", "utf-8"),
    ],
)
def test_what_is_no_json_is_refused(text: str | bytes, said: str) -> None:
    refused(ValueError, said, parse_json, text)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_byte_order_marks_are_no_part_of_a_text(tmp_path: Path, encoding: str) -> None:
    """In JSON, TOML and lists of lights; PowerShell writes UTF-16."""
    path, mark = tmp_path / "a.txt", "\ufeff" if encoding == "utf-16-be" else ""

    def written(text: str) -> Path:
        path.write_bytes((mark + text).encode(encoding))
        return path

    assert read_json(written('{"é": 1}'), "") == {"é": 1}
    assert read_toml(written('key = "é"'), "") == {"key": "é"}
    assert read_text(written("é"), "") == "é"
    assert parse_lights(str(written("0,10\n20,30\n"))) == [(0, 10), (20, 30)]


def test_files_are_bounded_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texts, "LIMIT_BYTES", 1 << 20)
    path = tmp_path / "a.json"
    path.write_bytes(b" " * 2_000_000)
    refused(InputError, "a.json: larger than 1 MiB; mend it", read_json, path, "mend it")
    refused(InputError, "b.json: no such file; mend it", read_json, tmp_path / "b.json", "mend it")
    refused(InputError, "no such file", read_rig, tmp_path / "none.toml")


class Entry(Document):
    id: Name
    count: int


class Root(Document):
    entries: list[Entry]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({}, "x.json: entries: is missing"),
        ({"entries": 3}, r"x.json: entries: use a list \[ \]"),
        ({"entries": [3]}, r"x.json: entries\[0\]: use an object { }"),
        ({"entries": [{"id": "a"}]}, r"x.json: entries\[0\]: count: is missing"),
        ({"entries": [{"id": "../a", "count": 1}]}, r"entries\[0\]: id: use a name of letters"),
        ({"entries": [{"id": "a", "count": True}]}, r"count: Input should be a valid int"),
        ({"entries": [{"id": None, "count": "1"}]}, r"id: is null; fill it in \(and 1 more\)"),
    ],
)
def test_an_error_is_a_line_with_the_path_in_the_document(content: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        checked(Root, content, "x.json")
    assert "\n" not in str(raised.value) and "pydantic" not in str(raised.value)


def test_values_become_the_text_of_an_option(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("# a rig\n[key]\nat = [0.5, 1, -2e-1]\nkelvin = 3200\naz = '0:90:4'\n")
    assert read_rig(tmp_path / "a.toml") == {
        "key": {"at": "0.5,1.0,-0.2", "kelvin": "3200.0", "az": "0:90:4"}
    }


@pytest.mark.parametrize(
    "data, said",
    [
        (b"", "0 lights; use 1 to 32"),
        (b"\n".join(b"[l%d]\naz = 1" % k for k in range(MOST_RIG_LIGHTS + 1)), "33 lights"),
        (b"key = 3", "key: use an object"),
        (b"[key]\naz = true", "key: az: use numbers"),
        (b"[key]\naz = [1, 'a']", "az: use numbers"),
        (b"[key]\naz = {b = 1}", "az: use numbers"),
        (b"[key]\naz = 1979-05-27", "use numbers"),
        (b"[key]\naz = 0x" + b"f" * 4000, "use numbers"),
        (b"[key]\naz = " + b"9" * 5000, "not TOML"),
        (b"a = " + b"[" * 30000, "not TOML"),
        (b"[key", "not TOML"),
        (b"\xff\xfe[key]", "not TOML"),
    ],
)
def test_faults(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(data)
    refused(InputError, f"{path} ... {said}", read_rig, path)
