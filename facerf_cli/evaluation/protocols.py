"""Protocols of `facerf evaluate`, by the names of their commands.

A protocol chooses the measured items, compares them one by one, and describes its tables; `run.py` does the
rest. To add a protocol, add an entry to `PROTOCOLS`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

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
    """Command of `facerf evaluate`; its functions take the options of the command."""

    name: str
    choose: Callable[[Any, Sequence[str]], Chosen]  # the items, from the options and the inputs
    compare: Callable[[Any, Bench, Any], Iterable[Comparison]]  # yield the comparisons of an item's content
    layout: Layout | None  # of the tables; None: only write images, for `compare`


def _faces(
    compare: Compare, options: FaceOptions, bench: Bench, faces: DatasetPerson | PhotoFaces
) -> Iterable[Comparison]:
    return faces.compared(compare, bench)


def notes(options: EvaluateOptions, chosen: Chosen) -> Iterator[str]:
    """Describe a run's choices in lines below its tables."""
    if options.has_field:
        ratio = "without" if options.network_alone else "with"
        yield f"The face field is used {ratio} the photo's ratio image."
    if isinstance(options, SolveOptions):
        squares = "non-negative, smooth least squares" if options.non_negative else "signed least squares"
        refined = "" if options.refine == "none" else f", refined by {options.refine}"
        yield f"The face field's light is estimated by {squares}{refined}."
    if isinstance(options, FaceOptions) and chosen.groups is not None:
        joint = "heads are fitted to all cameras of a person at once"
        separate = "each image is fitted separately, and images without a detected face are skipped"
        heads = joint if options.joint_fit else separate
        yield f"Split {options.split}: {chosen.groups} were chosen; {heads}."
    if isinstance(options, GeometryOptions):
        mean = options.mean_checkpoint
        trained = mean.stem if mean else "the same network, which was trained only on fitted faces"
        yield f"The mean face is rendered by {trained}; both faces are compared where both are visible."
    if isinstance(options, YaleOptions):
        database, _ = next(iter(chosen.items.values()))
        if options.ambient:
            yield f"Each flash has uniform light of {options.ambient:.3g} times the flash (--ambient)."
        aligned = (
            "aligned with their subject's frontal image (--shifts)" if database.shifts else "not aligned"
        )
        yield f"Images are {aligned}."
        marked, known = sum(map(len, database.marked.values())), len(database.left_out)
        yield f"Excluded from the database: {marked} images marked damaged and {known} known bad."
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
        compare_subject,
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
