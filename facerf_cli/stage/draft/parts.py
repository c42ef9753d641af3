"""The parts that the names of a capture's pictures have in common, and which of these vary.

A name is cut into runs of digits, runs of letters and single other characters; an azimuth and elevation such
as A+035E-20 stay one. Names that are cut alike are laid over each other. What lies between separators and
varies is one part, and so is a whole folder's or file's name in which only one thing varies: `light_017` is a
light's id as it stands. In a file's name a number that stays is of something else, as in `cam01_L017`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise
from pathlib import PurePosixPath
from random import Random

from facerf_cli.stage.draft.lamps import ANGLES

_TOKEN = re.compile(rf"(?P<angles>{ANGLES.pattern})|(?P<digits>[0-9]+)|(?P<letters>[^\W\d_]+)|.", re.I | re.S)
_ANGLES = re.sub(r"\?P<\w+>", "?:", ANGLES.pattern)
_EXPRESSIONS = {"angles": f"(?i:{_ANGLES})", "digits": "[0-9]+", "letters": r"[^\W\d_]+"}
_WORD = ("digits", "letters")  # the kinds that separators part
_ALIKE = 0.6  # of the names: with fewer cut alike, a folder's or file's name is one part as it stands
_CROSSED = 1.2  # pairs of two parts over the values of either: about 1 where one says what the other is
_NEARLY_ALL = 0.9
_MOST_PATHS = 10_000  # that are cut, which takes up to 20 kB a name; more than a capture has lights
ANY = "[^/]+"

Cut = tuple[tuple[str, str], ...]  # kind and text of each token


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the names: its text in every path, and an expression for what may stand there."""

    texts: tuple[str, ...]
    expression: str

    @cached_property
    def values(self) -> frozenset[str]:
        """The texts, each once."""
        return frozenset(self.texts)

    @property
    def varies(self) -> bool:
        """Whether paths differ in it."""
        return len(self.values) > 1


def parts_of(paths: Iterable[str]) -> list[Part]:
    """The parts, in order, of the paths that are named alike: each / is one, and the last is the suffix.

    The paths, with / between names, are as deep as most are and end as most do; of very many, some.
    """
    alike = _of_one_kind(paths)
    some = alike if len(alike) <= _MOST_PATHS else Random(0).sample(sorted(alike), _MOST_PATHS)
    rows = [path.split("/") for path in some]
    suffix = PurePosixPath(rows[0][-1]).suffix
    names = [(*row[:-1], row[-1].removesuffix(suffix)) for row in rows]
    cuts: list[dict[str, Cut]] = []
    for depth in range(len(rows[0])):
        cut, names = _cut_alike(names, depth)
        cuts.append(cut)
    slash, end = (Part((text,) * len(names), re.escape(text)) for text in ("/", suffix))
    parts: list[Part] = []
    for depth, cut in enumerate(cuts):
        found = _parts([cut[name[depth]] for name in names])
        is_folder = depth < len(cuts) - 1
        parts += [*_whole_where_one_varies(found, is_folder), slash if is_folder else end]
    return parts


def is_crossed(a: Part, b: Part) -> bool:
    """Whether many values of one part come with each of the other: else one says what the other is."""
    pairs = len(set(zip(a.texts, b.texts, strict=True)))
    return pairs > _CROSSED * max(len(a.values), len(b.values))


def _of_one_kind(paths: Iterable[str]) -> list[str]:
    """The paths of the depth and suffix that most have; of equally many, floating-point pictures."""
    kinds: dict[tuple[int, str], list[str]] = {}
    for path in paths:
        kinds.setdefault((path.count("/"), PurePosixPath(path).suffix), []).append(path)
    most = max(kinds, key=lambda kind: (len(kinds[kind]), kind[1].lower() in (".exr", ".hdr"), kind))
    return kinds[most]


def _cut_alike(names: list[tuple[str, ...]], depth: int) -> tuple[dict[str, Cut], list[tuple[str, ...]]]:
    """How the names at a depth are cut, and the paths whose are cut as most; where few are, at _ alone."""
    cut = {name: _cut(name) for name in {path[depth] for path in names}}
    shapes = {name: _shape(tokens) for name, tokens in cut.items()}
    [(most, count)] = Counter(shapes[path[depth]] for path in names).most_common(1)
    if count < _ALIKE * len(names):
        return _cut_at_lines(cut), names
    return cut, [path for path in names if shapes[path[depth]] == most]


def _cut(name: str) -> Cut:
    return tuple((match.lastgroup or match[0], match[0]) for match in _TOKEN.finditer(name))


def _cut_at_lines(names: Iterable[str]) -> dict[str, Cut]:
    """Names that are unlike but for as many _ in each, as `anna_L1` and `bob 2_L1`, cut there; else whole."""
    cut = {
        name: tuple(("_" if text == "_" else "name", text) for text in re.split("(_)", name))
        for name in names
    }
    return cut if len(set(map(_shape, cut.values()))) == 1 else {name: (("name", name),) for name in cut}


def _shape(tokens: Cut) -> tuple[str, ...]:
    return tuple(kind for kind, _ in tokens)


def _parts(rows: Sequence[Cut]) -> list[Part]:
    """Parts of names [paths] that are cut alike: each separator, and what lies between them."""
    tokens = [_part(column) for column in zip(*rows, strict=True)]
    parts: list[Part] = []
    for is_word, run in groupby(zip(_shape(rows[0]), tokens, strict=True), lambda pair: pair[0] in _WORD):
        found = [part for _, part in run]
        parts += _whole_where_one_varies(found, fixed_too=True) if is_word else found
    return parts


def _part(column: Sequence[tuple[str, str]]) -> Part:
    """A token of all paths."""
    kind, texts = column[0][0], tuple(text for _, text in column)
    part = Part(texts, re.escape(texts[0]))
    return Part(texts, _EXPRESSIONS.get(kind, ANY)) if part.varies else part


def _whole_where_one_varies(parts: Sequence[Part], fixed_too: bool) -> list[Part]:
    """The parts, those put together that say the same; one part where no two are left that vary.

    Without `fixed_too` what is fixed alone stays as it is, and so does a fixed number: it may name a camera.
    """
    apart = list(parts)
    places = [place for place, part in enumerate(apart) if part.varies]
    for first, second in reversed(list(pairwise(places))):
        if not is_crossed(apart[first], apart[second]) and not _counts_files(apart[first], apart[second]):
            apart[first : second + 1] = [_together(apart[first : second + 1])]
    varying = sum(part.varies for part in apart)
    numbered = any(re.search("[0-9]", part.texts[0]) for part in apart if not part.varies)
    return [_together(apart)] if varying < 2 and (fixed_too or (varying and not numbered)) else apart


def _counts_files(a: Part, b: Part) -> bool:
    """Whether one part alone tells all files apart: a counter or the time, which is nothing of a light."""
    coarse, fine = sorted((len(a.values), len(b.values)))
    return coarse < _NEARLY_ALL * len(a.texts) <= fine


def _together(parts: Sequence[Part]) -> Part:
    texts = tuple(map("".join, zip(*(part.texts for part in parts), strict=True)))
    return Part(texts, "".join(part.expression for part in parts))
