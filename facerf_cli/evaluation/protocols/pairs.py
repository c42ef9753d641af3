"""Folders of predictions against a folder of truths, matched by name: anybody's pictures can be measured.

Trees are mirrored; a name is the path without its suffix, so a truth .exr may have a .png prediction. Every
picture of every folder must have its counterparts, of one size: leaving out what went wrong improves a mean.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.evaluation import folder_name
from facerf_cli.evaluation.case import Case, Comparison, Facts, read_array, read_facts
from facerf_cli.face.landmarks import find_faces
from facerf_cli.files.images import LinearImage, read_image

SUFFIXES = frozenset(
    {".exr", ".hdr", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".npy"}
)
_NAMED_AT_MOST = 3


@dataclass(frozen=True)
class ImagePair:
    """A truth and its predictions by method, on disk, and what is known of the picture."""

    name: str
    truth: Path
    predictions: Mapping[str, Path]
    mask: Path | None = None
    person: str = ""
    facts: Mapping[str, str | float] = field(default_factory=dict)


def collect_pairs(
    predictions: Sequence[Path], truths: Path, masks: Path | None = None, facts: Path | None = None
) -> list[ImagePair]:
    """The pairs of folders, sorted by name; a folder of predictions is a method of its name.

    `masks` mirrors the truths; `facts` is a CSV file (`facts_file.read_facts`). Where it names no person,
    that is the truth's topmost folder, or in a flat tree each picture its own. Raises UsageError for folders
    that are none, InputError for names or sizes that do not match: the first few are named, and all counted.
    """
    others = [*predictions, *([] if masks is None else [masks])]
    _check_folders(predictions, [truths, *others])
    found = _images_in(truths, others)
    by_method = {folder_name(folder): _images_in(folder, [truths, *others]) for folder in predictions}
    mask_files = {} if masks is None else _images_in(masks, [truths, *predictions])
    described = {} if facts is None else read_facts(facts)
    complaints = [_mismatch(found, by_method[folder_name(folder)], str(folder)) for folder in predictions]
    complaints += [_mismatch(found, mask_files, str(masks))] if masks is not None else []
    complaints += [_mismatch(found, described, str(facts))] if facts is not None else []
    _refuse(complaints, f"names must be those of {truths}, folders alike; suffixes may differ")
    pairs = [
        _pair(name, found[name], {m: files[name] for m, files in by_method.items()}, mask_files, described)
        for name in sorted(found)
    ]
    _check_sizes(pairs)
    return pairs


def compare_pair(pair: ImagePair, find_landmarks: bool = False) -> Comparison:
    """Read a pair. EXR, HDR and .npy are scene-linear, other pictures are decoded by what they say.

    The mask is the mask's picture (its values as they are, the mean of its channels), else the truth's
    alpha, else everything. `find_landmarks` looks for the truth's face, for Face dis, and raises InputError
    where there is none.
    """
    truth = _read(pair.truth)
    mask = truth.alpha
    if pair.mask is not None:
        mask = _read(pair.mask, colourspace="linear").pixels.mean(-1).clip(0, 1)
    if mask is None:
        mask = np.ones(truth.pixels.shape[:2], np.float32)
    landmarks_px = find_faces(truth.pixels, str(pair.truth))[0].landmarks_px if find_landmarks else None
    return Comparison(
        Case(pair.name, pair.person, pair.facts),
        truth.pixels,
        mask,
        {method: _read(path).pixels for method, path in pair.predictions.items()},
        landmarks_px=landmarks_px,
    )


def _check_folders(predictions: Sequence[Path], folders: Sequence[Path]) -> None:
    if not predictions:
        raise UsageError("no folder of predictions given")
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder")
    names = [folder_name(folder) for folder in predictions]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UsageError(
            f"two folders of predictions are called {twice[0]!r}; rename one, it names the method"
        )
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UsageError("a folder is given twice; predictions, truths and masks are to lie apart")


def _images_in(folder: Path, leave_out: Sequence[Path]) -> dict[str, Path]:
    """Pictures by name, hidden ones and those of folders to be left out not among them."""
    elsewhere = {other.resolve() for other in leave_out}
    found: dict[str, Path] = {}
    for here, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f[0] != "." and (Path(here) / f).resolve() not in elsewhere]
        for file in sorted(files):
            path = Path(here) / file
            if file[0] == "." or path.suffix.lower() not in SUFFIXES:
                continue
            name = path.relative_to(folder).with_suffix("").as_posix()
            if name in found:
                raise InputError(f"{folder}: {name} stands in {found[name].name} and {file}; leave one")
            found[name] = path
    if not found:
        raise UsageError(f"{folder}: no pictures there (looked for {' '.join(sorted(SUFFIXES))})")
    return found


def _mismatch(truths: Mapping[str, Path], others: Mapping[str, object], where: str) -> str | None:
    """What is amiss with names, in words; None where nothing is."""
    missing, strangers = sorted(truths.keys() - others.keys()), sorted(others.keys() - truths.keys())
    parts = [f"{len(missing)} of {len(truths)} missing ({_few(missing)})"] if missing else []
    parts += [f"{len(strangers)} without a truth ({_few(strangers)})"] if strangers else []
    return f"{where}: {', '.join(parts)}" if parts else None


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED_AT_MOST]) + (", ..." if len(names) > _NAMED_AT_MOST else "")


def _refuse(complaints: Sequence[str | None], advice: str) -> None:
    """Raise all complaints in one line, if there are any."""
    if said := [complaint for complaint in complaints if complaint]:
        raise InputError(f"{'; '.join(said)}: {advice}")


def _pair(
    name: str,
    truth: Path,
    predictions: Mapping[str, Path],
    masks: Mapping[str, Path],
    facts: Mapping[str, Facts],
) -> ImagePair:
    known = facts.get(name, Facts())
    person = known.person or name.split("/")[0]
    return ImagePair(name, truth, predictions, masks.get(name), person, known.values)


def _check_sizes(pairs: Sequence[ImagePair]) -> None:
    """Refuse pictures of other sizes than their truths; only headers are read."""
    wrong: dict[str, list[str]] = {}
    for pair in pairs:
        wanted = _size_px(pair.truth)
        files = dict(pair.predictions) | ({} if pair.mask is None else {"the masks": pair.mask})
        for method, path in files.items():
            if (size := _size_px(path)) != wanted:
                words = f"{pair.name} is {size[0]} x {size[1]}, its truth {wanted[0]} x {wanted[1]}"
                wrong.setdefault(method, []).append(words)
    complaints = [
        f"{method}: {len(names)} of {len(pairs)} have another size ({_few(names)})"
        for method, names in wrong.items()
    ]
    _refuse(complaints, "pictures are to have their truth's frame")


def _size_px(path: Path) -> tuple[int, int]:
    """Width and height of a picture on disk, upright."""
    if path.suffix.lower() == ".npy":
        height, width = read_array(path).shape[:2]
        return width, height
    stream = oiio.ImageInput.open(str(path))
    if stream is None:
        oiio.geterror()  # or it prints its own words at exit
        read_image(path)  # says what is the matter
        raise FacerfError(f"{path}: cannot be read")
    spec = stream.spec()
    stream.close()
    turned = spec.get_int_attribute("Orientation", 1) >= 5
    return (spec.full_height, spec.full_width) if turned else (spec.full_width, spec.full_height)


def _read(path: Path, colourspace: str | None = None) -> LinearImage:
    if path.suffix.lower() == ".npy":
        return LinearImage(read_array(path))
    return read_image(path, colourspace)
