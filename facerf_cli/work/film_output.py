"""A film as the output of `relight`: its frames are written as images beside it, then joined and removed."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self

from facerf_cli.batch.inputs import FILM_SUFFIXES, Item
from facerf_cli.batch.made_from import DigestOf, FolderIndex, Recipe, RecipesOf
from facerf_cli.batch.run import BatchOptions, Outcome, all_finished, folder_not_file, run_items
from facerf_cli.batch.settings import Overwrite, Settings
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.output_options import Format
from facerf_cli.work.shots import Shot

_FORMATS: dict[str, Format] = {".mp4": "png", ".mov": "png16"}  # of the frames of each kind of film
_RATE = Fraction(24)
_MOST_RATE = 1000
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class FilmOutput:
    """The film to write, and its rate where that is given."""

    path: Path
    rate: Fraction | None = None

    @property
    def folder(self) -> Path:
        """The folder of the frames, which goes when the film is whole."""
        return self.path.with_name(f"{self.path.name}.frames")

    @property
    def formats(self) -> tuple[Format, ...]:
        """The format of the frames."""
        return (_FORMATS[self.path.suffix.lower()],)

    def check(self, items: Sequence[Item], shots: Sequence[Shot], images: Sequence[Path]) -> None:
        """Raise UsageError unless the images are the frames of one film."""
        photos = len(items) - sum(len(shot.frames) for shot in shots)
        one = len(items) == len(images) if shots else len(images) > 1
        if photos + len(shots) != 1 or not one:
            raise UsageError(
                f"-o {self.path}: is one film; give one film and one light, or one photo and --rotate "
                "FROM:TO:N, or a folder with -o"
            )
        if any(item.input_path.resolve() == self.path.resolve() for item in items):
            raise UsageError(f"-o {self.path}: is the input; give another name")
        if self.rate and shots and shots[0].film:
            raise UsageError("--fps: a film keeps its own times; leave it out")

    def key(self, items: Sequence[Item], recipes_of: RecipesOf) -> str:
        """Identify what the film is made from: inputs and recipes."""
        import hashlib
        import json
        from functools import cache

        from facerf_cli.files.texts import file_sha256

        digest_of = cache(file_sha256)
        made_from = recipes_of(digest_of), [digest_of(item.input_path) for item in items]
        return hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()[:16]

    def is_finished(self, key: str, overwrite: Overwrite) -> bool:
        """True if the film is there and need not be made again: its metadata say what it was made from."""
        from facerf_cli.files.film import comment_of

        if overwrite == "always" or not self.path.is_file():
            return False
        return overwrite == "never" or key in comment_of(self.path)

    def join(self, images: Sequence[Path], shots: Sequence[Shot], key: str) -> None:
        """Write the film from its frames, in order, and remove them."""
        from facerf_cli.files.film import Timing, film_timing, write_film
        from facerf_cli.run.logs import Provenance

        source = shots[0].film if shots else None
        timing = film_timing(source) if source else Timing.steady(len(images), self.rate or _RATE)
        facts = Provenance(source.name if source else "").attributes()
        said = "; ".join(f"{name}={value}" for name, value in facts.items())
        write_film(self.path, images, timing, f"Synthetic: relit by a trained model; {said}; made from {key}")
        self._remove_frames([*images, *(shot.track for shot in shots)])

    def _remove_frames(self, files: Sequence[Path]) -> None:
        for path in (*files, *self.folder.glob(".facerf-index*.jsonl"), *self.folder.glob("report*.jsonl")):
            path.unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()


class FrameWork(Protocol):
    """A verb's work on frames: `Relight`."""

    def outputs_of(self, item: Item) -> list[Path]:
        """The images of an item."""

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """Recipes of the images."""

    def readable(self, dry_run: bool) -> Self:
        """The work with its models loaded."""


def run_to_film(
    film: FilmOutput,
    items: Sequence[Item],
    shots: Sequence[Shot],
    work: FrameWork,
    options: BatchOptions,
    settings: Settings,
    process: Callable[[Any, Item], Outcome],
) -> int:
    """Make the frames of a film, and join them where all are made; return the exit code."""
    images = [path for item in items for path in work.outputs_of(item)]
    film.check(items, shots, images)
    if options.dry_run:
        print(f"{items[0].input_path} -> {film.path}")
        return 0
    key = film.key(items, work.recipes_of)
    if film.is_finished(key, options.overwrite):
        log.info("%s: already finished", film.path)
        return 0
    index = FolderIndex(options.output, "relight", options.shard, work.recipes_of)
    if not all_finished(items, work.outputs_of, options, index):
        work = work.readable(dry_run=False)
    relit, recipes = partial(process, work), work.recipes_of
    code = run_items("relight", items, relit, work.outputs_of, options, settings, recipes)
    if code or not all(path.exists() for path in images):
        log.error("%s: not written, since frames failed; the others stay in %s", film.path, film.folder)
        return 1
    film.join(images, shots, key)
    print(film.path)
    return 0


def film_output(output: Path, fps: str | None) -> FilmOutput | None:
    """The film that `-o` names; None where it names a folder."""
    suffix = output.suffix.lower()
    if suffix not in _FORMATS or output.is_dir():
        if suffix in FILM_SUFFIXES and not output.is_dir():
            raise UsageError(f"-o {output}: films are written as .mp4 or .mov; give one of these")
        if fps is not None:
            raise UsageError("--fps: is for -o FILE.mp4 or FILE.mov; leave it out")
        folder_not_file(output)
        return None
    from facerf_cli.files.film import require_av

    require_av(output)
    return FilmOutput(output, None if fps is None else _rate(fps))


def _rate(text: str) -> Fraction:
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= _MOST_RATE:
        raise UsageError(f"--fps {text}: not a rate; give frames a second, such as 25 or 24000/1001")
    return rate
