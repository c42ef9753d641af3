"""Write the pages of the site into a folder, which mkdocs.yml reads: `python -m tools.pages FOLDER`.

They are those of docs/, the README as home page, other files of the root, and a page for each verb, made of
its man pages. A link to a file that is no page becomes its address in the repository.
"""

import re
import shutil
import sys
import tomllib
from collections.abc import Collection, Iterator
from pathlib import Path
from posixpath import join, normpath, relpath

from facerf_cli import API
from facerf_cli.main import VERBS

ROOT = Path(__file__).parents[1]
MADE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "MODEL_CARD.md": "model_card.md",
    "CHANGELOG.md": "changelog.md",
}  # files of the root to pages of the site
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#]+)")
_MARKER = re.compile(r"(?:-|\d+\.) +")
_CODE_OR_SPECIAL = re.compile(r"`[^`]*`|[*_<]")
_API = "# Python API\n\n[Python](python.md) shows how it is used.\n\n" + "\n".join(
    f"::: facerf_cli.{module}.{name}\n    options: {{show_root_heading: true}}\n"
    for name, module in API.items()
)
_REPOSITORY = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Repository"]


def write_pages(folder: Path) -> None:
    """Replace a folder by the pages and pictures of the site."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs", folder)
    texts = {page: (ROOT / source).read_text() for source, page in MADE.items()} | {"api.md": _API}
    texts |= {path.name: path.read_text() for path in (ROOT / "docs").glob("*.md")}
    verbs = {f"verbs/{verb}.md": "\n".join(_manual(verb)) for verb in ("facerf", *VERBS)}
    pictures = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    files = {*texts, *verbs, *pictures}
    (folder / "verbs").mkdir()
    for page, text in ({page: linked(page, text, files) for page, text in texts.items()} | verbs).items():
        (folder / page).write_text(text)


def linked(page: str, markdown: str, files: Collection[str]) -> str:
    """The text of a page, its links to pages or to the repository; mkdocs refuses those that are neither."""
    folder = "" if page in MADE.values() else "docs"

    def address(link: re.Match[str]) -> str:
        path = normpath(join(folder, link[1]))
        target = MADE.get(path, path.removeprefix("docs/"))
        if target in files or not (ROOT / path).exists():
            return relpath(target, Path(page).parent)
        return f"{_REPOSITORY}/{'tree' if (ROOT / path).is_dir() else 'blob'}/main/{path}"

    return _LINK.sub(address, _lists(markdown))


def _lists(markdown: str) -> str:
    """Write lists as Python-Markdown reads them: after a blank line, what an item holds after four spaces."""
    lines: list[str] = []
    item, is_loose, is_code = (
        0,
        True,
        False,
    )  # item: the width of the marker of the item that a line belongs to
    for line in markdown.split("\n"):
        is_code ^= line.startswith("```")
        if marker := not is_code and _MARKER.match(line):
            if is_loose:
                lines.append("")
            item, is_loose = len(marker[0]), False
        elif line and not line.startswith(item * " "):
            item, is_loose = 0, True
        elif line and item:
            line = (4 - item) * " " + line
        is_loose |= not line
        lines.append(line)
    return "\n".join(lines)


def _manual(verb: str) -> Iterator[str]:
    """The lines of a verb's page: its man page, and those of the verbs within it."""
    name = "facerf" if verb == "facerf" else f"facerf-{verb}"
    yield from _markdown(ROOT / f"man/{name}.1")
    for page in sorted((ROOT / "man").glob(f"{name}-*.1")):
        if verb != "facerf" and page.stem.removeprefix("facerf-") not in VERBS:
            yield from _markdown(page, "##")


def _markdown(page: Path, heading: str = "#") -> Iterator[str]:
    """The lines of a man page as `facerf_cli.cli.manual` writes it, as Markdown."""
    lines = iter(page.read_text().splitlines())
    section, in_code = "NAME", False
    for line in lines:
        macro, _, rest = line.partition(" ")
        if macro == ".SH":
            section = rest
        if (
            section in ("NAME", "SEE ALSO")
            or line == ".SH SYNOPSIS"
            or (section == "EXIT STATUS" and page.stem != "facerf")
        ):
            continue
        match macro:
            case ".SH" | ".SS":
                yield f"\n{heading}{'#' * (1 + (macro == '.SS'))} {_text(rest).capitalize()}\n"
            case ".TP":
                term, meaning = next(lines), next(lines)
                yield f"\n`{_plain(term)}`\n:   {_text(meaning)}"
            case ".nf" | ".fi":
                in_code = not in_code
                yield "```sh" if in_code else "```"
            case ".B":
                yield f"{heading} {_plain(rest)}\n\n`{_plain(rest)} {_plain(next(lines))}`"
            case ".PP":
                yield ""
            case _:
                yield _plain(line) if in_code else _text(line)


def _plain(text: str) -> str:
    """The text of a line of troff."""
    text = re.sub(r"\\f[BR]|\\&", "", text)
    return text.replace(r"\-", "-").replace(r"\e", "\\")


def _text(text: str) -> str:
    """A line of troff as Markdown that shows it literally, but for code between backquotes."""
    return _CODE_OR_SPECIAL.sub(
        lambda found: {"<": "&lt;"}.get(found[0], found[0] if found[0][0] == "`" else f"\\{found[0]}"),
        _plain(text),
    )


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
