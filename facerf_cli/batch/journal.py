"""The journal of an output folder: what was made, from what, and how each item ended.

`.facerf.jsonl` has JSON rows of three kinds; the last row of each thing counts. With `--shard` each process
appends to its own journal (`.facerf-3-of-8.jsonl`) and reads all of them. With `-o FILE` the journal is in
the user's cache, so that no other file is written beside FILE, whose metadata contains its key.

- `file`: a file that was read or written: size, times, inode and SHA-256. If unchanged, it is not read again.
- `output`: a result, by its path in the folder, with its SHA-256. It is noted before it gets its name, so
  that the results of a killed run are recognised, and again at the end of its item with its `key`: the
  digests of its recipe (options, files and networks that shape it) and of its input.
- `item`: how an item ended: its status, outputs, facts and error. `--report` writes these rows.

A result is finished if its row has the expected key. A file is replaced only if facerf wrote it and it has
not changed since (`Journal.refusal`).
"""

import hashlib
import json
import mmap
import os
import os.path
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.settings import Overwrite, Shard
from facerf_cli.errors import FacerfError, InputError
from facerf_cli.files.atomic import atomic_path, is_temporary
from facerf_cli.files.texts import file_sha256, is_regular, parse_json, regular_size, require_regular
from facerf_cli.run.logs import json_line

Row = dict[str, Any]
_ADVICE = "move it, choose another -o, or pass --overwrite always"
_INPUT = 16  # digits of an input's digest in a key


