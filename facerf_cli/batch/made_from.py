"""Keys of outputs, and a folder's index of them, so that only stale ones are made again.

A key joins the digests of an output's recipe (all options and files that shape it) and of its input.
`.facerf-index.jsonl` has a row for each output (its key and SHA-256), for each recipe, and for each file
that was read (size, times, inode and SHA-256: an unchanged one is not read again). The last row of a name
counts. With `--shard` each process writes an index of its own and reads all. That of the one file that `-o`
names is in the user's cache, so that nothing lies beside the file; this file also carries its key.

A file is replaced only if facerf wrote it and it has not changed since (`FolderIndex.refusal`). Therefore
the digest of an output is noted before the output gets its name, in a journal per process
(`.facerf-index.MACHINE-PROCESS.jsonl`), which the next run merges: outputs of a killed run are recognised.
"""

import dataclasses
import hashlib
import json
import mmap
import os
import os.path
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Overwrite, Shard
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path, is_temporary, machine_id
from facerf_cli.files.texts import file_sha256, is_regular, parse_json, regular_size, require_regular
from facerf_cli.option import flag
from facerf_cli.run.logs import json_line

RESULTS_VERSION = 27  # raised where the same recipe gives other pixels
SHIPPED = Path(__file__).parents[1] / "assets"
# Entries of recipes that are not called as the option that sets them is.
_OPTIONS = {
    "colour": "the colour of --background",
    "colourspace": "--input-colourspace",
    "config": "--ocio",
    "data": "the data",
    "dataset_format": "facerf's version of datasets",
    "frames": "the images of --background",
    "kind": "--background",
    "lights": "the lights",
    "name": "the lights",
    "names": "the layers of --light",
    "non_negative": "--signed",
    "ocio_config": "--ocio",
    "path": "the image of --background",
    "pattern": "the pattern of the capture",
    "results": "facerf's version of results",
    "rig": "--lights",
    "sampling": "--envmap-sampling",
    "size_px": "--size",
    "stage_cameras": "the cameras of the capture",
    "stage_lights": "the lights of the capture",
    "stage_values": "the intensities, colours or --colour-chart of the capture",
    "texture_side": "--texture-size",
    "width_px": "--width",
}

Row = dict[str, Any]
Recipe = dict[str, Any]  # names and JSON values
DigestOf = Callable[[Path], str]  # SHA-256 of a file
RecipesOf = Callable[[DigestOf], Sequence[Recipe]]  # of each output of an item, or one for all of them
Keyed = Sequence[tuple[str, Recipe]]  # recipes with their digests
_INDEXES = ".facerf-index*.jsonl"
_ADVICE = "move it, choose another -o, or pass --overwrite always"
_INPUT = 16  # digits of an input's digest in a key


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


def other_options(old: Recipe, new: Recipe) -> str:
    """Name the options in which two recipes differ, as they are typed."""
    names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    return (
        "other options"
        + (": " if old and names else "")
        + ", ".join(dict.fromkeys(_OPTIONS.get(name, flag(name)) for name in names if old))
    )


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
    """SHA-256 of a file in a state: its size, times and inode."""
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


def require_same(before: Recipe, now: Recipe, said: str, advice: str) -> None:
    """Raise UsageError, `SAID: other options: --size; ADVICE`, where two recipes differ."""
    if before != now:
        raise UsageError(f"{said}: {other_options(before, now)}; {advice}")


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


