"""Photos as the items of `facerf evaluate`: read, cropped and fitted as every verb does."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from facerf_cli.commands.evaluation_options import EvaluateOptions
from facerf_cli.commands.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.commands.photo import PhotoOptions, face_model, fit_faces, read_photo
from facerf_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from facerf_cli.evaluation.cases import Case
    from facerf_cli.evaluation.photos import Portrait


def photo_items(inputs: Sequence[str], options: EvaluateOptions, preset: int) -> list[Item]:
    """The photos that the inputs name; of a preset the first so many."""
    items = collect_items(inputs, options.output, PHOTO_SUFFIXES)
    if not options.preset:
        return items
    if len(items) < preset:
        raise UsageError(f"{len(items)} photos, --preset paper measures {preset}; give a folder of more")
    return items[:preset]


def portraits(item: Item, photo: PhotoOptions, keep_eyes: bool) -> "Iterator[tuple[Case, Portrait]]":
    """The faces of a photo that were asked for; each is a person of its own."""
    from facerf_cli.evaluation.cases import Case
    from facerf_cli.evaluation.photos import Portrait

    picture = read_photo(item, photo)
    for face in fit_faces(item, picture, photo):
        name = f"{item.name}{face.tag}"
        try:
            portrait = Portrait.of(face_model(photo), face.fit, face.cropped, picture, keep_eyes)
        except InputError as error:
            raise InputError(f"{item.input_path}: {error}") from None
        yield Case(name, name, {"quality": face.fit.quality}), portrait
