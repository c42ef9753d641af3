"""Real people relit to real point lights, next to their images under these lights (Extended Yale B).

Each source is a user's photo: it is fitted, unwrapped, relit under all of its targets at once and composed
into its own frame, as `facerf relight` does. The light is given here and not estimated.

Figures of other methods are those of the README of the benchmark that the cases come from, of the same images
of 21 subjects: Si-MSE and SSIM by kind of source and target, Si-MSE by the angle between flash and camera.
DPR: Zhou et al., ICCV 2019. GeomConsistentFR: Hou et al., CVPR 2022.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch

from facerf_cli.capture.yale_b import YaleB
from facerf_cli.composite import Target
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.protocols.yale_b_cases import (
    ANGLES_DEG,
    SETTINGS_SUBJECTS,
    Question,
    Sitter,
    face_mask,
)
from facerf_cli.evaluation.published import PublishedFigure
from facerf_cli.evaluation.summary import Layout
from facerf_cli.face.fit import Geometry
from facerf_cli.face.head import Head
from facerf_cli.face.landmarks import FaceBox
from facerf_cli.light.studio import StudioLight
from facerf_cli.light.studio_points import far_samples
from facerf_cli.pipeline import find_for, head_of
from facerf_cli.portrait.find import LandmarksFrom

COLUMNS = ("frontal", "soft", "environment")
PEERS = ("DPR", "GeomConsistentFR")
SHOWN = ("copy of the source", *PEERS, "quotient image")
KNOWS_MORE = (  # learn from other subjects under the same flashes
    "others' mean",
    "others' Lambert",
    "quotient image",
)
PUBLISHED_SUBJECTS = 21
_SOURCE = "Yale B"
_SAME = f"same images, {PUBLISHED_SUBJECTS} people"
_MORE = _SAME + ", given more data"

# (Si-MSE, SSIM) by column, then Si-MSE by angle.
FIGURES: dict[str, tuple[tuple[tuple[float, float], ...], tuple[float, ...]]] = {
    "copy of the source": (
        ((0.0299, 0.609), (0.0512, 0.495), (0.0361, 0.646)),
        (0.0044, 0.0122, 0.0308, 0.0540, 0.0570),
    ),
    "DPR": (
        ((0.0111, 0.686), (0.0131, 0.641), (0.0145, 0.729)),
        (0.0057, 0.0080, 0.0122, 0.0164, 0.0155),
    ),
    "GeomConsistentFR": (
        ((0.0119, 0.674), (0.0151, 0.629), (0.0145, 0.709)),
        (0.0055, 0.0101, 0.0139, 0.0178, 0.0145),
    ),
    "others' mean": (
        ((0.0123, 0.610), (0.0123, 0.619), (0.0121, 0.654)),
        (0.0123, 0.0129, 0.0131, 0.0150, 0.0100),
    ),
    "others' Lambert": (
        ((0.0092, 0.672), (0.0125, 0.616), (0.0109, 0.760)),
        (0.0025, 0.0055, 0.0119, 0.0151, 0.0134),
    ),
    "quotient image": (
        ((0.0074, 0.751), (0.0093, 0.724), (0.0078, 0.789)),
        (0.0024, 0.0046, 0.0094, 0.0120, 0.0105),
    ),
}


def layout(
    database: YaleB, subjects: Sequence[str], network_alone: bool = False, room: float = 0.0
) -> Layout:
    """The contents of the tables, and the notes below them."""
    return Layout(
        name="yale-b",
        title="Extended Yale B: real people relit to real point lights",
        metrics=("si_mse", "ssim"),
        by=("column", "angle", "subjects"),
        published=published(),
        notes=tuple(_notes(database, subjects, network_alone, room)),
    )


def _notes(database: YaleB, subjects: Sequence[str], network_alone: bool, room: float) -> Iterator[str]:
    """Notes below the figures."""
    yield f"The field is {'the network alone' if network_alone else 'corrected by its source image'}."
    yield "Grey images, values as given, which are close to linear in light; the mask is one ellipse."
    yield "The flashes' strength is not known: metrics that do not fit a scale (MSE, PSNR) say little."
    if room:
        yield f"Each flash comes with {room:.3g} of its light from all around, as of a room (--room)."
    if database.shifts:
        yield "Images are aligned to their subject's frontal one by the given shifts."
    else:
        yield "Images are not aligned (no --shifts); the published figures are of aligned ones."
    marked, known = len(database.marked_damaged), len(database.left_out)
    yield f"Left out of all subjects there: {marked} images marked as damaged, {known} known to be."
    yield (
        f"Published rows are of the same images, aligned, of {PUBLISHED_SUBJECTS} subjects, by the benchmark "
        f"that they come from; here are {len(subjects)}. The quotient image knows more than one photo: other "
        "subjects under the same flashes."
    )
    if chosen := sorted(set(subjects) & set(SETTINGS_SUBJECTS)):
        yield f"Settings were chosen on {', '.join(chosen)}."


def published() -> tuple[PublishedFigure, ...]:
    """The published rows for the tables."""
    rows: list[PublishedFigure] = []

    def add(method: str, metric: str, mean: float, group: tuple[str, str], digits: int) -> None:
        data = _MORE if method in KNOWS_MORE else _SAME
        rows.append(PublishedFigure(method, metric, mean, None, group, _SOURCE, data, digits))

    for method in SHOWN:
        by_column, by_angle = FIGURES[method]
        for column, (si_mse, ssim) in zip(COLUMNS, by_column, strict=True):
            add(method, "si_mse", si_mse, ("column", column), 4)
            add(method, "ssim", ssim, ("column", column), 3)
        for (low, high), si_mse in zip(pairwise(ANGLES_DEG), by_angle, strict=True):
            add(method, "si_mse", si_mse, ("angle", f"{low}-{high} deg"), 4)
    return tuple(rows)


def compare_sitter(
    database: YaleB,
    subject: str,
    methods: Sequence[Method],
    network_alone: bool = False,
    geometry: Geometry = "landmarks",
    landmarks_from: LandmarksFrom = "facerf",
    room: float = 0.0,
) -> Iterator[Comparison]:
    """Yield all of a subject's cases, a source at a time: each method's image next to the subject's own.

    `room` is what the room sends back from all around, as a share of what a flash sends. A subject's sources
    share the landmarks, or the box, of its frontal image. Raises InputError where no face is found in that,
    or an image cannot be read.
    """
    sitter = Sitter(database, subject)
    questions = list(sitter.questions())
    frontal = sitter.image("frontal")
    name = str(database.folder / subject)
    face = find_for(geometry, _rgb(frontal), name, landmarks_from=landmarks_from)[0]
    for source in dict.fromkeys(question.source for question in questions):
        asked = [question for question in questions if question.source == source]
        photo = sitter.image(source)
        relit = _relit_by_all(sitter, photo, face, asked, methods, network_alone, room)
        for row, question in enumerate(asked):
            yield Comparison(
                case=_case(subject, question),
                truth=_rgb(sitter.image(question.light)),
                mask=face_mask().astype(np.float32),
                predictions={name: _rgb(images[row]) for name, images in relit.items()},
                source=_rgb(photo),
                grey_as_given=True,
            )


def _case(subject: str, question: Question) -> Case:
    """The case, named by the path of its prediction in the benchmark."""
    facts: dict[str, str | float] = {"column": question.column, "source": question.source}
    if question.angle_bin is not None:
        facts["angle"] = question.angle_bin
    facts["subjects"] = "settings" if subject in SETTINGS_SUBJECTS else "test"
    if question.angle_deg is not None:
        facts["angle_deg"] = question.angle_deg
    return Case(f"{subject}/{question.source}/{question.light}", subject, facts)


def _rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, -1).astype(np.float32)


def _relit_by_all(
    sitter: Sitter,
    photo: np.ndarray,
    face: FaceBox,
    asked: Sequence[Question],
    methods: Sequence[Method],
    network_alone: bool,
    room: float,
) -> Mapping[str, list[np.ndarray]]:
    """The images [H, W] of a source under every light of the questions, by method."""
    weights = torch.from_numpy(np.stack([sitter.weights(question.light) for question in asked])).float()
    used = weights.sum(0) > 0
    directions = torch.from_numpy(np.stack([flash.direction for flash in sitter.flashes])).float()[used]
    weights = weights[:, used]
    if room:
        around, share = far_samples(StudioLight())
        directions = torch.cat([directions, around])
        weights = torch.cat([weights, room * share * weights.sum(1, keepdim=True)], 1)
    rgb_weights = weights[..., None].expand(-1, -1, 3)
    pixels, heads = _rgb(photo), dict[int, Head]()
    relit = {}
    for method in methods:
        key = id(method.models)  # methods over the same networks share the fit
        if key not in heads:
            heads[key] = head_of(method.models, pixels, face)
        images = method.images(pixels, heads[key], directions, rgb_weights, Target(), network_alone)
        relit[method.name] = [image.mean(-1).clip(min=0) for image in images]
    return relit
