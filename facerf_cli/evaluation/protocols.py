"""The protocols of `facerf evaluate`: `PROTOCOLS` has them by the command's name.

A protocol chooses what is measured, compares it item by item, and says what its tables show and note. A new
one is a row more; `run.py` measures, keeps and sums up.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from facerf_cli.capture.yale_b import YaleB
from facerf_cli.evaluation.comparisons import (
    compare_images,
    compare_olats,
    freeze,
    reconstruct,
    reconstruct_with_mean,
    transfer,
)
from facerf_cli.evaluation.folders import choose_cases
from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.options import (
    Chosen,
    CompareOptions,
    EvaluateOptions,
    FaceOptions,
    GeometryOptions,
    OlatOptions,
    ReconstructionOptions,
    TransferOptions,
    YaleOptions,
)
from facerf_cli.evaluation.people import Bench, Compare, DatasetPerson, PhotoFaces
from facerf_cli.evaluation.selection import choose_couples, choose_people, choose_sources, olat_pairs
from facerf_cli.evaluation.summary import Layout
from facerf_cli.evaluation.yale_b import SETTINGS_SUBJECTS, choose_subjects, compare_subject


@dataclass(frozen=True)
class Protocol:
    """A command of `facerf evaluate`; each function takes the protocol's own options.

    Attributes:
        name: The command.
        choose: Choose what is measured, by the options and the inputs of the command line.
        compare: Yield the comparisons of what one item holds.
        layout: The tables; None: images alone are written, for `compare`.
        notes: Yield the notes below them.
    """

    name: str
    choose: Callable[[Any, Sequence[str]], Chosen]
    compare: Callable[[Any, Bench, Any], Iterable[Comparison]]
    layout: Layout | None
    notes: Callable[[Any, Chosen], Iterable[str]]


def _faces(
    compare: Compare, options: FaceOptions, bench: Bench, faces: DatasetPerson | PhotoFaces
) -> Iterable[Comparison]:
    return faces.compared(compare, bench)


def _subject(options: YaleOptions, bench: Bench, subject: tuple[YaleB, str]) -> Iterable[Comparison]:
    return compare_subject(*subject, bench, options.room)


def _olat_notes(options: OlatOptions, chosen: Chosen) -> Iterator[str]:
    yield f"Split {options.split}. {_field_is(options, 'its source image')}"
    yield from _of_dataset(options, chosen)


def _reconstruction_notes(options: ReconstructionOptions, chosen: Chosen) -> Iterator[str]:
    yield _light_by(options)
    yield from _of_dataset(options, chosen)


def _transfer_notes(options: TransferOptions, chosen: Chosen) -> Iterator[str]:
    yield _field_is(options, "the photo that it is read from")
    yield _light_by(options)
    yield from _of_dataset(options, chosen)


def _geometry_notes(options: GeometryOptions, chosen: Chosen) -> Iterator[str]:
    mean = options.mean_checkpoint
    trained = mean.stem if mean else "the same network, trained on fitted faces only"
    yield f"The mean face is rendered by {trained}; both are compared where both show the face."


def _field_is(options: EvaluateOptions, corrected_by: str) -> str:
    return f"The field is {'the network alone' if options.network_alone else f'corrected by {corrected_by}'}."


def _light_by(options: EvaluateOptions) -> str:
    squares = "non-negative, smooth least squares" if options.non_negative else "signed least squares"
    refined = "" if options.refine == "none" else f", refined by {options.refine}"
    return f"The field's light is estimated by {squares}{refined}."


def _of_dataset(options: FaceOptions, chosen: Chosen) -> Iterator[str]:
    """Note the number of sources or couples."""
    if chosen.groups is not None and options.joint_fit:
        yield f"{chosen.groups} were chosen; heads are those fitted to all cameras of a person at once."
    elif chosen.groups is not None:
        missing = "those in which no face is found are left out. Each image is fitted alone."
        yield f"{chosen.groups} were chosen; {missing}"


def _yale_b_notes(options: YaleOptions, chosen: Chosen) -> Iterator[str]:
    subjects = {name for _, name in chosen.items.values()}
    database, _ = next(iter(chosen.items.values()))
    yield _field_is(options, "its source image")
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


def _compare_notes(options: CompareOptions, chosen: Chosen) -> Iterator[str]:
    if options.ours:
        yield _field_is(options, "its source image")


def _no_notes(options: EvaluateOptions, chosen: Chosen) -> Sequence[str]:
    return ()


_ALL = (
    Protocol(
        "olat",
        partial(choose_people, olat_pairs),
        partial(_faces, compare_olats),
        Layout(
            "Single lights of held-out people",
            ("si_mse", "si_mse_clipped", "ssim", "tone_drift_deg"),
            by=("pose", "turn", "angle", "tone"),
        ),
        _olat_notes,
    ),
    Protocol(
        "reconstruction",
        choose_sources,
        partial(_faces, reconstruct),
        Layout(
            "Photos explained and rendered again",
            ("si_mse", "face_distance", "ssim", "light_error_deg"),
            by=("tone",),
        ),
        _reconstruction_notes,
    ),
    Protocol(
        "transfer",
        choose_couples,
        partial(_faces, transfer),
        Layout(
            "Reflectances of two images of a person exchanged",
            ("si_mse", "face_distance", "si_mse_channels", "ssim"),
            by=("turn", "tone"),
        ),
        _transfer_notes,
    ),
    Protocol(
        "geometry",
        choose_sources,
        partial(_faces, reconstruct_with_mean),
        Layout(
            "The fitted face and the mean face in its pose", ("si_mse", "face_distance", "ssim"), by=("tone",)
        ),
        _geometry_notes,
    ),
    Protocol(
        "yale-b",
        choose_subjects,
        _subject,
        Layout(
            "Extended Yale B: real people relit to real point lights",
            ("si_mse", "ssim"),
            by=("column", "angle", "subjects"),
        ),
        _yale_b_notes,
    ),
    Protocol("cases", partial(choose_people, olat_pairs), partial(_faces, freeze), None, _no_notes),
    Protocol(
        "compare",
        choose_cases,
        compare_images,
        Layout("Predictions against {truth}", ("si_mse", "mse", "psnr", "ssim", "lpips", "face_distance")),
        _compare_notes,
    ),
)
PROTOCOLS = {protocol.name: protocol for protocol in _ALL}
