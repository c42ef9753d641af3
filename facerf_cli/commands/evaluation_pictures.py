"""Pictures that an evaluation keeps: the strips of its report, and with --pictures all of them as EXR."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import facerf_cli
from facerf_cli.commands.options import Settings
from facerf_cli.errors import InputError
from facerf_cli.records import Provenance

if TYPE_CHECKING:
    from facerf_cli.evaluation.case_files import KeptStrip
    from facerf_cli.evaluation.cases import Comparison
    from facerf_cli.evaluation.strips import Strip

PICTURES, STRIPS = "pictures", "strips"
_STRIP_QUALITY = 88


def keep_pictures(
    comparison: "Comparison", folder: Path, settings: Settings, stamp: Mapping[str, str]
) -> list[str]:
    """Write FOLDER/pictures/{source,truth,mask,METHOD}/CASE.exr, scene-linear; give the paths from FOLDER on.

    Predictions carry the mark of what facerf makes, and the `stamp` of the face model; sources and truths are
    given and carry its version only.
    """
    import numpy as np

    from facerf_cli.files.images import write_exr

    name = comparison.case.name
    asked = {"truth": comparison.truth, "mask": comparison.mask, "source": comparison.source}
    given = {kind: picture for kind, picture in asked.items() if picture is not None}
    clash = set(given) & set(comparison.predictions)
    if clash:
        raise InputError(f"a method is called {clash.pop()!r}, as a folder of --pictures is; rename it")
    for kind, picture in given.items():
        pixels = np.broadcast_to(picture.reshape(*picture.shape[:2], -1), (*picture.shape[:2], 3))
        write_exr(folder / _place(kind, name), pixels, metadata={"Software": _software()})
    for method, picture in comparison.predictions.items():
        marks = Provenance(name, _checkpoint_of(method, settings), **stamp).attributes()
        write_exr(folder / _place(method, name), picture, metadata=marks)
    return [_place(kind, name) for kind in (*given, *comparison.predictions)]


def _software() -> str:
    return f"facerf {facerf_cli.__version__}"


def _checkpoint_of(method: str, settings: Settings) -> str:
    """The checkpoint that a method's pictures come from, as far as its name tells."""
    from facerf_cli.pipeline import DEFAULT_CHECKPOINT

    return (settings.checkpoint or DEFAULT_CHECKPOINT).stem if method == "field" else method


def _place(kind: str, case: str) -> str:
    """Where in the folder a case's picture is kept; a name that leads out of it is an error."""
    parts = PurePosixPath(case).parts
    if not parts or ".." in parts or PurePosixPath(case).is_absolute() or "/" in kind:
        raise InputError(f"{kind}/{case}: is no name for a picture in a folder")
    return f"{PICTURES}/{kind}/{case}.exr"


def keep_strips(
    strips: "Mapping[str, Strip]", folder: Path, item: str, settings: Settings, stamp: Mapping[str, str]
) -> "tuple[KeptStrip, ...]":
    """Write an item's strips to FOLDER/strips/ITEM/NUMBER.jpg in place of those that are there."""
    from facerf_cli.evaluation.case_files import KeptStrip

    place = folder / STRIPS / item
    for old in place.glob("[0-9][0-9][0-9].jpg"):
        old.unlink()
    kept = []
    for number, (case, strip) in enumerate(strips.items()):
        path = place / f"{number:03d}.jpg"
        _write_strip(path, strip, Provenance(case, _checkpoint_of("field", settings), **stamp))
        size = (strip.pixels.shape[1], strip.pixels.shape[0])
        relative = path.relative_to(folder).as_posix()
        kept.append(KeptStrip(case, relative, strip.methods, strip.ev, strip.scales, strip.has_source, size))
    return tuple(kept)


def _write_strip(path: Path, strip: "Strip", made: Provenance) -> None:
    from PIL import Image

    from facerf_cli.files.atomic import atomic_path
    from facerf_cli.files.xmp import embed_xmp

    with atomic_path(path) as temporary:
        Image.fromarray(strip.pixels).save(temporary, quality=_STRIP_QUALITY, subsampling=0)
        embed_xmp(temporary, made.attributes())
