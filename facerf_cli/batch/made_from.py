"""Recipes of outputs, and a folder's index of them, so that only stale ones are made again.

A recipe is all that shapes an output, apart from its input.

`.facerf-index.jsonl` holds three kinds of rows: files that were read (size, time, inode and SHA-256, so that
an unchanged file is not read again), recipes, and outputs (their recipe, input and SHA-256). The last
row of a name counts. With `--shard` each process writes an index of its own and reads all.
"""

import dataclasses
import hashlib
import json
import os
import os.path
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from facerf_cli.batch.settings import Shard
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import file_sha256, is_regular, parse_json, regular_size, require_regular
from facerf_cli.run.logs import json_line

RESULTS_VERSION = 21  # raised where the same recipe gives other pixels
SHIPPED = Path(__file__).parents[1] / "assets"

# Entries of recipes that are not called as the option that sets them is.
_OPTIONS = {
    "colour": "the colour of --background",
    "colourspace": "--input-colourspace",
    "config": "--ocio",
    "data": "the data",
    "dataset_format": "facerf's version of datasets",
    "kind": "--background",
    "leaders": "the first photo of --exposure-group",
    "matte_model": "the model of --matte-from",
    "names": "the layers of --light",
    "non_negative": "--signed",
    "ocio_config": "--ocio",
    "path": "the image of --background",
    "photo_of_stack": "--photo",
    "results": "facerf's version of results",
    "pattern": "the pattern of the capture",
    "rig": "--lights",
    "sampling": "--envmap-sampling",
    "size_px": "--size",
    "stage_cameras": "the cameras of the capture",
    "stage_lights": "the lights of the capture",
    "stage_values": "the intensities, colours or --colour-chart of the capture",
    "texture_side": "--texture-size",
    "width_px": "--width",
}

Recipe = dict[str, Any]  # names and JSON values
DigestOf = Callable[[Path], str]  # SHA-256 of a file
RecipesOf = Callable[[DigestOf], Sequence[Recipe]]  # of each output of an item, or one for all of them
_INDEXES = ".facerf-index*.jsonl"
Row = dict[str, Any]


def one_recipe(settings: Any) -> RecipesOf:
    """The recipe of all outputs of a verb: the fields of its settings."""
    return lambda digest_of: [recipe_of(settings, digest_of)]


def recipe_of(settings: Any, digest_of: DigestOf) -> Recipe:
    """List the fields of a dataclass, of dataclasses in it too, that shape outputs.

    A file counts by its content. Behind the checkpoints stand the networks that facerf ships.
    """
    recipe: Recipe = {"results": RESULTS_VERSION}
    _add_fields(recipe, settings, digest_of)
    return recipe


def key_of(recipe: Recipe) -> str:
    """A short digest of a recipe, by which outputs and cached files name it."""
    text = json.dumps(recipe, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:16]


def differences(old: Recipe, new: Recipe) -> str:
    """Say which options of a recipe changed, as they are typed; empty if none did."""
    parts = []
    for name in sorted(old.keys() | new.keys()):
        before, now = old.get(name), new.get(name)
        if before != now:
            both = [_short(value) for value in (before, now)]
            said = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
            parts.append(f"{said} is {both[1]}, was {both[0]}" if both[0] != both[1] else f"{said} changed")
    return "; ".join(parts)


def _short(value: Any) -> str:
    text = "not set" if value is None else str(value)
    is_content = isinstance(value, (list, dict)) or text.startswith("sha256:")
    return "another" if is_content or len(text) > 40 else text


def _add_fields(recipe: Recipe, settings: Any, digest_of: DigestOf) -> None:
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if not field.metadata.get("in_recipe", True):
            continue
        if dataclasses.is_dataclass(value):
            _add_fields(recipe, value, digest_of)
        elif field.name == "checkpoints":
            recipe["checkpoint"] = _content([*value, *sorted(SHIPPED.glob("*.safetensors"))], digest_of)
        else:
            recipe[field.name] = _plain(value, digest_of)