class FolderIndex:
    """The index of an output folder: outputs, by their path in it, and their keys; files; recipes."""

    def __init__(
        self,
        folder: Path,
        verb: str = "",
        shard: Shard = Shard(),  # noqa: B008 (frozen)
        file: Path | None = None,
    ) -> None:
        self._folder, self._verb = folder, verb
        self._prefix = os.path.join(folder, "")
        self.path = _in_cache(file) if file else folder / f".facerf-index{shard.suffix}.jsonl"
        # A cache that cannot be written to costs the next run the same work again, not this one.
        self._lost: tuple[type[Exception], ...] = (FacerfError, OSError) if file else ()
        self._is_single = file is not None
        self.outputs: dict[str, Row] = {}
        self._unfinished: dict[tuple[str, str], Row] = {}  # outputs of items that a killed run did not finish
        self._digests: dict[str, set[str]] = {}  # by output: what facerf has written there
        self._of_item: dict[Any, set[str]] = {}  # by command and item: its outputs
        self._files: dict[str, Row] = {}
        self._recipes: dict[str, Recipe] = {}
        for path in [self.path, *self._journals()] if file else sorted(folder.glob(_INDEXES)):
            for row in json_rows(path):
                self._take(row)
        self._new: list[Row] = []  # files read since the rows were last written

    def _take(self, row: Row) -> None:
        if isinstance(row.get("of"), dict):
            self._recipes[str(row.get("recipe"))] = row["of"]
        elif "output" in row:
            name = str(row["output"])
            if not name.startswith("/") and ".." not in name.split("/"):
                if "key" in row:
                    self.outputs[name] = row
                else:
                    self._unfinished[name, str(row.get("sha256"))] = row
                self._digests.setdefault(name, set()).add(str(row.get("sha256")))
                self._of_item.setdefault((row.get("verb"), row.get("item")), set()).add(name)
        elif "sha256" in row:
            self._files[str(row.get("file"))] = row

    def digest_of(self, path: Path) -> str:
        """SHA-256 of a file; an unchanged one that the index knows is not read. Raises InputError."""
        known = self._files.get(os.path.abspath(path))
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

    def to_make(
        self, read: Path, outputs: Sequence[Path], recipes: Keyed, overwrite: Overwrite
    ) -> dict[Path, str]:
        """Return the outputs of an input that must be made, and why: '' where they never were.

        Raises InputError for one that would replace a file which facerf did not write, or which has changed.
        """
        if overwrite == "always":
            return dict.fromkeys(outputs, "")
        if overwrite == "never":
            return {path: "" for path in outputs if not is_occupied(path)}
        stale = self.why_again(read, outputs, recipes)
        for path in stale:
            if refusal := self.refusal(path):
                raise InputError(refusal)
        return stale

    def why_again(self, read: Path, outputs: Sequence[Path], recipes: Keyed) -> dict[Path, str]:
        """The outputs of an input that must be made, and why: '' where they never were."""
        stale, digest = {}, None
        for number, path in enumerate(outputs):
            row, size = self.outputs.get(self._name(path)), regular_size(path)
            if size is None:
                stale[path] = "" if row is None else "an output is missing"
                continue
            key, recipe = _of_output(recipes, number)
            digest = digest or self._digest_or_none(read)
            before, _, read_before = str(row.get("key")).partition(" ") if row else ("", "", "")
            if row is None or row.get("verb") != self._verb:
                reason = "nothing says what they were made from"
            elif before != key:
                reason = f"made from {other_options(self._recipes.get(before, {}), recipe)}"
            elif read_before != digest[:_INPUT]:
                reason = "made from another input"
            elif self._is_of_ended_run(path, row):
                reason = "made by a run that was ended"
            else:
                reason = "" if size else "an output is empty"
            if reason and not (self._is_single and _carries(path, _key(key, digest))):
                stale[path] = reason
        return stale

    def _is_of_ended_run(self, path: Path, row: Row) -> bool:
        """True for an output that a run with other options wrote after its row, and did not note."""
        others = self._digests[self._name(path)] - {row.get("sha256")}
        return bool(others) and self._digest_or_none(path) in others

    def refusal(self, path: Path) -> str:
        """Say why an output must not be replaced; '' if facerf wrote what is there, or nothing is there."""
        if not is_occupied(path):
            return ""
        written = self._digests.get(self._name(path))
        if written and self._digest_or_none(path) in written:
            return ""
        state = "was changed after facerf wrote it" if written else "was not written by facerf"
        return f"{path}: {state}; {_ADVICE}"

    def is_edited(self, path: Path) -> bool:
        """True if an output is not as it was written."""
        return self._name(path) in self.outputs and self.refusal(path) != ""

    def key_of(self, read: Path, recipe: str) -> str:
        """Return the key of an output that is made from an input by the recipe of a digest."""
        return _key(recipe, self._digest_or_none(read))

    def replaceable(self, item: Item) -> set[Path]:
        """Return all files that this command has written for an item and that facerf may replace."""
        names = self._of_item.get((self._verb, item.name), set())
        paths = (self._folder / name for name in names)
        return {path for path in paths if os.path.exists(path) and not self.refusal(path)}

    def open(self, recipes: Keyed, has_work: bool) -> None:
        """Write the rows, for the outputs that follow, or since files were read that they do not know."""
        if not (has_work or self._new):
            return
        self._recipes.update(recipes)
        self._new.clear()
        rows: list[Mapping[str, Any]] = list(self._files.values())
        rows += [{"recipe": key, "of": recipe} for key, recipe in self._recipes.items()]
        rows += [*self._unfinished.values(), *self.outputs.values()]
        with suppress(*self._lost), atomic_path(self.path) as temporary:
            temporary.write_text(lines_of(rows), encoding="utf-8")

    def close(self) -> None:
        """Remove the journals at the end of a run; rows of items that did not end are kept."""
        for journal in self._journals():
            rows = ((str(row.get("output")), row) for row in json_rows(journal))
            self._append([row for name, row in rows if row.get("sha256") not in self._digests.get(name, ())])
            journal.unlink(missing_ok=True)

    def _journals(self) -> list[Path]:
        return sorted(self.path.parent.glob(f"{self.path.stem}.*.jsonl"))

    def add(self, item: str, made: Made, outputs: Sequence[Path], recipes: Keyed) -> None:
        """Add the rows of an item that was made; `outputs` are those that have a recipe, in their order."""
        self._note(made.read)
        keys = {self._name(path): _of_output(recipes, number)[0] for number, path in enumerate(outputs)}
        rows: list[Row] = []
        for row in made.outputs:
            self._note(row)
            name = self._name(Path(row["file"]))
            key = _key(keys.get(name, ""), made.read["sha256"])
            self._digests.setdefault(name, set()).add(row["sha256"])
            digest = {"sha256": row["sha256"], "key": key}
            rows.append({"output": name, "verb": self._verb, "item": item, **digest})
        self._append(rows)

    def add_file(self, read: Path, output: Path, recipes: Keyed) -> None:
        """Add the one output of a run that has no items."""
        self.open(recipes, has_work=True)
        self.add(output.name, Made(read_row(read), (read_row(output),)), [output], recipes)

    def own(self, path: Path) -> None:
        """Note a file that belongs to no item, such as the list of all pages, as written by facerf."""
        row = {"output": self._name(path), "verb": self._verb, "sha256": read_row(path)["sha256"]}
        self._append([row])

    def _append(self, rows: Iterable[Row]) -> None:
        with suppress(*self._lost), self.path.open("a", encoding="utf-8") as stream:
            stream.write(lines_of([*rows, *self._new]))
            stream.flush()
            with suppress(OSError):  # not every file system can
                os.fsync(stream.fileno())
        self._new.clear()

    def _digest_or_none(self, path: Path) -> str:
        try:
            return self.digest_of(path)
        except InputError:
            return "none"  # its item says so

    def _note(self, row: Row) -> None:
        self._files[str(row["file"])] = row
        self._new.append(row)

    def _name(self, path: Path) -> str:
        text = os.fspath(path)
        if text.startswith(self._prefix) and ".." not in text:  # as all of a verb's; ten times faster
            return text[len(self._prefix) :].replace(os.sep, "/")
        return Path(os.path.relpath(path, self._folder)).as_posix()


