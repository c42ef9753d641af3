"""The protocols of `facerf evaluate`, a value each: `PROTOCOLS` has them by the verb's name.

A protocol chooses what is measured, compares it item by item, and says what its tables show and note. A new
one is one more value; `run.py` measures, keeps and sums up.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from facerf_cli.capture.yale_b import YaleB
from facerf_cli.evaluation.cases import compare_images, freeze
from facerf_cli.evaluation.comparisons import (
    COMPOSITE,
    LAMBERT,
    compare_olats,
    reconstruct,
    reconstruct_with_mean,
    transfer,
)
from facerf_cli.evaluation.folders import choose_cases
from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.options import Chosen, EvaluateOptions
from facerf_cli.evaluation.people import Bench, Compare, DatasetPerson, PhotoFaces
from facerf_cli.evaluation.selection import choose_couples, choose_people, choose_sources, olat_pairs
from facerf_cli.evaluation.summary import Layout
from facerf_cli.evaluation.yale_b import SETTINGS_SUBJECTS, choose_subjects, compare_subject

MakeBench = Callable[[], Bench]  # when a protocol needs it: it loads networks


@dataclass(frozen=True)
class Protocol:
    """A verb of `facerf evaluate`.

    Attributes:
        name: The verb.
        choose: Choose what is measured, by the options and the inputs of the command line.
        compare: Yield the comparisons of what one item holds.
        layout: The tables; None: images alone are written, for `compare`.
        notes: Yield the notes below them.
    """

    name: str
    choose: Callable[[EvaluateOptions, Sequence[str]], Chosen]
    compare: Callable[[EvaluateOptions, MakeBench, Any], Iterable[Comparison]]
    layout: Layout | None
    notes: Callable[[EvaluateOptions, Chosen], Iterable[str]] = lambda options, chosen: ()


def _faces(
    compare: Compare, options: EvaluateOptions, bench: MakeBench, faces: DatasetPerson | PhotoFaces
) -> Iterable[Comparison]:
    return faces.compared(compare, bench())


def _subject(options: EvaluateOptions, bench: MakeBench, subject: tuple[YaleB, str]) -> Iterable[Comparison]:
    return compare_subject(*subject, bench(), options.room)


def _olat_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    yield f"Split {options.split}. {_field_is(options, 'its source image')}"
    yield from _of_dataset(options, chosen)
    yield "si_mse_clipped clips the truth at white, as a camera does; otherwise a glint outweighs a face."
    yield (
        f"{LAMBERT} is the source's own texture under the cosine of the light, the least to beat; "
        f"{COMPOSITE} is the first method's image of `facerf relight`, with the photo's detail."
    )
    yield "tone_drift_deg is of the skin under lights within 25 degrees of the camera's axis."


def _reconstruction_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    yield "The field is the network's own: corrected by the photo it would be exact by construction."
    yield _light_by(options)
    yield from _of_dataset(options, chosen)


def _transfer_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    yield _field_is(options, "the photo that it is read from")
    why = "one photo cannot separate red light from red skin"
    yield f"si_mse_channels fits a scale for each channel: {why}."
    if chosen.groups is None:
        yield "Where expressions differ, mouths differ, which no reflectance describes."
    yield _light_by(options)
    yield from _of_dataset(options, chosen)


def _geometry_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    mean = options.mean_checkpoint
    trained = mean.stem if mean else "the same network, trained on fitted faces only"
    yield f"The mean face is rendered by {trained}; both are compared where both show the face."


def _field_is(options: EvaluateOptions, corrected_by: str) -> str:
    return f"The field is {'the network alone' if options.network_alone else f'corrected by {corrected_by}'}."


def _light_by(options: EvaluateOptions) -> str:
    squares = "non-negative, smooth least squares" if options.non_negative else "signed least squares"
    refined = "" if options.refine == "none" else f", refined by {options.refine}"
    return f"The field's light is estimated by {squares}{refined}."


def _of_dataset(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    """Note the number of sources or couples."""
    if chosen.groups is not None and options.joint_fit:
        yield f"{chosen.groups} were chosen; heads are those fitted to all cameras of a person at once."
    elif chosen.groups is not None:
        missing = "those in which no face is found are left out. Each image is fitted alone."
        yield f"{chosen.groups} were chosen; {missing}"


def _yale_b_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    subjects = {name for _, name in chosen.items.values()}
    database, _ = next(iter(chosen.items.values()))
    yield _field_is(options, "its source image")
    yield "Grey images, values as given, which are close to linear in light; the mask is one ellipse."
    yield "The flashes' strength is not known: metrics that do not fit a scale (MSE, PSNR) say little."
    if options.room:
        yield f"Each flash comes with {options.room:.3g} of its light from all around, as of a room (--room)."
    if database.shifts:
        yield "Images are aligned to their subject's frontal one by the given shifts."
    else:
        yield "Images are not aligned (no --shifts)."
    marked, known = sum(map(len, database.marked.values())), len(database.left_out)
    yield f"Left out of all subjects there: {marked} images marked as damaged, {known} known to be."
    if settings := sorted(subjects & set(SETTINGS_SUBJECTS)):
        yield f"Settings were chosen on {', '.join(settings)}."


def _compare_notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    if options.ours:
        yield _field_is(options, "its source image")
        yield "In the source's pose images of facerf are those of `facerf relight`, in others the face alone."


OLAT = Protocol(
    "olat",
    partial(choose_people, olat_pairs),
    partial(_faces, compare_olats),
    Layout(
        "Single lights of held-out people",
        ("si_mse", "si_mse_clipped", "ssim", "tone_drift_deg"),
        by=("pose", "turn", "angle", "tone"),
    ),
    _olat_notes,
)
RECONSTRUCTION = Protocol(
    "reconstruction",
    choose_sources,
    partial(_faces, reconstruct),
    Layout(
        "Photos explained and rendered again",
        ("si_mse", "face_distance", "ssim", "light_error_deg"),
        by=("tone",),
    ),
    _reconstruction_notes,
)
TRANSFER = Protocol(
    "transfer",
    choose_couples,
    partial(_faces, transfer),
    Layout(
        "Reflectances of two images of a person exchanged",
        ("si_mse", "face_distance", "si_mse_channels", "ssim"),
        by=("turn", "tone"),
    ),
    _transfer_notes,
)
GEOMETRY = Protocol(
    "geometry",
    choose_sources,
    partial(_faces, reconstruct_with_mean),
    Layout(
        "The fitted face and the mean face in its pose", ("si_mse", "face_distance", "ssim"), by=("tone",)
    ),
    _geometry_notes,
)
YALE_B = Protocol(
    "yale-b",
    choose_subjects,
    _subject,
    Layout(
        "Extended Yale B: real people relit to real point lights",
        ("si_mse", "ssim"),
        by=("column", "angle", "subjects"),
    ),
    _yale_b_notes,
)
CASES = Protocol("cases", partial(choose_people, olat_pairs), partial(_faces, freeze), None)
COMPARE = Protocol(
    "compare",
    choose_cases,
    compare_images,
    Layout("Predictions against {truth}", ("si_mse", "mse", "psnr", "ssim", "lpips", "face_distance")),
    _compare_notes,
)
PROTOCOLS = {one.name: one for one in (OLAT, RECONSTRUCTION, TRANSFER, GEOMETRY, YALE_B, CASES, COMPARE)}