def _plain(value: Any, digest_of: DigestOf) -> Any:
    """A value as JSON; files, named by a path or by text, as digests of their content."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner: Recipe = {}
        _add_fields(inner, value, digest_of)
        return inner
    if isinstance(value, (tuple, list)):
        return [_plain(entry, digest_of) for entry in value]
    if isinstance(value, (str, Path)) and os.path.isfile(value):
        return _content([Path(value)], digest_of)
    if isinstance(value, Path):
        return _of_folder(value, digest_of)
    return value


def _of_folder(path: Path, digest_of: DigestOf) -> str:
    """The content of a folder; for a pattern (mattes/{stem}.png) of the folder that it begins with."""
    fixed, brace, rest = str(path).partition("{")
    folder = Path(f"{fixed}_").parent if brace else path
    files = (file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else ()
    return f"{brace}{rest}{_content(sorted(files), digest_of)}"


def _content(files: Iterable[Path], digest_of: DigestOf) -> str:
    return "sha256:" + " ".join(digest_of(path)[:16] for path in files)


@dataclass(frozen=True)
class Made:
    """Rows of an item that was made: its input as it was read, and its outputs."""

    read: Row
    outputs: tuple[Row, ...]


def read_row(path: Path) -> Row:
    """A row of a file or folder to be read: its state and its digest; InputError if it cannot be read.

    A folder's digest is of the names, sizes and times of the files in it.
    """
    try:
        state = os.stat(path)
        if stat.S_ISDIR(state.st_mode):
            digest = _listing_digest(path)
        else:
            require_regular(path)
            digest = _digest(path, *_state(state).values())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    return {"file": os.path.abspath(path), **_state(state), "sha256": digest}


@lru_cache(maxsize=8)  # every frame of a film has the film as its input
def _digest(path: Path, *_: int) -> str:
    """SHA-256 of a file in a state: its size, time and inode."""
    return file_sha256(path)


def _listing_digest(folder: Path) -> str:
    facts = []
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            state = path.stat()
            facts.append([path.relative_to(folder).as_posix(), state.st_size, state.st_mtime_ns])
    return hashlib.sha256(json.dumps(facts).encode("utf-8", "backslashreplace")).hexdigest()


def json_rows(path: Path) -> Iterator[Row]:
    """The objects of a file of JSON lines; a missing file has none."""
    if not is_regular(path):
        return
    for line in path.read_text(encoding="utf-8", errors="replace").split("\n"):
        with suppress(ValueError):  # a run that was killed may leave half a line
            row = parse_json(line)
            if isinstance(row, dict):
                yield row


def lines_of(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as JSON lines."""
    return "".join(json_line(row) + "\n" for row in rows)


class _Rows:
    """The rows of the indexes of a folder: files by path, recipes by key, outputs by path in the folder."""

    def __init__(self, folder: Path) -> None:
        self.files: dict[str, Row] = {}
        self.recipes: dict[str, Recipe] = {}
        self.outputs: dict[str, Row] = {}
        for path in sorted(folder.glob(_INDEXES)):
            for row in json_rows(path):
                self._take(row)

    def _take(self, row: Row) -> None:
        if isinstance(row.get("of"), dict):
            self.recipes[str(row.get("recipe"))] = row["of"]
        elif "output" in row:
            name = str(row["output"])
            if not name.startswith("/") and ".." not in name.split("/"):
                self.outputs[name] = row
        elif "sha256" in row:
            self.files[str(row.get("file"))] = row


def require_same(before: Recipe, now: Recipe, said: str, advice: str) -> None:
    """Raise UsageError, `SAID: --option is ..., was ...; ADVICE`, where two recipes differ."""
    if before != now:
        raise UsageError(f"{said}: {differences(before, now)}; {advice}")


def text_of_state(path: Path) -> str:
    """Text that changes when a file is written again."""
    state = path.stat()
    return f"{state.st_size}-{state.st_mtime_ns}"


def is_made_from(path: Path, text: str) -> bool:
    """Tell whether a safetensors file is there that has the text as its metadata `of`."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return bool((file.metadata() or {}).get("of") == text)
    except (SafetensorError, OSError):
        return False


def check_outputs(folder: Path) -> Iterator[tuple[Path, str]]:
    """Read all outputs in a folder's index; yield each, and `whole`, `missing`, `empty` or `changed`."""
    for name, row in sorted(_Rows(folder).outputs.items()):
        path = folder / name
        if not is_regular(path):
            yield path, "missing"
        elif not path.stat().st_size:
            yield path, "empty"
        else:
            yield path, "whole" if read_row(path)["sha256"] == row.get("sha256") else "changed"