class Writes:
    """Decides which files the writes of an item may replace, and journals the digests of what it writes.

    Attributes:
        written: SHA-256 and state of each file in the output folder that the item has written.
        left: Files that were left as they are.
    """

    def __init__(self, item: Item, folder: Path, verb: str, index: Path, overwrite: Overwrite) -> None:
        self.written: dict[Path, tuple[str, Row]] = {}
        self.left: set[Path] = set()
        self._item, self._folder, self._overwrite = item, folder, overwrite
        self._row = {"verb": verb, "item": item.name}
        self._journal = index.with_name(f"{index.stem}.{machine_id()}-{os.getpid()}.jsonl")

    def __call__(self, path: Path, temporary: Path) -> bool:
        """Tell whether a file takes the place of what is at a path; see `atomic.asking`.

        Raises InputError for a file that is not facerf's.
        """
        if is_temporary(path) or not path.is_relative_to(self._folder):
            return True
        exists = is_occupied(path)
        if exists and (path in self._item.kept or self._overwrite == "never"):
            self.left.add(path)
            return False
        if exists and self._overwrite == "changed" and path not in self._item.stale:
            raise InputError(f"{path}: was not written by facerf, or was changed since; {_ADVICE}")
        digest = file_sha256(temporary)
        self.written[path] = digest, {**_state(temporary.stat()), "ctime_ns": 0}  # a rename changes that
        row = {"output": path.relative_to(self._folder).as_posix(), **self._row, "sha256": digest}
        with suppress(OSError):  # only the next run after a kill needs it
            descriptor = os.open(self._journal, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                os.write(descriptor, lines_of([row]).encode())
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        return True

    def rows(self, outputs: Iterable[Path]) -> tuple[Row, ...]:
        """Return rows of all that was written, and of outputs that were not written by `atomic_path`."""
        rows: list[Row] = []
        for path, (digest, before) in self.written.items():
            with suppress(OSError):  # the user has removed it
                now = path.stat()
                same = {**_state(now), "ctime_ns": 0} == before  # else it was edited, and is read again
                state = _state(now) if same else {}
                rows.append({"file": os.path.abspath(path), **state, "sha256": digest})
        rows += [read_row(path) for path in outputs if path not in self.written]
        return tuple(rows)


def is_occupied(path: Path) -> bool:
    """True where anything but an empty file is: a full disk or a copy may leave empty ones."""
    return os.path.lexists(path) and regular_size(path) != 0


def _carries(path: Path, key: str) -> bool:
    """Tell whether a file contains a key, as the metadata of the file of `-o FILE` does."""
    with suppress(OSError, ValueError), path.open("rb") as file:  # ValueError: an empty file
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ).find(key.encode()) >= 0
    return False


def _in_cache(file: Path) -> Path:
    """The index of the one file that `-o` names."""
    from facerf_cli.files.downloads import cache_folder  # --help does without it

    name = hashlib.sha256(os.fsencode(os.path.abspath(file))).hexdigest()[:16]
    return cache_folder() / "written" / f"{name}.jsonl"


def keyed(recipes: Sequence[Recipe]) -> Keyed:
    """Recipes with their digests."""
    return [(key_of(recipe), recipe) for recipe in recipes]


def _of_output(recipes: Keyed, number: int) -> tuple[str, Recipe]:
    """The recipe of an item's output, or that of all of them."""
    return recipes[number if len(recipes) > 1 else 0]


def _key(recipe: str, input_sha256: str) -> str:
    return f"{recipe} {input_sha256[:_INPUT]}"


def _state(state: os.stat_result) -> dict[str, int]:
    times = {"mtime_ns": state.st_mtime_ns, "ctime_ns": state.st_ctime_ns}
    return {"size": state.st_size, "inode": state.st_ino, **times}
