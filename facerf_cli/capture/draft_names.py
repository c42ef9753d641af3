"""The parts that the names of a capture's pictures have in common, and which of these vary.

A name is cut into runs of digits, runs of letters and single other characters; an azimuth and elevation such
as A+035E-20 stay one. Names that are cut alike are laid over each other. What lies between separators and
varies is one part, and so is a whole folder's or file's name in which only one thing varies: `light_017` is a
light's id as it stands. In a file's name a number that stays is of something else, as in `cam01_L017`.

From the names of a capture's pictures to a pattern of {subject}, {camera} and {light}.

Which part is which is told by the words that stand in it or before it (`cam3`, `L017`), else by its place:
the lights come last, the subjects first.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, groupby, pairwise, permutations, takewhile
from pathlib import PurePosixPath
from random import Random

from facerf_cli.capture.capture import FIELDS
from facerf_cli.capture.draft_lights import ANGLES
from facerf_cli.capture.stage_json import MOST_CAMERAS, MOST_LIGHTS, MOST_SUBJECTS
from facerf_cli.errors import UsageError

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


_WORDS: Mapping[str, tuple[str, ...]] = {
    "subject": ("subject", "subj", "sub", "person", "actor", "face", "s", "p"),
    "camera": ("camera", "cam", "view", "c", "v"),
    "light": ("light", "lamp", "led", "flash", "olat", "l"),
}
_MOST = {"subject": MOST_SUBJECTS, "camera": MOST_CAMERAS, "light": MOST_LIGHTS}
_TOLD, _FAR_TOO_MANY = 4, 100  # what a word weighs against a place, and a limit against both


@dataclass(frozen=True)
class Naming:
    """How a capture's pictures are named."""

    pattern: str  # with {light}, and with {camera} and {subject} where the names have them
    by_place: tuple[str, ...]  # fields that are told by their place alone, and may be others
    strict: re.Pattern[str]  # of a picture's path, a group a field
    loose: re.Pattern[str]  # the same with anything for a light


def find_naming(paths: Sequence[str]) -> Naming:
    """The pattern that most of the paths follow; a UsageError where they are not those of a capture."""
    parts = parts_of(paths)
    same = _same_again(parts)
    varying = [place for place, part in enumerate(parts) if part.varies and place not in same]
    _require_a_capture(parts, varying)
    hints = _hints(parts)
    for place, (piece, _, _) in same.items():
        hints[piece] = hints[piece] or hints[place]
    if _ends_in_lights(varying, hints):
        hints[varying[-1]] = ""
    fields = _assigned(parts, varying, hints)
    by_place = tuple(field for place, field in fields.items() if hints[place] != field)
    settled = len(fields) == 1 or (len(fields) == len(FIELDS) and len(by_place) == 1)  # nothing else is left
    fields |= _fixed_fields(parts, hints, set(fields.values()))
    fields |= {place: fields[piece] for place, (piece, _, _) in same.items()}
    around = {place: (before, after) for place, (_, before, after) in same.items()}
    strict, loose = (re.compile(_expression(parts, fields, around, light)) for light in (None, ANY))
    return Naming(_pattern(parts, fields, around), () if settled else by_place, strict, loose)


def _same_again(parts: Sequence[Part]) -> dict[int, tuple[int, str, str]]:
    """The parts that are another over again, as in `anna/anna_L01.exr` or `s01/01_L01.exr`.

    By place: that of the part which it repeats, and what stands before and after the same text.
    """
    same: dict[int, tuple[int, str, str]] = {}
    for a, b in combinations([place for place, part in enumerate(parts) if part.varies], 2):
        for whole, piece in ((b, a), (a, b)):
            repeated = {place for place, _, _ in same.values()}
            free = not {whole, piece} & same.keys() and whole not in repeated
            if free and (around := _around(parts[whole], parts[piece])):
                same[whole] = (piece, *around)
    return same


def _around(whole: Part, piece: Part) -> tuple[str, str] | None:
    """What stands around a part's text in another's, alike in all paths; None where it does not."""
    before, found, after = whole.texts[0].partition(piece.texts[0])
    pairs = set(zip(whole.texts, piece.texts, strict=True))
    return (before, after) if found and all(a == f"{before}{b}{after}" for a, b in pairs) else None


def _require_a_capture(parts: Sequence[Part], varying: Sequence[int]) -> None:
    if not varying:
        raise UsageError("one picture is no capture, which has a picture a light")
    for a, b in combinations(varying, 2):
        if not is_crossed(parts[a], parts[b]):
            raise UsageError(
                f"the names vary together in {_shown(parts[a])} and {_shown(parts[b])}; rename the pictures, "
                "so that a light has one name under all subjects and cameras"
            )
    if len(varying) > len(FIELDS):
        examples = ", ".join(_shown(parts[place]) for place in varying)
        raise UsageError(
            f"{len(varying)} parts of the names vary ({examples}), and subject, camera and light are three; "
            "rename the pictures, or give a folder with fewer of them"
        )


