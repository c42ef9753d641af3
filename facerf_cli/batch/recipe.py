"""Recipes: all that shapes an output beside its input, so that it is made again only if that changed."""

import dataclasses
import os.path
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

RESULTS_VERSION = 10  # raised where the same recipe gives other pixels
SHIPPED = Path(__file__).parents[1] / "assets"
NOT_IN_RECIPE = {"in_recipe": False}  # metadata of a field that shapes no output

# Entries of recipes that are not called as the option that sets them is.
_OPTIONS = {
    "colour": "the colour of --background",
    "colourspace": "--input-colourspace",
    "config": "--ocio",
    "kind": "--background",
    "leaders": "the first photo of --exposure-group",
    "names": "the layers of --light",
    "non_negative": "--signed",
    "ocio_config": "--ocio",
    "path": "the image of --background",
    "photo_of_stack": "--photo",
    "results": "facerf's version of results",
    "rig": "--lights",
    "rotate_deg": "--rotate",
    "sampling": "--envmap-sampling",
    "size_px": "--size",
    "texture_side": "--texture-size",
    "width_px": "--width",
}

Recipe = dict[str, Any]  # names and JSON values
DigestOf = Callable[[Path], str]  # SHA-256 of a file
RecipesOf = Callable[[DigestOf], Sequence[Recipe]]  # of each output of an item, or one for all of them


@dataclasses.dataclass(frozen=True)
class OneRecipe:
    """The recipe of all outputs of a verb: the fields of its settings."""

    settings: Any

    def __call__(self, digest_of: DigestOf) -> list[Recipe]:
        """Return the one recipe."""
        return [recipe_of(self.settings, digest_of)]


def recipe_of(settings: Any, digest_of: DigestOf) -> Recipe:
    """List the fields of a dataclass, of dataclasses in it too, that shape outputs.

    A file counts by its content. Behind the checkpoints stand the networks that facerf ships.
    """
    recipe: Recipe = {"results": RESULTS_VERSION}
    _add_fields(recipe, settings, digest_of)
    return recipe


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
