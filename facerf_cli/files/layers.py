"""Choice of an image file's layer: by name, or the layer that renderers use for the image itself.

An EXR has parts, and each part has layers: channels whose names end in R, G and B after a dot.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.run.logs import one_line

_LETTERS = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}
# Words in the names of layers: the image itself, and other rendered quantities.
_IMAGE = "combined beauty rgba rgb image color colour composite final"
_OTHER = (
    "ao ambient occlusion ambientocclusion albedo depth z normal normals n p position uv motion vector"
    " velocity shadow shadows mask matte id crypto cryptomatte index mist emission env denoising"
)
_IMAGE_WORDS, _OTHER_WORDS = frozenset(_IMAGE.split()), frozenset(_OTHER.split())
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_MOST_NAMED = 8


class ImageLayer(NamedTuple):
    """Layer: its name, its part of the file, and the indices of its colour (one or three) and alpha."""

    name: str
    part: int
    colour: list[int]
    alpha: int | None = None


def chosen_layer(path: Path, specs: Sequence[oiio.ImageSpec], wanted: str | None) -> tuple[ImageLayer, str]:
    """Choose a layer by name, by default the image; return it and a log message.

    The message is empty for R, G and B of the first part.
    """
    layers = list(_layers(specs))
    if wanted is not None:
        name = wanted.casefold()
        named = (a for a in layers if name in (a.name.casefold(), a.name.rpartition(".")[2].casefold()))
        chosen = next(named, None)
        if chosen is None:
            known = ", ".join(layer.name for layer in layers if layer.name)
            advice = f"it has {known}" if known else "it has none with R, G and B"
            raise InputError(f"{path}: has no layer {one_line(wanted)!r}; {advice}")
    else:
        chosen = min(layers, key=_rank, default=ImageLayer("", 0, *first_channels(specs[0])))
    parts = [spec.get_string_attribute("oiio:subimagename") for spec in specs]
    if not chosen.name or (chosen.part, chosen.name) == (0, parts[0]):
        return chosen, ""
    others = dict.fromkeys([*parts, *(layer.name for layer in layers)])
    others.pop(chosen.name, None)
    rest = ", ".join(filter(None, list(others)[:_MOST_NAMED]))
    return chosen, f"layer {one_line(chosen.name)} is read" + (f", not {one_line(rest)}" if rest else "")


def _layers(specs: Sequence[oiio.ImageSpec]) -> Iterator[ImageLayer]:
    """Yield the layers with R, G and B of flat parts in the file's order.

    Channels without a layer name take their part's name.
    """
    for part, spec in enumerate(specs):
        names = () if spec.deep else spec.channelnames
        for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
            at = {}
            for index, name in enumerate(names):
                prefix, _, letter = name.rpartition(".")
                if prefix == layer:
                    at[_LETTERS.get(letter.lower(), letter.lower())] = index
            if all(letter in at for letter in "rgb"):
                name = layer or spec.get_string_attribute("oiio:subimagename")
                yield ImageLayer(name, part, [at[letter] for letter in "rgb"], at.get("a"))


def _rank(layer: ImageLayer) -> int:
    """Return 0 for the image, 1 for a name without a known word, 2 for another quantity."""
    words = {word.lower() for word in _WORD.findall(layer.name)}
    if words & _OTHER_WORDS:
        return 2
    return int(bool(words) and not words & _IMAGE_WORDS)


def first_channels(spec: oiio.ImageSpec) -> tuple[list[int], int | None]:
    """Return the first colour channels (one for grey, or three) and the alpha channel."""
    alpha = spec.alpha_channel
    rest = [index for index in range(spec.nchannels) if index != alpha]
    colour = rest[:3] if len(rest) >= 3 else rest[:1] or [0]
    return colour, alpha if alpha >= 0 and alpha not in colour else None
