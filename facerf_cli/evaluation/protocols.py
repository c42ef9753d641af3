"""The protocols of `facerf evaluate`: `PROTOCOLS` has them by the command's name.

A protocol chooses what is measured, compares it item by item, and says what its tables show. A new one is a
row more; `run.py` measures, keeps and sums up.
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
    EvaluateOptions,
    FaceOptions,
    GeometryOptions,
    YaleOptions,
)
from facerf_cli.evaluation.people import Bench, Compare, DatasetPerson, PhotoFaces
from facerf_cli.evaluation.selection import choose_couples, choose_people, choose_sources, olat_pairs
from facerf_cli.evaluation.summary import Layout
from facerf_cli.evaluation.yale_b import SETTINGS_SUBJECTS, choose_subjects, compare_subject
from facerf_cli.work.photo_options import SolveOptions


@dataclass(frozen=True)
class Protocol:
    """A command of `facerf evaluate`; each function takes the protocol's own options.

    Attributes:
        name: The command.
        choose: Choose what is measured, by the options and the inputs of the command line.
        compare: Yield the comparisons of what one item holds.
        layout: The tables; None: images alone are written, for `compare`.
    """

    name: str
    choose: Callable[[Any, Sequence[str]], Chosen]
    compare: Callable[[Any, Bench, Any], Iterable[Comparison]]
    layout: Layout | None


def _faces(
    compare: Compare, options: FaceOptions, bench: Bench, faces: DatasetPerson | PhotoFaces
) -> Iterable[Comparison]:
    return faces.compared(compare, bench)


def _subject(options: YaleOptions, bench: Bench, subject: tuple[YaleB, str]) -> Iterable[Comparison]:
    return compare_subject(*subject, bench, options.room)


def notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    """Yield what a run chose, for the lines below its tables."""
    if options.has_field:
        by = "the network alone" if options.network_alone else "corrected by the photo that it is read from"
        yield f"The field is {by}."
    if isinstance(options, SolveOptions):
        squares = "non-negative, smooth least squares" if options.non_negative else "signed least squares"
        refined = "" if options.refine == "none" else f", refined by {options.refine}"
        yield f"The field's light is estimated by {squares}{refined}."
    if isinstance(options, FaceOptions) and chosen.groups is not None:
        heads = "heads are those fitted to all cameras of a person at once"
        alone = "each image is fitted alone, and those in which no face is found are left out"
        yield f"Split {options.split}: {chosen.groups} were chosen; {heads if options.joint_fit else alone}."
    if isinstance(options, GeometryOptions):
        mean = options.mean_checkpoint
        trained = mean.stem if mean else "the same network, trained on fitted faces only"
        yield f"The mean face is rendered by {trained}; both are compared where both show the face."
    if isinstance(options, YaleOptions):
        yield from _yale_b_notes(options, chosen)


def _yale_b_notes(options: YaleOptions, chosen: Chosen) -> Iterator[str]:
    database, _ = next(iter(chosen.items.values()))
    if options.room:
        yield f"Each flash comes with {options.room:.3g} of its light from all around, as of a room (--room)."
    by = "aligned to their subject's frontal one by the given shifts" if database.shifts else "not aligned"
    yield f"Images are {by}."
    marked, known = sum(map(len, database.marked.values())), len(database.left_out)
    yield f"Left out of all subjects there: {marked} images marked as damaged, {known} known to be."
    if settings := sorted({name for _, name in chosen.items.values()} & set(SETTINGS_SUBJECTS)):
        yield f"Settings were chosen on {', '.join(settings)}."


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
    ),
    Protocol(
        "geometry",
        choose_sources,
        partial(_faces, reconstruct_with_mean),
        Layout(
            "The fitted face and the mean face in its pose", ("si_mse", "face_distance", "ssim"), by=("tone",)
        ),
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
    ),
    Protocol("cases", partial(choose_people, olat_pairs), partial(_faces, freeze), None),
    Protocol(
        "compare",
        choose_cases,
        compare_images,
        Layout("Predictions against {truth}", ("si_mse", "mse", "psnr", "ssim", "lpips", "face_distance")),
    ),
)
PROTOCOLS = {protocol.name: protocol for protocol in _ALL}