class Journal:
    """The rows of an output folder.

    Attributes:
        path: The file that this process appends to.
        items: The last row of each item, by command and item.
    """

    def __init__(
        self,
        folder: Path,
        verb: str = "",
        shard: Shard = Shard(),  # noqa: B008 (frozen)
        file: Path | None = None,
    ) -> None:
        self._folder, self._verb = folder, verb
        self._prefix = os.path.join(folder, "")
        self.path = _in_cache(file) if file else folder / f".facerf{shard.suffix}.jsonl"
        # If the cache cannot be written, the next run repeats the work, but this one succeeds.
        self._lost: tuple[type[Exception], ...] = (FacerfError, OSError) if file else ()
        self._is_single = file is not None
        self.items: dict[tuple[str, str], Row] = {}
        self._own: dict[str, Row] = {}  # rows of this process's file, by what they describe
        self._new: list[Row] = []  # rows of files that were read since rows were last written
        self._files: dict[str, Row] = {}
        self._outputs: dict[str, Row] = {}  # that have a key
        self._digests: dict[str, set[str]] = {}  # by output: what facerf has written there
        self._of_item: dict[tuple[str, str], set[str]] = {}  # by command and item: its outputs
        by_time = sorted(folder.glob(".facerf*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
        for path in [self.path] if file else by_time:
            for row in json_rows(path):
                self._take(row, is_own=path == self.path)

    def _take(self, row: Row, is_own: bool = True) -> None:
        """Take a row, in place of an earlier one of the same thing."""
        if "output" in row:
            name, digest = str(row["output"]), str(row.get("sha256"))
            if name.startswith("/") or ".." in name.split("/"):
                return
            self._digests.setdefault(name, set()).add(digest)
            self._of_item.setdefault((str(row.get("verb")), str(row.get("item"))), set()).add(name)
            of = f"output {name}"
            if "key" in row:
                self._outputs[name] = row
                for noted in self._digests[name] if is_own else ():  # before it got its name
                    self._own.pop(f"output {name} {noted}", None)
            else:
                of += f" {digest}"
        elif "file" in row and "sha256" in row:
            self._files[of := str(row["file"])] = row
        elif named := item_of(row):
            self.items[named] = row
            of = "item {} {}".format(*named)
        else:
            return
        if is_own:
            self._own.pop(of, None)
            self._own[of] = row

    def digest_of(self, path: Path) -> str:
        """Return the SHA-256 of a file, without reading it if its row is up to date. Raises InputError."""
        row = self._files.get(os.path.abspath(path))
        with suppress(OSError):
            state = os.stat(path)
            is_file = not stat.S_ISDIR(state.st_mode)  # a folder's state does not show changes of its files
            if row is not None and is_file and _state(state).items() <= row.items():
                return str(row["sha256"])
        row = file_row(path)
        self._take(row)
        self._new.append(row)
        return str(row["sha256"])

    def to_make(
        self, item: Item, outputs: Sequence[Path], keys: Sequence[str], overwrite: Overwrite
    ) -> dict[Path, str]:
        """Return the outputs of an item that must be made, and why: '' if they were never made.

        Args:
            item: Its input is compared by content.
            outputs: Its results, with one key each, or one key for all.
            keys: Digests of recipes (`recipe.key_of`).
            overwrite: Whether to replace existing results.

        Raises InputError for an output that may not be replaced (`refusal`).
        """
        if overwrite == "always":
            return dict.fromkeys(outputs, "")
        if overwrite == "never":
            return {path: "" for path in outputs if not is_occupied(path)}
        stale = {}
        for path, key in _with_keys(outputs, keys):
            reason = self.why(item, path, key)
            if reason is None:
                continue
            if refusal := self.refusal(path):
                raise InputError(refusal)
            stale[path] = reason
        return stale

    def why(self, item: Item, path: Path, recipe: str) -> str | None:
        """Return why a result must be made: '' if it was never made, None if it is finished."""
        row = self._outputs.get(self._name(path))
        if not (path.is_dir() or regular_size(path)):
            return "" if row is None else "missing or empty"
        key = self.key_of(item, recipe)
        if self._is_single and _carries(path, key):
            return None
        if row is None:
            return ""
        before, _, read = str(row["key"]).partition(" ")
        if before != recipe or row.get("verb") != self._verb:
            return "options changed"
        if read != key.partition(" ")[2]:
            return "input changed"
        others = self._digests[self._name(path)] - {row.get("sha256")}
        if others and self._digest_or_none(path) in others:  # written by an unfinished run, other options
            return "the last run was interrupted"
        return None

    def refusal(self, path: Path) -> str:
        """Return why an output must not be replaced; '' if facerf wrote it or it does not exist."""
        if not is_occupied(path):
            return ""
        written = self._digests.get(self._name(path))
        if written and self._digest_or_none(path) in written:
            return ""
        state = "was changed after facerf wrote it" if written else "was not written by facerf"
        return f"{path}: {state}; {_ADVICE}"

    def key_of(self, item: Item, recipe: str) -> str:
        """Return the key of a result: the digests of its recipe and of its input."""
        return _key(recipe, "none" if item.is_drawn else self._digest_or_none(item.input_path))

    def replaceable(self, item: Item) -> set[Path]:
        """Return all files that this command has written for an item and that facerf may replace."""
        names = self._of_item.get((self._verb, item.name), set())
        paths = (self._folder / name for name in names)
        return {path for path in paths if os.path.exists(path) and not self.refusal(path)}

    def open(self, todo: Iterable[Item]) -> None:
        """Rewrite the file without outdated rows, before items are made.

        Nothing is written if no item is to be made and all files that were read have rows.
        """
        todo = list(todo)
        for item in todo:
            self.items.pop((self._verb, item.name), None)
            self._own.pop(f"item {self._verb} {item.name}", None)
        if todo or self._new:
            with suppress(*self._lost), atomic_path(self.path) as temporary:
                temporary.write_text(lines_of(self._own.values()), encoding="utf-8")
        self._new.clear()

    def add(
        self, item: Item, row: Row, made: "Made | None", outputs: Sequence[Path], keys: Sequence[str]
    ) -> None:
        """Append the rows of an item that has ended.

        Args:
            item: The item.
            row: How it ended.
            made: Rows of its files; None after a failure.
            outputs: Its results, in the order of the keys.
            keys: Digests of recipes; a single one is the key of all files that were written.
        """
        rows = [row]
        if made:
            recipes = {self._name(path): key for path, key in _with_keys(outputs, keys)}
            rows += [file for file in (made.read, *made.outputs) if file]
            for written in made.outputs:
                recipe = recipes.get(self._name(Path(written["file"])), keys[0] if len(keys) == 1 else "")
                key = _key(recipe, made.read.get("sha256", "none"))
                rows.append(self._output_row(written, key, item.name))
        self._append(rows)

    def add_file(self, path: Path, item: Item | None = None, recipe: str = "") -> None:
        """Add a file that no work on an item has written, such as a video or the list of all pages.

        If it is the only output of an item, `recipe` is the digest of its recipe.
        """
        rows = [file_row(path), *([file_row(item.input_path)] if item else [])]
        key = _key(recipe, rows[-1]["sha256"]) if item else ""
        self._append([*rows, self._output_row(rows[0], key, item.name if item else "")])

    def _output_row(self, written: Row, key: str, item: str) -> Row:
        name = self._name(Path(written["file"]))
        return {"output": name, "verb": self._verb, "item": item, "sha256": written["sha256"], "key": key}

    def _append(self, rows: Iterable[Row]) -> None:
        rows = list(rows)
        for row in rows:
            self._take(row)
        with suppress(*self._lost):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            append_rows(self.path, [*self._new, *rows])
        self._new.clear()

    def _digest_or_none(self, path: Path) -> str:
        try:
            return self.digest_of(path)
        except InputError:
            return "none"  # its item reports that

    def _name(self, path: Path) -> str:
        text = os.fspath(path)
        if text.startswith(self._prefix) and ".." not in text:  # the usual case; ten times faster
            return text[len(self._prefix) :].replace(os.sep, "/")
        return Path(os.path.relpath(path, self._folder)).as_posix()


class Made(NamedTuple):
    """Rows of an item's files.

    Attributes:
        read: Row of the input; empty if there is none.
        outputs: Rows of the files that were written.
    """

    read: Row
    outputs: tuple[Row, ...]


class Writes:
    """Decides which files the writes of an item may replace, and notes the digests of what it writes.

    Attributes:
        left: Files that were left as they are.
    """

    def __init__(self, folder: Path, verb: str, journal: Path, overwrite: Overwrite, item: Item) -> None:
        self.left: set[Path] = set()
        self._written: dict[Path, tuple[str, Row]] = {}  # SHA-256 and state
        self._item, self._folder, self._journal, self._overwrite = item, folder, journal, overwrite
        self._row = {"verb": verb, "item": item.name}

    def __call__(self, path: Path, temporary: Path) -> bool:
        """Tell whether a file replaces the one at a path; see `atomic.asking`.

        Raises InputError for a file that facerf did not write.
        """
        if is_temporary(path) or not path.is_relative_to(self._folder):
            return True
        exists = is_occupied(path)
        if exists and (path in self._item.kept or self._overwrite == "never"):
            self.left.add(path)
            return False
        if exists and self._overwrite == "changed" and path not in self._item.stale:
            raise InputError(f"{path}: was not written by facerf, or was changed since; {_ADVICE}")
        digest = file_row(temporary)["sha256"]
        self._written[path] = digest, {**_state(temporary.stat()), "ctime_ns": 0}  # a rename changes that
        row = {"output": path.relative_to(self._folder).as_posix(), **self._row, "sha256": digest}
        with suppress(OSError):  # only the next run after a kill needs it
            append_rows(self._journal, [row])
        return True

    def rows(self, outputs: Iterable[Path]) -> tuple[Row, ...]:
        """Return rows of all files that were written, and of outputs not written by `atomic_path`."""
        rows: list[Row] = []
        for path, (digest, before) in self._written.items():
            with suppress(OSError):  # the user has removed it
                now = path.stat()
                same = {**_state(now), "ctime_ns": 0} == before  # else it was edited, and is read again
                rows.append(
                    {"file": os.path.abspath(path), **(_state(now) if same else {}), "sha256": digest}
                )
        rows += [file_row(path) for path in outputs if path not in self._written]
        return tuple(rows)


def append_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Append rows in one write, which other processes' writes do not split, and sync them to the disk."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(descriptor, lines_of(rows).encode())
        with suppress(OSError):  # not every file system can
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def file_row(path: Path) -> Row:
    """Return the row of a file or folder: its state and its digest; InputError if it cannot be read.

    A folder's digest covers the names, sizes and times of the files in it.
    """
    try:
        state = os.stat(path)
        if stat.S_ISDIR(state.st_mode):
            files = ((file, file.stat()) for file in sorted(path.rglob("*")) if file.is_file())
            listing = [[f.relative_to(path).as_posix(), s.st_size, s.st_mtime_ns] for f, s in files]
            digest = hashlib.sha256(json.dumps(listing).encode("utf-8", "backslashreplace")).hexdigest()
        else:
            require_regular(path)
            digest = _digest(path, *_state(state).values())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    return {"file": os.path.abspath(path), **_state(state), "sha256": digest}


@lru_cache(maxsize=8)  # every frame of a video has the video as its input
def _digest(path: Path, *_: int) -> str:
    """Return the SHA-256 of a file in a state: its size, times and inode."""
    return file_sha256(path)


def json_rows(path: Path) -> Iterator[Row]:
    """Yield the objects of a file of JSON lines; a missing file has none."""
    if not is_regular(path):
        return
    for line in path.read_text(encoding="utf-8", errors="replace").split("\n"):
        with suppress(ValueError):  # a killed run may leave half a line
            row = parse_json(line)
            if isinstance(row, dict):
                yield row


def item_of(row: Row) -> tuple[str, str] | None:
    """Return the command and the item that a row describes; None for a row of another kind."""
    verb, item = row.get("verb"), row.get("item")
    return (verb, item) if isinstance(verb, str) and isinstance(item, str) else None


def lines_of(rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as JSON lines."""
    return "".join(json_line(row) + "\n" for row in rows)


def is_occupied(path: Path) -> bool:
    """Tell whether a path has anything but an empty file, which a full disk or a copy may leave."""
    return os.path.lexists(path) and regular_size(path) != 0


def _carries(path: Path, key: str) -> bool:
    """Tell whether a file contains a key, which `-o FILE` writes into the metadata."""
    with suppress(OSError, ValueError), path.open("rb") as file:  # ValueError: an empty file
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ).find(key.encode()) >= 0
    return False


def _in_cache(file: Path) -> Path:
    from facerf_cli.files.downloads import cache_folder  # --help does without it

    name = hashlib.sha256(os.fsencode(os.path.abspath(file))).hexdigest()[:16]
    return cache_folder() / "written" / f"{name}.jsonl"


def _with_keys(outputs: Sequence[Path], keys: Sequence[str]) -> Iterator[tuple[Path, str]]:
    """Pair outputs with their keys, or with one key for all."""
    return zip(outputs, keys if len(keys) > 1 else [*keys] * len(outputs), strict=True)


def _key(recipe: str, input_sha256: str) -> str:
    return f"{recipe} {input_sha256[:_INPUT]}"


def _state(state: os.stat_result) -> dict[str, int]:
    times = {"mtime_ns": state.st_mtime_ns, "ctime_ns": state.st_ctime_ns}
    return {"size": state.st_size, "inode": state.st_ino, **times}