class FolderIndex:
    """The index of one verb in an output folder, for the recipes of this run."""

    def __init__(self, folder: Path, verb: str, shard: Shard, recipes_of: RecipesOf) -> None:
        self._folder, self._verb = folder, verb
        self._prefix = os.path.join(folder, "")
        self._rows = _Rows(folder)
        self._new: list[Row] = []  # files read since the rows were last written
        self.edited: list[Path] = []  # finished outputs that are not as they were written
        self.path = folder / f".facerf-index{shard.suffix}.jsonl"
        self.want(recipes_of)

    def want(self, recipes_of: RecipesOf) -> None:
        """Judge outputs by other recipes from now on."""
        self._wanted = [(key_of(recipe), recipe) for recipe in recipes_of(self.digest_of)]

    def digest_of(self, path: Path) -> str:
        """SHA-256 of a file; an unchanged one that the index knows is not read. Raises InputError."""
        known = self._rows.files.get(os.path.abspath(path))
        try:
            state = os.stat(path)
            is_file = not stat.S_ISDIR(state.st_mode)  # a folder's own state says nothing of its files
            same = is_file and known is not None and _state(state).items() <= known.items()
        except OSError:
            same = False
        if known is None or not same:
            known = read_row(path)
            self._note(known)
        return str(known["sha256"])

    def why_again(self, input_path: Path, outputs: Sequence[Path]) -> tuple[str | None, frozenset[Path]]:
        """Say why an item must be made, and which of its outputs; None if it is finished.

        The reason is empty where they never were made.
        """
        stale: dict[Path, str] = {}
        input_digest = cache(lambda: self._digest_or_none(input_path))
        for number, path in enumerate(outputs):
            reason = self._why(number, path, input_digest)
            if reason is not None:
                stale[path] = reason
        self.edited += [path for path in outputs if path not in stale and self._is_edited(path)]
        if not stale:
            return None, frozenset()
        return next(filter(None, stale.values()), ""), frozenset(stale)

    def _why(self, number: int, path: Path, input_digest: Callable[[], str | None]) -> str | None:
        row = self._rows.outputs.get(self._name(path))
        size = regular_size(path)
        if size is None:
            return "" if row is None else "an output is missing"
        if row is None or row.get("verb") != self._verb:
            return "there is no record of what they were made from"
        key, recipe = self._wanted_of(number)
        if row.get("recipe") != key:
            old = self._rows.recipes.get(str(row.get("recipe")), {})
            return differences(old, recipe) or "other options" if old else "other options"
        if input_digest() != row.get("input"):
            return "the input changed"
        if size == 0:
            return "an output is empty"
        return None

    def _is_edited(self, path: Path) -> bool:
        return self._digest_or_none(path) != self._rows.outputs[self._name(path)].get("sha256")

    @property
    def has_news(self) -> bool:
        """True if files were read that the rows do not know."""
        return bool(self._new)

    def open(self) -> None:
        """Write the rows, those that are known and those of this run's recipes."""
        self._rows.recipes.update(self._wanted)
        self._new.clear()
        rows: list[Mapping[str, Any]] = list(self._rows.files.values())
        rows += [{"recipe": key, "of": recipe} for key, recipe in self._rows.recipes.items()]
        rows += self._rows.outputs.values()
        with atomic_path(self.path) as temporary:
            temporary.write_text(lines_of(rows), encoding="utf-8")

    def add(self, made: Made, outputs: Sequence[Path]) -> None:
        """Add the rows of an item that was made; `outputs` are those that have a recipe, in their order."""
        rows: list[Row] = []
        self._note(made.read)
        keys = {self._name(path): self._wanted_of(number)[0] for number, path in enumerate(outputs)}
        for row in made.outputs:
            self._note(row)
            name = self._name(Path(row["file"]))
            made_from = {"input": made.read["sha256"], "recipe": keys.get(name)}
            rows.append({"output": name, "verb": self._verb, "sha256": row["sha256"], **made_from})
        rows += self._new
        self._new.clear()
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(lines_of(rows))

    def _wanted_of(self, number: int) -> tuple[str, Recipe]:
        """Key and recipe of an item's output, or those of all of them."""
        return self._wanted[number if len(self._wanted) > 1 else 0]

    def _digest_or_none(self, path: Path) -> str | None:
        try:
            return self.digest_of(path)
        except InputError:
            return None  # its item says so

    def _note(self, row: Row) -> None:
        self._rows.files[str(row["file"])] = row
        self._new.append(row)

    def _name(self, path: Path) -> str:
        text = os.fspath(path)
        if text.startswith(self._prefix) and ".." not in text:  # as all of a verb's; ten times faster
            return text[len(self._prefix) :].replace(os.sep, "/")
        return Path(os.path.relpath(path, self._folder)).as_posix()


def _state(state: os.stat_result) -> dict[str, int]:
    return {"size": state.st_size, "mtime_ns": state.st_mtime_ns, "inode": state.st_ino}