def _shown(part: Part) -> str:
    first, *_ = sorted(part.values)
    return f"{first!a} ({len(part.values)} values)"


def _hints(parts: Sequence[Part]) -> list[str]:
    """By part, the field that the word right before its number speaks of; empty where none does."""
    hints, before = [], ""
    for part in parts:
        hints.append(_hint(part, before))
        before = "" if part.varies or "/" in part.values else before + part.texts[0]
    return hints


def _hint(part: Part, before: str) -> str:
    if all(ANGLES.search(text) for text in part.values):
        return "light"
    texts = [text.casefold() for text in part.values]
    pairs = takewhile(lambda pair: pair[0] == pair[1], zip(min(texts), max(texts), strict=False))
    same = "".join(letter for letter, _ in pairs).rstrip("0123456789")
    if not all(re.match("[0-9]", text[len(same) :]) for text in texts):
        return ""
    word = re.split(r"[\W\d_]+", (same or before.casefold()).rstrip("_- ."))[-1]
    return next((field for field, known in _WORDS.items() if {word, word.removesuffix("s")} & {*known}), "")


def _ends_in_lights(varying: Sequence[int], hints: Sequence[str]) -> bool:
    """Whether the last part is the light against its word: one is needed, and `anna/face_1` is no face 1."""
    told = [hints[place] for place in varying]
    return "light" not in told and (len(told) < len(FIELDS) or told[-1] == "subject")


def _assigned(parts: Sequence[Part], varying: Sequence[int], hints: Sequence[str]) -> dict[int, str]:
    """The field of each part that varies."""

    def score(fields: Sequence[str]) -> int:
        pairs = list(zip(varying, fields, strict=True))
        told = sum(_TOLD * (1 if hints[place] == field else -1) for place, field in pairs if hints[place])
        placed = (fields[-1] == "light") + (fields[0] == "subject")
        too_many = any(len(parts[place].values) > _MOST[field] for place, field in pairs)
        return told + placed - _FAR_TOO_MANY * too_many

    best = max((fields for fields in permutations(FIELDS, len(varying)) if "light" in fields), key=score)
    if score(best) <= _TOLD - _FAR_TOO_MANY:
        counts = ", ".join(_shown(parts[place]) for place in varying)
        raise UsageError(
            f"the names vary too much for {MOST_LIGHTS} lights at most: {counts}; is this one capture?"
        )
    return dict(zip(varying, best, strict=True))


def _fixed_fields(parts: Sequence[Part], hints: Sequence[str], known: set[str]) -> dict[int, str]:
    """Parts that name the only camera, by a word of theirs, or the only subject, which may be any folder."""
    fixed = [place for place, part in enumerate(parts[:-1]) if not part.varies and part.texts[0] != "/"]
    named = {field: [place for place in fixed if hints[place] == field] for field in ("camera", "subject")}
    named["subject"] = [place for place in fixed if _is_folder(parts, place)] + named["subject"]
    fields: dict[int, str] = {}
    for field, places in named.items():
        if field not in known and (free := [place for place in places if place not in fields]):
            fields |= {place: field for place in fixed if parts[place].texts[0] == parts[free[0]].texts[0]}
    return fields


def _is_folder(parts: Sequence[Part], place: int) -> bool:
    """Whether a part is a folder's whole name."""
    return "/" in parts[place + 1].values and (place == 0 or "/" in parts[place - 1].values)


def _pattern(parts: Sequence[Part], fields: Mapping[int, str], around: Mapping[int, tuple[str, str]]) -> str:
    pieces = []
    for place, part in enumerate(parts):
        before, after = around.get(place, ("", ""))
        pieces.append(f"{before}{{{fields[place]}}}{after}" if place in fields else part.texts[0])
    return "".join(pieces)


def _expression(
    parts: Sequence[Part], fields: Mapping[int, str], around: Mapping[int, tuple[str, str]], light: str | None
) -> str:
    """A regular expression of the paths; `light` is of what may stand for a light, by default its like."""
    like = {field: parts[place].expression for place, field in fields.items() if place not in around}
    like |= {field: ANY for place, field in fields.items() if field == "camera" and _is_folder(parts, place)}
    like |= {"subject": ANY} | ({} if light is None else {"light": light})
    pieces, seen = [], set()
    for place, part in enumerate(parts):
        before, after = map(re.escape, around.get(place, ("", "")))
        field = fields.get(place)
        named = f"(?P={field})" if field in seen else f"(?P<{field}>{like.get(field or '')})"
        pieces.append(part.expression if field is None else before + named + after)
        seen.add(field)
    return "".join(pieces)
