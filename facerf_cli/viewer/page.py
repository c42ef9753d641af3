"""The page of a photo: HTML, style and script joined into one file that loads nothing."""

import base64
import hashlib
import html
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

from facerf_cli.files.documents import json_text

_HERE = Path(__file__).parent
# In the order in which they are joined: each uses those before it.
SCRIPTS = (
    "bytes.js",
    "arrays.js",
    "planes.js",
    "light.js",
    "exposure.js",
    "rays.js",
    "portrait.js",
    "decoder.js",
    "face.js",
    "readers.js",
    "whole_person.js",
    "gpu.js",
    "canvas.js",
    "ball.js",
    "state.js",
    "panel.js",
    "main.js",
)


@dataclass(frozen=True)
class IndexEntry:
    """A page in an index: its title, its address relative to the index, and its strip (JPEG, base64)."""

    title: str
    address: str
    strip: str


def page(title: str, photo: str, document: Mapping[str, Any], strip: str) -> str:
    """The page of a photo; `photo` is its path on a command line, `strip` a JPEG in base64."""
    data = json_text({**document, "title": title, "source": shlex.quote(photo)})
    return _filled("page.html", title, _script(), data=_in_script(data), strip=strip)


def index_page(entries: Sequence[IndexEntry]) -> str:
    """A page of links to pages, each with its strip."""
    item = Template(
        '<li><a href="$address"><img src="data:image/jpeg;base64,$strip" alt="">'
        "<span>$title</span></a></li>\n"
    )
    items = [
        item.substitute(address=html.escape(e.address), strip=e.strip, title=html.escape(e.title))
        for e in entries
    ]
    return _filled("index.html", f"{len(entries)} portraits", "", items="".join(items))


def strip_of(text: str) -> str:
    """The strip of a page that was written; empty where it holds none."""
    _, found, rest = text.partition('<meta name="facerf:strip" content="')
    return rest.partition('"')[0] if found else ""


def _filled(name: str, title: str, script: str, **parts: str) -> str:
    style = _text("page.css")
    template = Template(_text(name))
    return template.substitute(
        title=html.escape(title),
        style=style,
        script=script,
        style_hash=_hash(style),
        script_hash=_hash(script),
        **parts,
    )


def _script() -> str:
    return '"use strict";\n' + "\n".join(_text(name) for name in SCRIPTS)


def _in_script(data: str) -> str:
    """JSON as the content of a script element, which ends at the first closing tag."""
    return data.replace("<", "\\u003c")


def _hash(text: str) -> str:
    """The name of an inline element in a content security policy."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") + "'"


def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")
